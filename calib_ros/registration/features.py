"""From a frame to its features: edge points of the scan and edge maps of the image, neither of which depends on the extrinsic."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.camera import Camera, Rectifier
from calib_ros.config import Config
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame, PointCloud
from calib_ros.image.edges import EdgeLevel, edge_levels
from calib_ros.image.mask import used_pixels
from calib_ros.lidar.deskew import deskewed_edges, deskewed_frame, has_times, used_twist
from calib_ros.lidar.edges import EdgePoints, edge_points
from calib_ros.lidar.range_image import range_image
from calib_ros_semantics.first_guess.view import ClassView, class_view
from calib_ros_semantics.models.edge_classes import EDGE_SHARE, edge_weights, importance
from calib_ros_semantics.models.segmentation import OF_MASKS, FrameSemantics
from calib_ros_thesis.registry import objective_kind

Map = NDArray[np.float32]
WIDE_DEG = 125.0  # field from left to right border above which a pinhole cuts images down


class Features(Protocol):
    """What is kept of a frame, whatever the objective: points of the scan and edge maps of the image, of which neither depends on
    the extrinsic. See FrameFeatures for the meaning."""

    @property
    def fast(self) -> FrameFeatures: ...

    @property
    def name(self) -> str: ...

    @property
    def camera(self) -> Camera: ...

    @property
    def stamp(self) -> int: ...

    @property
    def has_reflectivity(self) -> bool: ...

    @property
    def twist(self) -> NDArray[np.float64] | None: ...

    @property
    def outline(self) -> EdgePoints: ...


@dataclass(frozen=True, eq=False)
class FrameFeatures:
    """Features of one frame for the fast score. points: LiDAR frame. levels: coarse to fine. camera: pinhole of the maps.

    has_reflectivity: False if the source gave no usable intensity, so that reflectivity edges are missing. twist: (6,) the
    LiDAR's velocity, rad/s and m/s in its own frame, by which the points were moved to the image's moment; None = they were not.

    timed_by_azimuth: the times of its points come from their azimuth, by the stage ``motion``.

    unknown_motion_s: half the time in which the scan sweeps the image, s, where nothing is known of the motion meanwhile: the
    points at the sides are then off by that time; 0 where they were moved, or the source says that they need not be.

    Where classes are known: importance: w_j of eq. 3.16. plain: the same frame without semantics, which is what the monitor
    compares with other frames. points.label tells whose edges points are. view: what the first guess needs, where points and
    pixels have classes.
    """

    points: EdgePoints
    levels: list[EdgeLevel]
    camera: Camera
    stamp: int
    name: str
    has_reflectivity: bool
    twist: NDArray[np.float64] | None = None
    timed_by_azimuth: bool = False
    unknown_motion_s: float = 0.0
    importance: float | None = None
    plain: FrameFeatures | None = None
    view: ClassView | None = None

    @property
    def fast(self) -> FrameFeatures:
        """These, as every objective's features have them."""
        return self

    @property
    def outline(self) -> EdgePoints:
        """What to draw of the scan's edges."""
        return self.points


