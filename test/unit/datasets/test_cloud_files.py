"""Clouds in files of every format, and what is wrong with them."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from calib_ros.datasets.cloud_files import read_cloud
from calib_ros.errors import BadInputError, MissingDependencyError


def cloud(seed: int = 0, count: int = 50) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1000 + seed)
    xyz = rng.normal(scale=10, size=(count, 3)).astype("<f4")
    return {
        **dict(zip("xyz", xyz.T, strict=True)),
        "intensity": rng.random(count).astype("<f4"),
        "ring": rng.integers(0, 32, count).astype("<u2"),
        "time": np.linspace(-0.05, 0.05, count).astype("<f4"),
    }


def pcd_header(columns: dict[str, np.ndarray], data: str) -> bytes:
    kinds = {"f": "F", "u": "U", "i": "I"}
    count = len(columns["x"])
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(columns),
        "SIZE " + " ".join(str(c.dtype.itemsize) for c in columns.values()),
        "TYPE " + " ".join(kinds[c.dtype.kind] for c in columns.values()),
        "COUNT " + " ".join("1" for _ in columns),
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        f"DATA {data}",
    ]
    return ("\n".join(lines) + "\n").encode()


def records(columns: dict[str, np.ndarray]) -> np.ndarray:
    return np.rec.fromarrays(list(columns.values()), names=list(columns))


def written(path: Path, columns: dict[str, np.ndarray]) -> None:
    """A cloud in the format of the path's ending; `NAME.ascii.pcd` and the like name the encoding."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = records(columns)
    text = "\n".join(" ".join(repr(v.item()) for v in row) for row in rows) + "\n"
    count, encoding = len(rows), path.suffixes[0]
    if path.suffix == ".pcd":
        blocks = b"".join(column.tobytes() for column in columns.values())
        data = {
            ".ascii": ("ascii", text.encode()),
            ".binary": ("binary", rows.tobytes()),
            ".compressed": ("binary_compressed", struct.pack("<II", len(packed := literal_lzf(blocks)), len(blocks)) + packed),
        }
        kind, body = data.get(encoding, data[".binary"])
        path.write_bytes(pcd_header(columns, kind) + body)
    elif path.suffix == ".ply":
        names = {"f4": "float", "u2": "ushort", "f8": "double"}
        kind = {".ascii": "ascii", ".binary": "binary_little_endian", ".big": "binary_big_endian"}[encoding]
        lines = ["ply", f"format {kind} 1.0", "comment by a test", f"element vertex {count}"]
        lines += [f"property {names[column.dtype.str[1:]]} {name}" for name, column in columns.items()]
        order = ">" if encoding == ".big" else "<"
        body = text.encode() if encoding == ".ascii" else rows.astype(rows.dtype.newbyteorder(order)).tobytes()
        path.write_bytes("\n".join([*lines, "end_header\n"]).encode() + body)
    elif path.suffix in (".las", ".laz"):
        laspy = pytest.importorskip("laspy")
        kind, version = (1, "1.2") if path.suffix == ".las" else (6, "1.4")
        file = laspy.create(point_format=kind, file_version=version)
        file.header.scales = [2.0**-20] * 3
        file.x, file.y, file.z = (np.nan_to_num(columns[axis].astype(float)) for axis in "xyz")
        file.intensity, file.gps_time = np.round(columns["intensity"] * 65535).astype(np.uint16), columns["time"]
        file.write(path)
    elif path.suffix in (".csv", ".xyz", ".pts"):
        between = {".csv": ", ", ".xyz": " ", ".pts": "\t"}[path.suffix]
        lines = [between.join(repr(v.item()) for v in row) for row in rows]
        head = {".csv": [between.join(columns)], ".xyz": ["# " + between.join(columns)], ".pts": [str(count)]}[path.suffix]
        path.write_text("\n".join([*head, *lines]) + "\n")
    elif path.suffix == ".bin":
        np.stack([columns[name] for name in ("x", "y", "z", "intensity")], axis=1).astype("<f4").tofile(path)
    elif encoding == ".points":
        rest = {name: column for name, column in columns.items() if name not in "xyz"}
        np.savez(path, points=np.stack([columns[axis] for axis in "xyz"], axis=1), **rest)
    else:
        np.savez_compressed(path, **columns)


