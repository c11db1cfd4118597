"""Broken messages and files are refused in one line or used; they never cause a crash, a hang or excessive memory."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from fuzz_runner import Listed, frames, originals
from fuzzing import LAUGHS, MERGES, WIDTH, MessageFuzzer, png_header
from paths import ROOT, SUPPORT
from ros_messages import Messages

from calib_ros import result, se3
from calib_ros.camera import Camera, Rectifier
from calib_ros.config import Config, LidarConfig, load_stages
from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.datasets.kitti_files import Timestamps, read_picture
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.lidar.range_image import range_image
from calib_ros.messages import decode_camera_info, decode_cloud, decode_compressed_image, decode_image
from calib_ros_synthetic.drive import SyntheticDrive

RUNNER = SUPPORT / "fuzz_runner.py"
pytestmark = pytest.mark.usefixtures("ros_in_this_process")
K = np.array([[70.0, 0, 48], [0, 70, 32], [0, 0, 1]])
MIB = 2**20


def fuzz(what: str, count: int, seed: int = 0, seconds: float = 240) -> dict[str, Any]:
    """A run of the fuzzer in its own process: it ends itself where a case hangs, and has 1.5 GiB to work with."""
    command = [sys.executable, "-W", "error", str(RUNNER), what, str(seed), str(count)]
    environment = {**os.environ, "PYTHONPATH": f"{SUPPORT}{os.pathsep}{ROOT}"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, env=environment, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    report: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    assert not report["failures"], "\n".join(report["failures"][:5])
    assert report["grown"] < 150, "MiB that were not given back"
    return report


def total(report: dict[str, Any], *kinds: str) -> int:
    return sum(count for name, count in report["outcomes"].items() if name.rpartition(" ")[0] in kinds)


def cases(short: int, long: int) -> pytest.MarkDecorator:
    """So many cases in `make test`, and at length in `make test-all`."""
    return pytest.mark.parametrize("count", [short, pytest.param(long, marks=pytest.mark.slow)])


@pytest.mark.parametrize("seed", [0, pytest.param(100, marks=pytest.mark.slow)])
@cases(300, 5500)
def test_mutated_messages(seed, count):
    report = fuzz("messages", count, seed)
    assert total(report, "cloud", "image", "compressed", "camera_info") == count
    assert report["most"][0] < 100, "MiB for a message of at most 200 kB"
    # Mutations that leave nothing to decode, or nothing to refuse, would show nothing.
    for kind in ("cloud", "image", "compressed", "camera_info", "scan in use", "camera in use"):
        assert min(report["outcomes"][f"{kind} {what}"] for what in ("taken", "refused")) > count // 200


@cases(80, 600)
def test_mutated_messages_in_the_pipeline(count):
    report = fuzz("pipeline", count)
    assert total(report, "pair") == count
    assert report["outcomes"]["pipeline says"] > count // 6
    assert report["outcomes"]["extrinsics"] > count // 60


@cases(180, 900)
def test_mutated_texts(count):
    report = fuzz("texts", count)
    assert total(report, "config", "result", "state") == count
    assert min(report["outcomes"][f"{kind} taken"] for kind in ("config", "result", "state")) > count // 180


@cases(200, 900)
def test_mutated_bags_and_folders(count):
    report = fuzz("folders", count)
    kinds = ("bag_mcap", "bag_sqlite3", "raw", "odometry", "object", "plain", "nuscenes")
    assert total(report, *kinds) == count
    assert min(report["outcomes"][f"{kind} {what}"] for kind in kinds for what in ("taken", "refused")) > count // 90


@cases(30, 300)
def test_mutated_files_through_the_command_line(count):
    report = fuzz("cli", count)
    assert sum(report["outcomes"][f"code {code}"] for code in (0, 1, 2)) == count
    assert min(report["outcomes"][f"code {code}"] for code in (0, 2)) >= count // 15


@pytest.mark.ros
@pytest.mark.slow
def test_mutated_messages_over_dds(street: list[Frame], drive: SyntheticDrive, capfd: pytest.CaptureFixture[str]) -> None:
    """A node with an extrinsic gets some hundred broken messages, keeps it, and then works as before."""
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    from ros_peer import Peer, camera_info_message, cloud_message

    from calib_ros.ros.client import result_from_message
    from calib_ros.ros.conversions import image_message, time_message

    fuzzer = MessageFuzzer(3, "rclpy", wild=False)
    start = {
        "initial_translation_m": drive.reference[:3, 3].tolist(),
        "initial_quaternion_xyzw": se3.quaternion_from_rotation(drive.reference[:3, :3]).tolist(),
        "reliability": "reliable",
        "image_is_rectified": False,
    }
    quick = {"search__rounds": 2, "search__starts": 512}
    quick |= {"online__min_keyframes": 4, "tracker__confirmations": 0}
    with Peer(**start, **quick) as peer:
        for frame in street[:6]:
            peer.publish(frame)
        before = peer.get_extrinsic()
        assert before.success
        stamp, last = street[5].stamp, street[6]
        counts = peer.calibration.pipeline.synchronizer.counts
        for k in range(200):
            stamp += NANOSECONDS
            info, image, cloud = fuzzer.camera_info(), fuzzer.image(), fuzzer.cloud(stamp)
            if k % 2:  # broken, but of the right sensor
                info = camera_info_message(last)
                image = image_message(last.image[:: 1 + k % 3], "camera", stamp)
                cloud = cloud_message(last.cloud, stamp)
                cloud.data = cloud.data[: int(fuzzer.rng.integers(len(cloud.data)))]
            for message, name in ((info, "camera"), (image, "camera"), (cloud, "velodyne")):
                message.header.frame_id = name if fuzzer.chance(0.9) else "elsewhere"
                if fuzzer.chance(0.9):
                    message.header.stamp = time_message(stamp)
            peer.info_pub.publish(info)
            peer.image_pub.publish(image)
            peer.cloud_pub.publish(cloud)
            # One by one: a queue that overflows on a slow machine loses messages, and they never come.
            peer.until(lambda n=7 + k: counts.images >= n and counts.clouds >= n, 60, what=f"message {k}")
        peer.settle()
        assert peer.calibration.health.errors > 100
        after = peer.get_extrinsic()
        assert after.last_good_known  # a mutated CameraInfo is another camera: the extrinsic is to be tested again
        kept, now = (result_from_message(answer.extrinsic).T_camera_lidar for answer in (before, after))
        np.testing.assert_allclose(now, kept, atol=1e-9)
        good = replace(last, stamp=stamp + 10 * NANOSECONDS, cloud_stamp=None)
        peer.publish(good)
        assert peer.calibration.pipeline.last_keyframe.stamp == good.stamp
    shown = capfd.readouterr()
    assert "Traceback" not in shown.err + shown.out
    assert "unexpected" not in shown.err + shown.out


# --- what fuzzing found, one by one ---------------------------------------------------------------------------------------


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
    ros = Messages("rosbags")
    for data in (png_header(60_000, 60_000, 2), png_header(15_000, 15_000, 6), b"P5\n16000 16000\n255\n" + bytes(500)):
        with pytest.raises(BadInputError, match="not a complete JPEG, PNG or BMP"):
            decode_compressed_image(ros.compressed("png", data))
        (tmp_path / "000000.png").write_bytes(data)
        with pytest.raises(BadInputError, match="missing or unreadable"):
            read_picture(tmp_path / "000000.png")
    small = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    at = small.index(b"\xff\xc0") + 5
    with pytest.raises(BadInputError, match="not a complete JPEG, PNG or BMP"):
        decode_compressed_image(ros.compressed("jpeg", small[:at] + struct.pack(">HH", 60_000, 60_000) + small[at + 4 :]))
    # Yet a black picture, which hardly has any bytes, is one.
    for suffix in (".png", ".jpg"):
        for channels in ((), (3,)):
            black = cv2.imencode(suffix, np.zeros((1080, 1920, *channels), np.uint8))[1].tobytes()
            assert decode_compressed_image(ros.compressed("x", black)).shape == (1080, 1920, *channels)


def test_a_truncated_jpeg_has_no_grey_rest():
    noise = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    whole = cv2.imencode(".jpg", noise)[1].tobytes()
    ros = Messages("rosbags")
    for size in (len(whole) // 2, len(whole) - 2):
        with pytest.raises(BadInputError, match="not a complete JPEG, PNG or BMP"):
            decode_compressed_image(ros.compressed("jpeg", whole[:size]))
    assert decode_compressed_image(ros.compressed("jpeg", whole + bytes(100))).shape == (48, 64, 3)


def test_driver_texts_stay_on_one_line():
    ros, bad = Messages("rosbags"), "x\ny" + "z" * 5000
    for decode, message in (
        (decode_image, ros.image(bad, 2, 2, bytes(4), 2)),
        (decode_compressed_image, ros.compressed(bad, b"")),
        (decode_camera_info, ros.camera_info(96, 64, K, model=bad)),
    ):
        with pytest.raises(BadInputError) as caught:
            decode(message)
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 500


def test_extreme_camera_model_is_refused_or_rectified():
    with pytest.raises(BadInputError, match="beyond 32766 px a side"):
        Camera(K, 2**31, 64)
    ros = Messages("rosbags")
    bent = ros.camera_info(96, 64, K, [0, 0, 10, 10, 0])
    with pytest.raises(BadInputError, match="do not allow rectification"):
        decode_camera_info(bent)


def test_tables_of_a_camera_wait_for_an_image_of_its_size():
    tracemalloc.start()
    rectify = Rectifier(Camera(K, 30_000, 30_000, "plumb_bob", np.array([0.01, 0, 0, 0, 0])))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert rectify.camera.width == 30_000
    assert peak < MIB


@pytest.mark.filterwarnings("error")
def test_coordinates_beyond_any_lidar_range_are_dropped():
    rng = np.random.default_rng(0)
    xyz = rng.normal(0, 10, (500, 3)).astype(np.float32)
    xyz[::5] = rng.choice(np.array([1e6, 1e19, 1e38, -1e38, np.inf, np.nan], np.float32), (100, 3))
    cloud = PointCloud(xyz)
    assert len(cloud.finite()) == 400
    assert len(range_image(cloud, LidarConfig()).cloud) <= 400


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


@pytest.mark.parametrize("text", [LAUGHS, MERGES, LAUGHS.replace("i:", "search:"), "search: &a {seed: *a}"])
def test_yaml_aliases_that_expand_are_refused(tmp_path: Path, text: str):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(BadInputError, match="aliases are not supported"):
        load_stages(path)
    with pytest.raises(BadInputError, match="neither valid JSON nor YAML"):
        result.load(path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("search: {seed: 0x" + "f" * 6000 + "}", "more than 1000 digits"),
        ('"a\\nb": 1', "a key that is no name"),
        ("? [a]\n: 1", "a key that is no name"),
        ("search: {seed: '" + "x" * 5000 + "'}", "xxx... must be of type int"),
    ],
)
def test_unprintable_yaml_is_refused_in_one_line(tmp_path: Path, text: str, says: str):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=says) as caught:
        Config.from_dict(load_stages(path))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 700


def test_a_configuration_from_windows(tmp_path: Path):
    (tmp_path / "a.yaml").write_bytes(b"\xef\xbb\xbfsearch:\r\n  seed: 7\r\n")
    assert load_stages(tmp_path / "a.yaml") == {"search": {"seed": 7}}


@pytest.mark.parametrize("path", ["/dev/zero", "/dev/urandom"])
def test_endless_files_are_refused(path: str):
    with pytest.raises(BadInputError, match="has more than 1000000 bytes; give a file like"):
        load_stages(path)
    with pytest.raises(BadInputError, match="has more than 1000000 bytes; give a JSON or YAML result"):
        result.load(path)


@pytest.mark.parametrize("change", [{"frames_used": -1}, {"frames_used": 2**32}, {"status": ["a"]}, {"camera_frame": {"a": 1}}])
def test_results_beyond_message_limits_are_refused(change: dict[str, Any]):
    with pytest.raises(BadInputError, match=next(iter(change))):
        result.parse(json.dumps({"T_camera_lidar": np.eye(4).tolist(), **change}), "x")


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
