"""From a frame to its features: edge points of the scan and edge maps of the image, neither of which depends on the extrinsic."""

from __future__ import annotations

from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import extensions, se3
from calib_ros.arrays import Transform
from calib_ros.camera import Camera, Rectifier, across_meridians
from calib_ros.config import Config
from calib_ros.datasets.recent import Recent
from calib_ros.errors import BadInputError, BadTimesError, TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.image.edges import EdgeLevel, edge_levels
from calib_ros.image.mask import used_pixels
from calib_ros.lidar.deskew import deskewed_edges, deskewed_frame, has_times, used_twist
from calib_ros.lidar.edges import EdgePoints, edge_points
from calib_ros.lidar.range_image import range_image
from calib_ros.registration.classes import EDGE_SHARE, OF_MASKS, FrameSemantics, Segmentation, class_models, edge_weights
from calib_ros.registration.progress import Progress
from calib_ros.registration.score.point_score import MARGIN, near_image
from calib_ros.registration.search.constraints import SearchBox

Map = NDArray[np.float32]
KEY_STEP = 61  # of points that tell a scan from others, a few thousand
Used = tuple[Frame, "FrameFeatures"]
BESIDE = 0.1  # of the image width: objects at the border have to be seen as a whole, or they have no shape
WIDE_DEG = 125.0  # field from left to right border above which a pinhole cuts images down


class ObjectiveKind(Protocol):
    """Another objective, which joins by the entry point ``calib_ros.objectives``. pinholes_only: it cannot project onto
    spheres. moves_points: the points that it keeps follow a time offset. uses: kinds of models, in doubt or not."""

    pinholes_only: bool
    moves_points: bool
    uses: tuple[str, ...]

    def extract(
        self,
        frame: Frame,
        image: NDArray[np.uint8],
        features: FrameFeatures,
        semantics: FrameSemantics | None,
        extractor: FeatureExtractor,
    ) -> Any:
        """What it keeps of a frame, as `FrameFeatures.own`. image: rectified, (h, w[, 3]) of features.camera. features: `own` is
        what it has kept of the same frame without semantics, if anything."""

    def __call__(self, edges: Any, T_prior: Transform, config: Config) -> Any:
        """The `Objective` of the frames of `edges`, a FastObjective, around T_prior (4, 4). Raises TooFewFeaturesError."""


def other_objective(config: Config) -> ObjectiveKind | None:
    """The objective that ``refine.objective`` names; None where it is the edges' own, "fast". The configuration checks names."""
    name = config.refine.objective
    kind: ObjectiveKind | None = None if name == "fast" else extensions.load(extensions.OBJECTIVES, name)
    return kind