def literal_lzf(data: bytes) -> bytes:
    """LZF without back references: runs of up to 32 bytes, each behind its length less one."""
    runs = (data[k : k + 32] for k in range(0, len(data), 32))
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


@pytest.mark.parametrize(
    "name",
    [
        "a.ascii.pcd", "a.binary.pcd", "a.compressed.pcd", "a.ascii.ply", "a.binary.ply", "a.big.ply", "a.bin",
        "a.points.npz", "a.columns.npz", "a.csv", "a.xyz",
    ],
)  # fmt: skip
def test_every_format_gives_the_same_points(tmp_path, name):
    columns = cloud(3)
    columns["x"][7] = np.nan
    path = tmp_path / name
    written(path, columns)
    found = read_cloud(path)
    assert np.array_equal(found.xyz, np.stack([columns[axis] for axis in "xyz"], axis=1), equal_nan=True)
    assert np.array_equal(found.intensity, columns["intensity"])
    assert found.finite().xyz.shape == (49, 3)
    if path.suffix == ".bin":
        assert (found.ring, found.time) == (None, None)
    else:
        assert np.array_equal(found.ring, columns["ring"])
        assert np.allclose(found.time, columns["time"], atol=1e-9)


@pytest.mark.parametrize("name", ["a.las", "a.laz", "a.pts"])
def test_formats_of_surveyors(tmp_path, name):
    """LAS and LAZ have integers with a scale, and no rings; a .pts begins with the number of its points."""
    columns = cloud(3)
    written(tmp_path / name, columns)
    found = read_cloud(tmp_path / name)
    assert np.allclose(found.xyz, np.stack([columns[axis] for axis in "xyz"], axis=1), atol=1e-5)
    assert found.ring is None
    assert np.corrcoef(found.intensity, columns["intensity"])[0, 1] > 0.999


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x,y,z,label\n1,2,3,car\n4,5,6,7\n", [[1, 2, 3], [4, 5, 6]]),
        ("x;y;z;intensity\n1,5;2,25;3,5;7\n", [[1.5, 2.25, 3.5]]),
        ("# frame 12 of it\n# x y z i\n1 2 3 4\n", [[1, 2, 3]]),
        ("1.e+00 2.e+00 3.E0 4\n", [[1, 2, 3]]),
        ("// from a tool\n1\t2\t3\n\n4\t5\tnan\n", [[1, 2, 3], [4, 5, np.nan]]),
    ],
)
def test_text_clouds_as_tools_write_them(tmp_path, text, expected):
    (tmp_path / "a.txt").write_text(text)
    assert np.array_equal(read_cloud(tmp_path / "a.txt").xyz, np.array(expected, np.float32), equal_nan=True)
    (tmp_path / "a.txt").write_text("what\nis this\n")
    with pytest.raises(BadInputError, match=r"cloud .*txt"):
        read_cloud(tmp_path / "a.txt")


def test_a_scan_in_firing_order_keeps_all_its_points(tmp_path):
    """Of lasers that alternate between up and down: every second point is nearer than the next one."""
    azimuth, elevation = np.linspace(0, 2 * np.pi, 1000).repeat(16), np.tile(np.arange(-15, 16, 2).reshape(2, 8).T.ravel(), 1000)
    e = np.deg2rad(elevation)
    xyz = 8 * np.stack([np.cos(e) * np.cos(azimuth), np.cos(e) * np.sin(azimuth), np.sin(e)], axis=1)
    np.hstack([xyz, np.ones((len(xyz), 1))]).astype("<f4").tofile(tmp_path / "a.bin")
    assert len(read_cloud(tmp_path / "a.bin")) == len(xyz)


