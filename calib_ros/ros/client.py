"""A client of the node, for programs that are not nodes themselves: calls the services, receives overlays."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

import numpy as np
import rclpy
from calib_ros_msgs.srv import GetExtrinsic
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from calib_ros.errors import CalibrationError
from calib_ros.messages import decode_image, stamp_ns
from calib_ros.result import Cause, Result
from calib_ros.ros.conversions import covariance_from_ros, matrix_from_transform
from calib_ros.ros.dds import use_large_message_profile


def result_from_message(msg: Any) -> Result:
    """calib_ros_msgs/Extrinsic -> Result."""
    known = msg.time_offset_sigma >= 0
    return Result(
        matrix_from_transform(msg.transform.transform),
        msg.status,
        msg.reason,
        msg.score,
        covariance_from_ros(msg.covariance),
        int(msg.frames_used),
        msg.transform.header.frame_id,
        msg.transform.child_frame_id,
        covariance_with_intrinsics=covariance_from_ros(msg.covariance_with_intrinsics),
        cause=next((cause for cause in Cause if cause.value == msg.cause), None),
        time_offset_s=msg.time_offset if known else None,
        time_offset_sigma_s=msg.time_offset_sigma if known else None,
    )


class ExtrinsicClient:
    """Talks to one running node. Use as a context manager.

    overlay: the newest one. overlays: how many came. frames: changes of the frame that they show. draws: let the node draw them.
    """

    def __init__(self, node_name: str = "/calib_ros", domain_id: int | None = None, draws: bool = True) -> None:
        use_large_message_profile()
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain_id)
        self._node = rclpy.create_node("calib_ros_client", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._name = node_name.rstrip("/")
        self._get = self._node.create_client(GetExtrinsic, f"{self._name}/get_extrinsic")
        self.overlay: NDArray[np.uint8] | None = None
        self.overlays, self.frames, self._stamp = 0, 0, -1
        if draws:
            self._node.create_subscription(Image, f"{self._name}/overlay", self._on_overlay, 1)

    def __enter__(self) -> ExtrinsicClient:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._executor.shutdown(timeout_sec=0.5)
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def _on_overlay(self, msg: Image) -> None:
        self.overlay = decode_image(msg)
        self.overlays += 1
        self.frames += stamp_ns(msg.header.stamp) != self._stamp
        self._stamp = stamp_ns(msg.header.stamp)

    def spin(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Receive messages for so long; True as soon as `until` holds."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if until():
                return True
            self._executor.spin_once(timeout_sec=0.05)
        return until()

    def get_extrinsic(self, timeout_s: float = 15.0) -> tuple[bool, str, Result, float]:
        """~/get_extrinsic -> (success, message, result, drift). CalibrationError when the node does not answer."""
        response = self._call(self._get, GetExtrinsic.Request(), timeout_s)
        return response.success, response.message, result_from_message(response.extrinsic), float(response.extrinsic.drift)

    def trigger(self, service: str, timeout_s: float = 60.0) -> tuple[bool, str]:
        """~/calibrate, ~/reset or ~/save -> (success, message). CalibrationError when the node does not answer."""
        client = self._node.create_client(Trigger, f"{self._name}/{service}")
        try:
            response = self._call(client, Trigger.Request(), timeout_s)
        finally:
            self._node.destroy_client(client)
        return response.success, response.message

    def _call(self, client: Any, request: Any, timeout_s: float) -> Any:
        if not client.wait_for_service(timeout_sec=timeout_s):
            raise CalibrationError(f"no node answers on {client.srv_name}; is calib_node running in the same ROS_DOMAIN_ID?")
        future = client.call_async(request)
        self.spin(timeout_s, future.done)
        if not future.done():
            client.remove_pending_request(future)
            raise CalibrationError(f"{client.srv_name} did not answer within {timeout_s:g} s")
        return future.result()
