"""~/capture over DDS: the raw frames of the newest keyframes as a bag that the command line calibrates."""

from __future__ import annotations

import json
import threading
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from ros_peer import Peer, camera_info_message, cloud_message, start_parameters
from scenes import is_near
from sensor_msgs.msg import CompressedImage
from std_srvs.srv import Trigger
from waiting import LIMIT_S

from calib_ros import se3
from calib_ros.cli.main import main
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.datasets.capture import read_events
from calib_ros.errors import BadInputError
from calib_ros.result import INITIAL, SUSPECT, Result, load
from calib_ros.ros import capture as capture_module
from calib_ros.ros.capture import RawKeyframe, _write_bag
from calib_ros.ros.conversions import Serialized, image_message

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]


def start(T: np.ndarray, folder: Path | str = "", frames: int = 0) -> dict[str, Any]:
    return {**start_parameters(T), "online__mode": "manual", "capture_dir": str(folder), "capture_frames": frames}


def folders(path: Path) -> list[Path]:
    return sorted(path.iterdir())


def test_capture_contains_the_received_frames(street, drive, tmp_path, capsys):
    off = se3.perturb(drive.reference, [0.4, -0.3, 0.3], [0.02, -0.02, 0.02])
    captures = tmp_path / "made" / "on demand"
    with Peer(**start(off, captures, 5), search__rotation_deg=1.5) as peer:
        assert "no keyframe" in peer.refusal("capture")
        peer.drive(street)
        done = peer.trigger("capture")
        assert done.success, done.message
        assert peer.trigger("capture").success  # a second one beside the first
        assert peer.calibration.health.errors == 0
        peer.until(lambda: any(value == "5" for key, value in peer.values.items() if "raw" in key), "the number of raw keyframes")
    first, second = folders(captures)
    assert done.message == f"5 keyframes saved to {first}"
    for folder in (first, second):
        assert [path.name for path in folders(folder)] == ["bag", "config.yaml", "events.jsonl", "result.json"]
        assert [event["event"] for event in read_events(folder)].count("keyframe") == len(street)
    with open_dataset(first / "bag") as source:
        assert (source.image_topic, source.points_topic, source.camera_info_topic) == ("/image", "/points", "/camera_info")
        assert (source.camera_frame, source.lidar_frame) == ("camera", "velodyne")
        assert len(source) == 5
        for frame, sent in zip((source[i] for i in range(5)), street[-5:], strict=True):
            np.testing.assert_array_equal(frame.image, sent.image)
            np.testing.assert_array_equal(frame.cloud.xyz, sent.cloud.xyz)
            np.testing.assert_array_equal(frame.cloud.intensity, sent.cloud.intensity)
            assert (frame.stamp, frame.camera) == (sent.stamp, sent.camera)
            np.testing.assert_allclose(frame.reference, off, atol=1e-9)
    np.testing.assert_allclose(load(first / "result.json").T_camera_lidar, off, atol=1e-9)
    config = Config.from_yaml(first / "config.yaml")
    assert (config.search.rotation_deg, config.online.mode) == (1.5, "manual")
    files = [str(first / "bag"), "--initial", str(first / "result.json"), "--config", str(first / "config.yaml")]
    assert main(["calibrate", *files, "--json", "-", "--search-deg", "0", "--search-m", "0"]) == 0
    assert is_near(drive.reference, np.array(json.loads(capsys.readouterr().out)["T_camera_lidar"]), 0.3, 0.08)


def test_the_service_says_what_it_needs(street, drive, tmp_path):
    """A folder and a number of frames, given while the node runs; a folder that cannot be written is named, and nothing stays."""
    (tmp_path / "file").write_text("")
    with Peer(**start(drive.reference)) as peer:
        peer.publish(street[0])
        assert len(peer.calibration.capture) == 0
        assert "set the parameters capture_dir to a folder and capture_frames" in peer.refusal("capture")
        peer.change(capture_dir=str(tmp_path / "file"), capture_frames=3)
        peer.drive(street[1:6])
        assert len(peer.calibration.capture) == 3
        assert f"{tmp_path / 'file'} cannot be written" in peer.refusal("capture")
        peer.change(capture_dir=str(tmp_path / "good"))
        assert "capture_frames" in peer.set(capture_frames=201)
        peer.change(capture_frames=1)  # fewer frames free memory at once
        peer.until(lambda: len(peer.calibration.capture) == 1)
        assert peer.trigger("capture").message.startswith("1 keyframes saved")
        assert len(folders(tmp_path / "good")) == 1
        assert peer.trigger("reset").success
        assert peer.refusal("capture")


