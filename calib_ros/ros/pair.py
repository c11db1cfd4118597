"""A camera and a LiDAR: joins the pipeline to topics, services and parameters of a ROS 2 node. No calibration happens here."""

from __future__ import annotations

import time
from typing import Any

import scipy.stats.qmc  # noqa: F401 - half a second, for which the first search would wait
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.parameter import Parameter

from calib_ros.extensions import node_services
from calib_ros.image.mask import check_mask
from calib_ros.online.events import Event, ExtrinsicUpdated, Inputs
from calib_ros.online.pipeline import Pipeline
from calib_ros.ros import parameters
from calib_ros.ros.capture import Capture
from calib_ros.ros.diagnostics import Diagnostics
from calib_ros.ros.distributions import remark
from calib_ros.ros.initial_extrinsic import InitialExtrinsic
from calib_ros.ros.inputs import PairInputs, SensorSubscriptions, SharedTopics, motion_source
from calib_ros.ros.interface import Interface
from calib_ros.ros.parameters import Parameters
from calib_ros.ros.publishers import ExtrinsicPublisher, OverlayPublisher, ProcessedPublisher
from calib_ros.ros.services import Services

DIAGNOSED_AGAIN_S = 0.2  # between two changes of status that /diagnostics follows at once
INACTIVE = "the node is not active; activate it first"


class PairInterface(Interface):
    """Of a pair, as docs/vehicle.md lists it. inputs: what a pair shares with others of a rig; None = it is alone."""

    def __init__(self, node: Node, inputs: PairInputs | None = None) -> None:
        declared, self.inputs = parameters.declare(node), inputs or PairInputs(SharedTopics(node))
        # What may be missing is asked for before anything is made that would have to be taken back.
        motion = motion_source(declared["motion_source"])
        super().__init__(node, declared, self.inputs.shared.node)
        for line in parameters.replaced(declared["preset"], declared.config, self.given):
            node.get_logger().info(line)
        self._nameless: set[str] = set()  # sensors whose messages have no frame_id
        asked = Inputs(
            self.inputs.frame,
            self._frame_ids,
            lambda *sensors: self.initial.choose(*sensors),
            self.inputs.cloud,
            self.tf.tree.others,
        )
        sensors = self.inputs.camera, self.inputs.lidar
        self.pipeline = Pipeline(declared.config, asked, self._on_event, self.inputs.common, sensors)
        self.pipeline.pause(INACTIVE)
        self.sensors, self.extrinsic = SensorSubscriptions(self, motion), ExtrinsicPublisher(self)
        self.initial, self.capture, self.overlay = InitialExtrinsic(self), Capture(self), OverlayPublisher(self)
        self.processed = ProcessedPublisher(self)
        self.parts += [self.sensors, self.extrinsic, self.initial, self.capture, self.overlay, self.processed, Services(self)]
        self.parts += [make(node, self.pipeline, self.health) for make in node_services(node.get_logger().warning).values()]
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._status_changed = node.create_guard_condition(self._on_status_change)
        self._status = self._noted = ""  # the newest, and the newest line
        self._published_at = 0.0  # for a change of status, by time.monotonic()
        self._diagnostics: Diagnostics | None = None  # while the node is active
        self.end_threads = self.pipeline.stop
        node.add_on_set_parameters_callback(self._on_parameters)

    def reset(self) -> None:
        """Forget the keyframes, and go back to the initial extrinsic."""
        self.pipeline.reset()
        self.capture.clear()
        self.inputs.on_reset()

    def start(self) -> None:
        """See `Interface`."""
        self.pipeline.resume()
        super().start()
        self._diagnostics = Diagnostics(self.node.get_fully_qualified_name(), self.health, self.pipeline)  # rates count from now
        models = self.pipeline.segmentation.in_use()
        self.node.get_logger().info(f"semantics: {'; '.join(models) or 'no models'}")
        if said := remark():
            self.node.get_logger().info(said)
        self.node.get_logger().info("waiting for images, clouds and CameraInfo")

    def pause(self) -> None:
        """See `Interface`."""
        self._diagnostics = None
        self.pipeline.pause(INACTIVE)
        super().pause()

    def destroy(self) -> None:
        """See `Interface`."""
        super().destroy()
        self.node.destroy_guard_condition(self._status_changed)
        self.node.destroy_publisher(self._publisher)

    def look(self) -> None:
        """See `Interface`."""
        if self.inputs.common is None:  # else the rig receives them
            self.pipeline.load.count_messages()
        super().look()
        if self._diagnostics is not None:
            self._diagnostics.count()
            self._publish(self._diagnostics)

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

    def _take(self, new: Parameters, changed: list[Parameter]) -> None:
        if new.config.image != self.parameters.config.image:
            camera = self.pipeline.camera
            check_mask(new.config.image, None if camera is None else (camera.width, camera.height))
        self.parameters = new
        self.pipeline.configure(new.config)

    def _on_status_change(self) -> None:
        """At once, but not for a status that flickers: the next second is soon enough then."""
        with self.health.guard():
            now = time.monotonic()
            if self._diagnostics is not None and now - self._published_at >= DIAGNOSED_AGAIN_S:
                self._published_at = now
                self._publish(self._diagnostics)

    def _publish(self, diagnostics: Diagnostics) -> None:
        """/diagnostics: every second, and when the status changes."""
        extra = {"reliable topics": " ".join(s.topic for s in self.sensors.adaptive if s.reliable) or "none"}
        extra["raw keyframes kept"] = str(len(self.capture))
        if self.parameters["consumers"]:
            extra["usable for"] = " ".join(self.extrinsic.served) or "none"
        message = diagnostics.message(self.node.get_clock().now().to_msg(), extra)
        message.status += [status for part in self.parts if (status := part.status()) is not None]
        # The vehicle and both sensors, as far as they are known.
        given, recalibrator = self.parameters, self.pipeline.recalibrator
        frames = [given["camera_frame"], given["lidar_frame"]]
        if recalibrator is not None:
            frames = [recalibrator.tracker.initial.camera_frame, recalibrator.tracker.initial.lidar_frame]
        for status in message.status:
            status.hardware_id = " ".join(filter(None, [given["vehicle"], *frames]))
        self._publisher.publish(message)
        if (health := message.status[0].message) != self._noted:
            self._noted = health
            self.capture.black_box.note(health, "health")
