"""Decoding of images, clouds and camera infos, from the message classes of rosbags and of rclpy."""

from __future__ import annotations

import itertools
import re
import struct
import zlib
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from ros_messages import FAMILIES, Messages

from calib_ros.errors import BadInputError
from calib_ros.messages import decode_camera_info, decode_cloud, decode_compressed_image, decode_image
from calib_ros.messages.image_encodings import ENCODINGS
from calib_ros.messages.pictures import PNG, decode_picture

STAMP = 1_700_000_000_123_456_789
HEIGHT, WIDTH = 12, 16


@pytest.fixture(params=FAMILIES)
def ros(request: pytest.FixtureRequest) -> Messages:
    return Messages(request.param)


@pytest.fixture
def bgr() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def pad(rows: np.ndarray, padding: int) -> tuple[np.ndarray, int]:
    """(H, bytes) rows with garbage behind each, and their step."""
    step = rows.shape[1] + padding
    out = np.full((len(rows), step), 0xAB, np.uint8)
    out[:, : rows.shape[1]] = rows
    return out, step


# --- images ---------------------------------------------------------------------------------------------------------------


def test_colour_encodings_give_bgr(ros, bgr):
    for (encoding, order), padding in itertools.product(
        (("bgr8", "012"), ("8UC3", "012"), ("rgb8", "210"), ("bgra8", "012a"), ("8UC4", "012a"), ("rgba8", "210a")), (0, 5)
    ):
        alpha = np.full((HEIGHT, WIDTH), 77, np.uint8)
        stored = np.stack([alpha if c == "a" else bgr[:, :, int(c)] for c in order], axis=2)
        data, step = pad(stored.reshape(HEIGHT, -1), padding)
        assert np.array_equal(decode_image(ros.image(encoding, WIDTH, HEIGHT, data, step)), bgr)


def test_grey_stays_two_dimensional(ros, bgr):
    data, step = pad(bgr[:, :, 0], 3)
    for encoding in ("mono8", "8UC1", "MONO8"):
        assert np.array_equal(decode_image(ros.image(encoding, WIDTH, HEIGHT, data, step)), bgr[:, :, 0])
    for encoding in ENCODINGS:
        image = decode_image(ros.image(encoding, 8, 8, bytes(8 * 12 * 8), 8 * 8))
        assert (image.dtype, image.shape[:2]) == (np.uint8, (8, 8))


