"""Frames and extrinsics <-> ROS messages."""

from __future__ import annotations

import array
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from builtin_interfaces.msg import Duration, Time
from calib_ros_msgs.msg import Advice as AdviceMsg
from calib_ros_msgs.msg import Consumer as ConsumerMsg
from calib_ros_msgs.msg import Extrinsic as ExtrinsicMsg
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage, Image, PointCloud2, PointField
from std_msgs.msg import Header

from calib_ros import se3
from calib_ros.frame import NANOSECONDS, PointCloud
from calib_ros.messages import decode_cloud, decode_compressed_image, decode_image
from calib_ros.messages.point_fields import LIVOX_FIELDS, LIVOX_OFFSETS, LIVOX_STRIDE, livox_scan
from calib_ros.messages.wire import WireHeader
from calib_ros.online.coach import Advice
from calib_ros.result import Consumer, Extrinsic

# ROS orders covariances of poses translation first; calib_ros has rotation first. The way back is the same.
_ROS_ORDER = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
STARVED = "starved: pairs of image and cloud wait for CPU time; give the node a core of its own, or let other work yield (nice)"
LIVOX_DATATYPES = {"u4": PointField.UINT32, "f4": PointField.FLOAT32, "u1": PointField.UINT8}


def pixels_from_message(image: Serialized) -> NDArray[np.uint8]:
    """Image or CompressedImage -> its pixels. BadInputError if it cannot be decoded."""
    picture = image.message()
    return decode_compressed_image(picture) if hasattr(picture, "format") else decode_image(picture)


def cloud_from_message(cloud: Serialized) -> PointCloud:
    """PointCloud2 -> PointCloud. BadInputError if it cannot be decoded."""
    return decode_cloud(cloud.message())


@dataclass(frozen=True, eq=False)
class Serialized:
    """A message as received, of which nothing but the header has been decoded. header: std_msgs/Header. restore: `data`, its CDR
    bytes, -> the message."""

    header: Header
    data: bytes
    restore: Callable[[bytes], Any]

    def message(self) -> Any:
        """The message, decoded anew."""
        return self.restore(self.data)


def header_message(header: WireHeader) -> Header:
    """The header of a message that is still serialised -> std_msgs/Header."""
    return Header(stamp=Time(sec=header.seconds, nanosec=header.nanoseconds), frame_id=header.frame_id)


