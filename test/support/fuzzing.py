"""Seeded mutators: messages and files as broken drivers, disks and people make them. The same seed gives the same cases."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from compressed_bags import ENCODERS, FFMPEG, FOXGLOVE, encoded, video_message
from ros_messages import Messages

from calib_ros.messages.image_encodings import ENCODINGS

WIDTH, HEIGHT = 96, 64
K = np.array([[70.0, 0, 48], [0, 70, 32], [0, 0, 1]])
STAMP = 1_700_000_000_123_456_789
# What 32 bits without a sign can hold, so that it can be published, too; and what a file or a program may hold.
SIZES = (0, 1, 2, 3, 4, 7, 16, 63, 96, 255, 2**16, 10**6, 2**31 - 1, 2**31, 2**32 - 1)
WILD_SIZES = (*SIZES, -1, -16, 2**63, 2**64)
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-3, 1e-40, 1e-300, 1e6, 1e9, -1e9, 1e19, 1e38, -1e38, 1e150, 1e300, np.inf, -np.inf, np.nan)
TEXTS = ("", "mono8", "BGR8 ", "rgb", "32FC1", "64FC4", "\N{SNOWMAN}", "8UC1\0", "a" * 3000)
TEXTS += ("bayer_", "nv12", "jpeg", "x\ny", "{}")
NAMES = ("x", "y", "z", "intensity", "ring", "time", "t", "timestamp", "", "rgb", " X ", "\N{SNOWMAN}", "line", "z" * 300)
VELODYNE = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")]
LAYOUTS: tuple[Any, ...] = (
    VELODYNE,
    [(name, kind.replace("<", ">")) for name, kind in VELODYNE],
    VELODYNE[:3],
    [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("intensity", "u1"), ("ring", "<i4"), ("timestamp", "<f8")],
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("pad", "u1", 4), ("reflectivity", "<f8"), ("ring", "<f8"), ("t", "<u4")],
    [("x", "<i2"), ("y", "<i2"), ("z", "<i2"), ("i", "<u2"), ("line", "i1"), ("time", "<i4")],
)
DISTORTIONS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4, "": 0}
OTHER_DISTORTIONS = {"omnidir": 5, "double_sphere": 2, "eucm": 2, "ucm": 1, "fov": 1, "division": 2, "kb6": 6}


def scan(rng: np.random.Generator, rings: int = 16, columns: int = 100) -> dict[str, np.ndarray]:
    """A small room with pillars as a spinning scanner sees it: columns of numbers, ring after ring."""
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, columns, endpoint=False), np.linspace(0.2, -0.3, rings))
    far = 8 + 2 * np.cos(4 * azimuth)
    pillars = np.sin(9 * azimuth + rng.uniform(0, 6)) > 0.8
    distance = np.where(pillars, 4.0, far) + rng.normal(0, 0.01, azimuth.shape)
    x, y = distance * np.cos(elevation) * np.cos(azimuth), distance * np.cos(elevation) * np.sin(azimuth)
    z = distance * np.sin(elevation)
    ring = np.repeat(np.arange(rings), columns)
    time = (azimuth / (2 * np.pi) * 0.1).ravel()
    return {"xyz": np.stack([x, y, z], -1).reshape(-1, 3), "intensity": 200.0 * pillars.ravel() + 20, "ring": ring, "time": time}


class MessageFuzzer:
    """Mutated messages of one family ("rosbags" or "rclpy"); those of rosbags also as they cannot be sent over a network."""

    def __init__(self, seed: int, family: str) -> None:
        self.rng = np.random.default_rng(seed)
        self.make = Messages(family)
        self.packets: dict[str, list[bytes]] = {}
        self.sizes = WILD_SIZES if family == "rosbags" else SIZES

    # ---- choices ------------------------------------------------------------------------------------------------------

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def one(self, choices: Any) -> Any:
        return choices[int(self.rng.integers(len(choices)))]

    def number(self, near: int) -> int:
        """An absurd number, or one beside what it should be."""
        return int(self.one(self.sizes)) if self.chance(0.7) else max(near + int(self.rng.integers(-3, 4)), 0)

    def some(self, values: np.ndarray) -> slice | np.ndarray:
        """All of an array, a single one, or every few."""
        return self.one((slice(None), slice(0, 1), slice(None, None, 3), self.rng.random(len(values)) < 0.5))

    def damaged(self, data: bytes) -> bytes:
        how = self.one(("empty", "shorter", "longer", "random", "flipped", "one byte"))
        if how in ("empty", "one byte"):
            return data[: int(how == "one byte")]
        if how == "shorter":
            return data[: int(self.rng.integers(0, len(data) + 1))]
        if how == "longer":
            return data + self.rng.bytes(int(self.rng.integers(1, 200)))
        return self.rng.bytes(len(data)) if how == "random" else flipped(self.rng, data, int(self.rng.integers(1, 40)))

    def stamp(self, message: Any) -> None:
        time = message.header.stamp
        time.sec = self.one((0, 1, -1, 2**31 - 1, -(2**31), 1_700_000_000))
        time.nanosec = self.one((0, 999_999_999, 2**32 - 1, 10**9))
        message.header.frame_id = self.one(("", "sensor", "/a", "\N{SNOWMAN}"))

    # ---- clouds -------------------------------------------------------------------------------------------------------

    def cloud(self, stamp: int = STAMP) -> Any:
        dtype = np.dtype(self.one(LAYOUTS))
        shape = (int(self.one((1, 4, 16, 16, 32))), int(self.one((1, 30, 60, 100))))
        columns = scan(self.rng, *shape)
        points = np.zeros(shape[0] * shape[1], dtype)
        for name in dtype.names or ():
            kind = dtype.fields[name][0].base if dtype.fields else dtype
            points[name] = self._column(name, kind, columns).reshape(points[name].shape[:1] + (1,) * (points[name].ndim - 1))
        organised = self.chance(0.4)
        message = self.make.cloud(points.reshape(shape) if organised else points, padding=int(self.one((0, 0, 5))), stamp=stamp)
        for _ in range(int(self.one((0, 0, 1, 1, 2, 3)))):
            self.one((self._cloud_size, self._field, self._fields, self._cloud_data, self._cloud_data, self._order))(message)
        if self.chance(0.1):
            self.stamp(message)
        return message

    def _column(self, name: str, kind: np.dtype, columns: dict[str, np.ndarray]) -> np.ndarray:
        count = len(columns["ring"])
        known = {**dict(zip("xyz", columns["xyz"].T, strict=True)), "intensity": columns["intensity"], "ring": columns["ring"]}
        known |= {"i": known["intensity"], "reflectivity": known["intensity"], "line": known["ring"], "pad": np.zeros(count)}
        values = np.array(known.get(name, columns["time"]), float)
        if name in ("t", "timestamp", "time"):
            unit = self.one((1.0, 1e3, 1e6, 1e9, 1e12, 0.0, -1.0))
            values = values * unit + self.one((0.0, 0.1 * unit, STAMP * 1e-9, STAMP * 1.0, -1e9))
        if self.chance(0.25):
            values[self.some(values)] = self.one(FLOATS)
        if self.chance(0.1):
            values = self.rng.normal(0, self.one((1e-3, 1.0, 1e3, 1e12)), count)
        if kind.kind in "iu":
            limits = np.iinfo(kind)
            return np.clip(np.nan_to_num(values, posinf=limits.max, neginf=limits.min), limits.min, limits.max)
        with np.errstate(all="ignore"):
            return values.astype(kind)

    def _cloud_size(self, message: Any) -> None:
        name = self.one(("width", "height", "point_step", "row_step"))
        setattr(message, name, self.number(getattr(message, name)))
        if self.chance(0.2):
            message.width, message.height = message.height, message.width

    def _field(self, message: Any) -> None:
        if message.fields:
            field = self.one(message.fields)
            name = self.one(("offset", "count", "datatype", "name", "name"))
            if name == "name":
                field.name = self.one(NAMES)
            elif name == "datatype":
                field.datatype = int(self.rng.integers(0, 13)) if self.chance(0.8) else 255
            else:
                setattr(field, name, self.number(getattr(field, name)))

    def _fields(self, message: Any) -> None:
        fields = list(message.fields)
        how = self.one(("none", "drop", "drop", "twice", "shuffle", "many"))
        if how == "drop" and fields:
            fields.pop(int(self.rng.integers(len(fields))))
        elif how == "twice" and fields:
            fields.append(self.one(fields))
        elif how == "shuffle":
            fields = [fields[k] for k in self.rng.permutation(len(fields))]
        elif how in ("none", "many"):
            fields = fields * (50 if how == "many" else 0)
        message.fields = fields

    def _cloud_data(self, message: Any) -> None:
        message.data = self.make.data(self.damaged(bytes(message.data)))

    def _order(self, message: Any) -> None:
        message.is_bigendian = not message.is_bigendian

    # ---- pictures -----------------------------------------------------------------------------------------------------

    def picture(self, channels: int = 3) -> np.ndarray:
        shape = (HEIGHT, WIDTH) if channels == 1 else (HEIGHT, WIDTH, channels)
        how = self.one(("noise", "noise", "blocks", "constant"))
        if how == "constant":
            return np.full(shape, self.one((0, 128, 255)), np.uint8)
        if how == "blocks":
            small = self.rng.integers(0, 256, (8, 12, *shape[2:]), np.uint8)
            return np.asarray(cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST))
        return self.rng.integers(0, 256, shape, np.uint8)

    def good_image(self) -> Any:
        return self.make.image("bgr8", WIDTH, HEIGHT, self.picture(), 3 * WIDTH)

    def image(self) -> Any:
        encoding = str(self.one(tuple(ENCODINGS)))
        kind = ENCODINGS[encoding]
        row = WIDTH * kind.channels * kind.bytes
        rows = HEIGHT * 3 // 2 if kind.planar_420 else HEIGHT
        data = np.resize(self.picture(), rows * row).tobytes()
        message = self.make.image(encoding, WIDTH, HEIGHT, data, row, big=int(self.one((0, 0, 1, 255))))
        for _ in range(int(self.one((0, 1, 1, 2)))):
            name = self.one(("width", "height", "step", "encoding", "data", "data"))
            if name == "encoding":
                message.encoding = self.one((*TEXTS, *ENCODINGS))
            elif name == "data":
                message.data = self.make.data(self.damaged(bytes(message.data)))
            else:
                setattr(message, name, self.number(getattr(message, name)))
        if self.chance(0.1):
            self.stamp(message)
        return message

    def compressed(self) -> Any:
        suffix = self.one((".png", ".jpg"))
        picture: np.ndarray = self.picture(int(self.one((1, 3, 3, 4) if suffix == ".png" else (1, 3))))
        if suffix == ".png" and self.chance(0.2):
            picture = picture.astype(np.uint16) * 200
        data = cv2.imencode(suffix, picture)[1].tobytes()
        if self.chance(0.2):
            data = png_header(self.number(WIDTH), self.number(HEIGHT), int(self.one((0, 2, 6))), data)
        elif self.chance(0.6):
            data = self.damaged(data)
        elif self.chance(0.1):
            data = b"P5\n60000 60000\n255\n" + data
        layout = self.one(("jpeg", "png", "bgr8; jpeg compressed bgr8", "bayer_rggb8; png compressed", "16UC1; compressedDepth"))
        return self.make.compressed(self.one(TEXTS) if self.chance(0.2) else layout, data)

    def video(self) -> list[Any]:
        """Messages of a few pictures, of a type and a codec, of which some are changed, lost or in another place."""
        codec, kind = self.one(tuple(ENCODERS)), self.one((FOXGLOVE, FFMPEG))
        out = []
        for packet in self.packets_of(codec):
            data = self.damaged(packet) if self.chance(0.15) else packet
            layout = self.one((*TEXTS, *ENCODERS)) if self.chance(0.05) else codec
            out.append(video_message(self.make, kind, layout, self.make.header(), data))
        if self.chance(0.2):
            out.insert(int(self.rng.integers(len(out))), out.pop(int(self.rng.integers(len(out)))))
        return out[int(self.chance(0.1)) :]

    def packets_of(self, codec: str) -> list[bytes]:
        if codec not in self.packets:
            self.packets[codec] = encoded([self.picture() for _ in range(5)], codec, 3)
        return self.packets[codec]

    def compressed_cloud(self) -> Any:
        kinds = [(name, "<f4") for name in ("x", "y", "z", "intensity")] + [("ring", "<u2"), ("time", self.one(("<f4", "<f8")))]
        columns = scan(self.rng, 4, 30)
        points = np.zeros(120, kinds)
        for name in points.dtype.names or ():
            points[name] = self._column(name, points.dtype[name], columns)
        layout = self.one(("zlib", "zstd", "draco", "draco"))
        message = self.make.compressed_cloud(points, layout)
        for _ in range(int(self.one((0, 1, 1, 2)))):
            how = self.one((self._cloud_size, self._field, self._fields, self._layout, self._packed, self._packed))
            how(message)
        return message

    def _layout(self, message: Any) -> None:
        message.format = self.one((*TEXTS, "zlib", "zstd", "draco", "cloudini"))

    def _packed(self, message: Any) -> None:
        message.compressed_data = self.make.data(self.damaged(bytes(message.compressed_data)))

    # ---- cameras ------------------------------------------------------------------------------------------------------

    def camera_info(self) -> Any:
        counts = self.one((DISTORTIONS, DISTORTIONS, OTHER_DISTORTIONS))
        model = self.one(tuple(counts))
        P = np.c_[K, np.zeros(3)]
        D = self.rng.normal(0, self.one((0.0, 0.02, 0.3)), counts[model])
        message = self.make.camera_info(WIDTH, HEIGHT, K, D, P, model=model)
        for _ in range(int(self.one((0, 1, 1, 2, 3)))):
            self._change(message, self.one(("size", "matrix", "matrix", "distortion", "distortion", "model", "part")))
        return message

    def _change(self, message: Any, what: str) -> None:
        """Another size, matrix, distortion, model or part of the picture for a CameraInfo."""
        if what == "model":
            message.distortion_model = self.one((*DISTORTIONS, *OTHER_DISTORTIONS, "fisheye", "none", "thin_prism", *TEXTS))
        elif what == "matrix":
            name = self.one("kkp")
            values = np.array(getattr(message, name), float)
            values[self.some(values)] = self.one(FLOATS)
            if self.chance(0.2):
                values = np.array(getattr(message, name), float)
                values[self.some(values)] *= self.one((0.0, -1.0, 1e-3, 1e3))
            setattr(message, name, values)
        elif what == "distortion":
            D = self.rng.normal(0, self.one((0.1, 10.0, 1e6)), int(self.one((0, 1, 2, 3, 4, 5, 8, 12, 14, 15, 1000))))
            if len(D) and self.chance(0.5):
                D[self.some(D)] = self.one(FLOATS)
            message.d = D if self.make.family == "rosbags" else D.tolist()
        elif what == "size":
            name = self.one(("width", "height"))
            setattr(message, name, self.number(getattr(message, name)))
        else:
            name = self.one(("binning_x", "binning_y", "x_offset", "y_offset", "width", "height"))
            setattr(message if name.startswith("binning") else message.roi, name, self.number(2))


def png_header(width: int, height: int, colour: int, data: bytes = b"") -> bytes:
    """A PNG that says it is so large, with the pixels of another."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    size = struct.pack(">II", width % 2**32, height % 2**32)
    header = chunk(b"IHDR", size + bytes([8, colour, 0, 0, 0]))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def flipped(rng: np.random.Generator, data: bytes, count: int) -> bytes:
    """So many bits, anywhere, turned over."""
    out = bytearray(data)
    for _ in range(count if out else 0):
        out[int(rng.integers(len(out)))] ^= 1 << int(rng.integers(8))
    return bytes(out)