@pytest.mark.parametrize("shuffled", [False, True])
@pytest.mark.parametrize("more", [-1, 0, 1, 2, 3, 4])
def test_scans_of_other_numbers_than_four_are_recognised(tmp_path, more, shuffled):
    """Along a ring, neighbours are near each other; other numbers taken for coordinates are not. In any order, the numbers of a
    point differ by their places."""
    azimuth, rng = np.linspace(0, 2 * np.pi, 2000, dtype=np.float32), np.random.default_rng(0)
    xyz = np.stack([12 * np.cos(azimuth), 9 * np.sin(azimuth), np.full(2000, -1.5)], axis=1)
    rows = np.hstack([xyz, rng.random((2000, 1 + more)) * 60]).astype("<f4")
    rows = rng.permutation(rows) if shuffled else rows
    path = tmp_path / "a.bin"
    rows.tofile(path)
    found = read_cloud(path)
    assert np.array_equal(found.xyz, rows[:, :3])
    assert found.intensity is None if more < 0 else np.array_equal(found.intensity, rows[:, 3])
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(BadInputError, match="truncated"):
        read_cloud(path)
    rng.normal(size=240).astype("<f4").tofile(path)
    with pytest.raises(BadInputError, match="has 3 or 4 or 5 or 6 or 8 numbers a point, which they do not tell"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("intensity", "ring", "time", "unit"), [("i", "channel", "t", 1e9), ("Reflectivity", "laser_id", "timestamp", 1e6)]
)
def test_fields_go_by_the_names_and_units_of_drivers(tmp_path, intensity, ring, time, unit):
    columns = cloud(4)
    named = {axis: columns[axis] for axis in "xyz"}
    named |= {intensity: columns["intensity"], ring: columns["ring"], time: columns["time"].astype("<f8") * unit}
    written(tmp_path / "a.binary.pcd", named)
    found = read_cloud(tmp_path / "a.binary.pcd")
    assert np.array_equal(found.intensity, columns["intensity"])
    assert np.array_equal(found.ring, columns["ring"])
    assert np.allclose(found.time, columns["time"], atol=1e-7)


def test_pcd_as_loosely_as_pcl_reads_it(tmp_path):
    path = tmp_path / "a.ascii.pcd"
    written(path, cloud(3))
    expected = read_cloud(path)
    head, _, body = path.read_text().partition("DATA ascii\n")
    head = "".join(line for line in head.splitlines(keepends=True) if not line.startswith(("COUNT", "#", "VIEWPOINT")))
    path.write_bytes((head + "DATA ascii\n" + body.replace(" ", "\t").replace("\n", " \n")).replace("\n", "\r\n").encode())
    found = read_cloud(path)
    assert np.array_equal(found.xyz, expected.xyz)
    assert np.array_equal(found.ring, expected.ring)


@pytest.mark.parametrize("padded", [False, True])
def test_padding_in_pcd_and_prefixes_in_ply(tmp_path, padded):
    """PCL pads its points with fields "_"; CloudCompare writes "scalar_" before the names of fields."""
    columns = cloud(3)
    xyz = np.stack([columns[axis] for axis in "xyz"], axis=1)
    kinds = [(axis, "<f4") for axis in "xyz"] + [("_a", "u1", 4), ("intensity", "<f4"), ("ring", "<u2"), ("_b", "u1", 2)]
    rows = np.zeros(50, kinds)
    for name in ("x", "y", "z", "intensity", "ring"):
        rows[name] = columns[name]
    head = "VERSION 0.7\nFIELDS x y z _ intensity ring _\nSIZE 4 4 4 1 4 2 1\nTYPE F F F U F U U\nCOUNT 1 1 1 4 1 1 2\n"
    head += "WIDTH 25\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 50\nDATA binary\n"
    # Of a field of COUNT 0 there are no bytes.
    empty = ("z _", "z w _"), ("4 4 4 1", "4 4 4 8 1"), ("F F F U", "F F F F U"), ("1 1 1 4", "1 1 1 0 4")
    for before, after in empty if padded else ():
        head = head.replace(before, after, 1)
    (tmp_path / "a.pcd").write_bytes(head.encode() + rows.tobytes())
    assert read_cloud(tmp_path / "a.pcd").time is None
    written(tmp_path / "a.ascii.ply", {name if name in "xyz" else f"scalar_{name.title()}": c for name, c in columns.items()})
    for path in (tmp_path / "a.pcd", tmp_path / "a.ascii.ply"):
        found = read_cloud(path)
        for values, expected in ((found.xyz, xyz), (found.intensity, columns["intensity"]), (found.ring, columns["ring"])):
            assert np.array_equal(values, expected)


