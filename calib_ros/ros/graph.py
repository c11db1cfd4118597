"""What several pairs of a rig come to together: one solution, what the node says of it. No calibration happens here."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

from calib_ros_msgs.msg import Rig, RigEdge, RigLoop, RigSensor
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from std_srvs.srv import Trigger

from calib_ros import se3
from calib_ros.arrays import Covariance, Transform
from calib_ros.config import Config
from calib_ros.frame import NANOSECONDS
from calib_ros.online.common import Common
from calib_ros.online.pacing import LoadBudget
from calib_ros.online.worker import Worker
from calib_ros.result import MOVED, SUSPECT
from calib_ros.rig.description import RigDescription
from calib_ros.rig.graph import solve
from calib_ros.rig.lidars import MOTION_KIND
from calib_ros.rig.live import KIND, LiveRig, Pair, PairState, RigState
from calib_ros.rig.report import RigReport
from calib_ros.ros.conversions import covariance_for_ros, time_message, transform_message
from calib_ros.ros.dds import LATCHED
from calib_ros.ros.diagnostics import ERROR, OK, WARN, status_message
from calib_ros.ros.inputs import Decoded
from calib_ros.ros.parts import NodePart
from calib_ros.ros.publishers import VALID_PERIODS
from calib_ros.ros.rig_lidars import LidarsOfRig

Priors = dict[str, tuple[Transform, Covariance]]


def priors_of(description: RigDescription) -> Priors:
    """Of the sensors, but for the reference, whose places it states."""
    others = [s for s in description.sensors if s.name != description.reference]
    return {s.name: s.believed(s.prior) for s in others if s.prior is not None}


def topics_of(description: RigDescription, camera: str, lidar: str) -> tuple[str, str, str]:
    """Of image, points and CameraInfo."""
    image = description[camera].topic or f"{camera}/image"
    # CameraInfo lies beside the images, as image_transport has it.
    info = description[camera].camera_info or "".join(image.rpartition("/")[:2]) + "camera_info"
    return image, description[lidar].topic or f"{lidar}/points", info


class RigGraph(NodePart):
    """~/rig, ~/reset, the rig's status on /diagnostics, its TF tree and files: what the pairs say, as one solution.

    own: the interface of the rig's node, a `Calibration`. pairs: those of the pairs. lidars: the pairs of two LiDARs. decoded: by
    sensor. state: the newest, None before the first second.
    """

    def __init__(
        self, own: Any, description: RigDescription, pairs: Mapping[Pair, Any], decoded: Mapping[str, Decoded], common: Common
    ) -> None:
        super().__init__(own)
        self.description, self.pairs = description, pairs
        config: Config = own.parameters.config
        self.state: RigState | None = None
        self._others = [s for s in description.sensors if s.name != description.reference]
        self._priors_given = priors_of(description)
        self._live = LiveRig(description, config.refine)
        self.load = LoadBudget(config.online, purse=common.purse)  # of receiving messages
        of_all = {name: topics_of(description, name, name)[1] for name in description.lidars}, decoded, common
        self.lidars = [LidarsOfRig(own, pair, *of_all, partial(self._start_of, *pair)) for pair in description.lidar_pairs]
        self._lock = threading.Lock()  # of state and what is published of them
        self._priors_now: Priors = dict(self._priors_given)
        self._told: list[PairState] = []  # what the newest solution rests on
        self._text = ""
        self._edges: list[TransformStamped] = []  # of the newest solution
        self._solver: Worker[tuple[LiveRig, list[PairState], Priors]] = Worker("calib_rig", self._solve, self._failed)
        self._publisher = self._create_publisher(Rig, "~/rig", LATCHED)
        self._serve(Trigger, "~/reset", self._reset)

    def start(self) -> None:
        """See `NodeService`."""
        names = ", ".join(f"{camera} with {lidar}" for camera, lidar in self.pairs)
        self._node.get_logger().info(f"a rig of {len(self.description.sensors)} sensors: {names}")

    def pause(self) -> None:
        """See `NodeService`."""
        with self._lock:
            self._forget()

    def end_threads(self) -> bool:
        """All threads of the rig; True if they ended."""
        with ThreadPoolExecutor(max(len(self.pairs), 1)) as all_at_once:
            list(all_at_once.map(lambda pair: pair.stop(), self.pairs.values()))
        ended = [bool(pair.ended) for pair in self.pairs.values()]
        return all([*ended, *(lidars.worker.stop() for lidars in self.lidars), self._solver.stop()])

    def configure(self, config: Config) -> None:
        """Use other constants from now on, and other settings of the node."""
        self.load.config = config.online
        self._own.tf.put_tree(self._edges)

    def _frame(self, name: str) -> str:
        """TF frame of a sensor, as far as it is known."""
        if frame := self.description[name].frame:
            return frame
        for (camera, lidar), pair in self.pairs.items():
            if name in (camera, lidar) and (recalibrator := pair.pipeline.recalibrator) is not None:
                names = recalibrator.tracker.initial
                return names.camera_frame if name == camera else names.lidar_frame
        return name

    def _priors(self) -> Priors:
        """Of all sensors whose places are known, by the description or TF."""
        found, reference = dict(self._priors_given), self._frame(self.description.reference)
        for sensor in self._others:
            if sensor.name not in found:
                T, _ = self._own.tf.lookup(reference, self._frame(sensor.name))
                if T is not None:
                    found[sensor.name] = sensor.believed(T)
        return found

    # ---- every second ---------------------------------------------------------------------------------------------------

    def check(self) -> None:
        """See `NodeService`."""
        self.load.count_messages()
        states, priors = [self._state_of(*names, pair) for names, pair in self.pairs.items()], self._priors()
        self._priors_now, reference = priors, self.description.reference
        doubt, lost = any(own.status in (SUSPECT, MOVED) for own in states), {own.pair for own in states if own.status == MOVED}
        for lidars in self.lidars:
            lidars.urgent = doubt
            if lidars.pair.kind == MOTION_KIND and any({*pair} & {*lidars.names} for pair in lost):
                lidars.reset()  # how both moved before says nothing of where they are now
            states.append(lidars.state())
        for names, pair in self.pairs.items():
            if self.description.pairs is None and pair.inputs.T is None and {*names} <= priors.keys() | {reference}:  # by TF
                pair.inputs.T = solve([], priors, reference).between(*names)[0]
        told, before = ([(own.extrinsic, own.usable, bool(own.unchecked)) for own in of] for of in (states, self._told))
        if told != before or self.state is None or len(priors) + 1 != len(self.state.sensors):
            self._told = states
            self._solver.put((self._live, states, priors))

    def _state_of(self, camera: str, lidar: str, pair: Any) -> PairState:
        recalibrator = pair.pipeline.recalibrator
        if recalibrator is None or pair.pipeline.paused:
            return PairState(camera, lidar, unchecked=pair.sensors.silent() if recalibrator is None else "")
        extrinsic = recalibrator.current
        validity = pair.extrinsic.validity(extrinsic)
        unchecked = "" if validity.usable or not extrinsic.usable else pair.sensors.silent() or validity.reason
        return PairState(camera, lidar, extrinsic, validity.usable, unchecked)

    def _start_of(self, target: str, source: str) -> Transform | None:
        """T_target_source (4, 4) by what is known so far; None before there is a prior of both."""
        state, priors = self.state, self._priors_now
        if not {target, source} <= priors.keys() | {self.description.reference}:
            return None
        # What LiDARs said of themselves must not come back after a reset: their own edge is not to be their start.
        known = state is not None and not any(own.pair == (target, source) and own.edge() for own in state.pairs)
        solution = state.solution if state is not None and known else solve([], priors, self.description.reference)
        return solution.between(target, source)[0] if {target, source} <= solution.poses.keys() else None

    def _solve(self, item: tuple[LiveRig, list[PairState], Priors]) -> None:
        """On a thread of its own."""
        live, states, priors = item
        state = live.update(states, priors)
        with self._lock:
            if not self._own.active or self._own.ended is not None or live is not self._live:  # its last message has been sent
                return
            self.state = state
            self._publisher.publish(self._message(state))
        if state.text != self._text:
            self._text = state.text
            if state.moved:
                self._health.error(state.text, "rig moved")
            else:
                self._health.note(state.text, "rig")
        reference = self._frame(state.solution.reference)
        others = [own for own in state.sensors if own.name != state.solution.reference]
        self._edges = [transform_message(own.T, reference, self._frame(own.name), self._stamp(own.name)) for own in others]
        self._own.tf.put_tree(self._edges)
        self._own.write_back.put(self._report(state))

    def _report(self, state: RigState) -> RigReport | None:
        """For the files of export.on_converged, once all sensors are to be relied on."""
        if len(state.sensors) < len(self.description.sensors) or not all(own.usable for own in state.sensors):
            return None
        frames = {own.name: self._frame(own.name) for own in state.sensors}
        of_cameras = {camera: pair.pipeline.camera for (camera, _), pair in self.pairs.items()}
        cameras = {name: camera for name, camera in of_cameras.items() if camera is not None}
        return replace(state.report, frames=frames, cameras=cameras, source=self._parameters["vehicle"])

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> None:
        for pair in self.pairs.values():
            pair.reset()
        for lidars in self.lidars:
            lidars.reset()
        with self._lock:
            self._live = LiveRig(self.description, self._parameters.config.refine)
            self._forget()
        response.success, response.message = True, "all pairs are back to the priors"

    def reset_lidars(self, lidar: str) -> None:
        """What is known of a LiDAR by other ones."""
        for own in self.lidars:
            if lidar in own.names:
                own.reset()

    def _failed(self, error: Exception) -> None:
        with self._lock:
            self._forget()
        self._health.unexpected(error)

    def _forget(self) -> None:
        """With the lock held: what was found does not hold any more, until it is solved anew."""
        if self.state is not None:
            self._publisher.publish(self._message(self.state, usable=False))
        self.state, self._told = None, []

    # ---- messages -------------------------------------------------------------------------------------------------------

    def again(self) -> None:
        """See `NodeService`."""
        with self._lock:
            if self.state is not None:
                self._publisher.publish(self._message(self.state))

    def _stamp(self, name: str) -> int:
        """Of the newest data of a sensor's pairs, ns."""
        stamps = [(names, pair.extrinsic.stamp) for names, pair in self.pairs.items()]
        stamps += [(lidars.names, lidars.stamp) for lidars in self.lidars]
        return max((stamp for names, stamp in stamps if name in names), default=0)

    def _message(self, state: RigState, usable: bool = True) -> Rig:
        """~/rig. usable: if not, nothing of it is."""
        solution, now = state.solution, self._node.get_clock().now().nanoseconds
        until = now + round(VALID_PERIODS * self._parameters["publish_period_s"] * NANOSECONDS)
        msg = Rig(reference=solution.reference, moved=list(state.moved), text=str(state))
        msg.header.frame_id, msg.header.stamp = self._frame(solution.reference), time_message(now)
        msg.valid_until = time_message(until)
        for own in state.sensors:
            said = RigSensor(name=own.name, status=own.status, reason=own.reason, usable=own.usable and usable)
            said.transform = transform_message(own.T, msg.header.frame_id, self._frame(own.name), self._stamp(own.name))
            said.covariance, (said.moved_deg, said.moved_m) = covariance_for_ros(own.covariance), own.moved
            msg.sensors.append(said)
        for loop in solution.loops:
            of_loop = RigLoop(sensors=list(loop.sensors), p_value=loop.p_value, closes=loop.closes)
            of_loop.rotation_deg, of_loop.translation_m = loop.size
            msg.loops.append(of_loop)
        msg.edges = [_edge(own, state) for own in state.pairs]
        for told, edges in ((msg.rejected, solution.rejected), (msg.doubted, solution.doubted)):
            told.extend(RigEdge(target=e.target, source=e.source, kind=e.kind) for e in edges)
        return msg

    def status(self) -> DiagnosticStatus:
        """See `NodeService`."""
        state, level, text = self.state, OK, ""
        missing = [s.name for s in self._others if s.name not in self._priors_now]
        values = dict.fromkeys(missing, "nobody knows where it is: set its prior, or publish it on /tf_static")
        if state is not None:
            good = all(s.usable for s in state.sensors) and not missing and not state.solution.rejected
            level, text = ERROR if state.moved else OK if good else WARN, str(state)
            values |= {s.name: ": ".join(filter(None, [s.status, s.reason])) for s in state.sensors}
            of_lidars = [own for own in state.pairs if own.kind != KIND]
            values |= {" with ".join(own.pair): own.status if own.usable else f"{own.status}: {own.reason}" for own in of_lidars}
        values |= {"errors": str(self._health.errors), "last error": self._health.last_error[0]}
        return status_message(f"{self._node.get_fully_qualified_name().lstrip('/')}: rig", level, text, values)


def _edge(own: PairState, state: RigState) -> RigEdge:
    edge, poses = own.edge(), state.solution.poses
    said = RigEdge(target=own.target, source=own.source, kind=own.kind, status=own.status, usable=own.usable)
    said.reason = "" if own.usable else own.reason
    said.covariance = covariance_for_ros(None if edge is None else edge.covariance)
    if edge is not None and {*own.pair} <= poses.keys():
        said.transform = transform_message(edge.T, "", "", 0).transform
        said.rotation_deg, said.translation_m = se3.error(se3.inverse(poses[own.target]) @ poses[own.source], edge.T)
    return said
