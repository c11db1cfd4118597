"""~/capture over DDS: the raw frames of the newest keyframes as a bag that the command line calibrates."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from ros_peer import Peer, cloud_message, start_parameters
from sensor_msgs.msg import CompressedImage
from std_srvs.srv import Trigger
from waiting import LIMIT_S, until

from calib_ros import se3
from calib_ros.cli.main import main
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.result import load
from calib_ros.ros.conversions import image_message

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]


def start(T: np.ndarray) -> dict[str, Any]:
    return {**start_parameters(T), "online__mode": "manual"}


def folders(path: Path) -> list[Path]:
    return sorted(path.iterdir())


def test_capture_contains_the_received_frames(street, drive, tmp_path, capsys):
    off = se3.perturb(drive.reference, [0.4, -0.3, 0.3], [0.02, -0.02, 0.02])
    captures = tmp_path / "made" / "on demand"
    options = {"capture_dir": str(captures), "capture_frames": 5, "search__rotation_deg": 1.5}
    with Peer(**start(off), **options) as peer:
        assert "no keyframe" in peer.refusal("capture")
        peer.drive(street)
        done = peer.trigger("capture")
        assert done.success, done.message
        assert peer.trigger("capture").success  # a second one beside the first
        assert peer.calibration.health.errors == 0
        peer.until(lambda: any(value == "5" for key, value in peer.values.items() if "raw" in key), "the number of raw keyframes")
    first, second = folders(captures)
    assert done.message == f"5 keyframes saved to {first}"
    assert [path.name for path in folders(first)] == ["bag", "config.yaml", "result.json"]
    assert [path.name for path in folders(second)] == ["bag", "config.yaml", "result.json"]

    with open_dataset(first / "bag") as source:
        assert (source.image_topic, source.points_topic, source.camera_info_topic) == ("/image", "/points", "/camera_info")
        assert (source.camera_frame, source.lidar_frame) == ("camera", "velodyne")
        assert len(source) == 5
        for frame, sent in zip((source[i] for i in range(5)), street[-5:], strict=True):
            np.testing.assert_array_equal(frame.image, sent.image)
            np.testing.assert_array_equal(frame.cloud.xyz, sent.cloud.xyz)
            np.testing.assert_array_equal(frame.cloud.intensity, sent.cloud.intensity)
            assert frame.stamp == sent.stamp
            assert frame.camera == sent.camera
            np.testing.assert_allclose(frame.reference, off, atol=1e-9)
    np.testing.assert_allclose(load(first / "result.json").T_camera_lidar, off, atol=1e-9)
    config = Config.from_yaml(first / "config.yaml")
    assert config.search.rotation_deg == 1.5
    assert config.online.mode == "manual"

    code = main(
        [
            *("calibrate", str(first / "bag"), "--initial", str(first / "result.json"), "--config", str(first / "config.yaml")),
            *("--json", "-", "--search-deg", "0", "--search-m", "0"),
        ]
    )
    result = json.loads(capsys.readouterr().out)
    assert code == 0
    T = np.array(result["T_camera_lidar"])
    assert se3.rotation_error_deg(drive.reference, T) < 0.3
    assert se3.translation_error_m(drive.reference, T) < 0.08


def test_the_service_says_how_to_enable_it(street, drive, tmp_path):
    with Peer(**start(drive.reference)) as peer:
        peer.publish(street[0])
        assert len(peer.calibration.capture) == 0
        assert "set the parameters capture_dir to a folder and capture_frames" in peer.refusal("capture")
        # Enabled while the node runs, and bounded; fewer frames free memory at once.
        peer.change(capture_dir=str(tmp_path), capture_frames=3)
        peer.drive(street[1:6])
        assert len(peer.calibration.capture) == 3
        assert "capture_frames" in peer.set(capture_frames=201)
        peer.change(capture_frames=1)
        peer.until(lambda: len(peer.calibration.capture) == 1)
        assert peer.trigger("capture").message.startswith("1 keyframes saved")
        assert peer.trigger("reset").success
        assert peer.refusal("capture")


def test_a_folder_that_cannot_be_written_is_named_and_nothing_stays(street, drive, tmp_path):
    (tmp_path / "file").write_text("")
    with Peer(**start(drive.reference), capture_dir=str(tmp_path / "file"), capture_frames=2) as peer:
        peer.publish(street[0])
        assert str(tmp_path / "file") in peer.refusal("capture")
        peer.change(capture_dir=str(tmp_path / "good"))
        assert peer.trigger("capture").success
        assert len(folders(tmp_path / "good")) == 1


def test_compressed_and_rectified_images(street, drive, tmp_path):
    """The bag's topic says that the images are rectified, so that the right numbers of CameraInfo count."""
    options = {"capture_dir": str(tmp_path), "capture_frames": 2, "image_transport": "compressed", "image_is_rectified": True}
    with Peer(CompressedImage, **start(drive.reference), **options) as peer:
        frame = street[0]
        peer.publish_camera(frame)
        message = CompressedImage(format="png", data=cv2.imencode(".png", frame.image)[1].tobytes())
        message.header = image_message(frame.image, "camera", frame.stamp).header
        peer.send(message, cloud_message(frame.cloud, frame.stamp))
        camera = peer.pipeline.camera
        assert peer.trigger("capture").success
    with open_dataset(folders(tmp_path)[0] / "bag") as source:
        assert source.image_topic == "/image_rect"
        assert source.rectified
        assert source.camera == camera
        np.testing.assert_array_equal(source[0].image, frame.image)


def test_callbacks_go_on_during_a_capture(street, drive, tmp_path, monkeypatch):
    with Peer(**start(drive.reference), capture_dir=str(tmp_path), capture_frames=2) as peer:
        peer.publish(street[0])
        capture, held, threads = peer.calibration.capture, threading.Event(), []
        write = capture.write

        def slowly(pipeline: Any) -> str:
            threads.append(threading.current_thread().name)
            assert held.wait(LIMIT_S)
            return write(pipeline)

        monkeypatch.setattr(capture, "write", slowly)
        answers: list[Any] = []
        asking = threading.Thread(target=lambda: answers.append(peer.trigger("capture")))
        asking.start()
        peer.until(lambda: threads)
        peer.drive(street[1:4])
        assert peer.recalibrator.keyframes_seen == 4
        assert peer.get_extrinsic().extrinsic.status == "initial"
        assert not answers
        held.set()
        asking.join()
        assert answers[0].success
        assert threads == ["calib_capture_0"]


def test_node_finishes_a_capture_before_it_ends(street, drive, tmp_path):
    with Peer(**start(drive.reference), capture_dir=str(tmp_path), capture_frames=8) as peer:
        peer.drive(street)
        peer.call_async(peer._triggers["capture"], Trigger.Request())
        until(lambda: any(tmp_path.iterdir()), "the capture to begin", turn=lambda: time.sleep(0.001))
        peer.node.stop()
        names = [path.name for path in folders(tmp_path)]
    assert len(names) == 1
    assert names[0].startswith("capture_")
    with open_dataset(tmp_path / names[0] / "bag") as source:
        assert len(source) == 8
