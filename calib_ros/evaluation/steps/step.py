"""One step of the method as a person sees it, and the frame that all steps are of."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.frame import Frame
from calib_ros.image.enhance import prepare, to_gray
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.thesis_features import ThesisFeatures
from calib_ros.registration.thesis_reference import RegistrationMaps, registration_maps

Image = NDArray[np.uint8]
Matrix = NDArray[np.float64]
WRONG_DEG, WRONG_M = 1.5, 0.15  # how far the deliberately wrong extrinsic is off


@dataclass(frozen=True, eq=False)
class Step:
    """section: its heading's number in the thesis. caption: what it is and what to look for.

    picture: (h, w[, 3]) BGR or grey. table: rows of text, the first one the heads. Either, both or none. wide: it takes a
    whole row of the page.
    """

    section: str
    name: str
    caption: str
    picture: Image | None = None
    table: tuple[tuple[str, ...], ...] = ()
    wide: bool = False


@dataclass(frozen=True, eq=False)
class Scene:
    """A frame as the registration sees it. frame: rectified, at working size. source: as recorded.

    T: T_camera_lidar (4, 4) of the pictures. maps: of eq. 3.12 there, at the last smoothing.
    """

    source: Frame
    frame: Frame
    T: Matrix
    config: Config
    features: ThesisFeatures
    maps: RegistrationMaps

    @staticmethod
    def of(frame: Frame, T: Matrix, config: Config) -> Scene:
        """Raises TooFewFeaturesError if the scan is empty, MissingDependencyError without scikit-learn."""
        # The optimiser goes back to auto: pictures need none, and not every one goes with the thesis's objective.
        refine = dataclasses.replace(config.refine, objective="thesis", optimizer="auto")
        extract = FeatureExtractor(frame.camera, dataclasses.replace(config, refine=refine))
        features = extract(frame)
        assert isinstance(features, ThesisFeatures)
        working = dataclasses.replace(frame, image=extract.working_image(frame.image), camera=extract.camera)
        maps = registration_maps(features, T, config.thesis)
        return Scene(frame, working, T, config, features, maps)

    @property
    def wrong(self) -> Matrix:
        """T turned and moved to the side, both the same way in the picture."""
        return np.asarray(se3.exp([0, np.deg2rad(WRONG_DEG), 0, 0, 0, 0]) @ se3.exp([0, 0, 0, WRONG_M, 0, 0]) @ self.T)

    @cached_property
    def gray(self) -> Image:
        """The image (h, w) grey."""
        return to_gray(self.frame.image)

    @cached_property
    def prepared(self) -> Image:
        """The image (h, w) as the edge operators get it."""
        return prepare(self.frame.image, self.config.image)
