"""The sources that a folder holds."""

from __future__ import annotations

from pathlib import Path

from calib_ros.datasets import is_bag
from calib_ros.datasets.kitti_layouts import drives_in
from calib_ros.errors import BadInputError


def sources_in(text: str) -> list[str]:
    """What open_source would open at a path: the path itself, or the KITTI drives and bags in that folder, by name.

    A synthetic drive is itself. BadInputError where nothing is found.
    """
    path = Path(text).expanduser()
    if not path.is_dir() or is_bag(path):
        return [text]  # open_source says what is wrong with it, if anything is
    found = drives_in(path) or [child for child in sorted(path.iterdir()) if is_bag(child)]
    if not found:
        raise BadInputError(f"{text} holds neither KITTI drives nor ROS 2 bags; give their folders one by one")
    return [str(one) for one in found]
