"""A camera and a LiDAR: joins the pipeline to topics, services and parameters of a ROS 2 node. No calibration happens here."""

from __future__ import annotations

import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.parameter import Parameter

from calib_ros.extensions import NodeService, node_services
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
        declared, self._inputs = parameters.declare(node), inputs or PairInputs(SharedTopics(node))
        # What may be missing is asked for before anything is made that would have to be taken back.
        motion = motion_source(declared["motion_source"])
        super().__init__(node, declared, self._inputs.shared.node)
        for line in parameters.replaced(declared["preset"], declared.config, self.given):
            node.get_logger().info(line)
        self._nameless: set[str] = set()  # sensors whose messages have no frame_id
        asked = Inputs(
            self._inputs.frame,
            self._frame_ids,
            lambda *sensors: self.initial.choose(*sensors),
            self._inputs.cloud,
            self.tf.tree.others,
        )
        self.pipeline = Pipeline(declared.config, asked, self._on_event, self._inputs.common, self._inputs.lidar)
        self.pipeline.pause(INACTIVE)
        of_pipeline = node, self.pipeline, lambda: self.parameters
        self.initial = InitialExtrinsic(*of_pipeline, self.tf, self.health.error)
        processed = ProcessedPublisher(node, self.pipeline)
        given = self._inputs, lambda: self.parameters, motion
        self.sensors = SensorSubscriptions(*given, self.pipeline, self.health, processed.receive)
        self.extrinsic = ExtrinsicPublisher(*of_pipeline, self.sensors.silent)
        self.capture = Capture(*of_pipeline, self.health, self.files, lambda: self.sensors.camera_info)
        self.overlay = OverlayPublisher(*of_pipeline)
        services = Services(node, self.pipeline, self.health, self.initial, self.extrinsic, self.reset)
        of_others = [make(node, self.pipeline, self.health) for make in node_services(node.get_logger().warning).values()]
        self.parts += [self.sensors, self.extrinsic, self.initial, self.capture, self.overlay, processed, services, *of_others]
        self.parts.append(DiagnosticsPublisher(self))
        self.again, self.end_threads = self.extrinsic.again, self.pipeline.stop
        node.add_on_set_parameters_callback(self._on_parameters)

    def reset(self) -> None:
        """Forget the keyframes, and go back to the initial extrinsic."""
        self.pipeline.reset()
        self.capture.clear()
        self._inputs.on_reset()

    def activate(self) -> None:
        """See `Interface`."""
        self.pipeline.resume()
        super().activate()
        models = self.pipeline.segmentation.in_use()
        self.node.get_logger().info(f"semantics: {'; '.join(models) or 'no models'}")
        if said := remark():
            self.node.get_logger().info(said)
        self.node.get_logger().info("waiting for images, clouds and CameraInfo")

    def deactivate(self) -> None:
        """See `Interface`."""
        self.pipeline.pause(INACTIVE)
        super().deactivate()

    def check(self) -> None:
        """See `Interface`."""
        if self._inputs.common is None:  # else the rig receives them
            self.pipeline.load.count_messages()
        super().check()

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
        if self._ended is None:  # else of a thread in a long computation that did not end in time
            for part in self.parts:
                part.add(event)

    def _take(self, new: Parameters, changed: list[Parameter]) -> None:
        if new.config.image != self.parameters.config.image:
            camera = self.pipeline.camera
            check_mask(new.config.image, None if camera is None else (camera.width, camera.height))
        self.parameters = new
        self.pipeline.configure(new.config)


class DiagnosticsPublisher(NodeService):
    """/diagnostics of a pair: every second, and when the status changes."""

    def __init__(self, own: PairInterface) -> None:
        self._own, self._node = own, own.node
        self._publisher = own.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._status_changed = own.node.create_guard_condition(self._on_status_change)
        self._status = ""
        self._published_at = 0.0  # for a change of status, by time.monotonic()
        self._noted = ""  # the newest line
        self._diagnostics: Diagnostics | None = None  # while the node is active

    def start(self) -> None:
        """Rates count from now on."""
        self._diagnostics = Diagnostics(self._node.get_fully_qualified_name(), self._own.health, self._own.pipeline)

    def pause(self) -> None:
        """See `NodeService`."""
        self._diagnostics = None

    def destroy(self) -> None:
        """See `NodeService`."""
        self._node.destroy_guard_condition(self._status_changed)
        self._node.destroy_publisher(self._publisher)

    def add(self, event: Event) -> None:
        """The status may have changed."""
        if isinstance(event, ExtrinsicUpdated) and event.extrinsic.result.status != self._status:
            self._status = event.extrinsic.result.status
            self._status_changed.trigger()

    def _on_status_change(self) -> None:
        """At once, but not for a status that flickers: the next second is soon enough then."""
        with self._own.health.guard():
            now = time.monotonic()
            if self._diagnostics is not None and now - self._published_at >= DIAGNOSED_AGAIN_S:
                self._published_at = now
                self._publish(self._diagnostics)

    def check(self) -> None:
        """See `NodeService`."""
        if self._diagnostics is not None:
            self._diagnostics.count()
            self._publish(self._diagnostics)

    def _publish(self, diagnostics: Diagnostics) -> None:
        own = self._own
        extra = {"reliable topics": " ".join(s.topic for s in own.sensors.adaptive if s.reliable) or "none"}
        extra["raw keyframes kept"] = str(len(own.capture))
        if own.parameters["consumers"]:
            extra["usable for"] = " ".join(own.extrinsic.served) or "none"
        message = diagnostics.message(self._node.get_clock().now().to_msg(), extra)
        message.status += [status for part in own.parts if (status := part.status()) is not None]
        # The vehicle and both sensors, as far as they are known.
        given, recalibrator = own.parameters, own.pipeline.recalibrator
        frames = [given["camera_frame"], given["lidar_frame"]]
        if recalibrator is not None:
            frames = [recalibrator.tracker.initial.camera_frame, recalibrator.tracker.initial.lidar_frame]
        for status in message.status:
            status.hardware_id = " ".join(filter(None, [given["vehicle"], *frames]))
        self._publisher.publish(message)
        if (health := message.status[0].message) != self._noted:
            self._noted = health
            own.capture.black_box.note(health, "health")
