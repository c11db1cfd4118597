"""The ROS 2 node."""

from calib_ros.runtime import use_one_blas_thread

use_one_blas_thread()