@pytest.mark.parametrize(("line", "more"), [("COUNT 1", "COUNT 4294967295"), ("POINTS 50", "POINTS 4294967295")])
def test_a_pcd_that_declares_more_than_it_holds_costs_nothing(tmp_path, line, more):
    written(tmp_path / "a.compressed.pcd", cloud(3))
    data = (tmp_path / "a.compressed.pcd").read_bytes()
    (tmp_path / "a.compressed.pcd").write_bytes(data.replace(line.encode(), more.encode(), 1))
    with pytest.raises(BadInputError, match="declares more than its"):
        read_cloud(tmp_path / "a.compressed.pcd")


@pytest.mark.parametrize("at", [100, 107, 243, 247, "chunks"])
def test_a_laz_that_declares_more_than_it_holds_costs_nothing(tmp_path, at):
    """Reading on, lazrs would end the process."""
    pytest.importorskip("laspy")
    path = tmp_path / "a.laz"
    written(path, cloud(3))
    data = bytearray(path.read_bytes())
    if at == "chunks":
        (begin,) = struct.unpack_from("<I", data, 96)
        at = struct.unpack_from("<q", data, begin)[0] + 4
    data[at : at + 4] = b"\xff\xff\xff\x5f"
    path.write_bytes(data)
    if at == 107:  # of files before version 1.4
        assert len(read_cloud(path)) == 50
        return
    with pytest.raises(BadInputError, match="its header speaks of"):
        read_cloud(path)


def test_a_laz_over_which_its_library_panics_is_refused(tmp_path):
    pytest.importorskip("laspy")
    path = tmp_path / "a.laz"
    written(path, cloud(3))
    data = bytearray(path.read_bytes())
    at = data.index(b"laszip encoded") - 2 + 54
    (items,) = struct.unpack_from("<H", data, at + 32)
    for k in range(items):
        struct.pack_into("<H", data, at + 34 + 6 * k + 2, 0)  # its size
    path.write_bytes(data)
    with pytest.raises(BadInputError, match="is damaged"):
        read_cloud(path)


def test_truncation_is_noticed_also_between_points(tmp_path):
    for name in ("a.compressed.pcd", "a.binary.ply", "a.columns.npz"):
        written(tmp_path / name, cloud(3))
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:260])
        with pytest.raises(BadInputError, match="copy it again"):
            read_cloud(tmp_path / name)
    for name in ("a.ascii.pcd", "a.binary.pcd", "a.ascii.ply"):
        path, columns = tmp_path / name, cloud(3)
        written(path, columns)
        data = path.read_bytes()
        last = data.splitlines(keepends=True)[-1] if "ascii" in name else b"0" * records(columns).itemsize
        path.write_bytes(data[: -len(last)])
        with pytest.raises(BadInputError, match="truncated: 49 of 50 points"):
            read_cloud(path)


def test_clouds_without_coordinates_and_arrays_of_wrong_shapes_are_refused(tmp_path):
    columns = cloud()
    columns["height"] = columns.pop("z")
    for name in ("a.binary.pcd", "a.ascii.ply", "a.columns.npz"):
        written(tmp_path / name, columns)
        with pytest.raises(BadInputError, match="z"):
            read_cloud(tmp_path / name)
    for arrays, says in (
        ({"xyz": np.zeros((5, 4))}, r"xyz has shape \(5, 4\), but must be \(n, 3\)"),
        ({"xyz": np.zeros((5, 3)), "ring": np.zeros(4)}, r"field ring has shape \(4,\), but there are 5 points"),
        ({"xyz": np.array([{}], object)}, "damaged"),
    ):
        np.savez(tmp_path / "a.npz", **arrays)
        with pytest.raises(BadInputError, match=says):
            read_cloud(tmp_path / "a.npz")


@pytest.mark.parametrize(("name", "library"), [("a.binary.pcd", "pypcd4"), ("a.binary.ply", "trimesh")])
def test_a_missing_library_is_named_with_its_pip_line(tmp_path, monkeypatch, name, library):
    written(tmp_path / name, cloud())
    for module in [m for m in sys.modules if m.partition(".")[0] == library] + [library]:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependencyError, match=f"pip install {library}"):
        read_cloud(tmp_path / name)
