"""A node with a rig and a peer that publishes what its sensors measure, over real DDS in this process."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from calib_ros_msgs.msg import Extrinsic, Rig
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_peer import LATCHED, NodeAndPeer, camera_info_message, cloud_message
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from std_srvs.srv import Trigger
from vehicle import QUICK
from waiting import LIMIT_S

from calib_ros import se3
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.online import pacing
from calib_ros.ros.conversions import image_message, matrix_from_transform
from calib_ros.ros.node import CalibNode
from calib_ros_synthetic.rig import SyntheticRig

Measured = tuple[int, str, Any]  # stamp, sensor, image or cloud
NO_CLOUD = PointCloud(np.zeros((0, 3), np.float32))


def measured(rig: SyntheticRig, cameras: Sequence[str], until_s: float, lidars: int = 1, hz: float = np.inf) -> list[Measured]:
    """What the first LiDARs and some cameras measure, in the order of time. hz: of none more often."""
    found: list[Measured] = []
    for name in (*cameras, *rig.lidars[:lidars]):
        own = rig.pictures(name) if name in cameras else rig.scans(name)
        last = -np.inf
        for k, stamp in enumerate(own.stamps - own.stamps[0]):
            if stamp <= until_s * NANOSECONDS and stamp - last > 0.9 * NANOSECONDS / hz:
                last = stamp
                found.append((own[k][0], name, own[k][1]))
    return sorted(found, key=lambda item: item[:2])


def describe(rig: SyntheticRig, cameras: Sequence[str], path: Path, lidars: int = 1, **changed: Any) -> Path:
    """rig.yaml of the first LiDARs and some cameras, with the priors of the source."""
    sensors: dict[str, Any] = {}
    for name in (*rig.lidars[:lidars], *cameras):
        kind, topic = ("camera", "image") if name in cameras else ("lidar", "points")
        T = rig.prior(name)
        prior = {"translation_m": T[:3, 3].tolist(), "quaternion_xyzw": se3.quaternion_from_rotation(T[:3, :3]).tolist()}
        sensors[name] = {"kind": kind, "topic": f"/{name}/{topic}", "frame": rig.frame_id(name), "prior": prior}
    path.write_text(yaml.safe_dump({"reference": rig.lidars[0], "sensors": sensors} | changed))
    return path


def again(items: Iterable[Measured], after_s: float) -> list[Measured]:
    """The same, so much later."""
    return [(stamp + round(after_s * NANOSECONDS), name, value) for stamp, name, value in items]


class RigPeer(NodeAndPeer):
    """The node under test, its pairs and a peer, each on an executor's thread. parameters: as of `Peer`. lidars: how many of the
    rig's; the cameras are paired with the first one."""

    def __init__(self, rig: SyntheticRig, cameras: Sequence[str], rig_file: Path, lidars: int = 1, **parameters: Any) -> None:
        values = {**QUICK, "semantics__segmentation": "none", "online__rest_period_s": 0.0, "online__max_load": 1.0}
        values |= {"max_data_age_s": 3600.0, "initial_from_tf": False, "publish_period_s": 0.2, **parameters}
        self.rig, self.cameras, self.lidar = rig, tuple(cameras), rig.lidars[0]
        self._patch = pytest.MonkeyPatch()
        self._patch.setattr(pacing, "SAVED_S", 1e6)  # which frames become keyframes must not depend on the machine
        super().__init__(CalibNode, {"rig_file": str(rig_file), **values})
        reliable = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
        topics = [(CameraInfo, f"/{c}/camera_info") for c in cameras] + [(Image, f"/{c}/image") for c in cameras]
        topics += [(PointCloud2, f"/{lidar}/points") for lidar in rig.lidars[:lidars]]
        self.publishers = {topic: self.peer.create_publisher(kind, topic, reliable) for kind, topic in topics}
        self.rigs: list[Rig] = []
        self._sent: dict[tuple[str, str], int] = defaultdict(int)
        self.statuses: dict[str, Any] = {}
        self.extrinsics: dict[str, list[Extrinsic]] = defaultdict(list)
        self.peer.create_subscription(Rig, "/calib_ros/rig", self.rigs.append, LATCHED)
        self.peer.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        for camera in cameras:
            heard = self.extrinsics[camera].append
            self.peer.create_subscription(Extrinsic, f"/calib_ros/{camera}/{self.lidar}/extrinsic", heard, LATCHED)
        self.spin()
        self.until(lambda: all(p.get_subscription_count() for p in self.publishers.values()), "the subscriptions")

    def pair(self, camera: str) -> Any:
        """The interface of a pair."""
        return self.calibration.graph.pairs[camera, self.lidar]

    def sensor(self, name: str, rig: Rig | None = None) -> Any:
        """What the newest message, or another one, says of a sensor."""
        return next(own for own in (rig or self.rigs[-1]).sensors if own.name == name)

    def usable(self) -> set[str]:
        """The sensors to be relied on, by the newest message."""
        return {own.name for own in self.rigs[-1].sensors if own.usable} if self.rigs else set()

    def drive(self, items: Iterable[Measured], without: Sequence[str] = ()) -> None:
        """Publish, each when the pairs have worked off the one before; nothing of some sensors."""
        for stamp, name, value in items:
            if name in without:
                continue
            if name in self.rig.lidars:
                self.publishers[f"/{name}/points"].publish(cloud_message(value, stamp, frame_id=name))
                pairs, stream = self.cameras if name == self.lidar else (), "clouds"
                for own in self.calibration.graph.lidars:
                    self.until(lambda o=own, n=name, s=stamp: o._recent[n] and o._recent[n][-1][0] == s, f"a scan of {name}")
                    assert own.worker.wait_idle(LIMIT_S)
            else:
                image = value[0] if isinstance(value, tuple) else value
                frame = Frame(image, NO_CLOUD, self.rig.camera(name), stamp)
                info = camera_info_message(frame, self.rig.frame_id(name))
                self.publishers[f"/{name}/camera_info"].publish(info)
                self.until(lambda name=name: self.pair(name).pipeline.camera is not None, "the camera")
                message = image_message(image, self.rig.frame_id(name), stamp)
                self.publishers[f"/{name}/image"].publish(message)
                pairs, stream = (name,), "images"
            self._sent[stream, name] += 1
            for camera in pairs:
                counts = self.pair(camera).pipeline.pairing.synchronizer.counts
                want = self._sent[stream, name]
                self.until(lambda c=counts, s=stream, w=want: getattr(c, s) >= w, f"{stream} of {name}")
                with self.pair(camera).pipeline._lock:
                    pass
                assert self.pair(camera).pipeline.wait_idle(LIMIT_S)

    def trigger(self, name: str) -> str:
        """The answer of a service below the node's name."""
        answer = self.call(self.peer.create_client(Trigger, f"/calib_ros/{name}"), Trigger.Request())
        assert answer.success, answer.message
        return str(answer.message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.statuses |= {status.name: status for status in message.status}

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        self._patch.undo()


def poses(rig: Rig) -> Iterator[tuple[str, Any]]:
    """T_reference_sensor (4, 4) of a message."""
    for own in rig.sensors:
        yield own.name, matrix_from_transform(own.transform.transform)
