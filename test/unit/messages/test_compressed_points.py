"""Clouds compressed by the plugins of point_cloud_transport, and videos' packets, as messages."""

from __future__ import annotations

import gzip
import sys

import numpy as np
import pytest
from bag_recorder import MS, START, Recorder
from ros_messages import STAMP, Messages, draco

from calib_ros.datasets.bag import BagSource
from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.messages import decode_cloud, decode_compressed_cloud
from calib_ros.messages.compressed_points import _draco_points

ROS = Messages("rosbags")
FIELDS = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("t", "<u4")]


def points(count: int = 50, kinds: list[tuple[str, str]] = FIELDS) -> np.ndarray:
    rng = np.random.default_rng(0)
    made = np.zeros(count, kinds)
    for name in "xyz":
        made[name] = rng.normal(0, 20, count)
    made["intensity"], made["ring"] = rng.integers(0, 255, count), np.arange(count) % 16
    for name in {"t", "timestamp"} & {name for name, _ in kinds}:
        made[name] = np.linspace(0, 1e8, count) if name == "t" else STAMP * 1e-9 + np.linspace(0, 0.1, count)
    return made


@pytest.mark.parametrize("layout", ["zlib", "zstd", "draco"])
def test_a_compressed_cloud_is_that_which_was_compressed(layout):
    if layout == "draco":
        pytest.importorskip("DracoPy", reason="DracoPy is not installed")
    cloud, raw = decode_compressed_cloud(ROS.compressed_cloud(points(), layout)), decode_cloud(ROS.cloud(points()))
    for name in ("xyz", "intensity", "ring", "time"):
        assert np.array_equal(getattr(cloud, name), getattr(raw, name)), name
    assert cloud.time is not None
    assert cloud.time[-1] == pytest.approx(0.1)


@pytest.mark.parametrize("layout", ["zlib", "zstd", "draco"])
def test_damaged_data_is_refused(layout):
    if layout == "draco":
        pytest.importorskip("DracoPy", reason="DracoPy is not installed")
    message = ROS.compressed_cloud(points(), layout)
    data = message.compressed_data.tobytes()
    for damaged in (b"", data[: len(data) // 2], bytes(len(data))):
        message.compressed_data = ROS.data(damaged)
        with pytest.raises(BadInputError, match=r"is damaged|is truncated"):
            decode_compressed_cloud(message)
    message.height = 2**20
    with pytest.raises(BadInputError, match=r"more than any scan has|is damaged"):
        decode_compressed_cloud(message)


def test_no_more_is_unpacked_than_the_cloud_has():
    cloud = decode_compressed_cloud(ROS.compressed_cloud(points(), "zlib", gzip.compress(bytes(2**26))))
    assert (cloud.xyz == 0).all()
    assert len(cloud) == 50


def test_times_that_draco_loses_and_fields_that_it_has_not_are_told(monkeypatch):
    pytest.importorskip("DracoPy", reason="DracoPy is not installed")
    made = points(kinds=[*FIELDS[:5], ("timestamp", "<f8")])
    cloud = decode_compressed_cloud(ROS.compressed_cloud(made, "draco"))
    assert np.array_equal(cloud.xyz[:, 2], made["z"])
    assert cloud.time is None
    assert "float64 are lost in decoding Draco" in cloud.time_problem
    with pytest.raises(BadInputError, match=r"5 attributes of Draco for 6 fields; republish the cloud as raw"):
        decode_compressed_cloud(ROS.compressed_cloud(made, "draco", draco(made[list(made.dtype.names)[:5]])))
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(MissingDependencyError, match="pip install DracoPy"):
        decode_compressed_cloud(ROS.compressed_cloud(made, "draco"))


def test_draco_with_metadata_and_of_too_many_points():
    library = pytest.importorskip("DracoPy", reason="DracoPy is not installed")
    made = points()
    xyz, more = np.c_[made["x"], made["y"], made["z"]], {name: np.c_[made[name]] for name in ("intensity", "ring")}
    packed = library.encode(
        xyz, create_metadata=True, quantization_origin=[-99, -99, -99], quantization_range=200, generic_attributes=more
    )
    assert _draco_points(packed) == 50
    for length in range(11, 60):
        with pytest.raises(IndexError):
            _draco_points(packed[:length])
    nested = ROS.compressed_cloud(made, "draco", b"DRACO" + bytes([2, 3, 0, 0, 0, 128, 0]) + bytes([0, 1, 0]) * 5000)
    with pytest.raises(BadInputError, match="Draco data is damaged"):
        decode_compressed_cloud(nested)
    data = bytearray(draco(made))
    data[13] = 4  # 262,194 points, for which the decoder would take memory
    with pytest.raises(BadInputError, match="262194 points of Draco for 50x1"):
        decode_compressed_cloud(ROS.compressed_cloud(made, "draco", bytes(data)))


def test_cloudini_is_refused_with_what_helps(tmp_path):
    with pytest.raises(BadInputError, match=r"'cloudini' is not read; republish .*point_cloud_transport republish"):
        decode_compressed_cloud(ROS.compressed_cloud(points(), "cloudini", b"CLOUDINI"))


def test_a_bag_of_compressed_clouds(tmp_path):
    with Recorder(tmp_path / "bag") as record:
        for k in range(3):
            stamp = START + 100 * MS * k
            record.image(stamp, value=k)
            record.info(stamp)
            message = record.ros.compressed_cloud(points(40 + k), "zstd")
            message.header = record.ros.header(stamp, "lidar")
            record.write("/points/zstd", message, stamp)
    bag = BagSource(tmp_path / "bag")
    assert [len(bag[k].cloud) for k in range(3)] == [40, 41, 42]
    assert bag.lidar_frame == "lidar"
