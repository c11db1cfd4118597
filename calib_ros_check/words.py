"""Errors of an extrinsic in words: which way the camera looks, and where it puts the LiDAR."""

from __future__ import annotations

import math

from calib_ros_check.outcome import CheckVerdict, Deviation

# By axis: what a positive and what a negative error means. A positive rotation about y, which points down, moves all points to
# the right in the image: the camera is taken to look further left than it does.
DIRECTIONS = {
    "rx": ("camera looks {} too far down", "camera looks {} too far up"),
    "ry": ("camera looks {} too far left", "camera looks {} too far right"),
    "rz": ("camera is rolled {} too far anticlockwise", "camera is rolled {} too far clockwise"),
    "tx": ("camera is {} too far left of the LiDAR", "camera is {} too far right of the LiDAR"),
    "ty": ("camera is {} too far above the LiDAR", "camera is {} too far below the LiDAR"),
    "tz": ("camera is {} too far behind the LiDAR", "camera is {} too far in front of the LiDAR"),
}


def amount(value: float, is_angle: bool) -> str:
    """An error with its unit."""
    if is_angle:
        return f"{abs(value):.2f} deg" if abs(value) < 10 else f"{abs(value):.0f} deg"
    return f"{100 * abs(value):.1f} cm" if abs(value) < 1 else f"{abs(value):.2f} m"


def axis_words(axis: Deviation) -> str:
    """Direction and size of the error along an axis; what is claimed is described, not what is true."""
    is_angle = axis.name[0] == "r"
    spread = amount(max(axis.high - axis.error, axis.error - axis.low), is_angle)
    if axis.low <= 0 <= axis.high and axis.verdict is CheckVerdict.PASS:
        return f"right within {amount(max(abs(axis.low), abs(axis.high)), is_angle)}"
    if axis.low <= 0 <= axis.high:
        return f"between {_signed(axis.low, is_angle)} and {_signed(axis.high, is_angle)}"
    return f"{DIRECTIONS[axis.name][int(axis.error < 0)].format(amount(axis.error, is_angle))} (+- {spread})"


def size_words(size: Deviation) -> str:
    """The size of the error in all."""
    is_angle = size.name == "rotation"
    return f"off by {amount(size.error, is_angle)} ({amount(size.low, is_angle)} to {amount(size.high, is_angle)})"


def _signed(value: float, is_angle: bool) -> str:
    return (math.copysign(1, value) < 0 and f"-{amount(value, is_angle)}") or f"+{amount(value, is_angle)}"
