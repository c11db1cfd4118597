"""How the models join the core: a `ClassModels` of calib_ros.registration.classes, by the entry point ``calib_ros.classes``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import GuessConfig, SemanticsConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import PointCloud
from calib_ros.registration.classes import ClassModels, Hypothesis
from calib_ros.registration.score.point_score import PointScore
from calib_ros_semantics.first_guess.guess import first_guess
from calib_ros_semantics.first_guess.score import label_score, select_views
from calib_ros_semantics.first_guess.view import ClassView, class_view
from calib_ros_semantics.models.segmentation import SegmentationModels


class ConfiguredClassModels:
    """The package's own; see ClassModels."""

    def segmentation(self, config: SemanticsConfig) -> SegmentationModels:
        """The configured models, loaded on first use."""
        return SegmentationModels(config)

    def view(self, cloud: PointCloud, classes: NDArray[np.uint8], camera: Camera) -> ClassView:
        """See class_view."""
        return class_view(cloud, classes, camera)

    def consistency(self, views: Sequence[ClassView]) -> PointScore | None:
        """The score of labelled points on pixels of their class; None where the frames show too little in common."""
        try:
            return label_score(select_views(views))
        except TooFewFeaturesError:
            return None

    def first_guess(self, views: Sequence[ClassView], config: GuessConfig, seed: int) -> list[Hypothesis]:
        """See first_guess.guess."""
        return first_guess(views, config, seed)


MODELS: ClassModels = ConfiguredClassModels()
