"""Measurements of the project: speed, studies behind the figures in docs/, long runs, drives with events."""

from calib_ros.runtime import use_one_blas_thread

use_one_blas_thread()
