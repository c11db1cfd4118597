"""Frames -> the messages of rosbags."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.frame import NANOSECONDS, PointCloud

# PointField datatypes of numpy's types.
_DATATYPES = {"<f4": 7, "<u2": 4}


class MessageBuilder:
    """Makes messages of a rosbags typestore for one camera and one LiDAR. Stamps are in ns."""

    def __init__(self, typestore: Any, camera_frame: str, lidar_frame: str) -> None:
        self._types = typestore.types
        self._camera_frame = camera_frame
        self._lidar_frame = lidar_frame

    def image(self, stamp: int, image: NDArray[np.uint8]) -> Any:
        """(H, W) -> mono8, (H, W, 3) -> bgr8."""
        grey = image.ndim == 2
        return self._types["sensor_msgs/msg/Image"](
            header=self._header(stamp, self._camera_frame),
            height=image.shape[0],
            width=image.shape[1],
            encoding="mono8" if grey else "bgr8",
            is_bigendian=0,
            step=image.shape[1] * (1 if grey else 3),
            data=np.ascontiguousarray(image).reshape(-1),
        )

    def camera_info(self, stamp: int, camera: Camera) -> Any:
        """CameraInfo with K, D, R = identity, and in P the camera of the rectified image."""
        P = np.zeros((3, 4))
        P[:, :3] = camera.rectified().K
        D = camera.D if len(camera.D) else np.zeros(4 if camera.model == "equidistant" else 5)  # ROS tools expect some
        return self._types["sensor_msgs/msg/CameraInfo"](
            header=self._header(stamp, self._camera_frame),
            height=camera.height,
            width=camera.width,
            distortion_model=camera.model,
            d=D,
            k=camera.K.reshape(9),
            r=np.eye(3).reshape(9),
            p=P.reshape(12),
            binning_x=0,
            binning_y=0,
            roi=self._types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
        )

    def cloud(self, stamp: int, cloud: PointCloud) -> Any:
        """x, y, z and, if the cloud has them, intensity, ring (uint16) and time (float32 s), without gaps."""
        columns: dict[str, tuple[str, NDArray[Any]]] = {axis: ("<f4", cloud.xyz[:, i]) for i, axis in enumerate("xyz")}
        for name, kind in (("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")):
            values = getattr(cloud, name)
            if values is not None:
                columns[name] = (kind, values)
        points = np.empty(len(cloud), [(name, kind) for name, (kind, _) in columns.items()])
        for name, (_, values) in columns.items():
            points[name] = values
        layout: Any = points.dtype.fields
        return self._types["sensor_msgs/msg/PointCloud2"](
            header=self._header(stamp, self._lidar_frame),
            height=1,
            width=len(points),
            fields=[
                self._types["sensor_msgs/msg/PointField"](name, layout[name][1], _DATATYPES[kind], 1)
                for name, (kind, _) in columns.items()
            ],
            is_bigendian=False,
            point_step=points.itemsize,
            row_step=points.nbytes,
            data=points.view(np.uint8) if len(points) else np.zeros(0, np.uint8),
            is_dense=bool(np.isfinite(cloud.xyz).all()),
        )

    def static_transform(self, stamp: int, T_camera_lidar: NDArray[np.float64]) -> Any:
        """TFMessage camera frame -> LiDAR frame: TF's transform maps points of the child into the parent."""
        x, y, z = (float(v) for v in T_camera_lidar[:3, 3])
        quaternion = (float(v) for v in se3.quaternion_from_rotation(T_camera_lidar[:3, :3]))
        transform = self._types["geometry_msgs/msg/Transform"](
            self._types["geometry_msgs/msg/Vector3"](x, y, z), self._types["geometry_msgs/msg/Quaternion"](*quaternion)
        )
        stamped = self._types["geometry_msgs/msg/TransformStamped"](
            self._header(stamp, self._camera_frame), self._lidar_frame, transform
        )
        return self._types["tf2_msgs/msg/TFMessage"]([stamped])

    def _header(self, stamp: int, frame: str) -> Any:
        time = self._types["builtin_interfaces/msg/Time"](stamp // NANOSECONDS, stamp % NANOSECONDS)
        return self._types["std_msgs/msg/Header"](time, frame)
