"""Pictures of trials: which ones, and where LiDAR points fall under the reference and under the estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame
from calib_ros.lidar.deskew import deskewed_edges, deskewed_frame
from calib_ros.lidar.edges import edge_points
from calib_ros.lidar.range_image import range_image
from calib_ros.overlay import render
from calib_ros_evaluation.report.statistics import OURS, accepted
from calib_ros_evaluation.results import SUCCESS_DEG, SUCCESS_M, Trial

Matrix = NDArray[np.float64]
Image = NDArray[np.uint8]
MAX_WIDTH = 1000  # px of a picture on the page
MOST_CASES = 10


@dataclass(frozen=True, eq=False)
class Picture:
    """image: (h, w, 3) BGR uint8."""

    title: str
    caption: str
    image: Image


class Case(NamedTuple):
    """A trial to show. title: why."""

    title: str
    trial: Trial


def chosen_cases(trials: Sequence[Trial], methods: Sequence[str]) -> list[Case]:
    """Of the experiment "single", best and worst trial of this project's method and the worst of each other, MOST_CASES at most.

    Refused and failed trials end where they began and show nothing; methods that trust no end are left out.
    """
    out: list[Case] = []
    for method in sorted(methods, key=lambda name: name != OURS):
        own = [t for t in accepted(trials) if t.method == method and t.experiment == "single" and np.isfinite(distance(t))]
        ends = {"best": min(own, key=distance), "worst": max(own, key=distance)} if own else {}
        if method != OURS or len(own) < 2:
            ends.pop("best", None)
        out += [Case(f"{method}, {kind} of {len(own)} accepted trials", trial) for kind, trial in ends.items()]
    return out[:MOST_CASES]


def distance(trial: Trial) -> float:
    """How far off a trial ends; below 1 is a success."""
    return max(trial.rotation_deg / SUCCESS_DEG, trial.translation_m / SUCCESS_M)


def overlay_pictures(cases: Sequence[tuple[str, Frame, Matrix, Matrix]], config: Config) -> list[Picture]:
    """(title, frame, T_reference, T_end) -> picture with points and edges under both, the reference above or to the left; at most
    MAX_WIDTH wide."""
    return [_overlay(*case, config) for case in cases]


def _overlay(title: str, frame: Frame, T_reference: Matrix, T_end: Matrix, config: Config) -> Picture:
    edges = deskewed_edges(edge_points(range_image(frame.cloud, config.lidar), config.lidar), frame, config.motion)
    shown = deskewed_frame(frame, config.motion)
    deg, cm = se3.rotation_error_deg(T_reference, T_end), 100 * se3.translation_error_m(T_reference, T_end)
    off = f"{deg:.2f} deg and {cm:.1f} cm off the reference"
    views = [
        render(shown, T, edges=edges, status=status, lines=lines)
        for status, T, lines in (("reference", T_reference, ()), ("estimate", T_end, (off,)))
    ]
    height, width = views[0].shape[:2]
    stacked = width > height
    image = np.concatenate(views, axis=0 if stacked else 1)
    if image.shape[1] > MAX_WIDTH:
        size = (MAX_WIDTH, round(image.shape[0] * MAX_WIDTH / image.shape[1]))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    where = "above" if stacked else "left"
    return Picture(title, f"Frame {frame.name or frame.stamp}: the estimate is {off}; {where}, the reference.", image)


def jpeg(picture: Picture) -> bytes:
    """The picture as a file. BadInputError if it is none."""
    image = picture.image
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise BadInputError(f"picture '{picture.title}' must be (h, w, 3) uint8, got {image.shape} {image.dtype}")
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 70])[1].tobytes()
