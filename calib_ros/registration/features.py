"""What the fast score keeps of a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera, Rectifier
from calib_ros.config import Config, SemanticsConfig
from calib_ros.errors import BadInputError
from calib_ros.frame import MAIN_CLASSES, UNLABELLED, Frame, SemanticClass
from calib_ros.image.edges import EdgeLevel, edge_levels
from calib_ros.lidar.deskew import deskewed_edges, deskewed_frame, used_twist
from calib_ros.lidar.edges import EdgePoints, edge_points
from calib_ros.lidar.range_image import range_image
from calib_ros.registration.registry import objective_kind
from calib_ros.registration.semantic_init.view import ClassView, class_view
from calib_ros.semantics.segmentation import OF_CLASSES, OF_MASKS, FrameSemantics


@dataclass(frozen=True, eq=False)
class FrameFeatures:
    """Features of one frame for the fast score. points: LiDAR frame. levels: coarse to fine. camera: pinhole of the maps.

    has_reflectivity: False if the source gave no usable intensity, so that reflectivity edges are missing. twist: (6,) the
    LiDAR's velocity, rad/s and m/s in its own frame, by which the points were moved to the image's moment; None = they were not.

    Where classes are known: importance: w_j of eq. 3.16. plain: the same frame without semantics, which is what the monitor
    compares with other frames. points.label tells whose edges points are; levels then have two maps for edges of any kind, and
    two more for each group of registration/class_edges.py. view: what the first guess needs, where points and pixels have
    classes.
    """

    points: EdgePoints
    levels: list[EdgeLevel]
    camera: Camera
    stamp: int
    name: str
    has_reflectivity: bool
    twist: NDArray[np.float64] | None = None
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


# Classes in the score: weights of frames and edges by class, and which image edges an edge may meet (thesis 3.6, 5.3).
C = SemanticClass
Map = NDArray[np.float32]
Classes = NDArray[np.uint8]
GROUPS = ((C.VEHICLE,), (C.PERSON, C.CYCLIST, C.POLE, C.SIGN))  # of classes whose edges are matched among themselves
GATE_PX = 6.0  # px at 1242 px image width; borders of class maps are off by as much
FEW_FRAMES_SHARE = 0.05  # added to the share of main classes, so that frames without any keep a part of their weight


def gates(classes: Classes) -> list[Map]:
    """Classes of pixels (H, W) -> for each of GROUPS where its edges may lie, (H, W) float32 0..1: on it, close around, and where
    nobody knows the class."""
    size = 2 * max(round(GATE_PX * classes.shape[1] / 1242), 1) + 1
    out = []
    for group in GROUPS:
        own = np.isin(classes, (*group, UNLABELLED)).astype(np.uint8)
        wide = cv2.dilate(own, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
        out.append(np.asarray(cv2.GaussianBlur(wide.astype(np.float32), (0, 0), size / 6), np.float32))
    return out


def gated(levels: Sequence[EdgeLevel], classes: Classes) -> list[EdgeLevel]:
    """Levels with two maps, of an image whose pixels have classes (H, W) -> the same with two more maps for each of GROUPS.

    These have mean 0, too, but keep the unit of the ungated maps. Standardised by themselves they would count the more the less
    their gates let through: on a KITTI scene vehicles then outvoted all else five times over, and the optimum lay 1 deg off.
    """
    open_for = gates(classes)
    return [EdgeLevel(np.concatenate([level.maps, *_behind(open_for, level)]), level.scale, level.sigma) for level in levels]


def _behind(open_for: Sequence[Map], level: EdgeLevel) -> list[Map]:
    """The level's maps (2, h, w) behind each of the gates (H, W)."""
    height, width = level.maps.shape[1:]
    # A map stands for whole cells of pixels only; 0 is its mean, and the least value in it stands for no edge.
    strength = level.maps - level.maps.min(axis=(1, 2), keepdims=True)
    out = []
    for gate in open_for:
        own = cv2.resize(gate[: height * level.scale, : width * level.scale], (width, height), interpolation=cv2.INTER_AREA)
        let_through = strength * own
        out.append(np.asarray(let_through - let_through.mean(axis=(1, 2), keepdims=True), np.float32))
    return out


