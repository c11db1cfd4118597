"""ROS messages -> arrays, cameras and clouds, without ROS. Duck-typed: accepts the messages of rosbags and those of rclpy."""

from calib_ros.messages.camera_info import decode_camera_info
from calib_ros.messages.compressed_points import decode_compressed_cloud
from calib_ros.messages.image_encodings import decode_compressed_image, decode_image
from calib_ros.messages.point_fields import decode_cloud
from calib_ros.messages.wire import stamp_ns

__all__ = ["decode_camera_info", "decode_cloud", "decode_compressed_cloud", "decode_compressed_image", "decode_image", "stamp_ns"]