# --- files ----------------------------------------------------------------------------------------------------------------

LAUGHS = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{b}: &{b} [{', '.join(['*' + a] * 10)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
MERGES = "a: &a {seed: 1, starts: 2}\n" + "".join(
    f"{b}: &{b} {{<<: [{', '.join(['*' + a] * 10)}]}}\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
VALUES = (
    *("", *["null", "true", "-1", "0", "1e400", ".nan", "-.inf"], "9" * 5000, "0x" + "f" * 6000, "1:" * 300 + "1"),
    *("1_0", "2024-13-45", "2024-01-01T00:00:00Z", "[1, 2]", "{a: 1}", "[[[]]]", "'text'", '"\\ud800"', '"a\\nb"'),
    *("!!python/object/apply:os.getcwd []", "!!binary aGVsbG8=", "!!set {a}", "&x [*x]", "*unknown", "\N{SNOWMAN}"),
    *("|\n  text\n", *["1e38", "2147483648", "-9223372036854775809", "NaN", "Infinity"]),
)
BOMBS = (
    *(LAUGHS, MERGES, LAUGHS.replace("i:", "search:"), LAUGHS.replace("i: ", "T_camera_lidar: ")),
    *(LAUGHS.replace("i: ", "status: "), LAUGHS + "search: {seed: *i}\n", "[" * 3000, "{a: " * 3000, '{"a":' * 100_000),
    *("- " * 3000, "search:\n" + "".join(" " * k + "a:\n" for k in range(1, 400)), "\0" * 1000, "a" * 200_000),
    *("? [a, b]\n: c\n", "? {a: b}\n: c\n", "a: &a [*a]\nsearch: *a\n", "search: &a {seed: *a}\n"),
    *("? 0x" + "f" * 6000 + "\n: 1\n", '"a\\nb": 1\n', "search: {0x" + "f" * 6000 + ": 1}\n"),
    *("/**: {ros__parameters: [1]}\n", "x: {ros__parameters: {search: {seed: 1}, search.seed: 2}}\n"),
    *("---\na: 1\n---\nb: 2\n", "%YAML 9.9\n---\na: 1\n", "\t- a\n", ""),
)


def text_file(rng: np.random.Generator, text: str) -> bytes:
    """A text with something wrong, as bytes."""
    how = int(rng.integers(12))
    lines = text.splitlines(keepends=True)
    at = int(rng.integers(max(len(lines), 1)))
    if how == 0:
        return BOMBS[int(rng.integers(len(BOMBS)))].encode("utf-8", "surrogatepass")
    if how == 1:
        return flipped(rng, text.encode(), int(rng.integers(1, 10)))
    if how == 2:
        return text.encode()[: int(rng.integers(len(text) + 1))]
    if how == 3:
        return text.encode(("utf-16", "utf-8-sig", "utf-32", "utf-16-be")[int(rng.integers(4))])
    if how == 4:
        return ("# caf\N{LATIN SMALL LETTER E WITH ACUTE}\n" + text).encode("latin-1", "replace")
    if how == 5:
        del lines[at : at + int(rng.integers(1, 4))]
    elif how == 6:
        lines[at:at] = lines[: int(rng.integers(1, 6))]
    elif how == 7 and lines:
        lines[at] = lines[at][int(rng.integers(len(lines[at]))) :]
    elif how == 8:
        lines.insert(at, ("\0", "\t x", ": :", "- -", "<<: *a", "\x85", "\ufeff", "}", "]")[int(rng.integers(9))] + "\n")
    else:
        text = "".join(lines)
        # The value behind a colon, or a number, becomes another.
        found = list(re.finditer(r"(?<=: )[^\n,}]+|-?\d+\.?\d*(e-?\d+)?", text))
        for match in [found[int(k)] for k in sorted(rng.integers(0, max(len(found), 1), 2))[::-1]] if found else []:
            text = text[: match.start()] + VALUES[int(rng.integers(len(VALUES)))] + text[match.end() :]
        return text.encode()
    return "".join(lines).encode()


def binary_file(rng: np.random.Generator, data: bytes) -> bytes:
    """Bytes truncated, flipped, spliced, repeated, blanked or with a large number in them."""
    how = int(rng.integers(7))
    at, to = sorted(int(k) for k in rng.integers(0, len(data) + 1, 2))
    if how == 0:
        return data[:at]
    if how == 1:
        return flipped(rng, data, int(rng.integers(1, 30)))
    if how == 2:
        return data[:at] + data[to:]
    if how == 3:
        return data[:to] + data[at:]
    if how == 4:
        return data[:at] + bytes(min(to - at, 64)) + data[min(to, at + 64) :]
    if how == 5:
        number = (2**63 - 1, 2**64 - 1, 2**31, 2**40, 10**9, 0)[int(rng.integers(6))]
        return data[:at] + struct.pack("<Q", number) + data[at + 8 :]
    return rng.bytes(int(rng.integers(0, 400)))


def damage_folder(rng: np.random.Generator, folder: Path) -> None:
    """One or two files of a folder damaged, deleted, swapped, or made something else."""
    for _ in range(int(rng.integers(1, 3))):
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        if not files:
            return
        path, other = files[int(rng.integers(len(files)))], files[int(rng.integers(len(files)))]
        how = int(rng.integers(10))
        if how == 0:
            path.unlink()
        elif how == 1:
            data = path.read_bytes()
            path.write_bytes(other.read_bytes())
            other.write_bytes(data)
        elif how == 2:
            path.unlink()
            path.mkdir()
        elif path.suffix in (".txt", ".yaml", ".json", ".csv", ".ply"):
            path.write_bytes(text_file(rng, path.read_text("utf-8", "replace")))
        else:
            path.write_bytes(binary_file(rng, path.read_bytes()))
