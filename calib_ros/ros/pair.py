"""A camera and a LiDAR: joins the pipeline to topics, services and parameters of a ROS 2 node. No calibration happens here."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import scipy.stats.qmc  # noqa: F401 - half a second, for which the first search would wait
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.timer import Timer

from calib_ros.errors import CalibrationError
from calib_ros.extensions import node_services
from calib_ros.online.black_box import BlackBox, Occasion
from calib_ros.online.events import Event, ExtrinsicUpdated, FrameIngested, Inputs, IntakeIdle
from calib_ros.online.pipeline import Pipeline
from calib_ros.result import CONVERGED, Extrinsic, Result
from calib_ros.ros import parameters
from calib_ros.ros.calibrate import CalibrateServers
from calib_ros.ros.capture import Capture
from calib_ros.ros.conversions import cloud_from_message, frame_from_messages, transform_message
from calib_ros.ros.diagnostics import Diagnostics, Health
from calib_ros.ros.distributions import remark
from calib_ros.ros.initial_extrinsic import InitialExtrinsic
from calib_ros.ros.publishers import ExtrinsicPublisher, OverlayPublisher, ProcessedPublisher
from calib_ros.ros.rig_pairs import PairOfRig
from calib_ros.ros.services import Services
from calib_ros.ros.subscriptions import SensorSubscriptions, motion_source
from calib_ros.ros.tf import LATCHED, StaticTf
from calib_ros.ros.write_back import WriteBack

DIAGNOSED_AGAIN_S = 0.2  # between two changes of status that /diagnostics follows at once
INACTIVE = "the node is not active; activate it first"


class PairInterface:
    """Topics, services and parameters on a node of any kind, as docs/vehicle.md lists them.

    Made with everything but the subscriptions to the sensors; activate() begins to receive and to estimate. Raises a
    CalibrationError for parameters that cannot work. To be used on the executor's thread. rig: what a pair shares with others.
    """

    def __init__(self, node: Node, rig: PairOfRig | None = None) -> None:
        self._node, self._rig = node, rig
        self.parameters = parameters.declare(node)
        self.health = Health(node.get_logger())
        given = {name: parameter.value for name, parameter in node._parameter_overrides.items()}
        for line in parameters.misspelt(given, node._parameters):
            node.get_logger().warning(line)
        for line in parameters.replaced(self.parameters["preset"], self.parameters.config, given):
            node.get_logger().info(line)
        # What may be missing is asked for before anything is made that would have to be taken back.
        motion = motion_source(self.parameters["motion_source"])
        listener = node if rig is None else rig.shared.node  # whose remapping holds for the topic
        self.tf = StaticTf(listener, self.parameters["initial_from_tf"], self.parameters["publish_tf"], self.health.error)
        self._tf_settings = self._tf_parameters()
        self.initial = InitialExtrinsic(lambda: self.parameters, self.tf, self.health.error)
        self._files = ThreadPoolExecutor(max_workers=1, thread_name_prefix="calib_files")  # disks may be slow
        self.write_back = WriteBack(lambda: self.parameters, self._files, self.health, self.tf.edges)
        self._export_settings = self._export_parameters()
        self.capture = Capture(lambda: self.parameters, lambda: self.sensors.camera_info)
        decode = (frame_from_messages, cloud_from_message) if rig is None else (rig.frame, rig.cloud)
        inputs = Inputs(decode[0], self._frame_ids, self.initial.choose, decode[1], self.tf.other_frames)
        shared = () if rig is None else (rig.common, rig.lidar)
        self.pipeline = Pipeline(self.parameters.config, inputs, self._on_event, *shared)
        self.pipeline.pause(INACTIVE)
        self.black_box = BlackBox(self.pipeline, lambda: self.parameters["capture.on"], self._record)
        self.processed = ProcessedPublisher(node, self.pipeline)
        receiver = node if rig is None else rig.shared.node
        topics = () if rig is None else (rig.shared.subscribe, rig.topics, (rig.camera, rig.lidar))
        self.sensors = SensorSubscriptions(
            receiver, self.parameters, motion, self.pipeline, self.health, self.processed.add, *topics
        )
        self.extrinsic = ExtrinsicPublisher(node, self.pipeline, lambda: self.parameters, self.sensors.silent)
        self._transform_pub = node.create_publisher(TransformStamped, "~/transform", LATCHED)
        self.overlay = OverlayPublisher(node, self.parameters["overlay_period_s"])
        self._diagnostics_pub = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._diagnostics = Diagnostics(node.get_fully_qualified_name(), self.health, self.pipeline)
        self._diagnosed_at = 0.0  # for a change of status, by time.monotonic()
        self._status_changed = node.create_guard_condition(self._on_status_change)
        self._last_stamp = 0
        self._saved = 0  # accepted estimates when the extrinsic was saved
        self._ended: bool | None = None
        self._noted = ""  # the newest line of the diagnostics
        self._nameless: set[str] = set()  # sensors whose messages have no frame_id
        self._timers: list[Timer] = []
        helpers = (
            self.initial,
            self.capture,
            self._save,
            self.extrinsic,
            self.health,
            self._files,
            self.black_box.events,
            self.reset,
        )
        self.serving = Services(node, self.pipeline, *helpers)
        self.calibrating = CalibrateServers(node, self.pipeline, self.serving.message, self.health)
        makers = node_services(node.get_logger().warning)
        self.beside = {name: make(node, self.pipeline, self.health) for name, make in makers.items()}
        node.add_on_set_parameters_callback(self._on_parameters)

    def reset(self) -> None:
        """Forget the keyframes, and go back to the initial extrinsic."""
        self.pipeline.reset()
        self.capture.clear()
        if self._rig is not None:
            self._rig.on_reset()

    # ---- states -------------------------------------------------------------------------------------------------------

    def activate(self) -> None:
        """Receive messages, make estimates, publish at a steady rate."""
        node = self._node
        self.pipeline.resume()
        try:
            self.sensors.start(self.parameters)
        except Exception:
            self.deactivate()
            raise
        self._diagnostics = Diagnostics(node.get_fully_qualified_name(), self.health, self.pipeline)  # rates count from now on
        # Steady time: a simulated clock that stands still must not silence the diagnostics.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timers = [
            node.create_timer(1.0, self._every_second, clock=steady),
            node.create_timer(self.parameters["publish_period_s"], self._publish_again, clock=steady),
        ]
        models = self.pipeline.segmentation.in_use()
        node.get_logger().info(f"semantics: {'; '.join(models) or 'no models'}")
        if said := remark():
            node.get_logger().info(said)
        node.get_logger().info("waiting for images, clouds and CameraInfo")

    def deactivate(self) -> None:
        """Receive nothing, end estimates under way, and say as the last message that the extrinsic is not usable any more.

        Keyframes and extrinsic stay.
        """
        self.pipeline.pause(INACTIVE)
        self.sensors.stop()
        self.black_box.check(flush=True)
        for timer in self._timers:
            self._node.destroy_timer(timer)
        self._timers = []
        self.pipeline.read_current(self.extrinsic.publish)

    def stop(self) -> bool:
        """End all threads, an estimate under way included; files under way are finished. True if they ended."""
        if self._ended is None:
            self._ended = self.pipeline.stop()
            self.black_box.check(flush=True)
            self._files.shutdown(wait=True)
            for service in self.beside.values():
                service.stop()
        return self._ended

    def destroy(self) -> bool:
        """Leave nothing on the node but its parameters. True if all threads ended."""
        if self._timers:
            self.deactivate()
        self.sensors.stop()
        ended = self.stop()
        self._node.remove_on_set_parameters_callback(self._on_parameters)
        for service in self.beside.values():
            service.destroy()
        for part in (self.calibrating, self.serving, self.tf):
            part.destroy()
        self._node.destroy_guard_condition(self._status_changed)
        for publisher in (self._transform_pub, self._diagnostics_pub, self.overlay.compressed):
            self._node.destroy_publisher(publisher)
        for publishing in (self.extrinsic, self.overlay, self.processed):
            self._node.destroy_publisher(publishing.publisher)
        return ended

    def destroy_nodes(self) -> None:
        """Those beside this one: none."""

    # ---- pipeline, on its threads -------------------------------------------------------------------------------------

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
        if self._ended is not None:
            return  # of a thread in a long computation that did not end in time
        if isinstance(event, ExtrinsicUpdated):
            extrinsic, result, stamp = event.extrinsic, event.extrinsic.result, event.stamp
            self._last_stamp = stamp
            before = self.health.extrinsic
            self.health.add_extrinsic(extrinsic)
            self.extrinsic.publish(extrinsic, stamp)
            self._transform_pub.publish(transform_message(result.T_camera_lidar, result.camera_frame, result.lidar_frame, stamp))
            self._publish_tf(extrinsic, stamp)
            if before is None or before.result.status != result.status:
                self._status_changed.trigger()
            self._saved = min(self._saved, extrinsic.accepted)  # counted anew after a reset
            if result.status == CONVERGED and extrinsic.accepted > self._saved:
                self._saved = extrinsic.accepted
                self._save(result)
            self.write_back.add(extrinsic)
            self.overlay.publish(self.pipeline.recalibrator, self.pipeline.last_keyframe, at_once=True)
        elif isinstance(event, FrameIngested):
            if self.black_box.wants(event):
                self.capture.add(event.image, event.cloud)
            self.overlay.publish(self.pipeline.recalibrator, event.frame)
        elif isinstance(event, IntakeIdle):
            self.processed.publish()
        elif event.solved:
            self.health.note(event.message, event.kind)
        else:
            self.health.error(event.message, event.kind)
        self.black_box.add(event)

    def _record(self, occasion: Occasion, events: str) -> None:
        def write() -> None:
            try:
                self._node.get_logger().info(
                    f"{occasion.kind}: {self.capture.write_occasion(occasion.kind, occasion.result, events)}"
                )
            except CalibrationError as error:
                self.health.error(str(error), "capture.on")
            except Exception as error:
                self.health.unexpected(error)

        self._files.submit(write)

    def _publish_tf(self, extrinsic: Extrinsic, stamp: int) -> None:
        self.tf.publish(extrinsic.result, self.parameters["tf_parent"], self.parameters["tf_child"], stamp)

    def _tf_parameters(self) -> tuple[bool, str, str]:
        return self.parameters["publish_tf"], self.parameters["tf_parent"], self.parameters["tf_child"]

    def _export_parameters(self) -> tuple[Any, ...]:
        return self.parameters["export.on_converged"], self.parameters["export.joint"]

    def _save(self, result: Result) -> tuple[bool, str]:
        return self.initial.save(result, self.pipeline, self._last_stamp)

    # ---- parameters and timer, on the executor ------------------------------------------------------------------------

    def _on_parameters(self, changed: list[Any]) -> SetParametersResult:
        """Constants of the stages take effect at once; what costs more to change waits for the next _every_second()."""
        camera = self.pipeline.camera
        size = None if camera is None else (camera.width, camera.height)
        answer, new = parameters.on_change(self.parameters, changed, size)
        if answer.successful and new["publish_tf"] and self.tf.missing:
            return SetParametersResult(successful=False, reason=self.tf.missing)
        self.parameters = new
        self.pipeline.configure(new.config)
        return answer

    def _every_second(self) -> None:
        with self.health.guard():
            self.health.log.catch_up()
            if self._rig is None:  # else the rig receives them
                self.pipeline.load.count_messages()
            self.overlay.period_s = self.parameters["overlay_period_s"]
            self.capture.resize()
            self.sensors.check(self.parameters)
            self.tf.check()
            tf_settings = self._tf_parameters()
            if tf_settings != self._tf_settings:
                self._tf_settings = tf_settings
                self.tf.switch(tf_settings[0])
                self.pipeline.read_current(self._publish_tf)
            if self._export_settings != (new := self._export_parameters()):
                self._export_settings = new
                self.pipeline.read_current(self.write_back.add)
            recalibrator = self.pipeline.recalibrator
            if recalibrator is not None and self.initial.superseded_by_tf(recalibrator):
                self._node.get_logger().info("TF connects camera and LiDAR by now: starting anew from it")
                self.pipeline.restart()
            self._diagnostics.count()
            self._publish_diagnostics()
            self.black_box.check()

    def _on_status_change(self) -> None:
        """/diagnostics at once, but not for a status that flickers: the next second is soon enough then."""
        with self.health.guard():
            now = time.monotonic()
            if self._timers and now - self._diagnosed_at >= DIAGNOSED_AGAIN_S:
                self._diagnosed_at = now
                self._publish_diagnostics()

    def _publish_diagnostics(self) -> None:
        extra = {"reliable topics": " ".join(s.topic for s in self.sensors.adaptive if s.reliable) or "none"}
        extra["raw keyframes kept"] = str(len(self.capture))
        if self.parameters["consumers"]:
            extra["usable for"] = " ".join(self.extrinsic.served) or "none"
        message = self._diagnostics.message(self._node.get_clock().now().to_msg(), extra)
        message.status += [status for service in self.beside.values() if (status := service.status()) is not None]
        for status in message.status:
            status.hardware_id = self._hardware_id()
        self._diagnostics_pub.publish(message)
        if (health := message.status[0].message) != self._noted:
            self._noted = health
            self.black_box.note(health, "health")

    def _hardware_id(self) -> str:
        """The vehicle and both sensors, as far as they are known."""
        recalibrator = self.pipeline.recalibrator
        frames = [self.parameters["camera_frame"], self.parameters["lidar_frame"]]
        if recalibrator is not None:
            frames = [recalibrator.tracker.initial.camera_frame, recalibrator.tracker.initial.lidar_frame]
        return " ".join(filter(None, [self.parameters["vehicle"], *frames]))

    def _publish_again(self) -> None:
        """Others see that the node is alive, and whether its extrinsic still is."""
        with self.health.guard():
            self.pipeline.read_current(self.extrinsic.publish, wait=False)
