"""The ROS 2 node: joins the pipeline to topics, services and parameters. No calibration happens here."""

from __future__ import annotations

import ctypes
import os
import sys
import traceback
from contextlib import suppress
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from calib_ros.errors import CalibrationError
from calib_ros.messages import decode_cloud
from calib_ros.online.pipeline import Event, ExtrinsicUpdated, FrameIngested, Inputs, Pipeline, Problem
from calib_ros.result import CONVERGED, Extrinsic, Result
from calib_ros.ros import parameters
from calib_ros.ros.bags import Capture
from calib_ros.ros.conversions import frame_from_messages, transform_message
from calib_ros.ros.dds import use_large_message_profile
from calib_ros.ros.diagnostics import Diagnostics, Health
from calib_ros.ros.initial_extrinsic import InitialExtrinsic, SaveOutcome
from calib_ros.ros.publishers import ExtrinsicPublisher, OverlayPublisher
from calib_ros.ros.services import Services
from calib_ros.ros.subscriptions import SensorSubscriptions
from calib_ros.ros.tf import LATCHED, Edge, StaticTf

# Options of mallopt, and their values, in glibc's malloc.h; see return_freed_memory.
M_MMAP_THRESHOLD, M_ARENA_MAX = -3, -8
MMAP_THRESHOLD = 1 << 20  # bytes
ARENAS = 2