class FeatureExtractor:
    """Turns frames of one camera into features; look-up tables for the lens are made once."""

    def __init__(self, camera: Camera, config: Config | None = None) -> None:
        self.config = config or Config()
        self.source_camera = camera
        self._rectify = Rectifier(camera, rectified_camera(camera, self.config))
        self.camera = working_camera(self._rectify.camera, self.config.image.max_width)

    @cached_property
    def used(self) -> NDArray[np.bool_] | None:
        """(h, w) of the working image, False in what ``image.mask`` and ``image.ignored_boxes`` leave out; None = all is used.

        BadInputError if the mask cannot be read or does not fit the camera; raised with the first frame.
        """
        used = used_pixels(self.config.image, self.source_camera.width, self.source_camera.height)
        masked = None if used is None else np.asarray(self._working(used.astype(np.uint8) * 255) == 255)
        seen = self._rectify.seen()
        if seen is None:
            return masked
        shown = np.asarray(self._shrunk(seen.astype(np.uint8) * 255) == 255)
        return shown if masked is None else shown & masked

    def __call__(self, frame: Frame, semantics: FrameSemantics | None = None, plain: Features | None = None) -> Features:
        """Features of a frame for the configured objective. semantics: of the frame. plain: its features without them, if
        there are any already: their edge maps are taken over.

        BadInputError if it was taken by another camera, TooFewFeaturesError if its scan is empty.
        """
        if frame.camera != self.source_camera:
            raise BadInputError(
                f"frame {frame.name or frame.stamp} carries another camera calibration than the others; "
                "frames of different calibrations cannot be estimated together: give only frames of one recording"
            )
        image = self.working_image(frame.image)
        if semantics is not None and semantics.labels is not None:
            frame = replace(frame, cloud=replace(frame.cloud, label=semantics.labels))
        elif frame.cloud.label is not None:  # what a source knows is used only where it is asked for
            frame = replace(frame, cloud=replace(frame.cloud, label=None))
        scan = range_image(frame.cloud, self.config.lidar)
        twist, still = used_twist(frame, self.config.motion), frame
        if scan.layout == "projection" and twist is not None:
            # Without rings one direction is measured at several times: what moved meanwhile would look like edges.
            still = deskewed_frame(frame, self.config.motion)
            scan = range_image(still.cloud, self.config.lidar)
        # Rings are regular in the scan as it was measured: edges are found there, and moved afterwards.
        points = deskewed_edges(edge_points(scan, self.config.lidar), still, self.config.motion)
        if plain is not None and plain.camera == self.camera:  # else: made with another image.max_width meanwhile
            levels = plain.fast.levels
        else:
            levels = edge_levels(image, float(self.camera.K[0, 0]), self.config.image, used=self.used)
        by_azimuth = still is frame and not frame.compensated and not has_times(frame.cloud)
        facts = (self.camera, frame.stamp, frame.name, scan.reflectivity is not None, twist, by_azimuth)
        fast = FrameFeatures(points, levels, *facts)
        if twist is None and not frame.compensated and self.config.motion.deskew != "off":
            fast = replace(fast, unknown_motion_s=self.config.motion.scan_period_s * self.source_camera.field_deg / 720)
        edges = None
        if semantics is not None:
            edges = None if semantics.edges is None else np.stack([self._working(part) for part in semantics.edges])
            classes = None if semantics.classes is None else self._working(semantics.classes, nearest=True)
            fast = with_semantics(fast, image, edges, classes, self.config, semantics.edges_of, self.used)
            if semantics.classes is not None and classes is not None and frame.cloud.label is not None:
                cloud = deskewed_frame(frame, self.config.motion).cloud
                fast = replace(fast, view=self._view(cloud, semantics.classes, classes))
        return objective_kind(self.config.refine.objective).extract(frame, image, fast, edges, semantics, self.config)

    def _view(self, cloud: PointCloud, recorded: NDArray[np.uint8], working: NDArray[np.uint8]) -> ClassView:
        """What the first guess needs, which knows pinholes only: of a wide lens, its central field."""
        if self.camera.is_pinhole:
            return class_view(cloud, working, self.camera)
        flat = Rectifier(self.source_camera)
        return class_view(cloud, flat.map(recorded, nearest=True), flat.camera)

    def working_image(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image (H, W[, 3]) rectified and shrunk to the size that the registration works at."""
        return np.asarray(self._working(image), np.uint8)

    def _working(self, values: NDArray[Any], nearest: bool = False) -> NDArray[Any]:
        """The same for values (H, W[, channels]) of any type. nearest: not averaged."""
        return self._shrunk(self._rectify.map(values, nearest), nearest)

    def _shrunk(self, values: NDArray[Any], nearest: bool = False) -> NDArray[Any]:
        size = (self.camera.width, self.camera.height)
        if (values.shape[1], values.shape[0]) == size:
            return values
        return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_NEAREST if nearest else cv2.INTER_AREA))


def with_semantics(
    plain: FrameFeatures,
    image: NDArray[np.uint8],
    edges: Map | None,
    classes: NDArray[np.uint8] | None,
    config: Config,
    edges_of: str = OF_MASKS,
    used: NDArray[np.bool_] | None = None,
) -> FrameFeatures:
    """Features with semantic edges and weights of classes, as far as they are known.

    image: (h, w[, 3]) of plain.camera. edges: (2, h, w) in 0..1, classes: (h, w) SemanticClass, both of that image.
    edges_of: see FrameSemantics. used: see FeatureExtractor.
    """
    points = plain.points
    if points.label is not None:
        points = replace(points, strength=points.strength * edge_weights(points.label))
    levels = plain.levels
    if edges is not None and edges_of == OF_MASKS:  # borders of classes do not improve the score
        levels = edge_levels(image, float(plain.camera.K[0, 0]), config.image, edges, EDGE_SHARE, used)
    weight = importance(classes) if classes is not None and config.semantics.frame_weights else None
    return replace(plain, points=points, levels=levels, importance=weight, plain=plain)


def at_time_offset(features: FrameFeatures, seconds: float) -> FrameFeatures:
    """The same with all points measured `seconds` later; itself if the LiDAR's velocity is not known."""
    if features.twist is None or not seconds:
        return features
    motion = se3.exp(features.twist * seconds)
    points, view, plain = features.points, features.view, features.plain
    time = None if points.time is None else (points.time + seconds).astype(np.float32)
    return replace(
        features,
        points=replace(points, xyz=se3.transform(motion, points.xyz).astype(np.float32), time=time),
        view=None if view is None else replace(view, xyz=se3.transform(motion, view.xyz).astype(np.float32)),
        plain=None if plain is None else at_time_offset(plain, seconds),
    )


def rectified_camera(camera: Camera, config: Config) -> Camera:
    """The camera of the rectified image: a pinhole, or a cylinder for what a pinhole cannot show (``image.projection``).

    Only the fast objective projects onto cylinders.
    """
    projection = config.image.projection
    wide = projection == "auto" and config.refine.objective == "fast" and camera.field_deg > WIDE_DEG
    return camera.unrolled() if wide or projection == "cylinder" else camera.rectified()


def working_camera(camera: Camera, max_width: int) -> Camera:
    """The pinhole or cylinder of an image shrunk to at most `max_width`; pixel centres at integers, so (c + 0.5) s - 0.5."""
    if camera.width <= max_width:
        return camera
    width, height = max_width, round(camera.height * max_width / camera.width)
    sx, sy = width / camera.width, height / camera.height
    S = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
    return Camera(S @ camera.K, width, height, camera.model if camera.is_cylinder else "plumb_bob")
