"""Features of the frames of an estimate: of those that can be used, and the classes of their points and pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros.arrays import Transform
from calib_ros.errors import BadTimesError, TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.registration.classes import Segmentation
from calib_ros.registration.features import FeatureExtractor, FrameFeatures
from calib_ros.registration.objective import search_margin
from calib_ros.registration.progress import Progress
from calib_ros.registration.score.point_score import near_image
from calib_ros.registration.search.constraints import SearchBox

Used = tuple[Frame, FrameFeatures]
BESIDE = 0.1  # of the image width: objects at the border have to be seen as a whole, or they have no shape


def usable_frames(
    frames: Sequence[Frame],
    extract: FeatureExtractor,
    segmentation: Segmentation | None,
    progress: Progress,
    around: tuple[Transform, SearchBox | None] | None = None,
) -> tuple[list[Used], list[str]]:
    """The frames that can be used with their features, and notes on others and on failed models. segmentation: None = without.
    around: T (4, 4) and the box about it, from where points come into view that need a class; None = all do."""
    used: list[Used] = []
    notes: list[str] = []
    for k, frame in enumerate(frames):
        try:
            points = points_in_reach(frame, extract, *around) if segmentation and around else None
            semantics = segmentation(frame, points=points) if segmentation else None
            used.append((frame, extract(frame, semantics)))
            notes += semantics.problems if semantics else ()
            notes += [frame.cloud.time_problem] if frame.cloud.time_problem and frame.cloud.time_problem not in notes else []
        except (TooFewFeaturesError, BadTimesError) as error:
            notes.append(f"frame {frame.name or k} left out: {error}")
        progress((k + 1) / len(frames))
    return used, notes


def with_classes(
    used: Sequence[Used],
    extract: FeatureExtractor,
    segmentation: Segmentation,
    T: Transform,
    box: SearchBox | None,
    progress: Progress,
) -> tuple[list[FrameFeatures], list[str]]:
    """Features with classes of points that may come into view from T (4, 4), anywhere in the box, the same where nothing was
    found; and notes on models that failed."""
    out: list[FrameFeatures] = []
    notes: list[str] = []
    for k, (frame, plain) in enumerate(used):
        semantics = segmentation(frame, points=points_in_reach(frame, extract, T, box))
        found = any(part is not None for part in (semantics.edges, semantics.classes, semantics.labels))
        out.append(extract(frame, semantics, plain) if found else plain)
        notes += semantics.problems
        progress((k + 1) / len(used))
    return out, notes


def points_in_reach(frame: Frame, extract: FeatureExtractor, T: Transform, box: SearchBox | None) -> NDArray[np.intp]:
    """Indices of a frame's points that may come into view from T (4, 4), anywhere in the box."""
    margin = search_margin(extract.camera, box) + BESIDE
    with np.errstate(invalid="ignore", over="ignore"):  # lost returns are NaN or inf, which are not near anything
        return near_image(frame.cloud.xyz, T, extract.camera, margin)
