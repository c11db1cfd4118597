"""The ROS 2 node."""

from calib_ros.blas import use_one_blas_thread

use_one_blas_thread()
