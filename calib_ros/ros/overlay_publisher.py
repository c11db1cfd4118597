"""~/overlay: the diagnostic picture, drawn only while someone looks, and not more often than asked."""

from __future__ import annotations

import time
from dataclasses import replace

from rclpy.node import Node
from sensor_msgs.msg import Image

from calib_ros.frame import Frame
from calib_ros.lidar.deskew import still_frame
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.overlay import caption, render
from calib_ros.ros.conversions import image_message


class OverlayPublisher:
    """Draws on the thread that calls it, 10 to 40 ms: a worker's, the executor's only for a reset. period_s may be replaced."""

    def __init__(self, node: Node, period_s: float) -> None:
        self._publisher = node.create_publisher(Image, "~/overlay", 1)
        self.period_s = period_s
        self._last = 0.0

    def publish(self, recalibrator: Recalibrator | None, frame: Frame | None, at_once: bool = False) -> None:
        """Draw a frame with the extrinsic in force below the initial one; at_once: the period does not count."""
        due = at_once or time.monotonic() - self._last >= self.period_s
        if recalibrator is None or frame is None or not due or self._publisher.get_subscription_count() == 0:
            return
        self._last = time.monotonic()
        extrinsic, initial = recalibrator.current, recalibrator.tracker.initial
        newest = recalibrator.newest()
        if newest is not None and newest.stamp == frame.stamp:
            frame = still_frame(replace(frame, twist=newest.twist), recalibrator.config.motion)
        picture = render(
            frame,
            extrinsic.result.T_camera_lidar,
            T_before=initial.T_camera_lidar,
            edges=newest.outline if newest is not None and newest.stamp == frame.stamp else None,
            lines=caption(extrinsic, len(recalibrator.buffer), initial.T_camera_lidar),
            status=extrinsic.result.status,
        )
        self._publisher.publish(image_message(picture, extrinsic.result.camera_frame, frame.stamp))
