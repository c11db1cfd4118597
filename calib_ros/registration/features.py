"""What is kept of a frame: points of the scan and edge maps of the image. Neither depends on the extrinsic."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera, Rectifier
from calib_ros.config import Config
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame
from calib_ros.image.edges import edge_levels
from calib_ros.lidar.deskew import still_cloud, still_edges, still_frame, used_twist
from calib_ros.lidar.edge_points import edge_points
from calib_ros.lidar.scan import range_image
from calib_ros.registration.first_guess.class_view import class_view
from calib_ros.registration.frame_features import FrameFeatures
from calib_ros.registration.semantic_features import with_semantics
from calib_ros.registration.thesis_features import ThesisFeatures, thesis_features
from calib_ros.semantics.seen import OF_MASKS, Seen

Features = FrameFeatures | ThesisFeatures


class FeatureExtractor:
    """Turns frames of one camera into features; look-up tables for the lens are made once."""

    def __init__(self, camera: Camera, config: Config | None = None) -> None:
        self.config = config or Config()
        self.source_camera = camera
        self._rectify = Rectifier(camera)
        self.camera = working_camera(self._rectify.camera, self.config.image.max_width)

    def __call__(self, frame: Frame, seen: Seen | None = None, plain: Features | None = None) -> Features:
        """Features of a frame for the configured objective. seen: what semantics make of it. plain: its features without them, if
        there are any already: their edge maps are taken over.

        BadInputError if it was taken by another camera, TooFewFeaturesError if its scan is empty.
        """
        if frame.camera != self.source_camera:
            raise BadInputError(
                f"frame {frame.name or frame.stamp} carries another camera calibration than the others; "
                "frames of different calibrations cannot be estimated together: give only frames of one recording"
            )
        image = self.working_image(frame.image)
        if seen is not None and seen.labels is not None:
            frame = replace(frame, cloud=replace(frame.cloud, label=seen.labels))
        elif frame.cloud.label is not None:  # what a source knows is used only where it is asked for
            frame = replace(frame, cloud=replace(frame.cloud, label=None))
        scan = range_image(frame.cloud, self.config.lidar)
        twist, still = used_twist(frame, self.config.motion), frame
        if scan.layout == "projection" and twist is not None:
            # Without rings one direction is measured at several times: what moved meanwhile would look like edges.
            still = still_frame(frame, self.config.motion)
            scan = range_image(still.cloud, self.config.lidar)
        # Rings are regular in the scan as it was measured: edges are found there, and moved afterwards.
        points = still_edges(edge_points(scan, self.config.lidar), still, self.config.motion)
        known = plain.fast if isinstance(plain, ThesisFeatures) else plain
        if known is not None and known.camera == self.camera:  # else: made with another image.max_width meanwhile
            levels = known.levels
        else:
            levels = edge_levels(image, float(self.camera.K[0, 0]), self.config.image, self.config.score)
        fast = FrameFeatures(points, levels, self.camera, frame.stamp, frame.name, scan.reflectivity is not None, twist)
        edges = None
        if seen is not None:
            edges = None if seen.edges is None else np.stack([self._working(part) for part in seen.edges])
            classes = None if seen.classes is None else self._working(seen.classes, nearest=True)
            fast = with_semantics(fast, image, edges, classes, self.config, seen.edges_of)
            if classes is not None and frame.cloud.label is not None:
                fast = replace(fast, view=class_view(still_frame(frame, self.config.motion).cloud, classes, self.camera))
        if self.config.refine.objective != "thesis":
            return fast
        semantic = None if edges is None else np.asarray(np.minimum(edges.sum(axis=0), 1), np.float32)
        at_image = still_cloud(frame, self.config.motion)
        kind = OF_MASKS if seen is None else seen.edges_of
        return thesis_features(frame.cloud, image, fast, self.config, semantic, at_image, kind)

    def working_image(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image (H, W[, 3]) rectified and shrunk to the size that the registration works at."""
        return np.asarray(self._working(image), np.uint8)

    def _working(self, values: NDArray[Any], nearest: bool = False) -> NDArray[Any]:
        """The same for values (H, W[, channels]) of any type. nearest: not averaged."""
        values = self._rectify.map(values, nearest)
        size = (self.camera.width, self.camera.height)
        if (values.shape[1], values.shape[0]) == size:
            return values
        return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_NEAREST if nearest else cv2.INTER_AREA))


def working_camera(camera: Camera, max_width: int) -> Camera:
    """The pinhole camera of an image shrunk to at most `max_width`; pixel centres at integers, so (c + 0.5) s - 0.5."""
    if camera.width <= max_width:
        return camera
    width, height = max_width, round(camera.height * max_width / camera.width)
    sx, sy = width / camera.width, height / camera.height
    S = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
    return Camera(S @ camera.K, width, height)
