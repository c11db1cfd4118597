"""Seeded mutators: messages and files as broken drivers, disks and people make them. The same seed gives the same cases."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
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
SIZES = (0, 1, 2, 3, 4, 7, 16, 63, 96, 255, 2**16, 10**6, 2**31 - 1, 2**31, 2**32 - 1, -1, 2**63, 2**64)
FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-3, 1e-40, 1e-300, 1e6, 1e9, -1e9, 1e19, 1e38, -1e38, 1e150, 1e300, np.inf, -np.inf, np.nan)
DISTORTIONS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4, "": 0, "omnidir": 5, "double_sphere": 2, "kb6": 6}
PACKINGS = ("zlib", "zstd", "draco", "draco")
FIELDS = ("x", "y", "z", "intensity", "ring", "time", "t", "timestamp", "", "rgb", " X ", "\N{SNOWMAN}", "line", "z" * 300)
TEXTS = (*FIELDS, *ENCODINGS, *DISTORTIONS, *PACKINGS, *ENCODERS, "32FC1", "8UC1\0", "a" * 3000, "bayer_", "jpeg", "x\ny", "{}")
VELODYNE = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")]
LAYOUTS: tuple[Any, ...] = (
    VELODYNE,
    [(name, kind.replace("<", ">")) for name, kind in VELODYNE],
    [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("intensity", "u1"), ("ring", "<i4"), ("timestamp", "<f8")],
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("pad", "u1", 4), ("reflectivity", "<f8"), ("ring", "<f8"), ("t", "<u4")],
    [("x", "<i2"), ("y", "<i2"), ("z", "<i2"), ("i", "<u2"), ("line", "i1"), ("time", "<i4")],
)


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
    """Messages of one family ("rosbags" or "rclpy"), of whose parts up to three hold something else."""

    def __init__(self, seed: int, family: str) -> None:
        self.rng = np.random.default_rng(seed)
        self.make = Messages(family)
        self.packets: dict[str, list[bytes]] = {}

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def one(self, choices: Any) -> Any:
        return choices[int(self.rng.integers(len(choices)))]

    # ---- any message --------------------------------------------------------------------------------------------------

    def mutated(self, message: Any) -> Any:
        """The same message, in up to three places another."""
        for _ in range(int(self.one((0, 1, 1, 2, 3)))):
            owner, name = self.one(list(_parts(message)))
            with suppress(AssertionError, OverflowError, TypeError):  # rclpy's messages cannot hold everything
                setattr(owner, name, self._another(getattr(owner, name)))
        return message

    def _another(self, value: Any) -> Any:
        if isinstance(value, bool):
            return not value
        if isinstance(value, (int, np.integer)):
            return int(self.one(SIZES)) if self.chance(0.7) else max(int(value) + int(self.rng.integers(-3, 4)), 0)
        if isinstance(value, str):
            return self.one(TEXTS)
        if isinstance(value, list) and not (value and isinstance(value[0], float)):
            return value and self.one(([], value[1:], [*value, value[0]], value[::-1], 50 * value))
        numbers = np.array(value)
        if numbers.dtype == np.uint8:
            return self.make.data(self.damaged(numbers.tobytes()))
        count = len(numbers) if self.chance(0.7) else int(self.one((0, 1, 2, 3, 5, 8, 12, 1000)))
        numbers = np.resize(numbers, count).astype(float) if len(numbers) else np.full(count, 0.1)
        if self.chance(0.8):
            numbers[self.rng.random(count) < self.one((0.2, 1.0))] = self.one(FLOATS)
        else:
            numbers *= self.one((-1.0, 1e-3, 1e3))
        return numbers if self.make.family == "rosbags" else numbers.tolist()

    def damaged(self, data: bytes) -> bytes:
        if self.chance(0.2):
            return data + self.rng.bytes(int(self.rng.integers(1, 200)))
        return binary_file(self.rng, data)

    # ---- whole ones ---------------------------------------------------------------------------------------------------

    def cloud(self, stamp: int = STAMP) -> Any:
        return self.mutated(self.make.cloud(self._points(self.one(LAYOUTS)), padding=int(self.one((0, 0, 5))), stamp=stamp))

    def compressed_cloud(self) -> Any:
        return self.mutated(self.make.compressed_cloud(self._points(VELODYNE).ravel(), self.one(PACKINGS)))

    def _points(self, layout: Any) -> np.ndarray:
        """A scan with such columns, some of them with wild values."""
        dtype, columns = np.dtype(layout), scan(self.rng, *self.one(((4, 30), (16, 100), (16, 100), (32, 60), (1, 1))))
        known = {**dict(zip("xyz", columns["xyz"].T, strict=True)), **columns}
        known |= {"i": known["intensity"], "reflectivity": known["intensity"], "line": known["ring"]}
        points = np.zeros(len(columns["ring"]), dtype)
        for name in [each for each in dtype.names or () if each != "pad"]:
            values, kind = np.array(known.get(name, columns["time"]), float), dtype[name]
            if name in ("t", "timestamp", "time"):
                unit = self.one((1.0, 1e3, 1e6, 1e9, 0.0, -1.0))
                values = values * unit + self.one((0.0, 0.1 * unit, STAMP * 1e-9, STAMP * 1.0))
            if self.chance(0.25):
                values[self.rng.random(len(values)) < self.one((0.01, 0.5, 1.0))] = self.one(FLOATS)
            if kind.kind in "iu":
                low, high = np.iinfo(kind).min, np.iinfo(kind).max
                values = np.clip(np.nan_to_num(values, posinf=high, neginf=low), low, high)
            with np.errstate(all="ignore"):
                points[name] = values.astype(kind)
        return points.reshape(-1, 10) if len(points) > 1 and self.chance(0.4) else points

    def picture(self, channels: int = 3) -> np.ndarray:
        shape = (HEIGHT, WIDTH) if channels == 1 else (HEIGHT, WIDTH, channels)
        return np.full(shape, 128, np.uint8) if self.chance(0.1) else self.rng.integers(0, 256, shape, np.uint8)

    def good_image(self) -> Any:
        return self.make.image("bgr8", WIDTH, HEIGHT, self.picture(), 3 * WIDTH)

    def image(self) -> Any:
        encoding = str(self.one(tuple(ENCODINGS)))
        kind = ENCODINGS[encoding]
        row = WIDTH * kind.channels * kind.bytes
        rows = HEIGHT * 3 // 2 if kind.planar_420 else HEIGHT
        data = np.resize(self.picture(), rows * row).tobytes()
        return self.mutated(self.make.image(encoding, WIDTH, HEIGHT, data, row, big=int(self.one((0, 0, 1, 255)))))

    def compressed(self) -> Any:
        suffix = self.one((".png", ".jpg"))
        data = cv2.imencode(suffix, self.picture(int(self.one((1, 3, 3, 4) if suffix == ".png" else (1, 3)))))[1].tobytes()
        if self.chance(0.2):
            data = png_header(int(self.one(SIZES)), HEIGHT, int(self.one((0, 2, 6))), data)
        layout = self.one(("jpeg", "png", "bgr8; jpeg compressed bgr8", "bayer_rggb8; png compressed", "16UC1; compressedDepth"))
        return self.mutated(self.make.compressed(layout, data))

    def video(self) -> list[Any]:
        """Messages of a few pictures, of a type and a codec, of which some are changed, lost or in another place."""
        codec, kind = self.one(tuple(ENCODERS)), self.one((FOXGLOVE, FFMPEG))
        out = [video_message(self.make, kind, codec, self.make.header(), packet) for packet in self.packets_of(codec)]
        out = [self.mutated(message) if self.chance(0.15) else message for message in out]
        if self.chance(0.2):
            out.insert(int(self.rng.integers(len(out))), out.pop(int(self.rng.integers(len(out)))))
        return out[int(self.chance(0.1)) :]

    def packets_of(self, codec: str) -> list[bytes]:
        if codec not in self.packets:
            self.packets[codec] = encoded([self.picture() for _ in range(5)], codec, 3)
        return self.packets[codec]

    def camera_info(self) -> Any:
        model = self.one(tuple(DISTORTIONS))
        D = self.rng.normal(0, self.one((0.0, 0.02, 0.3)), DISTORTIONS[model])
        return self.mutated(self.make.camera_info(WIDTH, HEIGHT, K, D, np.c_[K, np.zeros(3)], model=model))


def _parts(message: Any) -> Iterator[tuple[Any, str]]:
    """What can be changed: each field of a message, and of the messages in it, with its owner."""
    fields = getattr(message, "__dataclass_fields__", None)  # of rosbags; else of rclpy
    for name in (fields or message.get_fields_and_field_types()) if message is not None else ():
        if name != "__msgtype__":
            value = getattr(message, name)
            within = value if isinstance(value, list) else [value]
            nested = [own for own in within if hasattr(own, "__dataclass_fields__") or hasattr(own, "get_fields_and_field_types")]
            if not nested or isinstance(value, list):
                yield message, name
            for own in nested:
                yield from _parts(own)


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
