"""How the models join the core: a `ClassModels` of calib_ros.registration.classes, by the entry point ``calib_ros.classes``."""

from __future__ import annotations

from collections.abc import Sequence

from calib_ros.errors import TooFewFeaturesError
from calib_ros.registration.classes import ClassModels
from calib_ros.registration.score.point_score import PointScore
from calib_ros_semantics.first_guess.guess import first_guess
from calib_ros_semantics.first_guess.score import label_score, select_views
from calib_ros_semantics.first_guess.view import ClassView, class_view
from calib_ros_semantics.models.segmentation import SegmentationModels


class ConfiguredClassModels:
    """The package's own; see ClassModels."""

    segmentation = SegmentationModels
    view = staticmethod(class_view)
    first_guess = staticmethod(first_guess)

    @staticmethod
    def consistency(views: Sequence[ClassView]) -> PointScore | None:
        """The score of labelled points on pixels of their class; None where the frames show too little in common."""
        try:
            return label_score(select_views(views))
        except TooFewFeaturesError:
            return None


MODELS: ClassModels = ConfiguredClassModels()