class CalibNode(Node):
    """Topics, services and parameters as the README lists them."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("calib_ros", **kwargs)
        self.parameters = parameters.declare(self)
        self.health = Health(self.get_logger())
        for line in parameters.misspelt(self._parameter_overrides, self._parameters):
            self.get_logger().warning(line)
        self.tf = StaticTf(self, self.parameters["initial_from_tf"], self.parameters["publish_tf"], self.health.error)
        self._tf_settings = self._tf_parameters()
        self.initial = InitialExtrinsic(lambda: self.parameters, self.tf, self.health.error)
        self.capture = Capture(lambda: self.parameters, lambda: self.sensors.camera_info)
        inputs = Inputs(frame_from_messages, self._frame_ids, self.initial.choose, decode_cloud)
        self.pipeline = Pipeline(self.parameters.config, inputs, self._on_event)
        self.extrinsic = ExtrinsicPublisher(self, self.pipeline, lambda: self.parameters)
        self._transform_pub = self.create_publisher(TransformStamped, "~/transform", LATCHED)
        self.overlay = OverlayPublisher(self, self.parameters["overlay_period_s"])
        self._diagnostics_pub = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._diagnostics = Diagnostics(self.get_fully_qualified_name(), self.health, self.pipeline)
        self._last_stamp = 0
        self._saved = 0  # accepted estimates when the extrinsic was saved
        self._ended: bool | None = None
        self._nameless: set[str] = set()  # sensors whose messages have no frame_id
        self.sensors = SensorSubscriptions(self, self.parameters, self.pipeline, self.health)
        self.serving = Services(*(self, self.pipeline, self.initial, self.capture, self._save, self.extrinsic, self.health))
        self.add_on_set_parameters_callback(self._on_parameters)
        # Steady time: a simulated clock that stands still must not silence the diagnostics.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self._every_second, clock=steady)
        self.create_timer(self.parameters["publish_period_s"], self._publish_again, clock=steady)

    # ---- pipeline, on its threads -------------------------------------------------------------------------------------

    def _frame_ids(self, image: Any, cloud: Any) -> tuple[str, str]:
        names = []
        for sensor, message in (("camera", image), ("lidar", cloud)):
            name = self.parameters[f"{sensor}_frame"] or message.header.frame_id
            if not name and sensor not in self._nameless:
                self._nameless.add(sensor)
                self.health.error(f"messages of the {sensor} have no frame_id: it is called '{sensor}'; set {sensor}_frame")
            names.append(name or sensor)
        return names[0], names[1]

    def _on_event(self, event: Event) -> None:
        if isinstance(event, ExtrinsicUpdated):
            extrinsic, result, stamp = event.extrinsic, event.extrinsic.result, event.stamp
            self._last_stamp = stamp
            self.health.add_extrinsic(extrinsic)
            self.extrinsic.publish(extrinsic, stamp)
            self._transform_pub.publish(transform_message(result.T_camera_lidar, result.camera_frame, result.lidar_frame, stamp))
            self._publish_tf(extrinsic, stamp)
            self._saved = min(self._saved, extrinsic.accepted)  # counted anew after a reset
            if result.status == CONVERGED and extrinsic.accepted > self._saved:
                self._saved = extrinsic.accepted
                self._save(result)
            self.overlay.publish(self.pipeline.recalibrator, self.pipeline.last_keyframe, at_once=True)
        elif isinstance(event, FrameIngested):
            if event.is_keyframe:
                self.capture.add(event.image, event.cloud)
            self.overlay.publish(self.pipeline.recalibrator, event.frame)
        elif isinstance(event, Problem):
            self.health.error(event.message)

    def _publish_tf(self, extrinsic: Extrinsic, stamp: int) -> None:
        self.tf.publish(extrinsic.result, Edge(self.parameters["tf_parent"], self.parameters["tf_child"]), stamp)

    def _tf_parameters(self) -> tuple[bool, str, str]:
        return self.parameters["publish_tf"], self.parameters["tf_parent"], self.parameters["tf_child"]

    def _save(self, result: Result) -> SaveOutcome:
        return self.initial.save(result, self.pipeline, self._last_stamp)

    # ---- parameters and timer, on the executor ------------------------------------------------------------------------

    def _on_parameters(self, changed: list[Any]) -> SetParametersResult:
        """Constants of the stages take effect at once; what costs more to change waits for the next _every_second()."""
        answer, new = parameters.on_change(self.parameters, changed)
        if answer.successful and new["publish_tf"] and self.tf.missing:
            return SetParametersResult(successful=False, reason=self.tf.missing)
        self.parameters = new
        self.pipeline.configure(new.config)
        return answer

    def _every_second(self) -> None:
        with self.health.guard():
            self.overlay.period_s = self.parameters["overlay_period_s"]
            self.capture.resize()
            self.sensors.check(self.parameters)
            self.tf.check()
            tf_settings = self._tf_parameters()
            if tf_settings != self._tf_settings:
                self._tf_settings = tf_settings
                self.tf.switch(tf_settings[0])
                self.pipeline.read_current(self._publish_tf)
            recalibrator = self.pipeline.recalibrator
            if recalibrator is not None and self.initial.superseded_by_tf(recalibrator):
                self.get_logger().info("TF connects camera and LiDAR by now: starting anew from it")
                self.pipeline.restart()
            extra = {"reliable topics": " ".join(s.topic for s in self.sensors.adaptive if s.reliable) or "none"}
            extra["raw keyframes kept"] = str(len(self.capture))
            self._diagnostics_pub.publish(self._diagnostics.message(self.get_clock().now().to_msg(), extra))

    def _publish_again(self) -> None:
        """Others see that the node is alive, and whether its extrinsic still is."""
        with self.health.guard():
            self.pipeline.read_current(self.extrinsic.publish, wait=False)

    # ---- end ----------------------------------------------------------------------------------------------------------

    def destroy_node(self) -> None:
        """Ends the threads first: they publish through this node."""
        self.stop()
        super().destroy_node()

    def stop(self) -> bool:
        """End all threads of the node, an estimate under way included; a capture under way is finished. True if they ended."""
        if self._ended is None:
            self._ended = self.pipeline.stop()
            self.serving.stop()
        return self._ended


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
    except Exception as error:  # rcl's message names what is wrong with the arguments or the parameter file
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
        ended = node is None or node.stop()
        executor.shutdown(timeout_sec=0.2)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        if not ended:
            end_at_once()
    return 0


def end_at_once() -> None:
    """End the process although a thread is still in a long computation: all files are written, nothing is to be waited for.

    The interpreter's own end would take the thread's next return from compiled code for an error, and abort. Exit code 1, with
    the trace, while an exception is on its way out.
    """
    crashed = sys.exc_info()[0] is not None
    if crashed:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(int(crashed))


def return_freed_memory() -> None:
    """Let glibc map every large array on its own; does nothing with another C library. To be called before threads start.

    By default it learns from the first arrays freed to keep their places for later ones, in an arena per thread. Features and
    maps of many sizes then leave gaps: the resident memory grows by a sixth in ten minutes without anything being lost.
    """
    with suppress(AttributeError, OSError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, MMAP_THRESHOLD)
        mallopt(M_ARENA_MAX, ARENAS)


if __name__ == "__main__":
    sys.exit(main())
