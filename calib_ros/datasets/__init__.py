"""Datasets: small classes with `__len__` and `__getitem__` -> Frame (see `source.Source`), opened by `open_dataset`."""

from calib_ros.datasets.open import open_dataset as open_dataset
from calib_ros.datasets.open import open_source as open_source
from calib_ros.datasets.source import Source as Source
