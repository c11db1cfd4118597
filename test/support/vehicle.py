"""A node that has found its extrinsic and a vehicle that drives on, for tests of faults."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from itertools import cycle
from typing import Any

import numpy as np
import pytest
from ros_peer import Peer, camera_info_message, cloud_message, start_parameters
from scenes import is_near

from calib_ros import se3
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.ros.client import result_from_message
from calib_ros.ros.conversions import image_message
from calib_ros_synthetic.drive import SyntheticDrive

QUICK = {
    "search__rounds": 1,
    "search__starts": 64,
    "online__min_keyframes": 4,
    "online__buffer_size": 6,
    "tracker__confirmations": 0,
}
CLOSE_DEG, CLOSE_M = 0.4, 0.12  # of five frames of the small street


def off(reference: np.ndarray) -> np.ndarray:
    """A start that the node has to leave: by 1.8 deg and 11 cm."""
    return se3.perturb(reference, [1.2, -1.0, 0.8], [0.08, -0.05, 0.06])


def is_right(reference: np.ndarray, extrinsic: Any, factor: float = 1.0) -> bool:
    return is_near(reference, result_from_message(extrinsic).T_camera_lidar, CLOSE_DEG * factor, CLOSE_M * factor)


class Vehicle:
    """A node that has found its extrinsic, and frames without end: stamps go on, and a frame differs from the one before."""

    def __init__(self, peer: Peer, street: list[Frame], reference: np.ndarray) -> None:
        self.peer, self.reference = peer, reference
        self.stamp = street[0].stamp
        self._street = cycle(street)
        self._published_before = 0

    def frame(self, after_s: float = 2.0, **changed: Any) -> Frame:
        """The next frame, so much later than the last one."""
        self.stamp += int(after_s * NANOSECONDS)
        return dataclasses.replace(next(self._street), **{"stamp": self.stamp, "cloud_stamp": None, **changed})

    def send(self, frame: Frame, image: Any = None, cloud: Any = None) -> None:
        """A frame, or other messages in its place, that may not become a pair."""
        self.peer.send(
            image or image_message(frame.image, "camera", frame.stamp), cloud or cloud_message(frame.cloud, frame.stamp)
        )

    def assert_recovers(self) -> None:
        """New pairs are taken in, an estimate is accepted and the service answers with it."""
        peer = self.peer
        peer.info_pub.publish(camera_info_message(self.frame()))
        peer.until(lambda: peer.pipeline.camera == self.frame(0).camera, "the right camera")
        recalibrator = peer.recalibrator
        accepted, keyframes = recalibrator.current.accepted, recalibrator.keyframes.seen
        for _ in range(8):
            peer.publish(self.frame())
            if recalibrator.current.accepted > accepted:
                break
        assert recalibrator.keyframes.seen > keyframes, peer.last_error()
        assert recalibrator.current.accepted > accepted, recalibrator.current.result.reason
        answer = peer.get_extrinsic()
        assert answer.success
        assert answer.extrinsic.status == "converged"
        assert is_right(self.reference, answer.extrinsic)

    def assert_kept(self) -> None:
        """The current extrinsic is right, usable or not, and so was whatever was published since the last call."""
        answer = self.peer.get_extrinsic()
        assert answer.last_good_known
        assert is_right(self.reference, answer.last_good)
        assert is_right(self.reference, answer.extrinsic)
        new, self._published_before = self.peer.extrinsics[self._published_before :], len(self.peer.extrinsics)
        assert all(is_right(self.reference, extrinsic, 1.5) for extrinsic in new)

    def forget_published(self) -> None:
        self._published_before = len(self.peer.extrinsics)


@pytest.fixture(scope="module", name="vehicle")
def vehicle_fixture(
    ros_in_this_process: None, drive: SyntheticDrive, street: list[Frame], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Vehicle]:
    state = tmp_path_factory.mktemp("vehicle") / "state" / "state.json"
    with Peer(**start_parameters(off(drive.reference)), **QUICK, state_file=str(state), initial_from_tf=False) as peer:
        vehicle = Vehicle(peer, street, drive.reference)
        peer.publish(vehicle.frame())
        vehicle.assert_recovers()
        vehicle.assert_recovers()
        vehicle.forget_published()
        yield vehicle
