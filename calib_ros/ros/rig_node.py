"""All pairs of a rig in one process, one solution from what they find, and what the node says of it. No calibration happens here.

Every pair has the interface of a node of its own, named by its LiDAR below the camera: ~/CAMERA/LIDAR/extrinsic and so on.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

from calib_ros_msgs.msg import Rig
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from calib_ros.arrays import Covariance, Transform
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS
from calib_ros.online.common import Common
from calib_ros.online.pacing import LoadBudget
from calib_ros.online.worker import Worker
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import MOVED, SUSPECT
from calib_ros.rig.description import CAMERA, Sensor, prior_covariance, read_rig
from calib_ros.rig.edges import box_of
from calib_ros.rig.graph import solve
from calib_ros.rig.lidars import MOTION_KIND
from calib_ros.rig.live import LiveRig, Pair, PairState, RigState
from calib_ros.ros import parameters
from calib_ros.ros.answers import ROUNDS, after_answers
from calib_ros.ros.conversions import transform_message
from calib_ros.ros.diagnostics import Health
from calib_ros.ros.executor import Beside
from calib_ros.ros.pair import PairInterface
from calib_ros.ros.parameters import Parameters
from calib_ros.ros.publishers import VALID_PERIODS
from calib_ros.ros.rig_lidars import LidarsOfRig
from calib_ros.ros.rig_messages import rig_message, rig_status
from calib_ros.ros.rig_pairs import (
    OF_PAIR,
    OF_RIG,
    USED,
    PairOfRig,
    camera_pairs,
    lidar_pairs,
    node_of_pair,
)
from calib_ros.ros.shared_topics import SharedTopics, decoded_clouds, decoded_images
from calib_ros.ros.tf import LATCHED, StaticTf
from calib_ros.ros.write_back import WriteBack, check_files

TF_CURE = "take what says otherwise out of the robot's description, or write the rig to its joints with calib-ros rig --out"
Priors = dict[str, tuple[Transform, Covariance]]


class RigInterface:
    """Topics, services and parameters of a rig on a node, with the members of a `PairInterface`.

    pairs: their interfaces, on nodes that spin along. state: the newest, None before the first second. Raises a CalibrationError
    for a rig file or parameters that cannot work.
    """

    def __init__(self, node: Node, declared: Parameters) -> None:
        self._node, self.parameters, self.health = node, declared, Health(node.get_logger())
        self.description = read_rig(declared["rig_file"])
        wanted = camera_pairs(self.description, declared["rig_file"])
        self._check_files(declared)
        overrides = node._parameter_overrides
        for line in parameters.misspelt({name: p.value for name, p in overrides.items()}, node._parameters):
            node.get_logger().warning(line)
        for name in sorted(((OF_RIG | OF_PAIR) - USED) & set(overrides)):
            node.get_logger().warning(f"parameter '{name}' has no effect with a rig_file")
        self.state: RigState | None = None
        others = [s for s in self.description.sensors if s.name != self.description.reference]
        self._priors_given = {s.name: (s.prior, _covariance(s)) for s in others if s.prior is not None}
        self._live = LiveRig(self.description, declared.config.refine)
        wanted_tf = declared["initial_from_tf"], declared["publish_tf"]
        self.tf = StaticTf(node, *wanted_tf, self.health.error, (TF_CURE, TF_CURE))
        common, self._shared = Common(declared.config.online), SharedTopics(node)
        self.load = LoadBudget(declared.config.online, purse=common.purse)  # of receiving messages
        decoded = {s.name: decoded_images() if s.kind == CAMERA else decoded_clouds() for s in self.description.sensors}
        self.pairs: dict[Pair, PairInterface] = {}
        self._views: list[PairOfRig] = []  # of pairs that are estimated only if they share a view
        self._beside = Beside(context=node.context)
        self._beside.spin_from(node)
        try:
            for camera, lidar in wanted:
                pair = PairOfRig(
                    *(camera, lidar, common, self._shared, self._topics(camera, lidar), decoded[camera], decoded[lidar])
                )
                known = self._between(camera, lidar)
                pair.T = None if known is None else known[0]
                own = node_of_pair(node, declared, self.description, (camera, lidar), known)
                self._beside.add_node(own)
                self.pairs[camera, lidar] = made = PairInterface(own, pair)
                pair.on_reset = partial(self._reset_lidars, lidar)
                if self.description.pairs is None:
                    pair.unseen = lambda why, made=made: self._unseen(made, why)
                    self._views.append(pair)
        except BaseException:  # of one pair: the others must not go on
            self._destroy_pairs()
            self._beside.destroy(node)
            self.tf.destroy()
            raise
        topics = {name: self._topics(name, name)[1] for name in self.description.lidars}
        given = (lambda: self.parameters, self.health)
        self.lidars = [
            LidarsOfRig(pair, topics, decoded, common, *given, partial(self._start_of, *pair))
            for pair in lidar_pairs(self.description)
        ]
        self._lock = threading.Lock()  # of state, active and what is published of them
        self._active = False
        self._priors_now: Priors = dict(self._priors_given)
        self._told: list[PairState] = []  # what the newest solution rests on
        self._text = ""
        self._edges: list[TransformStamped] = []  # of the newest solution
        self._edges_told = self._edges
        self._files = ThreadPoolExecutor(max_workers=1, thread_name_prefix="calib_files")  # disks may be slow
        self._write_back = WriteBack(lambda: self.parameters, self._files, self.health)
        self._solver: Worker[tuple[LiveRig, list[PairState], Priors]] = Worker("calib_rig", self._solve, self._failed)
        self.publisher = node.create_publisher(Rig, "~/rig", LATCHED)
        self._diagnostics_pub = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._timers: list[Timer] = []
        self._ended: bool | None = None
        self._service = node.create_service(Trigger, "~/reset", self._reset)
        node.add_on_set_parameters_callback(self._on_parameters)

    # ---- states -------------------------------------------------------------------------------------------------------

    def activate(self) -> None:
        """See `PairInterface`."""
        self._active = True
        for pair in self.pairs.values():
            pair.activate()
        for lidars in self.lidars:
            lidars.activate(self._shared)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timers = [
            self._node.create_timer(1.0, self._every_second, clock=steady),
            self._node.create_timer(self.parameters["publish_period_s"], self._publish, clock=steady),
        ]
        names = ", ".join(f"{camera} with {lidar}" for camera, lidar in self.pairs)
        self._node.get_logger().info(f"a rig of {len(self.description.sensors)} sensors: {names}")

    def deactivate(self) -> None:
        """See `PairInterface`."""
        for timer in self._timers:
            self._node.destroy_timer(timer)
        self._timers = []
        for pair in self.pairs.values():
            pair.deactivate()
        for lidars in self.lidars:
            lidars.deactivate()
        with self._lock:
            self._active = False
            self._forget()

    def stop(self) -> bool:
        """See `PairInterface`."""
        if self._ended is None:
            with ThreadPoolExecutor(max(len(self.pairs), 1)) as all_at_once:
                ended = list(all_at_once.map(lambda pair: pair.stop(), self.pairs.values()))
            self._ended = all([*ended, *(lidars.stop() for lidars in self.lidars), self._solver.stop()])
            self._files.shutdown(wait=True)
        return self._ended

    def destroy(self) -> bool:
        """See `PairInterface`."""
        if self._timers:
            self.deactivate()
        ended = self.stop()
        self._destroy_pairs()
        self._node.remove_on_set_parameters_callback(self._on_parameters)
        self.tf.destroy()
        after_answers(self._node, partial(self._node.destroy_service, self._service))
        for publisher in (self.publisher, self._diagnostics_pub):
            self._node.destroy_publisher(publisher)
        return ended

    def _destroy_pairs(self) -> None:
        for pair in self.pairs.values():
            pair.destroy()
        for _ in range(ROUNDS + 1):  # so that `after_answers` comes to its end
            self._beside.spin_ready()

    def destroy_nodes(self) -> None:
        """Those of the pairs, at the very end."""
        self._beside.destroy(self._node)

    # ---- what the pairs start from --------------------------------------------------------------------------------------

    def _topics(self, camera: str, lidar: str) -> tuple[str, str, str]:
        image = self.description[camera].topic or f"{camera}/image"
        # CameraInfo lies beside the images, as image_transport has it.
        info = self.description[camera].camera_info or "".join(image.rpartition("/")[:2]) + "camera_info"
        return image, self.description[lidar].topic or f"{lidar}/points", info

    def _between(self, camera: str, lidar: str) -> tuple[Transform, SearchBox] | None:
        """T_camera_lidar (4, 4) by the description, and how far around to search; None where it leaves that to TF."""
        reference = self.description.reference
        if not all(name in self._priors_given or name == reference for name in (camera, lidar)):
            return None
        T, C = solve([], self._priors_given, reference).between(camera, lidar)
        return T, box_of(C)

    def _unseen(self, pair: PairInterface, why: str) -> None:
        pair.pipeline.pause(why)
        self._node.get_logger().info(why)

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
        for sensor in self.description.sensors:
            if sensor.name not in found and sensor.name != self.description.reference:
                T, _ = self.tf.lookup(reference, self._frame(sensor.name))
                if T is not None:
                    found[sensor.name] = T, prior_covariance(T, sensor.sigma_deg, sensor.sigma_m)
        return found

    # ---- every second ---------------------------------------------------------------------------------------------------

    def _every_second(self) -> None:
        with self.health.guard():
            self.health.log.catch_up()
            self.load.count_messages()
            self.tf.check()
            states, priors = [self._state_of(*names, pair) for names, pair in self.pairs.items()], self._priors()
            self._priors_now = priors
            doubt = any(own.status in (SUSPECT, MOVED) for own in states)
            for lidars in self.lidars:
                lidars.urgent = doubt
                if lidars.pair.kind == MOTION_KIND and any(
                    own.status == MOVED and {*own.pair} & {*lidars.names} for own in states
                ):
                    lidars.reset()  # how both moved before says nothing of where they are now
                lidars.check()
                states.append(lidars.state())
            for view in [own for own in self._views if own.T is None]:  # whose priors TF tells
                if {view.camera, view.lidar} <= priors.keys() | {self.description.reference}:
                    view.T = solve([], priors, self.description.reference).between(view.camera, view.lidar)[0]
            changed = len(states) != len(self._told) or not all(map(PairState.says_as, states, self._told))
            if changed or self.state is None or len(priors) + 1 != len(self.state.sensors):
                self._told = states
                self._solver.put((self._live, states, priors))
            if (edges := self._edges) is not self._edges_told and self.tf.publish_tree(edges):
                self._edges_told = edges
            self._diagnostics_pub.publish(self._diagnostics(priors))

    def _state_of(self, camera: str, lidar: str, pair: PairInterface) -> PairState:
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
            if not self._active or self._ended is not None or live is not self._live:  # its last message has been sent
                return
            self.state = state
            self.publisher.publish(self._message(state))
        if state.text != self._text:
            self._text = state.text
            if state.moved:
                self.health.error(state.text, "rig moved")
            else:
                self.health.note(state.text, "rig")
        reference = self._frame(state.solution.reference)
        others = [own for own in state.sensors if own.name != state.solution.reference]
        self._edges = [transform_message(own.T, reference, self._frame(own.name), self._stamp(own.name)) for own in others]
        self._write(state)

    def _write(self, state: RigState) -> None:
        """To the files of export.on_converged, once all sensors are to be relied on."""
        if len(state.sensors) == len(self.description.sensors) and all(own.usable for own in state.sensors):
            frames = {own.name: self._frame(own.name) for own in state.sensors}
            of_cameras = {camera: pair.pipeline.camera for (camera, _), pair in self.pairs.items()}
            cameras = {name: camera for name, camera in of_cameras.items() if camera is not None}
            self._write_back.put(replace(state.report, frames=frames, cameras=cameras, source=self.parameters["vehicle"]))

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        with self.health.guard():
            for pair in self.pairs.values():
                pair.reset()
            for lidars in self.lidars:
                lidars.reset()
            with self._lock:
                self._live = LiveRig(self.description, self.parameters.config.refine)
                self._forget()
            response.success, response.message = True, "all pairs are back to the priors"
        return response

    def _reset_lidars(self, lidar: str) -> None:
        """What is known of a LiDAR by other ones."""
        for own in self.lidars:
            if lidar in own.names:
                own.reset()

    def _failed(self, error: Exception) -> None:
        with self._lock:
            self._forget()
        self.health.unexpected(error)

    def _forget(self) -> None:
        """With the lock held: what was found does not hold any more, until it is solved anew."""
        if self.state is not None:
            self.publisher.publish(self._message(self.state, usable=False))
        self.state, self._told = None, []

    # ---- messages -------------------------------------------------------------------------------------------------------

    def _publish(self) -> None:
        with self.health.guard(), self._lock:
            if self.state is not None:
                self.publisher.publish(self._message(self.state))

    def _stamp(self, name: str = "") -> int:
        """Of the newest data of a sensor's pairs, ns; of all pairs without a name."""
        stamps = [(names, pair.extrinsic.stamp) for names, pair in self.pairs.items()]
        stamps += [(lidars.names, lidars.stamp) for lidars in self.lidars]
        return max((stamp for names, stamp in stamps if not name or name in names), default=0)

    def _message(self, state: RigState, usable: bool = True) -> Rig:
        now = self._node.get_clock().now().nanoseconds
        until = now + round(VALID_PERIODS * self.parameters["publish_period_s"] * NANOSECONDS)
        return rig_message(state, self._frame, self._stamp, (now, until), usable)

    def _diagnostics(self, priors: Mapping[str, Any]) -> DiagnosticArray:
        missing = [s.name for s in self.description.sensors if s.name not in priors and s.name != self.description.reference]
        told = dict.fromkeys(missing, "nobody knows where it is: set its prior, or publish it on /tf_static")
        status = rig_status(f"{self._node.get_fully_qualified_name().lstrip('/')}: rig", self.state, told, self.health)
        status.hardware_id = self.parameters["vehicle"]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        return message

    # ---- parameters -------------------------------------------------------------------------------------------------------

    def _on_parameters(self, changed: Sequence[Parameter]) -> SetParametersResult:
        """What changes holds for all pairs, but for what is each one's own."""
        answer, new = parameters.on_change(self.parameters, list(changed), None)
        if answer.successful and new["publish_tf"] and self.tf.missing:
            return SetParametersResult(successful=False, reason=self.tf.missing)
        try:
            if any(p.name == "export.on_converged" for p in changed):
                self._check_files(new)
        except BadInputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        passed = [p for p in changed if p.name not in OF_RIG | OF_PAIR]
        for own in self._beside.get_nodes() if answer.successful and passed else ():
            told = own.set_parameters_atomically(passed)
            if not told.successful:
                return told
        if answer.successful:
            self.parameters, self.load.config = new, new.config.online
            self.tf.switch(new["publish_tf"])
            self._edges_told = []
            if (state := self.state) is not None:
                self._write(state)
        return answer

    def _check_files(self, given: Parameters) -> None:
        pairs = [*camera_pairs(self.description, given["rig_file"]), *lidar_pairs(self.description)]
        check_files(given["export.on_converged"], self.description, pairs)


def _covariance(sensor: Sensor) -> Covariance:
    assert sensor.prior is not None
    return prior_covariance(sensor.prior, sensor.sigma_deg, sensor.sigma_m)
