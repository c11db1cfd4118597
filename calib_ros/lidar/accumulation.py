"""Scans put together over a while: a scanner that does not repeat its pattern is sparse in 0.1 s, and dense in one."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config import MotionConfig
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.lidar.deskew import has_times, moved, scan_times
from calib_ros.lidar.ego_motion import estimate_motion

Stamped = tuple[int, PointCloud]
KEPT = 64  # motions between two scans: scans overlap where frames follow each other


class Accumulator:
    """Adds the points of earlier scans to those of a frame, moved by what the LiDAR did meanwhile."""

    def __init__(self) -> None:
        self._twists: OrderedDict[tuple[int, int], NDArray[np.float64] | None] = OrderedDict()

    def __call__(self, frame: Frame, earlier: Iterable[Stamped], seconds: float, config: MotionConfig) -> Frame:
        """A frame with the scans of the last `seconds`, its own among them; itself if there are no others.

        earlier: stamp, ns, and cloud, newest first; what lies before two scans between which the motion is unknown is left out.
        Points of earlier scans are where they would have been measured at the cloud's stamp. Rings get lost. Raises
        MissingDependencyError without small_gicp.
        """
        stamp, cloud = frame.cloud_stamp, frame.cloud
        if stamp is None or seconds <= 0:
            return frame
        if frame.compensated:
            config = replace(config, spin="none")
        time = cloud.time  # None where nothing will be moved by them
        if not (has_times(cloud) or frame.twist is None or frame.compensated):
            time = scan_times(cloud.xyz, config).astype(np.float32)
        parts, T, after = [replace(cloud, ring=None, time=time)], np.eye(4), (stamp, _bare(cloud, frame))
        for at, before in earlier:
            gap_s = (after[0] - at) / NANOSECONDS
            if stamp - at >= round(seconds * NANOSECONDS):
                break
            own = (at, _bare(before, frame))
            twist = self._twist(own, after, gap_s, config)
            if twist is None:
                break
            T = T @ se3.inverse(se3.exp(twist * gap_s))
            tau = own[1].time if own[1].time is not None and has_times(own[1]) else scan_times(before.xyz, config)
            xyz = se3.transform(T, moved(before.xyz, twist, tau)).astype(np.float32)
            parts.append(replace(before, xyz=xyz, ring=None, time=np.zeros(len(xyz), np.float32)))
            after = own
        if len(parts) == 1:
            return frame
        fields = {name: [getattr(part, name) for part in parts] for name in ("intensity", "time", "label")}
        joined: dict[str, Any] = {name: None if any(v is None for v in vs) else np.concatenate(vs) for name, vs in fields.items()}
        return replace(frame, cloud=replace(parts[0], xyz=np.concatenate([part.xyz for part in parts]), **joined))

    def _twist(self, before: Stamped, after: Stamped, gap_s: float, config: MotionConfig) -> NDArray[np.float64] | None:
        key = before[0], after[0]
        if key not in self._twists:
            newest = next(reversed(self._twists.values()), None)
            self._twists[key] = estimate_motion(before[1], after[1], gap_s, config, newest).twist
            while len(self._twists) > KEPT:
                self._twists.popitem(last=False)
        return self._twists[key]


def _bare(cloud: PointCloud, frame: Frame) -> PointCloud:
    """A cloud as its motion is estimated: of a compensated frame all points are of one moment."""
    return replace(cloud, time=None) if frame.compensated else cloud
