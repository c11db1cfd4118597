"""What fuzzing found, one by one: messages and files that once cost memory, time or a traceback."""

from __future__ import annotations

import itertools
import struct
import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from fuzzing import LAUGHS, MERGES, WIDTH, MessageFuzzer, png_header
from ros_messages import Messages
from sample_sources import Listed, frames, originals

from calib_ros import result
from calib_ros.camera import Camera, Rectifier
from calib_ros.config import Config, load_stages
from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.datasets.kitti_files import Timestamps, read_image
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import NANOSECONDS, PointCloud
from calib_ros.lidar.range_image import range_image
from calib_ros.messages import decode_camera_info, decode_cloud, decode_compressed_image, decode_image

K = np.array([[70.0, 0, 48], [0, 70, 32], [0, 0, 1]])
MIB = 2**20


def loose(message: Any) -> SimpleNamespace:
    """The same message without types, so that it can hold anything."""
    return SimpleNamespace(**{name: getattr(message, name) for name in message.__dataclass_fields__ if name != "__msgtype__"})


@pytest.mark.parametrize("size", [(2**31, 2**31), (2**32 - 1, 1), (1, 2**32 - 1), (60_000, 60_000)])
def test_declared_sizes_cost_no_memory(size):
    fuzzer = MessageFuzzer(0, "rosbags")
    width, height = size
    changes = {"width": width, "height": height}
    cloud, image = loose(fuzzer.cloud()), loose(fuzzer.good_image())
    info = loose(fuzzer.make.camera_info(WIDTH, 64, K, [0.1, 0, 0, 0, 0]))
    tracemalloc.start()
    for decode, message, more in (
        (decode_cloud, cloud, {"row_step": 0, "point_step": 1}),
        (decode_cloud, cloud, {"row_step": 0}),
        (decode_image, image, {"step": 0}),
        (decode_image, image, {"step": 2**32 - 1}),
        (decode_camera_info, info, {}),
    ):
        with pytest.raises(BadInputError):
            decode(SimpleNamespace(**{**vars(message), **changes, **more}))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < MIB


def test_image_size_is_limited_by_its_bytes(tmp_path: Path):
    """Truncated ones have no grey rest. Yet a black picture, which hardly has any bytes, is one."""
    ros = Messages("rosbags")
    whole = cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8))[1].tobytes()
    at = whole.index(b"\xff\xc0") + 5
    for data in (
        *(png_header(60_000, 60_000, 2), png_header(15_000, 15_000, 6), b"P5\n16000 16000\n255\n" + bytes(500)),
        *(whole[: len(whole) // 2], whole[:-2], whole[:at] + struct.pack(">HH", 60_000, 60_000) + whole[at + 4 :]),
    ):
        with pytest.raises(BadInputError, match="not a complete JPEG, PNG or BMP"):
            decode_compressed_image(ros.compressed("png", data))
        (tmp_path / "000000.png").write_bytes(data)
        with pytest.raises(BadInputError, match="is no complete PNG"):
            read_image(tmp_path / "000000.png")
    assert decode_compressed_image(ros.compressed("jpeg", whole + bytes(100))).shape == (48, 64, 3)
    for suffix, channels in itertools.product((".png", ".jpg"), ((), (3,))):
        black = cv2.imencode(suffix, np.zeros((1080, 1920, *channels), np.uint8))[1].tobytes()
        assert decode_compressed_image(ros.compressed("x", black)).shape == (1080, 1920, *channels)


def test_extreme_cameras_are_refused_or_cost_nothing_before_their_first_image():
    with pytest.raises(BadInputError, match="beyond 32766 px a side"):
        Camera(K, 2**31, 64)
    with pytest.raises(BadInputError, match="do not allow rectification"):
        decode_camera_info(Messages("rosbags").camera_info(96, 64, K, [0, 0, 10, 10, 0]))
    tracemalloc.start()
    rectify = Rectifier(Camera(K, 30_000, 30_000, "plumb_bob", np.array([0.01, 0, 0, 0, 0])))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert rectify.camera.width == 30_000
    assert peak < MIB


@pytest.mark.parametrize("layout", ["auto", "rings", "projection"])
def test_a_range_image_has_no_millions_of_cells_for_a_thousand_points(layout):
    rng = np.random.default_rng(1)
    near = np.r_[rng.normal(0, 1e-4, 500), rng.uniform(-1.5, 1.5, 500)]
    azimuth = np.r_[rng.normal(0, 1e-4, 500), rng.uniform(-3, 3, 500)]
    xyz = 10 * np.stack([np.cos(near) * np.cos(azimuth), np.cos(near) * np.sin(azimuth), np.sin(near)], 1)
    scan = range_image(PointCloud(xyz.astype(np.float32)), Config.from_dict({"lidar": {"layout": layout}}).lidar)
    assert scan.range.size <= 450_000
    columns = scan.range.shape[1]
    assert scan.azimuth_step == pytest.approx(2 * np.pi / columns, rel=0.5 / columns + 1e-9)


ALIASES = "aliases are not supported"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (LAUGHS, ALIASES),
        (MERGES, ALIASES),
        ("search: {seed: 0x" + "f" * 6000 + "}", "more than 1000 digits"),
        ('"a\\nb": 1', "a key that is no name"),
        ("search: {seed: '" + "x" * 5000 + "'}", "xxx... must be of type int"),
    ],
)
def test_yaml_that_expands_or_cannot_be_printed_is_refused_in_one_line(tmp_path: Path, text: str, says: str):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=says) as caught:
        Config.from_dict(load_stages(path))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 700
    if says == ALIASES:
        with pytest.raises(BadInputError, match="neither valid JSON nor YAML"):
            result.load(path)


