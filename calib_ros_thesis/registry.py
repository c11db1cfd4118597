"""Objectives by name: ``refine.objective`` chooses one, and its module is imported only then.

An objective says what it keeps of a frame beside the features of the fast score, and how it is built from the features of
several frames. A new one needs a line in OBJECTIVES and its name in the choices of ``refine.objective``.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from calib_ros.config import Config
    from calib_ros.frame import Frame
    from calib_ros.registration.features import Features, FrameFeatures
    from calib_ros.registration.objective import Objective
    from calib_ros.registration.progress import Observer
    from calib_ros.registration.score.atlas import Atlas
    from calib_ros.registration.search.constraints import PoseConstraints
    from calib_ros_semantics.models.segmentation import FrameSemantics

OBJECTIVES = {"fast": "calib_ros.registration.objective:FastObjective", "thesis": "calib_ros_thesis.objective:ThesisObjective"}


class ObjectiveKind(Protocol):
    """A class of objectives."""

    def extract(
        self,
        frame: Frame,
        image: NDArray[np.uint8],
        fast: FrameFeatures,
        edges: NDArray[np.float32] | None,
        semantics: FrameSemantics | None,
        config: Config,
    ) -> Features:
        """What the objective needs of a frame. image: rectified, (h, w[, 3]) of fast.camera. edges: semantic ones (2, h, w) in
        0..1 of that image, None if there are none. semantics: where they come from."""
        ...

    def __call__(
        self,
        features: Sequence[Features],
        T_prior: NDArray[np.float64],
        config: Config,
        constraints: PoseConstraints,
        atlas: Atlas | None,
        observer: Observer | None,
    ) -> Objective:
        """The objective around T_prior (4, 4). atlas: of the frames' edge maps, if there is one. observer: watches all
        evaluations. Raises TooFewFeaturesError."""
        ...


def objective_kind(name: str) -> ObjectiveKind:
    """The objective called `name`. KeyError if there is none: the configuration checks names."""
    module, _, attribute = OBJECTIVES[name].partition(":")
    return cast(ObjectiveKind, getattr(import_module(module), attribute))
