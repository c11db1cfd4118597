"""The black box over DDS: what a node records when its sensors or its extrinsic go wrong, and what the check says of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ros_peer import Peer, start_parameters
from scenes import is_near
from vehicle import CLOSE_DEG, CLOSE_M, QUICK, Vehicle, is_right, off, vehicle_fixture  # noqa: F401  # a fixture

from calib_ros import se3
from calib_ros.cli.main import main
from calib_ros.datasets import open_dataset
from calib_ros.datasets.capture import read_events
from calib_ros.export import FORMER
from calib_ros.frame import Frame
from calib_ros.result import load
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
KNOCK = ([0.9, 1.5, -0.9], [0.03, -0.03, 0.02])  # 2 deg / 5 cm


def recorded(folder: Path, kind: str) -> Path | None:
    return next(folder.glob(f"event_*_{kind}"), None)


def test_a_covered_lens_is_recorded_with_a_picture_of_it(vehicle: Vehicle, street: list[Frame], tmp_path: Path) -> None:
    peer = vehicle.peer
    assert "capture.on needs a folder in capture_dir and in capture_frames" in peer.set(capture__on=["blinded"])
    assert "capture.on = 'blind' must be one of moved, refused" in peer.set(
        capture__on=["blind"], capture_dir="x", capture_frames=3
    )
    peer.change(capture__on=["blinded"], capture_dir=str(tmp_path), capture_frames=3)
    peer.drive(vehicle.frame() for _ in range(3))
    last = vehicle.stamp
    peer.drive(vehicle.frame(image=np.zeros_like(street[0].image)) for _ in range(4))
    assert peer.get_extrinsic().extrinsic.status == "blinded"
    folder = peer.until(lambda: recorded(tmp_path, "blinded"), "the record")
    with open_dataset(folder / "bag") as bag:
        before, dark = bag[1], bag[2]
        assert (len(bag), before.stamp) == (3, last)
        assert not dark.image.any()
    assert is_right(vehicle.reference, peer.get_extrinsic().last_good)
    assert np.allclose(load(folder / "result.json").T_camera_lidar, peer.recalibrator.current.result.T_camera_lidar)
    *_, told = read_events(folder)
    assert (told["event"], told["kind"]) == ("capture", "blinded")
    assert "the camera shows nothing" in told["reason"]
    peer.publish(vehicle.frame())
    peer.change(capture__on=[], capture_frames=0)


def test_a_folder_that_cannot_be_written_is_one_line(vehicle: Vehicle, street: list[Frame], tmp_path: Path) -> None:
    peer = vehicle.peer
    (tmp_path / "file").write_text("")
    peer.change(capture__on=["blinded"], capture_dir=str(tmp_path / "file"), capture_frames=3)
    peer.drive(vehicle.frame() for _ in range(3))
    peer.calibration.capture.black_box._begun.clear()  # the one of another test
    peer.drive(vehicle.frame(image=np.zeros_like(street[0].image)) for _ in range(3))
    peer.until(lambda: f"{tmp_path / 'file'} cannot be written" in peer.last_error(), "the reason")
    peer.change(capture__on=[], capture_frames=0)
    vehicle.assert_recovers()


@pytest.mark.slow
def test_a_knock_is_recorded_explained_by_the_check_and_written_back_once_found(
    drive: SyntheticDrive, street: list[Frame], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    boxes, result = tmp_path / "boxes", tmp_path / "result.json"
    settings = {"capture_dir": str(boxes), "capture_frames": 20, "capture__on": ["moved", "suspect"]}
    knocked = se3.perturb(drive.reference, *KNOCK)
    with Peer(**start_parameters(off(drive.reference)), **QUICK, **settings, export__on_converged=[str(result)]) as peer:
        before, after = (
            Vehicle(peer, street, drive.reference),
            Vehicle(peer, [drive.moved(k, knocked) for k in range(8)], knocked),
        )
        peer.publish(before.frame())
        before.assert_recovers()
        before.assert_recovers()
        peer.calibration.files.submit(int).result()  # files are written one after the other
        written, after.stamp = result.read_text(), before.stamp
        statuses = []
        for _ in range(12):
            peer.publish(after.frame())
            statuses.append(peer.get_extrinsic().extrinsic.status)
            if "moved" in statuses and statuses[-1] == "converged":
                break
        assert is_right(knocked, peer.get_extrinsic().extrinsic)
        folder = peer.until(lambda: recorded(boxes, "moved"), "the record")
        peer.until(lambda: Path(f"{result}{FORMER}").exists() and result.read_text() != written, "the new extrinsic")
    assert recorded(boxes, "suspect")
    assert Path(f"{result}{FORMER}").read_text() == written
    assert is_near(knocked, load(result).T_camera_lidar, CLOSE_DEG, CLOSE_M)
    used = load(folder / "result.json")
    assert used.status == "moved"
    np.testing.assert_allclose(used.T_camera_lidar, load(f"{result}{FORMER}").T_camera_lidar, atol=0.01)

    assert main(["check", str(folder), "--json", str(tmp_path / "check.json")]) == 1  # fail
    said, told = capsys.readouterr().out, json.loads((tmp_path / "check.json").read_text())
    assert (told["verdict"], told["cause"]) == ("fail", None)
    np.testing.assert_allclose(told["T_checked"], used.T_camera_lidar, atol=1e-9)
    assert is_near(knocked, np.array(told["T_estimated"]), 0.4, 0.1)
    assert told["rotation"]["error"] == pytest.approx(np.linalg.norm(KNOCK[0]), abs=0.4)
    assert "the node said moved: the calibration has moved" in said
    assert "checked is result.json, the extrinsic that the node used, by the" in said