@pytest.mark.parametrize("path", ["/dev/zero", "/dev/urandom"])
def test_endless_files_are_refused(path: str):
    with pytest.raises(BadInputError, match="has more than 1000000 bytes; give a file like"):
        load_stages(path)
    with pytest.raises(BadInputError, match="has more than 1000000 bytes; give a JSON or YAML result"):
        result.load(path)


def test_texts_of_a_result_can_be_written_and_sent():
    text = '{"T_camera_lidar": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]], "status": "a\\nb", "reason": "\\ud800"}'
    loaded = result.parse(text, "x")
    assert (loaded.status, loaded.reason) == ("a b", "?")


@pytest.mark.parametrize(
    "line", ["2011-09-26 13:02:25 +02:00", "2011-09-26 13:02:25.0123456789", "1e299", "-3e9", "9999-01-01 1:2:3"]
)
def test_stamps_beyond_message_limits_are_refused(tmp_path: Path, line: str):
    (tmp_path / "times.txt").write_text(line + "\n2011-09-26T13:02:25Z\n")
    stamps = Timestamps(tmp_path / "times.txt")
    with pytest.raises(BadInputError, match="no timestamp on line 1"):
        stamps.ns(0)
    assert stamps.ns(1) == 1_317_042_145 * NANOSECONDS


@pytest.mark.parametrize(("stamp", "cloud_stamp"), [(-1, None), (2**31 * NANOSECONDS, None), (5, 2**31 * NANOSECONDS)])
def test_stamps_beyond_bag_limits_are_refused(tmp_path: Path, stamp: int, cloud_stamp: int | None):
    listed = Listed([replace(frame, stamp=stamp, cloud_stamp=cloud_stamp) for frame in frames(1)])
    with pytest.raises(BadInputError, match=r"frame 0 of listed is stamped .* correct the timestamps"):
        write_bag(listed, tmp_path / "bag")
    assert not list(tmp_path.iterdir())


def test_nonsensical_bag_metadata_is_refused(tmp_path: Path):
    bag = next(iter(originals(tmp_path)))
    good = (bag / "metadata.yaml").read_text()
    for text in (
        good.replace("message_count: 2", "message_count: two"),
        good.replace("name: /camera/image_raw", "name: 5"),
        MERGES + good,
    ):
        assert text != good
        (bag / "metadata.yaml").write_text(text)
        with pytest.raises(BadInputError, match=r"cannot be read .*; recover it with") as caught:
            open_dataset(bag)
        assert "\n" not in str(caught.value)
