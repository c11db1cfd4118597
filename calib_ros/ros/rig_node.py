"""All pairs of a rig in one process, one solution from what they find, and what the node says of it. No calibration happens here.

Every pair has the interface of a node of its own, named by its LiDAR below the camera: ~/CAMERA/LIDAR/extrinsic and so on.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from calib_ros_msgs.msg import Rig
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from calib_ros import se3
from calib_ros.arrays import Covariance, Transform
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS
from calib_ros.online.common import Common
from calib_ros.online.pacing import LoadBudget
from calib_ros.online.worker import Worker
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import MOVED, SUSPECT
from calib_ros.rig.description import RigDescription, read_rig
from calib_ros.rig.edges import box_of
from calib_ros.rig.graph import solve
from calib_ros.rig.lidars import MOTION_KIND
from calib_ros.rig.live import LiveRig, Pair, PairState, RigState
from calib_ros.rig.report import RigReport
from calib_ros.ros.answers import ROUNDS, after_answers, serve
from calib_ros.ros.conversions import transform_message
from calib_ros.ros.dds import LATCHED
from calib_ros.ros.executor import Beside
from calib_ros.ros.inputs import PairInputs, SharedTopics, decoded_once
from calib_ros.ros.interface import Interface
from calib_ros.ros.pair import PairInterface
from calib_ros.ros.parameters import Parameters
from calib_ros.ros.publishers import VALID_PERIODS
from calib_ros.ros.rig_lidars import LidarsOfRig
from calib_ros.ros.rig_messages import rig_message, rig_status
from calib_ros.ros.write_back import check_files
from calib_ros.runtime import trim_memory

TF_CURE = "take what says otherwise out of the robot's description, or write the rig to its joints with calib-ros rig --out"
CHECKS_PER_TRIM = 20  # keyframes of many pairs leave gaps
TOKEN = re.compile(r"[A-Za-z][A-Za-z0-9_]*")  # of the name of a node
# Settings of a node of one pair that a rig has in another way, or a pair each by itself.
OF_RIG = {"rig_file", "publish_tf", "tf_parent", "tf_child", "export.on_converged", "export.joint"}
OF_PAIR = {"camera_frame", "lidar_frame", "initial_translation_m", "initial_quaternion_xyzw", "state_file", "capture_dir"}
USED = {"rig_file", "publish_tf", "export.on_converged", "state_file", "capture_dir"}  # of these, by the rig as well
Priors = dict[str, tuple[Transform, Covariance]]


class RigInterface(Interface):
    """Topics, services and parameters of a rig.

    pairs: their interfaces, on nodes that spin along. state: the newest, None before the first second. Raises a CalibrationError
    for a rig file or parameters that cannot work.
    """

    def __init__(self, node: Node, declared: Parameters) -> None:
        self.description, path = read_rig(declared["rig_file"]), declared["rig_file"]
        for sensor in self.description.sensors:
            if not TOKEN.fullmatch(sensor.name):
                raise BadInputError(f"{path}: sensors.{sensor.name} cannot be part of a topic's name; use letters, digits and _")
        if not self.description.camera_pairs:
            raise BadInputError(f"{path}: pairs holds no camera with a LiDAR, which the node estimates; add one")
        check_files(declared["export.on_converged"], self.description)
        super().__init__(node, declared, node, (TF_CURE, TF_CURE))
        for name in sorted(((OF_RIG | OF_PAIR) - USED) & set(self.given)):
            node.get_logger().warning(f"parameter '{name}' has no effect with a rig_file")
        self.state: RigState | None = None
        self._others = [s for s in self.description.sensors if s.name != self.description.reference]
        self._priors_given = {s.name: s.believed(s.prior) for s in self._others if s.prior is not None}
        self._live = LiveRig(self.description, declared.config.refine)
        common, shared = Common(declared.config.online), SharedTopics(node)
        self.load = LoadBudget(declared.config.online, purse=common.purse)  # of receiving messages
        decoded = {sensor.name: decoded_once(sensor.kind) for sensor in self.description.sensors}
        self.pairs: dict[Pair, PairInterface] = {}
        self._views: list[PairInputs] = []  # of pairs that are estimated only if they share a view
        self._beside = Beside(node)
        try:
            for camera, lidar in self.description.camera_pairs:
                topics = self._topics(camera, lidar)
                inputs = PairInputs(shared, decoded[camera], decoded[lidar], common, camera, lidar, topics)
                known = self._between(camera, lidar)
                inputs.T = None if known is None else known[0]
                own = node_of_pair(node, declared, self.description, (camera, lidar), known)
                self._beside.add_node(own)
                self.pairs[camera, lidar] = made = PairInterface(own, inputs)
                inputs.on_reset = partial(self._reset_lidars, lidar)
                if self.description.pairs is None:
                    inputs.unseen = lambda why, made=made: self._unseen(made, why)
                    self._views.append(inputs)
        except BaseException:  # of one pair: the others must not go on
            for made in self.pairs.values():
                made.destroy()
            self._finish_answers()
            self._beside.destroy()
            self.tf.destroy()
            raise
        topics_of = {name: self._topics(name, name)[1] for name in self.description.lidars}
        of_all = shared, topics_of, decoded, common, lambda: self.parameters, self.health
        self.lidars = [LidarsOfRig(pair, *of_all, partial(self._start_of, *pair)) for pair in self.description.lidar_pairs]
        self.parts += [*self.pairs.values(), *self.lidars]
        self._lock = threading.Lock()  # of state and what is published of them
        self._priors_now: Priors = dict(self._priors_given)
        self._told: list[PairState] = []  # what the newest solution rests on
        self._text, self._checks = "", 0
        self._edges: list[TransformStamped] = []  # of the newest solution
        self._solver: Worker[tuple[LiveRig, list[PairState], Priors]] = Worker("calib_rig", self._solve, self._failed)
        self.publisher = node.create_publisher(Rig, "~/rig", LATCHED)
        self._diagnostics_pub = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._service = serve(Trigger, "~/reset", node, self.health, self._reset)
        node.add_on_set_parameters_callback(self._on_parameters)

    # ---- states -------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """See `Interface`."""
        super().start()
        names = ", ".join(f"{camera} with {lidar}" for camera, lidar in self.pairs)
        self.node.get_logger().info(f"a rig of {len(self.description.sensors)} sensors: {names}")

    def pause(self) -> None:
        """See `Interface`."""
        super().pause()
        with self._lock:
            self._forget()

    def end_threads(self) -> bool:
        """See `Interface`."""
        with ThreadPoolExecutor(max(len(self.pairs), 1)) as all_at_once:
            list(all_at_once.map(lambda pair: pair.stop(), self.pairs.values()))
        ended = [bool(pair.ended) for pair in self.pairs.values()]
        return all([*ended, *(lidars.worker.stop() for lidars in self.lidars), self._solver.stop()])

    def destroy(self) -> None:
        """See `Interface`."""
        super().destroy()
        self._finish_answers()
        after_answers(self.node, partial(self.node.destroy_service, self._service))
        for publisher in (self.publisher, self._diagnostics_pub):
            self.node.destroy_publisher(publisher)

    def _finish_answers(self) -> None:
        """Of pairs that are destroyed."""
        for _ in range(ROUNDS + 1):  # so that `after_answers` comes to its end
            self._beside.spin_ready()

    def destroy_nodes(self) -> None:
        """See `Interface`."""
        self._beside.destroy()

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
        self.node.get_logger().info(why)

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
                T, _ = self.tf.lookup(reference, self._frame(sensor.name))
                if T is not None:
                    found[sensor.name] = sensor.believed(T)
        return found

    # ---- every second ---------------------------------------------------------------------------------------------------

    def look(self) -> None:
        """See `Interface`."""
        self.load.count_messages()
        super().look()
        self._checks += 1
        if self._checks % CHECKS_PER_TRIM == 0:
            trim_memory()
        states, priors = [self._state_of(*names, pair) for names, pair in self.pairs.items()], self._priors()
        self._priors_now = priors
        doubt, lost = any(own.status in (SUSPECT, MOVED) for own in states), {own.pair for own in states if own.status == MOVED}
        for lidars in self.lidars:
            lidars.urgent = doubt
            if lidars.pair.kind == MOTION_KIND and any({*pair} & {*lidars.names} for pair in lost):
                lidars.reset()  # how both moved before says nothing of where they are now
            states.append(lidars.state())
        for view in [own for own in self._views if own.T is None]:  # whose priors TF tells
            if {view.camera, view.lidar} <= priors.keys() | {self.description.reference}:
                view.T = solve([], priors, self.description.reference).between(view.camera, view.lidar)[0]
        told, before = ([(own.extrinsic, own.usable, bool(own.unchecked)) for own in of] for of in (states, self._told))
        if told != before or self.state is None or len(priors) + 1 != len(self.state.sensors):
            self._told = states
            self._solver.put((self._live, states, priors))
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
            if not self.active or self.ended is not None or live is not self._live:  # its last message has been sent
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
        self.tf.put_tree(self._edges)
        self.write_back.put(self._report(state))

    def _report(self, state: RigState) -> RigReport | None:
        """For the files of export.on_converged, once all sensors are to be relied on."""
        if len(state.sensors) < len(self.description.sensors) or not all(own.usable for own in state.sensors):
            return None
        frames = {own.name: self._frame(own.name) for own in state.sensors}
        of_cameras = {camera: pair.pipeline.camera for (camera, _), pair in self.pairs.items()}
        cameras = {name: camera for name, camera in of_cameras.items() if camera is not None}
        return replace(state.report, frames=frames, cameras=cameras, source=self.parameters["vehicle"])

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> None:
        for pair in self.pairs.values():
            pair.reset()
        for lidars in self.lidars:
            lidars.reset()
        with self._lock:
            self._live = LiveRig(self.description, self.parameters.config.refine)
            self._forget()
        response.success, response.message = True, "all pairs are back to the priors"

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

    def again(self) -> None:
        """See `Interface`."""
        super().again()
        with self._lock:
            if self.state is not None:
                self.publisher.publish(self._message(self.state))

    def _stamp(self, name: str = "") -> int:
        """Of the newest data of a sensor's pairs, ns; of all pairs without a name."""
        stamps = [(names, pair.extrinsic.stamp) for names, pair in self.pairs.items()]
        stamps += [(lidars.names, lidars.stamp) for lidars in self.lidars]
        return max((stamp for names, stamp in stamps if not name or name in names), default=0)

    def _message(self, state: RigState, usable: bool = True) -> Rig:
        now = self.node.get_clock().now().nanoseconds
        until = now + round(VALID_PERIODS * self.parameters["publish_period_s"] * NANOSECONDS)
        return rig_message(state, self._frame, self._stamp, (now, until), usable)

    def _diagnostics(self, priors: Mapping[str, Any]) -> DiagnosticArray:
        missing = [s.name for s in self._others if s.name not in priors]
        told = dict.fromkeys(missing, "nobody knows where it is: set its prior, or publish it on /tf_static")
        status = rig_status(f"{self.node.get_fully_qualified_name().lstrip('/')}: rig", self.state, told, self.health)
        status.hardware_id = self.parameters["vehicle"]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.node.get_clock().now().to_msg()
        return message

    # ---- parameters -------------------------------------------------------------------------------------------------------

    def _take(self, new: Parameters, changed: list[Parameter]) -> None:
        """What changes holds for all pairs, but for what is each one's own."""
        if any(p.name == "export.on_converged" for p in changed):
            check_files(new["export.on_converged"], self.description)
        passed = [p for p in changed if p.name not in OF_RIG | OF_PAIR]
        for own in self._beside.get_nodes() if passed else ():
            told = own.set_parameters_atomically(passed)
            if not told.successful:
                raise BadInputError(told.reason)
        self.parameters, self.load.config = new, new.config.online
        self.tf.put_tree(self._edges)


