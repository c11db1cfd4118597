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
from calib_ros.image.thesis_edges import blend, gradient_edges
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.thesis_features import ThesisFeatures, semantic_share
from calib_ros.registration.thesis_reference import RegistrationMaps, registration_maps
from calib_ros.semantics.seen import OF_CLASSES, OF_MASKS, Seen

Image = NDArray[np.uint8]
Matrix = NDArray[np.float64]
WRONG_DEG, WRONG_M = 1.5, 0.15  # how far the deliberately wrong extrinsic is off
SEMANTIC_EDGES = {OF_MASKS: "boundaries of masks", OF_CLASSES: "borders of classes"}


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

    T: T_camera_lidar (4, 4) of the pictures. maps: of eq. 3.12 there, at the last smoothing. seen: what the models see in the
    source, None without models. semantic: its edges (2, h, w) in 0..1 at working size, to 1/255.
    """

    source: Frame
    frame: Frame
    T: Matrix
    config: Config
    features: ThesisFeatures
    maps: RegistrationMaps
    seen: Seen | None = None
    semantic: NDArray[np.float32] | None = None

    @staticmethod
    def of(frame: Frame, T: Matrix, config: Config, seen: Seen | None = None) -> Scene:
        """Raises TooFewFeaturesError if the scan is empty, MissingDependencyError without scikit-learn."""
        # The optimiser goes back to auto: pictures need none, and not every one goes with the thesis's objective.
        refine = dataclasses.replace(config.refine, objective="thesis", optimizer="auto")
        extract = FeatureExtractor(frame.camera, dataclasses.replace(config, refine=refine))
        features = extract(frame, seen)
        assert isinstance(features, ThesisFeatures)
        working = dataclasses.replace(frame, image=extract.working_image(frame.image), camera=extract.camera, classes=None)
        maps = registration_maps(features, T, config.thesis)
        semantic = None
        if seen is not None and seen.edges is not None:
            levels = np.asarray(np.rint(255 * seen.edges), np.uint8)
            semantic = np.stack([extract.working_image(part) for part in levels]) / np.float32(255)
        return Scene(frame, working, T, config, features, maps, seen, semantic)

    @property
    def wrong(self) -> Matrix:
        """T turned and moved to the side, both the same way in the picture."""
        return np.asarray(se3.exp([0, np.deg2rad(WRONG_DEG), 0, 0, 0, 0]) @ se3.exp([0, 0, 0, WRONG_M, 0, 0]) @ self.T)

    @property
    def semantic_edges(self) -> str:
        """What they are called."""
        return "no semantic edges" if self.seen is None or self.semantic is None else SEMANTIC_EDGES[self.seen.edges_of]

    @cached_property
    def gray(self) -> Image:
        """The image (h, w) grey."""
        return to_gray(self.frame.image)

    @cached_property
    def prepared(self) -> Image:
        """The image (h, w) as the edge operators get it."""
        return prepare(self.frame.image, self.config.image)

    @cached_property
    def unsmoothed(self) -> NDArray[np.float32]:
        """E^I (h, w) before its smoothing: gradient edges, blended with semantic ones where there are any (figure 3.10)."""
        gradient = gradient_edges(self.prepared, self.config.image, self.config.thesis)
        semantic = None if self.semantic is None else np.asarray(np.minimum(self.semantic.sum(axis=0), 1), np.float32)
        return blend(gradient, semantic, self.semantic_share)

    @property
    def semantic_share(self) -> float:
        """Share of the semantic edges in E^I."""
        return semantic_share(self.config.thesis, OF_MASKS if self.seen is None else self.seen.edges_of)
