"""The ROS 2 node: joins the pipeline to topics, services and parameters. No calibration happens here."""

from __future__ import annotations

import sys
from typing import Any

import rclpy
from calib_ros_msgs.msg import Extrinsic as ExtrinsicMsg
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from calib_ros.errors import CalibrationError
from calib_ros.frame import Frame
from calib_ros.online.extrinsic import Extrinsic
from calib_ros.online.pipeline import Hooks, OnlinePipeline
from calib_ros.result import CONVERGED, Result
from calib_ros.ros import parameters
from calib_ros.ros.capture import Capture
from calib_ros.ros.conversions import extrinsic_message, frame_from_messages, transform_message
from calib_ros.ros.diagnostics import Diagnostics
from calib_ros.ros.health import Health
from calib_ros.ros.initial import InitialExtrinsic
from calib_ros.ros.memory import return_freed_memory
from calib_ros.ros.overlay_publisher import OverlayPublisher
from calib_ros.ros.sensors import Sensors
from calib_ros.ros.services import Services
from calib_ros.ros.shared_files import use_large_message_profile
from calib_ros.ros.static_tf import LATCHED, StaticTf


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
        self.pipeline = OnlinePipeline(
            self.parameters.config,
            Hooks(
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
        if recalibrator is not None and self.initial.came_too_late(recalibrator):
            self.get_logger().info("TF connects camera and LiDAR by now: starting anew from it")
            self.pipeline.begin_anew()
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
