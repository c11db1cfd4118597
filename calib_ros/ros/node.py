"""The ROS 2 node: joins the pipeline to topics, services and parameters. No calibration happens here."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import rclpy
from calib_ros_msgs.msg import Extrinsic as ExtrinsicMsg
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped, TwistStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, PointCloud2

from calib_ros.camera import Camera
from calib_ros.errors import CalibrationError, MissingDependencyError
from calib_ros.frame import Frame
from calib_ros.lidar.deskew import deskewed_frame
from calib_ros.messages import decode_camera_info, stamp_ns
from calib_ros.online.pipeline import Pipeline, PipelineHooks
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.overlay import caption, render
from calib_ros.result import CONVERGED, Extrinsic, Result
from calib_ros.ros import parameters
from calib_ros.ros.bags import Capture
from calib_ros.ros.conversions import extrinsic_message, frame_from_messages, image_message, transform_message
from calib_ros.ros.dds import use_large_message_profile
from calib_ros.ros.diagnostics import Diagnostics, Health, return_freed_memory
from calib_ros.ros.parameters import Parameters
from calib_ros.ros.services import Services
from calib_ros.ros.subscriptions import AdaptiveSubscription
from calib_ros.ros.tf import LATCHED, InitialExtrinsic, StaticTf

# What the node listens to: image, cloud, CameraInfo, and what tells how fast the vehicle moves.
MOTION_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


class Sensors:
    """The subscriptions; hands every message over to the pipeline. camera_info: the newest usable CameraInfo, None before."""

    def __init__(self, node: Node, parameters: Parameters, pipeline: Pipeline, health: Health) -> None:
        self.camera_info: CameraInfo | None = None
        self._pipeline, self._health = pipeline, health
        self._rectified = parameters["image_is_rectified"]
        image = CompressedImage if parameters["image_transport"] == "compressed" else Image
        wanted = parameters["reliability"]
        self.image = AdaptiveSubscription(node, image, "image", health.timed(self._on_image), wanted)
        self.points = AdaptiveSubscription(node, PointCloud2, "points", health.timed(self._on_points), wanted)
        # A camera's driver may say once, latched, what never changes.
        self.info = AdaptiveSubscription(
            node, CameraInfo, "camera_info", health.timed(self._on_camera_info), wanted, latched=True
        )
        self.adaptive = (self.image, self.points, self.info)
        source = parameters["motion_source"]
        if source != "none":
            kind, decode = _motion_message(source)

            def on_motion(msg: Any) -> None:
                pipeline.speed_gate.measured(stamp_ns(msg.header.stamp), *decode(msg))

            node.create_subscription(kind, source, health.timed(on_motion), MOTION_QOS)

    def check(self, parameters: Parameters) -> None:
        """To be called about once a second: follow the publishers and the parameters."""
        for subscription in self.adaptive:
            subscription.preference = parameters["reliability"]
            problem = subscription.check()
            if problem:
                self._health.error(problem)
        if parameters["image_is_rectified"] != self._rectified:
            self._rectified = parameters["image_is_rectified"]
            if self.camera_info is not None:
                self._on_camera_info(self.camera_info)

    def _on_image(self, msg: Any) -> None:
        self._pipeline.add_image(stamp_ns(msg.header.stamp), msg)

    def _on_points(self, msg: PointCloud2) -> None:
        self._pipeline.add_cloud(stamp_ns(msg.header.stamp), msg)

    def _on_camera_info(self, msg: CameraInfo) -> None:
        try:
            camera: Camera = decode_camera_info(msg, self._rectified)
        except CalibrationError as error:
            self._health.error(str(error))
            return
        self.camera_info = msg
        self._pipeline.set_camera(camera)


def _motion_message(source: str) -> tuple[type[Any], Callable[[Any], tuple[float | None, float | None]]]:
    """Message type of a motion source, and what makes speed, m/s, and turn rate, deg/s, of it; None = not told.

    MissingDependencyError without nav_msgs where it is needed.
    """
    if source == "imu":
        return Imu, lambda msg: (None, None if msg.angular_velocity_covariance[0] == -1 else _turn(msg.angular_velocity))
    if source == "twist":
        return TwistStamped, lambda msg: (_length(msg.twist.linear), _turn(msg.twist.angular))
    try:
        from nav_msgs.msg import Odometry
    except ImportError:
        raise MissingDependencyError(
            "motion_source: odom needs nav_msgs; install it (apt: ros-<distro>-nav-msgs) or set motion_source to twist or imu"
        ) from None
    return Odometry, lambda msg: (_length(msg.twist.twist.linear), _turn(msg.twist.twist.angular))


def _length(vector: Any) -> float:
    return float(np.linalg.norm([vector.x, vector.y, vector.z]))


def _turn(vector: Any) -> float:
    return float(np.rad2deg(_length(vector)))


# ~/overlay: the diagnostic picture, drawn only while someone looks, and not more often than asked.
class OverlayPublisher:
    """Draws on the thread that calls it, 10 to 40 ms: a worker's, the executor's only for a reset. period_s may be replaced."""

    def __init__(self, node: Node, period_s: float) -> None:
        self._publisher = node.create_publisher(Image, "~/overlay", 1)
        self.period_s = period_s
        self._last = 0.0

    def publish(self, recalibrator: Recalibrator | None, frame: Frame | None, at_once: bool = False) -> None:
        """Draw a frame with the current extrinsic below the initial one; at_once: the period does not count."""
        due = at_once or time.monotonic() - self._last >= self.period_s
        if recalibrator is None or frame is None or not due or self._publisher.get_subscription_count() == 0:
            return
        self._last = time.monotonic()
        extrinsic, initial = recalibrator.current, recalibrator.tracker.initial
        newest = recalibrator.newest()
        if newest is not None and newest.stamp == frame.stamp:
            frame = deskewed_frame(replace(frame, twist=newest.twist), recalibrator.config.motion)
        picture = render(
            frame,
            extrinsic.result.T_camera_lidar,
            T_before=initial.T_camera_lidar,
            edges=newest.outline if newest is not None and newest.stamp == frame.stamp else None,
            lines=caption(extrinsic, len(recalibrator.buffer), initial.T_camera_lidar),
            status=extrinsic.result.status,
        )
        self._publisher.publish(image_message(picture, extrinsic.result.camera_frame, frame.stamp))


class CalibNode(Node):
    """Topics, services and parameters as the README lists them."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("calib_ros", **kwargs)
        self.parameters = parameters.declare(self)
        self.health = Health(self.get_logger())
        for line in parameters.misspelt(self._parameter_overrides, self._parameters):
            self.get_logger().warning(line)
        self.tf = StaticTf(self, self.parameters["initial_from_tf"], self.parameters["publish_tf"])
        self._tf_told = (self.parameters["publish_tf"], self.parameters["tf_parent"])
        self.initial = InitialExtrinsic(lambda: self.parameters, self.tf, self.health.error)
        self.capture = Capture(lambda: self.parameters, lambda: self.sensors.camera_info)
        self.pipeline = Pipeline(
            self.parameters.config,
            PipelineHooks(
                *(frame_from_messages, self._frame_ids, self.initial.choose, self._on_extrinsic, self._on_frame),
                *(self.health.error, self.capture.keep),
            ),
        )
        self._extrinsic_pub = self.create_publisher(ExtrinsicMsg, "~/extrinsic", LATCHED)
        self._transform_pub = self.create_publisher(TransformStamped, "~/transform", LATCHED)
        self.overlay = OverlayPublisher(self, self.parameters["overlay_period_s"])
        self._diagnostics_pub = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._diagnostics = Diagnostics(self.get_fully_qualified_name(), self.health, self.pipeline)
        self._last_stamp = 0
        self.sensors = Sensors(self, self.parameters, self.pipeline, self.health)
        self.serving = Services(
            *(self, self.pipeline, self.initial, self.capture, self._write_state, lambda: self._last_stamp, self.health)
        )
        self.add_on_set_parameters_callback(self._on_parameters)
        # Steady time: a simulated clock that stands still must not silence the diagnostics.
        upkeep = self.health.timed(self._every_second)
        self.create_timer(1.0, lambda: upkeep(None), clock=Clock(clock_type=ClockType.STEADY_TIME))

    # ---- asked by the pipeline, on its threads ------------------------------------------------------------------------

    def _frame_ids(self, image: Any, cloud: Any) -> tuple[str, str]:
        camera = self.parameters["camera_frame"] or image.header.frame_id or "camera"
        return camera, self.parameters["lidar_frame"] or cloud.header.frame_id or "lidar"

    def _on_extrinsic(self, extrinsic: Extrinsic, stamp: int) -> None:
        result = extrinsic.result
        self._last_stamp = stamp
        accepted = self.health.estimated(extrinsic)
        self._extrinsic_pub.publish(extrinsic_message(extrinsic, stamp))
        self._transform_pub.publish(transform_message(result.T_camera_lidar, result.camera_frame, result.lidar_frame, stamp))
        self._publish_tf(extrinsic, stamp)
        if result.status == CONVERGED and accepted:
            self._write_state(result)
        self.overlay.publish(self.pipeline.recalibrator, self.pipeline.last_keyframe, at_once=True)

    def _on_frame(self, frame: Frame, is_keyframe: bool) -> None:
        self.overlay.publish(self.pipeline.recalibrator, frame)

    def _publish_tf(self, extrinsic: Extrinsic, stamp: int) -> None:
        self.tf.publish(extrinsic.result, self.parameters["tf_parent"], stamp)

    def _write_state(self, result: Result) -> str:
        return self.initial.save(result, self.pipeline, self._last_stamp)

    # ---- upkeep -------------------------------------------------------------------------------------------------------

    def _on_parameters(self, changed: list[Any]) -> SetParametersResult:
        """Constants of the stages hold at once; what costs more to change waits for the next _every_second()."""
        answer, new = parameters.on_change(self.parameters, changed)
        if answer.successful and new["publish_tf"] and self.tf.missing:
            return SetParametersResult(successful=False, reason=self.tf.missing)
        self.parameters = new
        self.pipeline.configure(new.config)
        return answer

    def _every_second(self, _: None) -> None:
        self.overlay.period_s = self.parameters["overlay_period_s"]
        self.capture.resize()
        self.sensors.check(self.parameters)
        tf = (self.parameters["publish_tf"], self.parameters["tf_parent"])
        if tf != self._tf_told:
            self._tf_told = tf
            self.tf.switch(tf[0])
            self.pipeline.telling.to(self._publish_tf)
        recalibrator = self.pipeline.recalibrator
        if recalibrator is not None and self.initial.superseded_by_tf(recalibrator):
            self.get_logger().info("TF connects camera and LiDAR by now: starting anew from it")
            self.pipeline.restart()
        extra = {"reliable topics": " ".join(s.topic for s in self.sensors.adaptive if s.reliable) or "none"}
        extra["raw keyframes kept"] = str(len(self.capture))
        self._diagnostics_pub.publish(self._diagnostics.message(self.get_clock().now().to_msg(), extra))

    def destroy_node(self) -> None:
        """Ends the threads first: they publish through this node."""
        self.stop()
        super().destroy_node()

    def stop(self) -> None:
        """End all threads of the node, an estimate under way included; a capture under way is finished."""
        self.pipeline.stop()
        self.serving.stop()


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM: 0; 2 with one line if it cannot start."""
    use_large_message_profile()
    return_freed_memory()
    try:
        parameters.check_files(sys.argv if args is None else args)
        rclpy.init(args=args)
    except CalibrationError as error:
        print(f"calib_node: {error}", file=sys.stderr)
        return 2
    except Exception as error:  # rcl says in its text what is wrong with the arguments or the parameter file
        print(f"calib_node: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    executor = SingleThreadedExecutor()
    node = None
    try:
        node = CalibNode()
        executor.add_node(node)
        node.get_logger().info("waiting for images, clouds and CameraInfo")
        executor.spin()
    except CalibrationError as error:
        print(f"calib_node: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        if rclpy.ok():
            raise  # else: a signal took the context away while the node was being made
    finally:
        if node is not None:
            node.stop()
        executor.shutdown(timeout_sec=0.2)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
