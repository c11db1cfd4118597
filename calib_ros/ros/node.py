"""The ROS 2 node: converts messages, hands them to the pipeline, publishes what it says. No calibration happens here."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from typing import Any

import rclpy
from calib_ros_msgs.msg import Extrinsic as ExtrinsicMsg
from calib_ros_msgs.srv import GetExtrinsic
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_srvs.srv import Trigger

from calib_ros.camera import Camera
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import Frame
from calib_ros.messages import decode_camera_info, stamp_ns
from calib_ros.online.pipeline import Hooks, OnlinePipeline
from calib_ros.online.state import load_state, save_state
from calib_ros.online.tracker import Extrinsic
from calib_ros.registration.initial_guess import nominal
from calib_ros.result import CONVERGED, INITIAL, Result, load
from calib_ros.ros import parameters
from calib_ros.ros.conversions import extrinsic_message, frame_from_messages, transform_message
from calib_ros.ros.health import Health
from calib_ros.ros.overlay_publisher import OverlayPublisher
from calib_ros.ros.shared_files import use_large_message_profile
from calib_ros.ros.static_tf import StaticTf

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class CalibNode(Node):
    """Topics, services and parameters as the README lists them."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("calib_ros", **kwargs)
        self.parameters = parameters.declare(self)
        self.health = Health(self.get_logger())
        self.tf = StaticTf(self, self.parameters["initial_from_tf"], self.parameters["publish_tf"])
        self.pipeline = OnlinePipeline(
            self.parameters.config,
            Hooks(frame_from_messages, self._frame_ids, self._initial, self._on_extrinsic, self._on_frame, self.health.error),
        )
        self._extrinsic_pub = self.create_publisher(ExtrinsicMsg, "~/extrinsic", LATCHED)
        self._transform_pub = self.create_publisher(TransformStamped, "~/transform", LATCHED)
        self.overlay = OverlayPublisher(self, self.parameters["overlay_period_s"])
        self._diagnostics_pub = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._last_stamp = 0
        reliability = (
            ReliabilityPolicy.RELIABLE if self.parameters["reliability"] == "reliable" else ReliabilityPolicy.BEST_EFFORT
        )
        sensor = QoSProfile(depth=10, reliability=reliability)
        image_type = CompressedImage if self.parameters["image_transport"] == "compressed" else Image
        self.create_subscription(image_type, "image", self.health.timed(self._on_image), sensor)
        self.create_subscription(PointCloud2, "points", self.health.timed(self._on_points), sensor)
        self.create_subscription(CameraInfo, "camera_info", self.health.timed(self._on_camera_info), sensor)
        self.create_service(GetExtrinsic, "~/get_extrinsic", self._get_extrinsic)
        # A callback that awaits holds its group: in the node's own one it would stop all others for the time of an estimate.
        self.create_service(Trigger, "~/calibrate", self._calibrate, callback_group=MutuallyExclusiveCallbackGroup())
        self.create_service(Trigger, "~/reset", self._reset)
        self.create_service(Trigger, "~/save", self._save)
        self.add_on_set_parameters_callback(self._on_parameters)
        # Steady time: a simulated clock that stands still must not silence the diagnostics.
        self.create_timer(1.0, self._publish_diagnostics, clock=Clock(clock_type=ClockType.STEADY_TIME))

    # ---- topics in ----------------------------------------------------------------------------------------------------

    def _on_image(self, msg: Any) -> None:
        self.pipeline.add_image(stamp_ns(msg.header.stamp), msg)

    def _on_points(self, msg: PointCloud2) -> None:
        self.pipeline.add_cloud(stamp_ns(msg.header.stamp), msg)

    def _on_camera_info(self, msg: CameraInfo) -> None:
        try:
            self.pipeline.set_camera(decode_camera_info(msg, self.parameters["image_is_rectified"]))
        except CalibrationError as error:
            self.health.error(str(error))

    # ---- asked by the pipeline, on its threads ------------------------------------------------------------------------

    def _frame_ids(self, image: Any, cloud: Any) -> tuple[str, str]:
        camera = self.parameters["camera_frame"] or image.header.frame_id or "camera"
        return camera, self.parameters["lidar_frame"] or cloud.header.frame_id or "lidar"

    def _initial(self, camera: Camera, camera_frame: str, lidar_frame: str) -> Result | None:
        """Saved state, parameters, TF, nominal, in this order; None while TF may still come."""
        path = self.parameters["state_file"]
        if path and os.path.exists(path):
            try:
                return load_state(path, camera, camera_frame, lidar_frame)
            except BadInputError as error:
                self.health.error(str(error))
        given = self.parameters.initial()
        if given is not None:
            return given
        T, pending = self.tf.lookup(camera_frame, lidar_frame)
        if T is not None:
            return Result(T, INITIAL, "from TF")
        if pending:
            return None
        return Result(nominal(self.parameters["nominal_yaw_deg"]), INITIAL, "nominal: no saved state, parameters or TF gave one")

    def _saved(self) -> Result | None:
        """The saved state before any message has told which sensors these are, as far as the parameters do not deny it."""
        path = self.parameters["state_file"]
        if not path or not os.path.exists(path):
            return None
        try:
            saved = load(path)
        except BadInputError:
            return None  # said when the sensors are known and the start is chosen
        names = ((self.parameters["camera_frame"], saved.camera_frame), (self.parameters["lidar_frame"], saved.lidar_frame))
        if any(wanted and wanted != found for wanted, found in names):
            return None
        return replace(saved, status=INITIAL, reason="from the saved state")

    def _on_extrinsic(self, extrinsic: Extrinsic, stamp: int) -> None:
        result = extrinsic.result
        self._last_stamp = stamp
        self.health.estimated(extrinsic)
        self._extrinsic_pub.publish(extrinsic_message(extrinsic, stamp))
        self._transform_pub.publish(transform_message(result.T_camera_lidar, result.camera_frame, result.lidar_frame, stamp))
        if self.parameters["publish_tf"]:
            self.tf.publish(result, self.parameters["tf_parent"], stamp)
        if result.status == CONVERGED and extrinsic.accepted:
            self._write_state(result)
        self.overlay.publish(self.pipeline.recalibrator, self.pipeline.last_keyframe, at_once=True)

    def _on_frame(self, frame: Frame, is_keyframe: bool) -> None:
        self.overlay.publish(self.pipeline.recalibrator, frame)

    def _write_state(self, result: Result) -> str:
        path, camera = self.parameters["state_file"], self.pipeline.camera
        if not path or camera is None:
            return "nothing saved: set the parameter state_file to a path"
        try:
            save_state(path, result, camera)
        except BadInputError as error:
            self.health.error(str(error))
            return str(error)
        return f"saved to {path}"

    # ---- services -----------------------------------------------------------------------------------------------------

    def _get_extrinsic(self, request: GetExtrinsic.Request, response: GetExtrinsic.Response) -> GetExtrinsic.Response:
        recalibrator = self.pipeline.recalibrator
        if recalibrator is None:
            given = self._saved() or self.parameters.initial() or Result(nominal(self.parameters["nominal_yaw_deg"]), INITIAL)
            response.extrinsic = extrinsic_message(Extrinsic(given), 0)
            response.message = "no pair of image and cloud with a CameraInfo yet; this is the initial extrinsic"
            return response
        extrinsic = recalibrator.current
        result = extrinsic.result
        response.extrinsic = extrinsic_message(extrinsic, self._last_stamp)
        response.success = recalibrator.tracker.last_good is not None
        wanted = max(recalibrator.config.online.min_keyframes, 1)
        response.message = result.reason or (
            f"estimated from {result.frames_used} keyframes"
            if response.success
            else f"{len(recalibrator.buffer)} of {wanted} keyframes"
        )
        return response

    async def _calibrate(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Answers when the estimate is done; meanwhile the executor goes on with everything else."""
        executor = self.executor
        done: Future = Future(executor=executor)

        def finish(estimate: Any) -> None:  # on the worker's thread
            done.set_result(estimate)
            executor.wake()  # it looks at waiting coroutines only when something else wakes it

        self.pipeline.request_estimate().add_done_callback(finish)
        estimate = await done
        error = estimate.exception()
        if error is not None:
            response.message = str(error) or "stopped"
            return response
        result = estimate.result().result
        response.success = result.status == CONVERGED
        response.message = f"{result.status}: {result.frames_used} keyframes, score {result.score:.3f}. {result.reason}".strip()
        return response

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.pipeline.reset()
        response.success, response.message = True, "keyframes forgotten, back to the initial extrinsic"
        return response

    def _save(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        recalibrator = self.pipeline.recalibrator
        last_good = recalibrator.tracker.last_good if recalibrator is not None else None
        if last_good is None:
            response.message = "nothing to save: no estimate has been accepted yet"
            return response
        response.message = self._write_state(last_good)
        response.success = response.message.startswith("saved")
        return response

    # ---- upkeep -------------------------------------------------------------------------------------------------------

    def _on_parameters(self, changed: list[Any]) -> Any:
        answer, config = parameters.on_change(self.pipeline.config, changed)
        if answer.successful and config is not self.pipeline.config:
            self.pipeline.configure(config)
        return answer

    def _publish_diagnostics(self) -> None:
        self._diagnostics_pub.publish(
            self.health.message(self.pipeline, self.get_fully_qualified_name(), self.get_clock().now().to_msg())
        )

    def destroy_node(self) -> None:
        """Ends the pipeline's threads first: they publish through this node."""
        self.pipeline.stop()
        super().destroy_node()


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM: 0; 2 with one line if it cannot start."""
    use_large_message_profile()
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
            node.pipeline.stop()
        executor.shutdown(timeout_sec=0.2)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
