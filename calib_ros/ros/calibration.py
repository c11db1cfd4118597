"""The interface of a node: of a camera and a LiDAR, or of a rig, each pair of which has the same on a node of its own.

Joins pipelines, and of several pairs their graph, to topics, services and parameters. No calibration happens here.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.timer import Timer

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.errors import BadInputError, CalibrationError, MissingDependencyError
from calib_ros.extensions import NodeService, node_services
from calib_ros.image.mask import check_mask
from calib_ros.online.common import Common
from calib_ros.online.events import Event, ExtrinsicUpdated, Inputs
from calib_ros.online.pipeline import Pipeline
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.rig.description import RigDescription, read_rig
from calib_ros.rig.edges import box_of
from calib_ros.rig.graph import solve
from calib_ros.rig.live import Pair
from calib_ros.ros import parameters
from calib_ros.ros.capture import Capture
from calib_ros.ros.diagnostics import Diagnostics, Health
from calib_ros.ros.executor import Beside, every
from calib_ros.ros.graph import RigGraph, priors_of, topics_of
from calib_ros.ros.initial_extrinsic import InitialExtrinsic
from calib_ros.ros.inputs import PairInputs, SensorSubscriptions, SharedTopics, decoded_once, motion_source
from calib_ros.ros.parameters import Parameters
from calib_ros.ros.parts import ROUNDS
from calib_ros.ros.publishers import ExtrinsicPublisher, OverlayPublisher, ProcessedPublisher
from calib_ros.ros.services import Services
from calib_ros.ros.tf import CURES, StaticTf
from calib_ros.ros.write_back import WriteBack, check_files
from calib_ros.runtime import trim_memory

DIAGNOSED_AGAIN_S = 0.2  # between two changes of status that /diagnostics follows at once
CHECKS_PER_TRIM = 20  # keyframes leave gaps
TF_CURE = "take what says otherwise out of the robot's description, or write the rig to its joints with calib-ros rig --out"
TOKEN = re.compile(r"[A-Za-z][A-Za-z0-9_]*")  # of the name of a node
# Settings of a node of one pair that a rig has in another way, or a pair each by itself.
OF_RIG = {"rig_file", "publish_tf", "tf_parent", "tf_child", "export.on_converged", "export.joint"}
OF_PAIR = {"camera_frame", "lidar_frame", "initial_translation_m", "initial_quaternion_xyzw", "state_file", "capture_dir"}
USED = {"rig_file", "publish_tf", "export.on_converged", "state_file", "capture_dir"}  # of these, by the rig as well


class Calibration(NodeService):
    """Topics, services and parameters of a node, as docs/vehicle.md lists them: a list of parts.

    Made with everything but the subscriptions to the sensors; start() begins to receive and to estimate. Raises a
    CalibrationError for a rig file or parameters that cannot work. To be used on the executor's thread. inputs: None, but for a
    pair of a rig, whose timers and topics are those of the rig's node. parameters: as they are now. files: writes them, one after
    the other. active: between start() and pause(). ended: once stopped, whether all threads did. graph: of a rig, with its
    pairs; None: this is a pair, which has a pipeline.
    """

    graph: RigGraph | None = None
    pipeline: Pipeline
    initial: InitialExtrinsic
    _beside: Beside | None = None  # the nodes of a rig's pairs

    def __init__(self, node: Node, inputs: PairInputs | None = None) -> None:
        declared = parameters.declare(node)
        description = _described(declared) if declared["rig_file"] else None
        # What may be missing is asked for before anything is made that would have to be taken back.
        motion = motion_source(declared["motion_source"])
        self.node, self.parameters, self.health = node, declared, Health(node.get_logger())
        self.inputs = inputs or PairInputs(SharedTopics(node))
        self._given = set(node._parameter_overrides)
        for line in parameters.misspelt({name: p.value for name, p in node._parameter_overrides.items()}, node._parameters):
            node.get_logger().warning(line)
        self.tf = StaticTf(self, CURES if description is None else (TF_CURE, TF_CURE))
        self.files = ThreadPoolExecutor(max_workers=1, thread_name_prefix="calib_files")  # disks may be slow
        self.write_back = WriteBack(self)
        self.parts: list[NodeService] = [self.health, self.tf, self.write_back]  # as they begin; they end the other way round
        self._end_threads: Callable[[], bool] = lambda: True  # all but those of the parts; True if they ended
        self._timers: list[Timer] = []
        self._is_part, self.active, self._checks = inputs is not None, False, 0
        self.ended: bool | None = None
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._status_changed = node.create_guard_condition(self._on_status_change)
        self._status = self._noted = ""  # of a pair: the newest, and the newest line
        self._diagnosed_at = 0.0  # for a change of status, by time.monotonic()
        node.add_on_set_parameters_callback(self._on_parameters)
        try:
            self._make_pair(motion) if description is None else self._make_rig(description)
        except BaseException:  # of one pair: the others must not go on
            self.destroy()
            self.destroy_nodes()
            raise

    def _make_pair(self, motion: Any) -> None:
        node, inputs, config = self.node, self.inputs, self.parameters.config
        for line in parameters.replaced(self.parameters["preset"], config, self._given):
            node.get_logger().info(line)
        self._nameless: set[str] = set()  # sensors whose messages have no frame_id
        initial = lambda *sensors: self.initial.choose(*sensors)  # noqa: E731
        asked = Inputs(inputs.frame, self._frame_ids, initial, inputs.cloud, self.tf.tree.others)
        self.pipeline = Pipeline(config, asked, self._on_event, inputs.common, (inputs.camera, inputs.lidar))
        self._end_threads = self.pipeline.stop
        self.extrinsic, self.initial, self.capture = ExtrinsicPublisher(self), InitialExtrinsic(self), Capture(self)
        self.overlay, self.processed = OverlayPublisher(self), ProcessedPublisher(self)
        self.sensors = SensorSubscriptions(self, motion)
        self.parts += [self.extrinsic, self.initial, self.capture, self.overlay, self.processed, Services(self), self.sensors]
        self.parts.append(Diagnostics(node.get_fully_qualified_name(), self.health, self.pipeline, self._more))
        self.parts += [make(node, self.pipeline, self.health) for make in node_services(node.get_logger().warning).values()]

    def _make_rig(self, description: RigDescription) -> None:
        node, declared, shared = self.node, self.parameters, self.inputs.shared
        for name in sorted(((OF_RIG | OF_PAIR) - USED) & self._given):
            node.get_logger().warning(f"parameter '{name}' has no effect with a rig_file")
        common, self._beside = Common(declared.config.online), Beside(node)
        decoded = {sensor.name: decoded_once(sensor.kind) for sensor in description.sensors}
        pairs: dict[Pair, Calibration] = {}
        priors, reference = priors_of(description), description.reference
        for pair in description.camera_pairs:
            camera, lidar = pair
            topics = topics_of(description, camera, lidar)
            inputs = PairInputs(shared, decoded[camera], decoded[lidar], common, camera, lidar, topics)
            known = None  # T_camera_lidar (4, 4), and how far around to search; else the description leaves that to TF
            if {camera, lidar} <= priors.keys() | {reference}:
                T, C = solve([], priors, reference).between(camera, lidar)
                inputs.T, known = T, (T, box_of(C))
            own = node_of_pair(node, declared, description, pair, known)
            self._beside.add_node(own)
            pairs[pair] = made = Calibration(own, inputs)
            self.parts.append(made)
            if description.pairs is None:
                inputs.unseen = made.leave_out
        self.graph = RigGraph(self, description, pairs, decoded, common)
        for (_, lidar), made in pairs.items():
            made.inputs.on_reset = partial(self.graph.reset_lidars, lidar)
        self.parts += [*self.graph.lidars, self.graph]
        self._end_threads = self.graph.end_threads

    # ---- states -------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Receive messages, make estimates, publish at a steady rate."""
        self.active = True
        try:
            for part in self.parts:
                part.start()
        except Exception:
            self.pause()
            raise
        ticks = () if self._is_part else ((1.0, self.check), (self.parameters["publish_period_s"], self.again))
        self._timers = [every(self.node, period_s, call) for period_s, call in ticks]

    def pause(self) -> None:
        """Receive nothing, end estimates under way, and say as the last message that nothing is usable any more.

        Keyframes and extrinsic stay.
        """
        self.active = False
        for timer in self._timers:
            self.node.destroy_timer(timer)
        self._timers = []
        for part in reversed(self.parts):
            part.pause()

    def stop(self) -> None:
        """End all threads, an estimate under way included; files under way are finished."""
        if self.ended is None:
            self.ended = self._end_threads()
            for part in self.parts:
                part.stop()
            self.files.shutdown(wait=True)

    def destroy(self) -> None:
        """Leave nothing on the node but its parameters."""
        if self.active:
            self.pause()
        self.stop()
        self.node.remove_on_set_parameters_callback(self._on_parameters)
        for part in reversed(self.parts):
            part.destroy()
        if self._beside is not None:
            for _ in range(ROUNDS + 1):  # so that `after_answers` of the pairs comes to its end
                self._beside.spin_ready()
        self.node.destroy_guard_condition(self._status_changed)
        self.node.destroy_publisher(self._publisher)

    def destroy_nodes(self) -> None:
        """Those of the pairs of a rig, at the very end."""
        if self._beside is not None:
            self._beside.destroy()

    def check(self) -> None:
        """See `NodeService`."""
        with self.health.guard():
            for part in self.parts:
                part.check()
            self._diagnose()
            self._checks += 1
            if not self._is_part and self._checks % CHECKS_PER_TRIM == 0:
                trim_memory()

    def again(self) -> None:
        """See `NodeService`."""
        with self.health.guard():
            for part in self.parts:
                part.again()

    def reset(self) -> None:
        """Of a pair: forget the keyframes, and go back to the initial extrinsic."""
        self.pipeline.reset()
        self.capture.clear()
        self.inputs.on_reset()

    def leave_out(self, why: str) -> None:
        """A pair makes no estimates any more. why: for a person."""
        self.pipeline.pause(why)
        self.inputs.shared.node.get_logger().info(why)

    # ---- diagnostics --------------------------------------------------------------------------------------------------

    def _diagnose(self) -> None:
        """/diagnostics: every second, and when the status changes."""
        names, message = [self.parameters["vehicle"]], DiagnosticArray()
        message.status = [status for part in self.parts if (status := part.status()) is not None]
        message.header.stamp = self.node.get_clock().now().to_msg()
        if self.graph is None:  # the vehicle and both sensors, as far as they are known
            names += [self.parameters["camera_frame"], self.parameters["lidar_frame"]]
            if (recalibrator := self.pipeline.recalibrator) is not None:
                names[1:] = recalibrator.tracker.initial.camera_frame, recalibrator.tracker.initial.lidar_frame
        for status in message.status:
            status.hardware_id = " ".join(filter(None, names))
        self._publisher.publish(message)
        if self.graph is None and (health := message.status[0].message) != self._noted:
            self._noted = health
            self.capture.black_box.note(health, "health")

    def _more(self) -> dict[str, str]:
        """Values for the diagnostics of a pair, by name."""
        found = {"reliable topics": " ".join(s.topic for s in self.sensors.adaptive if s.reliable) or "none"}
        found["raw keyframes kept"] = str(len(self.capture))
        if self.parameters["consumers"]:
            found["usable for"] = " ".join(self.extrinsic.served) or "none"
        return found

    def _on_status_change(self) -> None:
        """At once, but not for a status that flickers: the next second is soon enough then."""
        with self.health.guard():
            now = time.monotonic()
            if self.active and now - self._diagnosed_at >= DIAGNOSED_AGAIN_S:
                self._diagnosed_at = now
                self._diagnose()

    # ---- what a pipeline asks and tells -------------------------------------------------------------------------------

    def _frame_ids(self, image: Any, cloud: Any) -> tuple[str, str]:
        names = []
        for sensor, message in (("camera", image), ("lidar", cloud)):
            name = self.parameters[f"{sensor}_frame"] or message.header.frame_id
            if not name and sensor not in self._nameless:
                self._nameless.add(sensor)
                text = f"messages of the {sensor} have no frame_id: it is called '{sensor}'; set {sensor}_frame"
                self.health.error(text, f"frame_id of the {sensor}")
            names.append(name or sensor)
        return names[0], names[1]

    def _on_event(self, event: Event) -> None:
        """On the pipeline's threads."""
        if self.ended is None:  # else of a thread in a long computation that did not end in time
            for part in self.parts:
                part.add(event)
            if isinstance(event, ExtrinsicUpdated) and event.extrinsic.result.status != self._status:
                self._status = event.extrinsic.result.status
                self._status_changed.trigger()

    # ---- parameters ---------------------------------------------------------------------------------------------------

    def _on_parameters(self, changed: list[Parameter]) -> SetParametersResult:
        """What costs more to change than constants of the stages waits for the next check()."""
        try:
            new = parameters.changed(self.parameters, changed)
            if new["publish_tf"] and self.tf.missing:
                raise MissingDependencyError(self.tf.missing)
            self._take(new, changed)
        except CalibrationError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take(self, new: Parameters, changed: list[Parameter]) -> None:
        """Use other parameters from now on; those of a rig hold for all pairs, but for what is each one's own. Raises a
        CalibrationError for what cannot work."""
        if self.graph is None or self._beside is None:
            if new.config.image != self.parameters.config.image:
                camera = self.pipeline.camera
                check_mask(new.config.image, None if camera is None else (camera.width, camera.height))
            self.parameters = new
            self.pipeline.configure(new.config)
            return
        if any(p.name == "export.on_converged" for p in changed):
            check_files(new["export.on_converged"], self.graph.description)
        passed = [p for p in changed if p.name not in OF_RIG | OF_PAIR]
        for own in self._beside.get_nodes() if passed else ():
            told = own.set_parameters_atomically(passed)
            if not told.successful:
                raise BadInputError(told.reason)
        self.parameters = new
        self.graph.configure(new.config)


def _described(declared: Parameters) -> RigDescription:
    """The rig of the parameter rig_file. BadInputError if the node cannot estimate it, or write it where it is to be written."""
    path = declared["rig_file"]
    description = read_rig(path)
    for sensor in description.sensors:
        if not TOKEN.fullmatch(sensor.name):
            raise BadInputError(f"{path}: sensors.{sensor.name} cannot be part of a topic's name; use letters, digits and _")
    if not description.camera_pairs:
        raise BadInputError(f"{path}: pairs holds no camera with a LiDAR, which the node estimates; add one")
    check_files(declared["export.on_converged"], description)
    return description


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