def test_compressed_and_rectified_images(street, drive, tmp_path):
    """The bag's topic says that the images are rectified, so that the right numbers of CameraInfo count."""
    options = {"image_transport": "compressed", "image_is_rectified": True}
    with Peer(CompressedImage, **start(drive.reference, tmp_path, 2), **options) as peer:
        frame = street[0]
        peer.publish_camera(frame)
        message = CompressedImage(format="png", data=cv2.imencode(".png", frame.image)[1].tobytes())
        message.header = image_message(frame.image, "camera", frame.stamp).header
        peer.send(message, cloud_message(frame.cloud, frame.stamp))
        camera = peer.pipeline.camera
        assert peer.trigger("capture").success
    with open_dataset(folders(tmp_path)[0] / "bag") as source:
        assert (source.image_topic, source.rectified, source.camera) == ("/image_rect", True, camera)
        np.testing.assert_array_equal(source[0].image, frame.image)


def test_callbacks_go_on_during_a_capture_and_the_node_finishes_it_before_it_ends(street, drive, tmp_path, monkeypatch):
    with Peer(**start(drive.reference, tmp_path, 8)) as peer:
        peer.publish(street[0])
        capture, held, threads = peer.calibration.capture, threading.Event(), []
        write = capture.write

        def slowly() -> str:
            threads.append(threading.current_thread().name)
            assert held.wait(LIMIT_S)
            return write()

        monkeypatch.setattr(capture, "write", slowly)
        answer = peer.call_async(peer._triggers["capture"], Trigger.Request())
        peer.until(lambda: threads)
        peer.drive(street[1:8])
        assert peer.recalibrator.keyframes.seen == 8
        assert peer.get_extrinsic().extrinsic.status == "initial"
        assert not answer.done()
        threading.Timer(0.1, held.set).start()
        peer.node.stop()  # waits for it
        (folder,) = folders(tmp_path)
    assert threads == ["calib_files_0"]
    assert folder.name.startswith("capture_")
    with open_dataset(folder / "bag") as source:
        assert len(source) == 8


def test_clocks_of_clouds_may_count_from_elsewhere(street, tmp_path):
    """As those of a LiDAR that counts from its start: the bag tells which messages came together."""
    later = 10**18

    def received(message: Any) -> Serialized:
        return Serialized(message.header, serialize_message(message), partial(deserialize_message, message_type=type(message)))

    kept = [
        RawKeyframe(
            received(image_message(f.image, "camera", f.stamp)),
            received(cloud_message(f.cloud, f.stamp - later)),
            received(camera_info_message(f)),
        )
        for f in street
    ]
    _write_bag(tmp_path / "bag", kept, Result(street[0].reference, INITIAL), False)
    with open_dataset(tmp_path / "bag") as source:
        assert len(source) == len(street)


def size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def test_the_black_box_keeps_to_number_and_size_and_captures_on_request_stay(street, drive, tmp_path, monkeypatch):
    with Peer(**start(drive.reference, tmp_path, 5)) as peer:
        peer.drive(street[:5])
        assert peer.trigger("capture").success
        capture, result = peer.calibration.capture, peer.recalibrator.current.result

        def record() -> tuple[int, Path]:
            """How many keyframes were written where."""
            words = capture.write_occasion(SUSPECT, result, "{}\n").split()
            return int(words[0]), Path(words[-1])

        monkeypatch.setattr(capture_module, "KEPT", 2)
        for _ in range(4):
            count, newest = record()
        on_request, *events = folders(tmp_path)
        assert on_request.name.startswith("capture_")
        assert (count, len(events)) == (5, 2)
        assert newest in events
        assert size_of(newest) > sum(len(f.image.data) + len(f.cloud.data) for f in capture._frames)

        for most, keyframes in ((2 * size_of(newest) - 1_000_000, 5), (size_of(newest) // 2, 2)):
            monkeypatch.setattr(capture_module, "MOST_BYTES", most)
            count, newest = record()
            assert (count, [on_request, newest]) == (keyframes, folders(tmp_path))
            assert size_of(newest) <= most
        monkeypatch.setattr(capture_module, "MOST_BYTES", 100_000)
        with pytest.raises(BadInputError, match="nothing captured of suspect: there is no keyframe, or one takes all"):
            record()
        assert folders(tmp_path) == [on_request, newest]
