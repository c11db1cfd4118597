"""Two LiDARs of a rig whose scans are registered to each other: from their messages to what the rig knows of the pair."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from sensor_msgs.msg import PointCloud2

from calib_ros.arrays import Transform
from calib_ros.errors import CalibrationError, MissingDependencyError
from calib_ros.frame import NANOSECONDS
from calib_ros.lidar.ego_motion import MAX_GAP_S
from calib_ros.online.common import Common
from calib_ros.online.pacing import LoadBudget, Work, is_due
from calib_ros.online.worker import Worker
from calib_ros.result import INITIAL
from calib_ros.rig.lidar_pair import QUICK_S, LidarPair
from calib_ros.rig.lidars import LidarScans
from calib_ros.rig.live import PairState
from calib_ros.ros.conversions import Serialized
from calib_ros.ros.inputs import Decoded, Listener
from calib_ros.ros.parts import NodePart
from calib_ros.ros.subscriptions import livox_forms, serialized

SCANS_KEPT = 8  # messages of a LiDAR, among them the first one of a beat and that before it, while the other one is late
Stamped = tuple[int, Serialized]
Moment = Mapping[str, list[Stamped]]  # of each LiDAR a scan and the one before it


class LidarsOfRig(NodePart):
    """Registers the scans of two LiDARs, those that cameras look at as well, on a thread of its own and within the load budget.

    names: target and source, their topics and decoders by name. start: T_target_source (4, 4) to begin with, None = unknown yet.
    worker: its thread. To be used on the executor's thread.
    """

    def __init__(
        self,
        own: Any,
        names: tuple[str, str],
        topics: Mapping[str, str],
        decoded: Mapping[str, Decoded],
        common: Common,
        start: Callable[[], Transform | None],
    ) -> None:
        super().__init__(own)
        self.names, self._topics, self._decoded, self._common, self._start = names, topics, decoded, common, start
        self.reset()
        self.load = LoadBudget(self._parameters.config.online, purse=common.purse)
        self.missing = ""  # why nothing is registered, for a person
        self._recent: dict[str, deque[Stamped]] = {name: deque(maxlen=SCANS_KEPT) for name in names}
        self.stamp = 0  # of the newest scans that were registered, ns
        self._beat: int | None = None  # the same of those that were looked at
        self.urgent = False  # a displacement is suspected, whatever this pair has seen
        self._listeners: dict[str, Listener] = {}
        self.worker: Worker[Moment] = Worker("calib_lidars", self._register, self._failed)

    def start(self) -> None:
        """Receive scans."""
        forms, reliability = [serialized(PointCloud2), *livox_forms()], self._parameters["reliability"]
        subscribe = partial(self._own.inputs.shared.subscribe, forms, guard=self._health.guard, preference=reliability)
        self._listeners = {name: subscribe(self._topics[name], partial(self._add, name)) for name in self.names}

    def pause(self) -> None:
        """Receive nothing any more."""
        for listener in self._listeners.values():
            listener.destroy()
        self._listeners = {}
        for recent in self._recent.values():
            recent.clear()

    def reset(self) -> None:
        """Forget what was registered; scans that are worked on go into what is forgotten."""
        config = self._parameters.config
        self.pair = LidarPair(*self.names, config.motion.time_offset_sigma_s, config.refine)

    def state(self) -> PairState:
        """What it says of itself now."""
        extrinsic, most = self.pair.extrinsic, self._parameters["max_data_age_s"]
        told = [(name, own) for name, own in self._listeners.items() if own.silent_s > most]
        silent = ", ".join(f"nothing comes from {name} on {own.topic}" for name, own in told)
        return PairState(*self.names, extrinsic, extrinsic.usable and not silent, silent, self.pair.kind)

    def check(self) -> None:
        """Follow the publishers and the parameters."""
        self.load.config = self._parameters.config.online
        for listener in self._listeners.values():
            listener.check()

    def _add(self, name: str, stamp: int, message: Any) -> None:
        own, every_s = self._recent[name], QUICK_S if self.urgent else self.pair.every_s
        if own and stamp < own[-1][0]:  # a clock was set back
            for recent in self._recent.values():
                recent.clear()
            self._beat = None
        own.append((stamp, message))
        reached = min((recent[-1][0] for recent in self._recent.values() if recent), default=0)
        if self.missing or not all(self._recent.values()) or not is_due(self._beat, reached, every_s, in_step=True):
            return
        moment, beat = {}, reached - reached % round(every_s * NANOSECONDS)
        for one, recent in self._recent.items():
            at = next((k for k, (s, _) in enumerate(recent) if k and s >= beat), None)
            if at is None:
                return
            moment[one] = [recent[at - 1], recent[at]]
        if self.worker.busy or not self.load.allows_estimate(True):
            return
        self._beat = reached
        stamps = [scans[1][0] for scans in moment.values()]
        if max(stamps) - min(stamps) <= MAX_GAP_S * NANOSECONDS and self._start() is not None:
            self.worker.put(moment)

    def _register(self, moment: Moment) -> None:
        pair, T, motion = self.pair, self._start(), self._parameters.config.motion
        with self._common.estimates.mine(self.worker.check_cancelled), self.load.counting(Work.ESTIMATES):
            self.load.start_estimate()
            scans = [
                LidarScans([(s, self._decoded[name](m)) for s, m in own], motion, estimate=self._common.scans(name).motion)
                for name, own in moment.items()
            ]
            if T is not None:
                pair.add(scans[0], scans[1], T)
                self.stamp = min(int(own.stamps[-1]) for own in scans)

    def _failed(self, error: Exception) -> None:
        who = " and ".join(self.names)
        if isinstance(error, MissingDependencyError):
            self.missing = f"{who} are not registered to each other, their priors are used: {error}"
            self.pair.say(INITIAL, self.missing)
            self._health.error(self.missing, "registration of LiDARs")
        elif isinstance(error, CalibrationError):
            self._health.error(f"{who}: {error}", f"scans of {who}")
        else:
            self._health.unexpected(error)