def node_of_pair(
    node: Node, given: Parameters, description: RigDescription, pair: Pair, known: tuple[Transform, SearchBox] | None
) -> Node:
    """A node of a pair, below that of the rig: what is remapped or renamed on the command line is the rig's.

    given: parameters of the rig, which are the pair's but for what is its own. known: T_camera_lidar (4, 4) by the description,
    and how far around to search.
    """
    overrides, (camera, lidar) = node._parameter_overrides, pair
    own: dict[str, Any] = {"camera_frame": description[camera].frame, "lidar_frame": description[lidar].frame}
    if description[camera].mask:
        own["image.mask"] = description[camera].mask
    if known is not None:
        T, box = known
        own["initial_translation_m"] = T[:3, 3].tolist()
        own["initial_quaternion_xyzw"] = se3.quaternion_from_rotation(T[:3, :3]).tolist()
        own["search.rotation_deg"], own["search.translation_m"] = np.max(box.rotation_deg), np.max(box.translation_m)
        own |= {name: overrides[name].value for name in ("search.rotation_deg", "search.translation_m") if name in overrides}
    if path := given["state_file"]:
        stem, dot, ending = path.rpartition(".")
        own["state_file"] = f"{stem}.{camera}.{lidar}.{ending}" if dot else f"{path}.{camera}.{lidar}"
    if folder := given["capture_dir"]:
        own["capture_dir"] = f"{folder}/{camera}/{lidar}"
    of_all = [n for n in overrides if n in node._parameters and n not in OF_RIG | OF_PAIR and n not in own]
    return Node(
        lidar,
        context=node.context,
        namespace=f"{node.get_fully_qualified_name()}/{camera}",
        use_global_arguments=False,
        parameter_overrides=[overrides[n] for n in of_all] + [Parameter(n, value=v) for n, v in own.items()],
        allow_undeclared_parameters=True,
    )