def cloud_of_livox(data: bytes) -> PointCloud2:
    """CDR bytes of Livox's CustomMsg -> the same points as a PointCloud2. BadInputError for a truncated message."""
    header, big_endian, points = livox_scan(data)
    msg = PointCloud2(height=1, width=len(points) // LIVOX_STRIDE, point_step=LIVOX_STRIDE, row_step=len(points))
    msg.header, msg.is_bigendian = header_message(header), big_endian
    msg.fields = [
        PointField(name=name, offset=offset, datatype=LIVOX_DATATYPES[kind], count=1)
        for (name, kind), offset in zip(LIVOX_FIELDS.items(), LIVOX_OFFSETS, strict=True)
    ]
    msg.data = array.array("B", points)
    return msg


def time_message(stamp: int) -> Time:
    """Nanoseconds -> builtin_interfaces/Time."""
    seconds, rest = divmod(int(stamp), NANOSECONDS)
    return Time(sec=seconds, nanosec=rest)


def duration_message(seconds: float) -> Duration:
    """Seconds -> builtin_interfaces/Duration; what no Duration can hold becomes -1 s."""
    if not 0 <= seconds < 2**31:
        return Duration(sec=-1)
    whole, rest = divmod(round(seconds * NANOSECONDS), NANOSECONDS)
    return Duration(sec=whole, nanosec=rest)


def transform_message(T: NDArray[np.float64], parent: str, child: str, stamp: int) -> TransformStamped:
    """T_parent_child (4, 4) -> TransformStamped with frame_id = parent, child_frame_id = child."""
    msg = TransformStamped()
    msg.header.frame_id, msg.child_frame_id, msg.header.stamp = parent, child, time_message(stamp)
    t, q = msg.transform.translation, msg.transform.rotation
    t.x, t.y, t.z = (float(x) for x in T[:3, 3])
    q.x, q.y, q.z, q.w = (float(x) for x in se3.quaternion_from_rotation(T[:3, :3]))
    return msg


def matrix_from_transform(transform: Any) -> NDArray[np.float64]:
    """geometry_msgs/Transform -> (4, 4). BadInputError if its quaternion is no rotation, or a number is not finite."""
    t, q = transform.translation, transform.rotation
    T = se3.from_parts(se3.rotation_from_quaternion([q.x, q.y, q.z, q.w]), [t.x, t.y, t.z])
    return se3.as_transform(T, "the transform")


@dataclass(frozen=True)
class Validity:
    """Whether an extrinsic is to be used.

    valid_until: ns, by the publisher's clock; 0 if not usable. data_age_s: inf = no data yet. reason: beyond the extrinsic's own.
    """

    usable: bool = False
    valid_until: int = 0
    data_age_s: float = math.inf
    reason: str = ""


UNKNOWN = Validity()
NO_ADVICE = Advice()


def extrinsic_message(
    extrinsic: Extrinsic, stamp: int, validity: Validity = UNKNOWN, consumers: Sequence[Consumer] = (), advice: Advice = NO_ADVICE
) -> ExtrinsicMsg:
    """The current extrinsic -> calib_ros_msgs/Extrinsic; an unknown covariance has -1 as its first element.

    The field `drift` is the normalised innovation. stamp: ns, of the newest data. consumers: who is told whether to use it.
    """
    result = extrinsic.result
    msg = ExtrinsicMsg()
    msg.transform = transform_message(result.T_camera_lidar, result.camera_frame, result.lidar_frame, stamp)
    msg.covariance = covariance_for_ros(result.covariance)
    msg.covariance_with_intrinsics = covariance_for_ros(result.covariance_with_intrinsics)
    msg.score = float(result.score)
    msg.status, msg.reason = result.status, "; ".join(filter(None, [validity.reason, result.reason]))
    msg.cause = "" if result.cause is None else result.cause.value
    msg.frames_used, msg.drift = int(result.frames_used), float(extrinsic.normalised_innovation)
    msg.usable, msg.valid_until = validity.usable, time_message(validity.valid_until)
    msg.data_age, msg.estimated_at = duration_message(validity.data_age_s), time_message(extrinsic.estimated_at)
    if result.time_offset_s is not None and result.time_offset_sigma_s is not None:
        msg.time_offset, msg.time_offset_sigma = result.time_offset_s, result.time_offset_sigma_s
    else:
        msg.time_offset_sigma = -1.0
    msg.advice = AdviceMsg(weak=list(advice.weak), text=advice.text, progress=advice.progress)
    msg.advice.remaining = duration_message(-1.0 if advice.remaining_s is None else advice.remaining_s)
    for consumer in consumers:
        usable = validity.usable and consumer.is_served(result.covariance)
        told = ConsumerMsg(name=consumer.name, tolerance_deg=consumer.deg, tolerance_m=consumer.m, usable=usable)
        msg.consumers.append(told)
    return msg


def advice_of(msg: ExtrinsicMsg) -> Advice:
    """The other way."""
    told, remaining = msg.advice, msg.advice.remaining
    known = remaining.sec >= 0
    return Advice(tuple(told.weak), told.text, told.progress, remaining.sec + remaining.nanosec / NANOSECONDS if known else None)


def covariance_for_ros(covariance: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """(6, 6), rotation first -> (36,) row-major, order x, y, z, rx, ry, rz; -1 as its first element where it is unknown. Flat,
    since rclpy takes a (6, 6) array and sends it wrongly."""
    if covariance is None:
        return np.r_[-1.0, np.zeros(35)]
    return np.asarray(covariance[_ROS_ORDER]).reshape(36)


def covariance_from_ros(values: Any) -> NDArray[np.float64] | None:
    """The other way; None where it is unknown."""
    return np.asarray(values, float).reshape(6, 6)[_ROS_ORDER] if values[0] >= 0 else None


def image_message(image: NDArray[np.uint8], frame_id: str, stamp: int) -> Image:
    """BGR (H, W, 3) uint8 -> sensor_msgs/Image; array.array is the only type that rclpy takes over without a copy per byte."""
    msg = Image(height=image.shape[0], width=image.shape[1], encoding="bgr8", step=image.shape[1] * 3)
    msg.header.frame_id, msg.header.stamp = frame_id, time_message(stamp)
    data = array.array("B")
    data.frombytes(np.ascontiguousarray(image).data.cast("B"))
    msg.data = data
    return msg


def compressed_image_message(image: NDArray[np.uint8], frame_id: str, stamp: int) -> CompressedImage:
    """BGR (H, W, 3) uint8 -> sensor_msgs/CompressedImage, a JPEG as image_transport's plugin `compressed` makes it."""
    msg = CompressedImage(format="bgr8; jpeg compressed bgr8")
    msg.header.frame_id, msg.header.stamp = frame_id, time_message(stamp)
    msg.data = array.array("B", cv2.imencode(".jpg", image)[1].tobytes())
    return msg