@dataclass(frozen=True, eq=False)
class FrameFeatures:
    """What is kept of one frame. points: LiDAR frame. levels: coarse to fine. camera: pinhole, or sphere, of the maps.

    has_reflectivity: False if the source gave no usable intensity. twist: (6,) the LiDAR's velocity, rad/s and m/s in its own
    frame, by which the points were moved to the image's moment; None = they were not. timed_by_azimuth: the times of its points
    come from their azimuth, by the stage ``motion``. unknown_motion_s: how long an unknown motion displaces points, s: half the
    time in which the scan sweeps the image, or as `ego_motion.unknown_motion_s` has it; 0 where it is known. plain: the same
    frame without semantics, where it has some. view: its classes as `ClassModels` keeps them. own: what another objective keeps.
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
    plain: FrameFeatures | None = None
    view: Any = None
    own: Any = None

    @property
    def edges_only(self) -> FrameFeatures:
        """The same without what another objective keeps."""
        return self if self.own is None else replace(self, own=None)


# What does not depend on a camera: whether a scan has reflectivities, and its edges as measured, by `scan_key`.
ScanKey = tuple[int, bytes]
ScanEdges = MutableMapping[ScanKey, tuple[bool, EdgePoints]]


def scan_key(frame: Frame) -> ScanKey | None:
    """What tells the scan of a frame from others: points of it, since drivers may not stamp, and cameras have their own clocks.
    None of one that is not to be shared."""
    cloud = frame.cloud
    return None if cloud.label is not None or not len(cloud) else (len(cloud), cloud.xyz[::KEY_STEP].tobytes())


class FeatureExtractor:
    """Turns frames of one camera into features; look-up tables for the lens are made once. scans: shared with the extractors of
    other cameras beside the same LiDAR, whose scans are then searched once. pictures: the newest edge maps, shared with the
    extractors of the same camera beside other LiDARs."""

    def __init__(
        self, camera: Camera, config: Config | None = None, scans: ScanEdges | None = None, pictures: Recent | None = None
    ) -> None:
        self.config = config or Config()
        self.scans, self._pictures = scans, pictures
        self.source_camera = camera
        self._other = other_objective(self.config)
        self._rectify = Rectifier(camera, rectified_camera(camera, self.config))
        self.camera = working_camera(self._rectify.camera, self.config.image.max_width)

    @cached_property
    def used(self) -> NDArray[np.bool_] | None:
        """(h, w) of the working image, False in what ``image.mask`` and ``image.ignored_boxes`` leave out; None = all is used.
        BadInputError if the mask cannot be read or does not fit the camera."""
        used, seen = used_pixels(self.config.image, self.source_camera.width, self.source_camera.height), self._rectify.seen()
        masked = None if used is None else np.asarray(self.working(used.astype(np.uint8) * 255) == 255)
        shown = None if seen is None else np.asarray(self._shrunk(seen.astype(np.uint8) * 255) == 255)
        return shown & masked if shown is not None and masked is not None else (shown if masked is None else masked)

    @cached_property
    def across(self) -> Map | None:
        """Directions (2, h, w) in which lines parallel to the camera's y axis change a sphere's picture; None on a pinhole, where
        it is along the rows everywhere."""
        return across_meridians(self.camera).astype(np.float32) if self.camera.is_sphere else None

    def __call__(
        self, frame: Frame, semantics: FrameSemantics | None = None, plain: FrameFeatures | None = None
    ) -> FrameFeatures:
        """Features of a frame. semantics: of the frame. plain: its features without them, of which is taken over what classes do
        not change. BadInputError if it was taken by another camera, TooFewFeaturesError if its scan is empty."""
        if frame.camera != self.source_camera:
            raise BadInputError(
                f"frame {frame.name or frame.stamp} carries another camera calibration than the others; "
                "frames of different calibrations cannot be estimated together: give only frames of one recording"
            )
        image, labels = self.working_image(frame.image), None if semantics is None else semantics.labels
        if labels is not None or frame.cloud.label is not None:  # what a source knows is used only where it is asked for
            frame = replace(frame, cloud=replace(frame.cloud, label=labels))
        known = plain if plain is not None and plain.camera == self.camera else None  # else: another image.max_width meanwhile
        features = known.edges_only if known is not None and labels is None else self._of_edges(frame, image, known)
        if semantics is not None:
            features = self._with_semantics(features, frame, image, semantics)
        if self._other is None:
            return features
        features = features if known is None else replace(features, own=known.own)
        return replace(features, own=self._other.extract(frame, image, features, semantics, self))

    def _of_edges(self, frame: Frame, image: NDArray[np.uint8], plain: FrameFeatures | None) -> FrameFeatures:
        """Edges of scan and image. plain: whose edge maps are taken over."""
        twist = used_twist(frame, self.config.motion)
        key, still = None if self.scans is None else scan_key(frame), frame
        found = None if self.scans is None or key is None else self.scans.get(key)
        if found is None:
            scan = range_image(frame.cloud, self.config.lidar)
            if scan.layout == "projection" and twist is not None:
                # Without rings one direction is measured at several times: what moved meanwhile would look like edges.
                still = deskewed_frame(frame, self.config.motion)
                scan = range_image(still.cloud, self.config.lidar)
            found = scan.reflectivity is not None, edge_points(scan, self.config.lidar)
            if self.scans is not None and key is not None and still is frame:
                self.scans[key] = found
        reflectivity, edges = found
        # Rings are regular in the scan as it was measured: edges are found there, and moved afterwards.
        points = deskewed_edges(edges, still, self.config.motion)
        levels = self._levels(image, points, of=frame) if plain is None else plain.levels
        by_azimuth = still is frame and not frame.compensated and not has_times(frame.cloud)
        unknown = twist is None and not frame.compensated and self.config.motion.deskew != "off"
        unknown_s = self.config.motion.scan_period_s * self.source_camera.field_deg / 720 if unknown else 0.0
        facts = (self.camera, frame.stamp, frame.name, reflectivity, twist, by_azimuth, unknown_s)
        return FrameFeatures(points, levels, *facts)

    def _levels(
        self, image: NDArray[np.uint8], points: EdgePoints, semantic: Map | None = None, of: Frame | None = None
    ) -> list[EdgeLevel]:
        """Edge maps of a working image, no sharper than the scanner's edges are placed: evenly within a step. of: the frame whose
        maps other pairs of the camera may have made."""
        blunt = points.azimuth_step / np.sqrt(12)
        make = partial(edge_levels, image, float(self.camera.K[0, 0]), semantic, EDGE_SHARE, self.used, self.across, blunt)
        if of is None or self._pictures is None:
            return make()
        own = self.source_camera
        lens = own.model, own.K.tobytes(), own.D.tobytes(), own.said_rectified
        return self._pictures((of.stamp, of.image[::KEY_STEP].tobytes(), self.config.image, lens, blunt), make)

    def seen_anew(self, features: FrameFeatures, image: NDArray[np.uint8]) -> FrameFeatures:
        """Features of the same scan, had this camera taken the image; without semantics."""
        levels = self._levels(self.working_image(image), features.points)
        return replace(features, levels=levels, camera=self.camera, plain=None, view=None)

    def _with_semantics(
        self, features: FrameFeatures, frame: Frame, image: NDArray[np.uint8], semantics: FrameSemantics
    ) -> FrameFeatures:
        """Features with semantic edges and weights of classes, as far as they are known. image: (h, w[, 3]) of the camera."""
        points, levels, models = features.points, features.levels, class_models()
        edges = self.semantic_edges(semantics) if semantics.edges_of == OF_MASKS else None
        if points.label is not None:
            points = replace(points, strength=points.strength * edge_weights(points.label))
        if edges is not None:
            levels = self._levels(image, points, edges)
        out = replace(features, points=points, levels=levels, plain=features)
        if models is None or semantics.classes is None or frame.cloud.label is None:
            return out
        cloud = deskewed_frame(frame, self.config.motion).cloud
        if self.camera.is_pinhole:
            return replace(out, view=models.view(cloud, self.working(semantics.classes, nearest=True), self.camera))
        flat = Rectifier(self.source_camera)  # a first guess knows pinholes only: of a wide lens, its central field
        return replace(out, view=models.view(cloud, flat.map(semantics.classes, nearest=True), flat.camera))

    def semantic_edges(self, semantics: FrameSemantics) -> Map | None:
        """Semantic edges (2, h, w) of the working image."""
        return None if semantics.edges is None else np.stack([self.working(part) for part in semantics.edges])

    def working_image(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image (H, W[, 3]) rectified and shrunk to the size that the registration works at."""
        return np.asarray(self.working(image), np.uint8)

    def working(self, values: NDArray[Any], nearest: bool = False) -> NDArray[Any]:
        """The same for values (H, W[, channels]) of the recorded image, of any type. nearest: not averaged."""
        return self._shrunk(self._rectify.map(values, nearest), nearest)

    def _shrunk(self, values: NDArray[Any], nearest: bool = False) -> NDArray[Any]:
        size = (self.camera.width, self.camera.height)
        if (values.shape[1], values.shape[0]) == size:
            return values
        return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_NEAREST if nearest else cv2.INTER_AREA))