def test_sixteen_bit_is_stretched_whatever_band_it_uses(ros):
    for (low, high), big in itertools.product(((0, 4095), (7000, 9000), (0, 65535)), (0, 1)):
        values = np.linspace(low, high, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
        data, step = pad(np.round(values).astype(">u2" if big else "<u2").view(np.uint8), 1)
        image = decode_image(ros.image("mono16", WIDTH, HEIGHT, data, step, big))
        assert image.dtype == np.uint8
        assert image.min() == 0
        assert image.max() == 255
        expected = (values - low) / (high - low) * 255
        assert np.abs(image - expected).max() < 3  # the percentiles cut 0.5 % off at each end
    flat = decode_image(ros.image("16UC1", 4, 4, np.full((4, 4), 0x8000, "<u2"), 8))
    assert (flat == 0x80).all()


def test_bayer_patterns_give_their_colours(ros):
    for pattern, bits in itertools.product(("rggb", "bggr", "gbrg", "grbg"), (8, 16)):
        # Left half reddish, right half bluish, so that swapped channels or shifted rows show.
        scene = np.zeros((HEIGHT, 2 * WIDTH, 3), np.uint16)
        scene[:, :WIDTH], scene[:, WIDTH:] = (0, 100, 200), (255, 50, 20)
        mosaic = np.zeros(scene.shape[:2], np.uint16)
        for i, colour in enumerate(pattern):
            row, column = divmod(i, 2)
            mosaic[row::2, column::2] = scene[row::2, column::2, "bgr".index(colour)]
        data = mosaic.astype(np.uint8) if bits == 8 else (mosaic * 16).astype("<u2")
        image = decode_image(ros.image(f"bayer_{pattern}{bits}", 2 * WIDTH, HEIGHT, data, 2 * WIDTH * bits // 8))
        inner = np.r_[2 : WIDTH - 2, WIDTH + 2 : 2 * WIDTH - 2]
        assert np.abs(image[2:-2, inner].astype(int) - scene[2:-2, inner]).max() <= 1


RED, BLUE = (81, 90, 240), (41, 240, 110)  # Y, U, V of BT.601


def test_yuv_encodings_give_their_colours(ros):
    for encoding in ("yuv422", "uyvy", "yuv422_yuy2", "yuyv", "nv12", "nv21"):
        Y, U, V = (
            np.repeat([[red, blue]], HEIGHT, 0).repeat(WIDTH // 2, 1).astype(np.uint8)
            for red, blue in zip(RED, BLUE, strict=True)
        )
        if encoding.startswith("nv"):
            chroma = np.stack([U, V] if encoding == "nv12" else [V, U], axis=2)[::2, ::2].reshape(HEIGHT // 2, WIDTH)
            data, step = pad(np.vstack([Y, chroma]), 2)
        else:
            chroma = np.where(np.arange(WIDTH) % 2 == 0, U, V)
            pair = (chroma, Y) if encoding in ("yuv422", "uyvy") else (Y, chroma)
            data, step = pad(np.stack(pair, axis=2).reshape(HEIGHT, -1), 2)
        image = decode_image(ros.image(encoding, WIDTH, HEIGHT, data, step)).astype(int)
        assert np.abs(image[:, : WIDTH // 2] - (0, 0, 255)).max() <= 3
        assert np.abs(image[:, WIDTH // 2 :] - (255, 0, 0)).max() <= 3


def test_unusable_images_say_why(ros):
    for encoding, width, height, size, step, says in (
        ("32FC1", 4, 4, 64, 16, "mono8, "),
        ("mono8", 0, 4, 0, 0, "no pixels"),
        ("bgr8", 4, 4, 47, 12, "truncated"),
        ("bgr8", 4, 4, 48, 4, "step 4"),
        ("mono8", 2**31, 2**31, 16, 2**31, "truncated"),
        ("nv12", 3, 4, 18, 3, "even"),
    ):
        message = ros.image(encoding, width, height, bytes(size), step)
        with pytest.raises(BadInputError, match=says) as caught:
            decode_image(message)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", [".png", ".jpg"])
def test_compressed_colour_and_grey(ros, kind):
    smooth = cv2.resize(np.array([[[250, 10, 10], [10, 10, 250]]], np.uint8), (WIDTH, HEIGHT))
    for picture, layout in ((smooth, "rgb8; jpeg compressed bgr8"), (smooth[:, :, 2], "mono8; jpeg compressed")):
        image = decode_compressed_image(ros.compressed(layout, cv2.imencode(kind, picture)[1].tobytes()))
        assert image.shape == picture.shape
        assert np.abs(image.astype(int) - picture).max() <= (0 if kind == ".png" else 20)


def test_compressed_png_of_other_depths(ros, bgr):
    png = lambda picture: cv2.imencode(".png", picture)[1].tobytes()  # noqa: E731
    assert np.array_equal(decode_compressed_image(ros.compressed("png", png(np.dstack([bgr, bgr[:, :, 0]])))), bgr)
    ramp = np.linspace(0, 4095, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH).astype(np.uint16)
    image = decode_compressed_image(ros.compressed("mono16; png compressed", png(ramp)))
    assert (image.dtype, image.min(), image.max()) == (np.uint8, 0, 255)
    mosaic = np.zeros((HEIGHT, WIDTH), np.uint8)
    mosaic[::2, ::2] = 200
    image = decode_compressed_image(ros.compressed("bayer_rggb8; png compressed", png(mosaic)))
    assert np.array_equal(image[4, 4], (0, 0, 200))


def test_unreadable_compressed_images(ros):
    for data in (b"", b"\x89PNG\r\n\x1a\n", b"nonsense" * 10):
        with pytest.raises(BadInputError, match="JPEG, PNG or BMP"):
            decode_compressed_image(ros.compressed("jpeg", data))
    with pytest.raises(BadInputError, match="depth image"):
        decode_compressed_image(ros.compressed("16UC1; compressedDepth png", b"12345"))


def png(width: int, height: int, bits: int, rows: bytes) -> np.ndarray:
    """A grey PNG of these bytes, whatever they are."""
    header, out = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0), PNG
    for kind, data in ((b"IHDR", header), (b"IDAT", zlib.compress(rows, 9)), (b"IEND", b"")):
        out += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return np.frombuffer(out, np.uint8)


@pytest.mark.parametrize("bits", [1, 2, 4])
def test_png_that_packs_pixels(bits):
    """Black but for its last column: more than a thousand pixels for each byte of the file, as of a mask."""
    width, height = 4096, 2048
    row = bytes(1 + width * bits // 8 - 1) + bytes([2**bits - 1])
    data = png(width, height, bits, row * height)
    assert width * height > 1100 * len(data)
    expected = np.zeros((height, width), np.uint8)
    expected[:, -1] = 255
    assert np.array_equal(decode_picture(data), expected)


@pytest.mark.parametrize(("bits", "packed"), [(0, 1), (1, 8), (2, 4), (4, 2), (8, 1), (16, 1)])
def test_png_that_promises_too_much(bits, packed, capfd):
    """What no encoder can have written does not even reach OpenCV, which would take memory for it and complain on stderr."""
    enough = len(png(8, 8, bits, bytes(1000))) * 1100 * packed
    assert decode_picture(png(enough // 8 + 1, 8, bits, bytes(1000))) is None
    assert capfd.readouterr().err == ""


# --- clouds ---------------------------------------------------------------------------------------------------------------


def structured(n: int, dtype: list | dict, **columns: object) -> np.ndarray:
    points = np.zeros(n, np.dtype(dtype))
    for name, values in columns.items():
        points[name] = values
    return points


VELODYNE = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")]
OUSTER = {
    "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
    "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "u1", "<u2", "<u4"],
    "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
    "itemsize": 48,
}


def test_velodyne_layout(ros):
    rng = np.random.default_rng(2)
    xyz = rng.normal(size=(100, 3)).astype(np.float32)
    xyz[7] = np.nan
    intensity, ring = rng.random(100).astype(np.float32), rng.integers(0, 64, 100)
    time = np.linspace(-0.1, 0, 100, dtype=np.float32)
    points = structured(100, VELODYNE, x=xyz[:, 0], y=xyz[:, 1], z=xyz[:, 2], intensity=intensity, ring=ring, time=time)
    cloud = decode_cloud(ros.cloud(points))
    assert np.array_equal(cloud.xyz, xyz, equal_nan=True)
    assert np.array_equal(cloud.intensity, intensity)
    assert np.array_equal(cloud.ring, ring)
    assert np.allclose(cloud.time, time, atol=1e-7)
    assert (cloud.xyz.dtype, cloud.intensity.dtype, cloud.ring.dtype, cloud.time.dtype) == ("f4", "f4", "i4", "f4")
    assert all(v.flags.c_contiguous for v in (cloud.xyz, cloud.intensity, cloud.ring, cloud.time))
    assert len(cloud.finite()) == 99
    message = Messages("rosbags").cloud(points)
    assert not np.shares_memory(decode_cloud(message).xyz, message.data)  # it does not keep the message alive


def test_organised_ouster_layout_with_padded_rows(ros):
    rows, columns = 4, 25
    n = rows * columns
    t = np.tile(np.arange(columns) * 4_000_000, rows)  # ns, all rows fire together
    points = structured(
        n, OUSTER, x=np.arange(n), y=-np.arange(n), z=1, intensity=5, t=t, reflectivity=9, ring=np.arange(n) // columns
    )
    cloud = decode_cloud(ros.cloud(points.reshape(rows, columns), padding=11))
    assert np.array_equal(cloud.xyz, np.c_[np.arange(n), -np.arange(n), np.ones(n)])
    assert np.array_equal(cloud.ring, np.repeat(np.arange(rows), columns))
    assert (cloud.intensity == 5).all()  # not the reflectivity
    assert np.allclose(cloud.time, t * 1e-9)


@pytest.mark.parametrize("kind", ["<f8", "<i2", ">i4", ">f4"])
def test_other_coordinate_types(ros, kind):
    fields = [("pad", "u1", 3), ("z", kind), ("y", kind), ("x", kind), ("i", "u1"), ("ring", f"{kind[0]}u2")]
    message = ros.cloud(structured(3, fields, x=[1, 2, 3], y=-4, z=7, i=[0, 128, 255], ring=[1, 300, 2]))
    cloud = decode_cloud(message)
    assert np.array_equal(cloud.xyz, [[1, -4, 7], [2, -4, 7], [3, -4, 7]])
    assert cloud.xyz.dtype.isnative
    assert np.array_equal(cloud.intensity, [0, 128, 255])
    assert np.array_equal(cloud.ring, [1, 300, 2])
    assert cloud.time is None
    for message.width, message.height in ((0, 1), (1, 0), (0, 0)):
        message.fields, message.point_step = [], 0
        assert decode_cloud(message).xyz.shape == (0, 3)


def test_array_fields_and_count_zero(ros):
    points = structured(
        2,
        [("X", "<f4"), ("Y", "<f4"), ("Z", "<f4"), ("normal", "<f4", 3), ("reflectivity", "<u2")],
        X=[1, 2],
        reflectivity=[3, 4],
    )
    message = ros.cloud(points)
    message.fields[4].count = 0
    for message.row_step in (0, 5, 10**9):  # of a single row it does not matter
        cloud = decode_cloud(message)
    assert np.array_equal(cloud.xyz[:, 0], [1, 2])
    assert np.array_equal(cloud.intensity, [3, 4])
    message.fields[4].offset += 1  # a count of 0 stands for 1, which does not fit here
    with pytest.raises(BadInputError, match="field reflectivity ends at byte 27"):
        decode_cloud(message)


SCAN = np.linspace(0, 0.1, 50)  # seconds from the stamp


def test_point_times_in_every_unit(ros):
    for name, kind, values in (
        ("t", "<u4", SCAN * 1e9),  # Ouster
        ("time", "<f4", SCAN),  # Velodyne
        ("timestamp", "<f8", STAMP * 1e-9 + SCAN),  # Hesai, Robosense: absolute seconds
        ("timestamp", "<f8", STAMP + SCAN * 1e9),  # Livox: absolute ns
        ("timestamp", "<f8", STAMP * 1e-3 + SCAN * 1e6),  # absolute µs
        ("time_stamp", "<u4", SCAN * 1e9),  # Autoware
        ("offset_time", "<u4", SCAN * 1e6),  # µs
        ("time", "<f4", SCAN * 1e3),  # ms
        ("time", "<f8", SCAN * 1e9),  # ns
    ):
        points = structured(50, [*VELODYNE[:3], (name, kind)], **{name: values})
        cloud = decode_cloud(ros.cloud(points, stamp=STAMP))
        assert cloud.time.dtype == np.float32
        assert np.abs(cloud.time - SCAN).max() < 2e-6
    for kind, values in (("<f4", SCAN - 0.1), ("<f8", STAMP * 1e-9 + SCAN - 0.1)):  # before the stamp
        cloud = decode_cloud(ros.cloud(structured(50, [*VELODYNE[:3], ("time", kind)], time=values)))
        assert np.abs(cloud.time - (SCAN - 0.1)).max() < 2e-6
    values = STAMP * 1e-9 + SCAN
    values[[3, 9]] = 0, np.nan  # points without a time
    cloud = decode_cloud(ros.cloud(structured(50, [*VELODYNE[:3], ("timestamp", "<f8")], timestamp=values)))
    assert (cloud.time[[3, 9]] == 0).all()
    assert np.abs(np.delete(cloud.time - SCAN, [3, 9])).max() < 2e-6
    assert (decode_cloud(ros.cloud(structured(5, VELODYNE))).time == 0).all()


def test_times_that_cannot_be_used_are_left_out_and_named(ros):
    for kind, values, says in (
        ("<f8", np.array([1.0, 1e15, 1e300]), "more than a scan can last"),
        ("<f8", STAMP * 1e-9 + 37.0 + SCAN[:3], r"of another clock, \+37 s from the header stamp"),
        ("<f8", 5000.5 + SCAN[:3], "of another clock"),
        ("<f4", np.float32(STAMP * 1e-9) + 0 * SCAN[:3], r"all the same \(float32\)"),
    ):
        cloud = decode_cloud(ros.cloud(structured(3, [*VELODYNE[:3], ("timestamp", kind)], timestamp=values), stamp=STAMP))
        assert cloud.time is None, kind
        assert re.search(says, cloud.time_problem), cloud.time_problem
        assert cloud.select(np.arange(2)).time_problem == cloud.time_problem
    assert not decode_cloud(ros.cloud(structured(5, VELODYNE))).time_problem


def test_unusable_clouds_say_why():
    for change, says in (
        ({"point_step": 0}, "point_step is 0"),
        ({"point_step": 20}, "field time ends at byte 22"),
        ({"width": 2**31, "height": 2**31}, "row_step"),
        ({"height": 2}, "truncated"),
        ({"data": bytes(219)}, "truncated"),
        ({"width": -1}, "negative"),
    ):
        good = Messages("rosbags").cloud(structured(10, VELODYNE))
        message = SimpleNamespace(**{name: getattr(good, name) for name in good.__dataclass_fields__ if name != "__msgtype__"})
        vars(message).update(change)
        with pytest.raises(BadInputError, match=says) as caught:
            decode_cloud(message)
        assert "\n" not in str(caught.value)


def test_unknown_datatype_matters_only_where_it_is_needed(ros):
    message = ros.cloud(structured(2, VELODYNE, x=[1, 2]))
    message.fields[3].datatype = 99
    assert decode_cloud(message).intensity is None
    message.fields[0].datatype = 99
    with pytest.raises(BadInputError, match="field x has unknown datatype 99"):
        decode_cloud(message)
    with pytest.raises(BadInputError, match=r"no field z among \(x, y, ring\)"):
        decode_cloud(ros.cloud(structured(2, [("x", "<f4"), ("y", "<f4"), ("ring", "<f4")])))


# --- camera info ----------------------------------------------------------------------------------------------------------

K = np.array([[700.0, 0, 320], [0, 710, 240], [0, 0, 1]])
P = np.array([[650.0, 0, 310, -40], [0, 650, 235, 0], [0, 0, 1, 0]])


def test_camera_info(ros):
    message = ros.camera_info(640, 480, K, [-0.3, 0.1, 0.001, 0.002, 0.0], P)
    camera = decode_camera_info(message)
    assert np.array_equal(camera.K, K)
    assert np.array_equal(camera.D, [-0.3, 0.1, 0.001, 0.002, 0.0])
    assert (camera.width, camera.height, camera.model) == (640, 480, "plumb_bob")
    rectified = decode_camera_info(message, rectified=True)
    assert np.array_equal(rectified.K, P[:, :3])
    assert rectified.is_pinhole
    assert rectified.said_rectified
    assert not decode_camera_info(ros.camera_info(640, 480, K, [], P), rectified=True).said_rectified
    assert not camera.said_rectified
    loose = {"K": list(K.ravel()), "D": [0.1, 0, 0, 0], "P": list(P.ravel()), "distortion_model": "equidistant"}  # ROS 1's names
    assert decode_camera_info(SimpleNamespace(width=640, height=480, **loose)).model == "equidistant"
    for model, D in (("mei", [1.2, -0.1, 0.02, 1e-3, 0.0]), ("double_sphere", [-0.2, 0.6]), ("fisheye", [0.1, 0, 0, 0, 0.01])):
        assert np.array_equal(decode_camera_info(ros.camera_info(640, 480, K, D, model=model)).D, D)
    camera = decode_camera_info(ros.camera_info(640, 480, K, roi=(20, 40, 400, 600), binning=2))
    assert (camera.width, camera.height) == (300, 200)
    assert np.array_equal(camera.K, [[350, 0, 150], [0, 355, 100], [0, 0, 1]])


def test_unusable_camera_infos_say_why(ros):
    for message, rectified, says in (
        (ros.camera_info(640, 480, np.zeros(9)), False, "K is all zero; calibrate"),
        (ros.camera_info(640, 480, K), True, "P is all zero"),
        (ros.camera_info(640, 480, K, [0.1, 0.2, 0.3]), False, "got 3"),
        (SimpleNamespace(width=1, height=1, k=[1] * 8, d=[], distortion_model=""), False, "K has 8 numbers, not 9"),
    ):
        with pytest.raises(BadInputError, match=says):
            decode_camera_info(message, rectified)