def channels(label: Classes) -> NDArray[np.intp]:
    """Classes of edge points (n,) -> number of the pair of maps that each is matched with: 0 = edges of anything."""
    table = np.zeros(256, np.intp)
    for k, group in enumerate(GROUPS):
        table[list(group)] = k + 1
    return np.asarray(table[label])


def edge_weights(label: Classes, config: SemanticsConfig) -> Map:
    """Classes of edge points (n,) -> their weights (n,)."""
    table = np.full(256, config.weight_other, np.float32)
    for cls, weight in (
        (C.VEHICLE, config.weight_vehicle),
        (C.PERSON, config.weight_person),
        (C.CYCLIST, config.weight_person),
        (C.POLE, config.weight_pole),
        (C.SIGN, config.weight_pole),
        (C.BUILDING, config.weight_building),
        (C.VEGETATION, config.weight_vegetation),
        (C.GROUND, config.weight_ground),
    ):
        table[cls] = weight
    return np.asarray(table[label])


def importance(classes: Classes) -> float | None:
    """w_j of eq. 3.16: the share of the main classes among the pixels (H, W) whose class is known; None if none is."""
    count = np.bincount(classes.ravel(), minlength=256)
    known = count.sum() - count[UNLABELLED]
    return None if known == 0 else float(count[list(MAIN_CLASSES)].sum() / known)


def frame_weights(shares: Sequence[float | None]) -> NDArray[np.float64]:
    """w_j of several frames (n,), of mean 1. One whose classes are not known, as they come later than the frame, weighs 1."""
    known = np.array([s for s in shares if s is not None])
    if not len(known):
        return np.ones(len(shares))
    mean = float(known.mean()) + FEW_FRAMES_SHARE
    return np.array([1.0 if s is None else (s + FEW_FRAMES_SHARE) / mean for s in shares])


# The fast score's features of a frame, with what semantics know of it.
def with_semantics(
    plain: FrameFeatures,
    image: NDArray[np.uint8],
    edges: Map | None,
    classes: NDArray[np.uint8] | None,
    config: Config,
    edges_of: str = OF_MASKS,
) -> FrameFeatures:
    """Features with semantic edges, weights and groups of classes, as far as they are known.

    image: (h, w[, 3]) of plain.camera. edges: (2, h, w) in 0..1, classes: (h, w) SemanticClass, both of that image.
    edges_of: see Seen.
    """
    own, points = config.semantics, plain.points
    if points.label is not None:
        points = replace(points, strength=points.strength * edge_weights(points.label, own))
        # Points that weigh nothing would still be projected every time.
        points = points.select(np.flatnonzero(points.strength > 0))
    levels = plain.levels
    share = own.class_edge_share if edges_of == OF_CLASSES else own.edge_share
    if edges is not None and share > 0:
        levels = edge_levels(image, float(plain.camera.K[0, 0]), config.image, config.score, edges, share)
    if classes is not None and points.label is not None and own.match_classes:
        levels = gated(levels, classes)
    weight = importance(classes) if classes is not None and own.frame_weights else None
    return replace(plain, points=points, levels=levels, importance=weight, plain=plain)


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


class FeatureExtractor:
    """Turns frames of one camera into features; look-up tables for the lens are made once."""

    def __init__(self, camera: Camera, config: Config | None = None) -> None:
        self.config = config or Config()
        self.source_camera = camera
        self._rectify = Rectifier(camera)
        self.camera = working_camera(self._rectify.camera, self.config.image.max_width)

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
            levels = edge_levels(image, float(self.camera.K[0, 0]), self.config.image, self.config.score)
        fast = FrameFeatures(points, levels, self.camera, frame.stamp, frame.name, scan.reflectivity is not None, twist)
        edges = None
        if semantics is not None:
            edges = None if semantics.edges is None else np.stack([self._working(part) for part in semantics.edges])
            classes = None if semantics.classes is None else self._working(semantics.classes, nearest=True)
            fast = with_semantics(fast, image, edges, classes, self.config, semantics.edges_of)
            if classes is not None and frame.cloud.label is not None:
                fast = replace(fast, view=class_view(deskewed_frame(frame, self.config.motion).cloud, classes, self.camera))
        return objective_kind(self.config.refine.objective).features(frame, image, fast, edges, semantics, self.config)

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