def views_of(features: Sequence[FrameFeatures]) -> list[Any]:
    """The classes of those frames that have some, as `ClassModels` keeps them."""
    return [f.view for f in features if f.view is not None]


def at_time_offset(features: FrameFeatures, seconds: float) -> FrameFeatures:
    """The same with all points measured `seconds` later; itself if the LiDAR's velocity is not known, or another objective keeps
    points of its own, which stay."""
    if features.twist is None or features.own is not None or not seconds:
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
    """The camera of the rectified image: a pinhole, or a sphere for what a pinhole cannot show (``image.projection``), where
    the objective can project onto one."""
    projection, other = config.image.projection, other_objective(config)
    wide = projection == "auto" and (other is None or not other.pinholes_only) and camera.field_deg > WIDE_DEG
    return camera.unrolled() if wide or projection == "sphere" else camera.rectified()


def working_camera(camera: Camera, max_width: int) -> Camera:
    """The pinhole or sphere of an image shrunk to at most `max_width`; pixel centres at integers, so (c + 0.5) s - 0.5."""
    if camera.width <= max_width:
        return camera
    width, height = max_width, round(camera.height * max_width / camera.width)
    sx, sy = width / camera.width, height / camera.height
    S = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
    model = camera.model if camera.is_sphere else "plumb_bob"
    return Camera(S @ camera.K, width, height, model, said_rectified=camera.said_rectified)


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


def search_margin(camera: Camera, box: SearchBox | None) -> float:
    """How far around the image points may come into view anywhere in a box, as a share of its width."""
    if box is None:
        return MARGIN
    deg, m = box.reach
    return max(MARGIN, float(1.6 * camera.K[0, 0] / camera.width * (np.tan(np.deg2rad(deg)) + m / 5)))
