"""Datasets: small classes with __len__ and __getitem__ -> Frame (see Source)."""

from calib_ros.datasets.opening import open_source as open_source
from calib_ros.datasets.source import Source as Source
