"""The first guess from classes: exact small worlds, a synthetic street from any yaw, refusals; and objects among classes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from scenes import RenderedDrive

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.frame import UNLABELLED, PointCloud, SemanticClass
from calib_ros.registration.classes import PoseHypothesis
from calib_ros.registration.initial_guess import allowed, poses
from calib_ros.registration.motion_guess.guess import best_registration, search_boxes
from calib_ros.registration.search.constraints import SEMANTIC_BOX, SearchBox
from calib_ros.result import CONVERGED, REFUSED, Result
from calib_ros_semantics.first_guess.centroids import LEFT, RIGHT, Objects, agreed_poses, cloud_objects, find_pairs, image_objects
from calib_ros_semantics.first_guess.guess import CANDIDATES, CENTROIDS, OTHER_WAY_DEG, first_guess
from calib_ros_semantics.first_guess.score import class_score
from calib_ros_semantics.first_guess.view import ClassView, class_view

C = SemanticClass
CAMERA = Camera(np.array([[300.0, 0, 319.5], [0, 300, 119.5], [0, 0, 1]]), 640, 240)
OBJECTS = (C.VEHICLE, C.PERSON, C.CYCLIST, C.POLE, C.SIGN)


def turned(view: ClassView, yaw_deg: float) -> tuple[ClassView, np.ndarray]:
    """The view with its points turned left, and what T_camera_lidar has to be multiplied with from the right."""
    R = se3.rotation_from_euler(np.deg2rad(yaw_deg), 0, 0)
    return replace(view, xyz=np.asarray(view.xyz @ R.T, np.float32)), se3.from_parts(R.T, np.zeros(3))


def balls(T: np.ndarray, seed: int, wrong: int = 0, n: int = 120) -> ClassView:
    """Balls of random classes all around the LiDAR, as a camera at T sees them; of `wrong` of them pixels have another class."""
    rng = np.random.default_rng(seed)
    azimuth, distance = rng.uniform(-np.pi, np.pi, n), rng.uniform(8, 25, n)
    centre = np.c_[distance * np.cos(azimuth), distance * np.sin(azimuth), rng.uniform(-1.5, 2.5, n)]
    cls = rng.choice(OBJECTS, n).astype(np.uint8)
    seen = cls.copy()
    seen[:wrong] = rng.choice(OBJECTS, wrong)
    classes = np.full((CAMERA.height, CAMERA.width), C.SKY, np.uint8)
    p = se3.transform(T, centre)
    uv, inside = CAMERA.project(p)
    for k in np.argsort(-p[:, 2]):
        if inside[k]:
            radius = 0.4 * CAMERA.K[0, 0] / p[k, 2]
            cv2.circle(classes, tuple(int(v) for v in np.round(16 * uv[k])), round(16 * radius), int(seen[k]), -1, shift=4)
    surface = rng.standard_normal((n, 80, 3))
    surface *= 0.4 / np.linalg.norm(surface, axis=2, keepdims=True)
    xyz = (centre[:, None] + surface).reshape(-1, 3).astype(np.float32)
    return class_view(PointCloud(xyz, label=np.repeat(cls, 80)), classes, CAMERA)


def mounted(yaw_deg: float = 0.0, seed: int = 0) -> np.ndarray:
    """A camera that looks anywhere, 0.5 m from the LiDAR and some degrees off level."""
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal(3)
    centre = 0.5 * direction / np.linalg.norm(direction)
    pitch, roll = np.deg2rad(rng.uniform(-6, 6, (2, 1)))
    return poses(np.deg2rad([yaw_deg]), pitch, roll, centre[None])[0]


def assert_near(T: np.ndarray, other: np.ndarray, deg: float, m: float) -> None:
    assert se3.rotation_error_deg(T, other) < deg
    assert se3.translation_error_m(T, other) < m


@pytest.fixture(scope="module")
def street_views() -> tuple[list[ClassView], np.ndarray]:
    """Three places of a street, and the extrinsic."""
    drive = RenderedDrive(seed=31, frames=3, width=640, height=240, speed=0, stride=30)
    frames = [drive[k] for k in range(3)]
    return [class_view(f.cloud, f.classes, drive.camera) for f in frames], drive.reference


@pytest.mark.parametrize("problem", ["labels", "size", "lens"])
def test_invalid_views_are_refused(problem: str) -> None:
    label = None if problem == "labels" else np.zeros(1, np.uint8)
    camera = Camera(CAMERA.K, 640, 240, D=np.array([-0.3, 0.1, 0, 0])) if problem == "lens" else CAMERA
    classes = np.zeros((240, 320 if problem == "size" else 640), np.uint8)
    with pytest.raises(BadInputError, match="a first guess needs"):
        class_view(PointCloud(np.ones((1, 3), np.float32), label=label), classes, camera)


@pytest.mark.parametrize(("yaw", "wrong", "seen"), [(180.0, 0, 0.5), (-97.0, 30, 1.0), (60.0, 20, 0.7)])
def test_centroids_alone_find_the_pose(yaw: float, wrong: int, seen: float) -> None:
    """Objects of the wrong class in the image, and missing in the cloud."""
    T = mounted(yaw)
    views = [balls(T, seed, wrong, 60) for seed in range(3)]
    kept = [np.linalg.norm(v.xyz, axis=1) < 8 + 17 * seen for v in views]  # the far ones are missing
    views = [replace(v, xyz=v.xyz[own], label=v.label[own]) for v, own in zip(views, kept, strict=True)]
    pairs = find_pairs(views)
    found = agreed_poses(pairs, 0)
    assert_near(T, found[0], 1.0, 0.3)
    assert pairs.inliers(found[0]) > 2 * max(pairs.inliers(turned_away(found[0], by)) for by in (40, 130, 220))


def turned_away(T: np.ndarray, yaw_deg: float) -> np.ndarray:
    return T @ se3.from_parts(se3.rotation_from_euler(np.deg2rad(yaw_deg), 0, 0), np.zeros(3))


def test_centroids_need_no_sweep_and_say_what_they_miss(street_views) -> None:
    views, T = street_views
    found = first_guess([turned(v, 120)[0] for v in views], sweep=False)
    assert_near(T @ turned(views[0], 120)[1], found[0].T, 2.0, 0.5)
    assert {h.kind for h in found} == {CENTROIDS}
    nothing = [replace(v, label=np.where(v.label < C.GROUND, UNLABELLED, v.label)) for v in views]
    with pytest.raises(TooFewFeaturesError, match=r"3 objects .* of \d+ in the images 0 may be in the clouds"):
        agreed_poses(find_pairs(nothing), 0)
    assert not find_pairs(nothing).per_object(T[None]).any()


@pytest.mark.parametrize(("yaw", "columns", "kind"), [(75.0, (0, 200), RIGHT), (-75.0, (440, 640), LEFT), (75.0, (0, 640), None)])
def test_of_a_row_that_the_border_cuts_the_end_in_view_counts(yaw: float, columns: tuple[int, int], kind: int | None) -> None:
    """A row of 110 deg in the cloud, of which the image shows one end, or the middle."""
    azimuth, z = (a.ravel() for a in np.meshgrid(np.deg2rad(np.arange(yaw - 55, yaw + 55, 0.4)), np.arange(-1, 1, 0.2)))
    cloud = PointCloud(
        np.c_[10 * np.cos(azimuth), 10 * np.sin(azimuth), z].astype(np.float32), label=np.full(len(z), C.VEHICLE, np.uint8)
    )
    classes = np.full((CAMERA.height, CAMERA.width), C.SKY, np.uint8)
    classes[90:150, columns[0] : columns[1]] = C.VEHICLE
    pairs = find_pairs([class_view(cloud, classes, CAMERA)])
    assert pairs.cls.tolist() == ([] if kind is None else [C.VEHICLE + kind])
    if kind is not None:
        end = poses(np.zeros(1), np.zeros(1), np.zeros(1), np.zeros((1, 3)))[0, :3, :3] @ pairs.point[0]
        assert np.rad2deg(np.arccos(end @ pairs.ray[0] / np.linalg.norm(end))) < 2.0


@pytest.mark.parametrize("yaw", [pytest.param(180.0, marks=pytest.mark.slow), -135.0])
def test_a_street_is_recognised_from_any_yaw(street_views, yaw: float) -> None:
    views, T = street_views
    back = turned(views[0], yaw)[1]
    found = first_guess([turned(v, yaw)[0] for v in views])
    assert_near(T @ back, found[0].T, 2.0, 0.5)
    assert found[0].margin > 0.3 * found[0].score


def test_hypotheses_are_distinct_best_first_and_repeatable(street_views) -> None:
    views, _ = street_views
    found = first_guess(views[:1])
    assert len(found) == CANDIDATES
    assert all(a.score >= b.score for a, b in pairwise(found))
    assert all(
        se3.rotation_error_deg(a.T, b.T) > 1 or se3.translation_error_m(a.T, b.T) > 0.4
        for k, a in enumerate(found)
        for b in found[:k]
    )
    other_way = [h for h in found[1:] if se3.rotation_error_deg(h.T, found[0].T) > OTHER_WAY_DEG]
    assert found[0].margin == pytest.approx(found[0].score - other_way[0].score)
    assert all(allowed(h.T[None]).all() for h in found)
    assert all(h.kind in ("centroids", "sweep") for h in found)
    again = first_guess(views[:1])
    assert [(h.T.tobytes(), h.score, h.margin, h.inliers) for h in again] == [
        (h.T.tobytes(), h.score, h.margin, h.inliers) for h in found
    ]


def test_missing_labels_of_a_frame_do_no_harm(street_views) -> None:
    views, T = street_views
    blind = replace(views[0], classes=np.full_like(views[0].classes, UNLABELLED))
    bare = replace(views[1], xyz=views[1].xyz[:0], label=views[1].label[:0])
    assert_near(T, first_guess([blind, bare, views[2], views[1]])[0].T, 2.0, 0.7)


def test_class_confusions_count_as_matches(street_views) -> None:
    """A cyclist that the image's network takes for a vehicle, or for the sky."""
    views, T = street_views
    view = views[0]
    xyz = se3.transform(se3.inverse(T), np.tile([0.0, 0, 10], (40, 1))).astype(np.float32)
    values = []
    for there in (C.CYCLIST, C.VEHICLE, C.PERSON, C.SKY):
        classes = np.full_like(view.classes, C.GROUND)
        rows, columns = classes.shape
        classes[:, columns // 3 : 2 * columns // 3], classes[: rows // 8] = there, C.CYCLIST
        seen = replace(view, classes=classes, xyz=xyz, label=np.full(40, C.CYCLIST, np.uint8))
        values.append(class_score([seen], [int(C.CYCLIST)]).at(2).value(T))
    assert values[0] > values[1] > values[3]
    assert values[0] > values[2] > values[3]


def test_too_few_common_classes_are_reported(street_views) -> None:
    view = street_views[0][0]
    no_pixels = replace(view, classes=np.full_like(view.classes, UNLABELLED))
    no_points = replace(view, xyz=view.xyz[:0], label=view.label[:0])
    only_ground = replace(view, label=np.full_like(view.label, C.GROUND))
    for views, told in (
        ([no_pixels, no_points], "2 frames have 0 points of none"),
        ([only_ground], "points of ground"),
        ([], "at least one frame"),
    ):
        with pytest.raises(TooFewFeaturesError, match=told) as error:
            first_guess(views)
        assert "\n" not in str(error.value)


def test_different_cameras_are_refused(street_views) -> None:
    view = street_views[0][0]
    other = Camera(view.camera.K * [[1.1], [1.1], [1]], view.camera.width, view.camera.height)
    with pytest.raises(BadInputError, match="different cameras"):
        first_guess([view, replace(view, camera=other)])


def hypothesis(x: float, score: float) -> PoseHypothesis:
    return PoseHypothesis(se3.from_parts(np.eye(3), [x, 0, 0]), score, 0.0, "sweep", 0)


@pytest.mark.parametrize(
    ("results", "expected"),
    [
        ([(CONVERGED, 0.3), (CONVERGED, 0.5)], 1),
        ([(CONVERGED, 0.3), (REFUSED, 0.5)], 0),
        ([(REFUSED, np.nan), (REFUSED, 0.2)], 1),
    ],
)
def test_a_converged_result_counts_before_a_higher_score(results: list[tuple[str, float]], expected: int) -> None:
    told = [Result(se3.from_parts(np.eye(3), [k, 0, 0]), status, "", score) for k, (status, score) in enumerate(results)]
    boxes: list[SearchBox] = []

    def estimate(T: np.ndarray, box: SearchBox) -> Result:
        boxes.append(box)
        return told[int(T[0, 3])]

    best, tried = best_registration([hypothesis(0, 0.5), hypothesis(1, 0.42), hypothesis(2, 0.1)], estimate)
    assert best is told[expected]
    assert tried == 2  # those that score nearly as much as the best
    narrow, wide = search_boxes(SEMANTIC_BOX)
    assert boxes == [narrow] * 2 if best.converged else [narrow] * 2 + [wide] * 2


# --- objects: where they are, and which are left out ----------------------------------------------------------------------


COARSE = Camera(np.array([[100.0, 0, 49.5], [0, 100, 29.5], [0, 0, 1]]), 100, 60)  # 0.57 deg a pixel
NO_POINTS, NO_LABELS = np.empty((0, 3), np.float32), np.empty(0, np.uint8)


def seen(classes: np.ndarray) -> ClassView:
    return ClassView(COARSE, classes, NO_POINTS, NO_LABELS)


def scanned(*parts: tuple[SemanticClass, np.ndarray]) -> ClassView:
    xyz = np.concatenate([points for _, points in parts]).astype(np.float32)
    label = np.concatenate([np.full(len(points), c, np.uint8) for c, points in parts])
    return ClassView(COARSE, np.full((60, 100), UNLABELLED, np.uint8), xyz, label)


def whole(found: Objects) -> Objects:
    """Without the ends of objects."""
    return found[found.cls < LEFT]


def patch(azimuth_deg: float, elevation_deg: float, distance: float, half_deg: float = 1.0) -> np.ndarray:
    """Points every 0.5 deg of a square of directions."""
    side = np.deg2rad(np.arange(-half_deg, half_deg + 0.1, 0.5))
    a, e = (grid.ravel() for grid in np.meshgrid(np.deg2rad(azimuth_deg) + side, np.deg2rad(elevation_deg) + side))
    return distance * np.c_[np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]


def test_regions_have_their_centroid_unless_small_and_their_end_where_cut_at_the_side() -> None:
    classes = np.full((60, 100), C.GROUND, np.uint8)
    classes[10:20, 30:50] = C.VEHICLE
    classes[20:24, 51:55] = C.VEHICLE  # nearer than the gaps of a scanner
    classes[40:50, 70:74] = C.VEHICLE
    classes[50, 5] = C.PERSON
    classes[:5, 40:50] = classes[20:30, :5] = classes[5:30, 98:] = C.POLE
    found = image_objects([seen(classes), seen(np.full((60, 100), UNLABELLED, np.uint8))])
    assert found.cls[4:].tolist() == [LEFT + C.POLE, RIGHT + C.POLE]  # of what the right and the left border cut
    found = whole(found)
    assert found.cls.tolist() == [C.VEHICLE, C.VEHICLE, C.PERSON, C.POLE]
    assert (found.frame == 0).all()
    middles = [[(200 * 39.5 + 16 * 52.5) / 216, (200 * 14.5 + 16 * 21.5) / 216], [71.5, 44.5], [5, 50], [44.5, 2]]
    uv = found.position[:, :2] / found.position[:, 2:] * 100 + COARSE.K[:2, 2]
    assert np.allclose(uv, middles)
    assert np.allclose(np.deg2rad(found.extent[:2]) * 100, [[25, 14], [4, 10]])
    small = Camera(COARSE.K * [[4], [4], [1]], 100, 60)  # a pixel is 0.02 square degrees
    assert C.PERSON not in image_objects([ClassView(small, classes, NO_POINTS, NO_LABELS)]).cls


def test_points_of_near_directions_are_an_object_whatever_their_distance() -> None:
    row = np.concatenate([patch(10, 0, 8), patch(12, 0, 30)])  # a car before another one: one region of an image
    behind = patch(180, -2, 12)  # on both sides of where the azimuth begins anew
    found = cloud_objects(
        [scanned((C.VEHICLE, row), (C.VEHICLE, patch(20, 0, 8)), (C.PERSON, behind), (C.SIGN, np.array([[9.0, -9, 0]])))]
    )
    assert found.cls.tolist() == [kind + c for c in (C.VEHICLE, C.VEHICLE, C.PERSON) for kind in (0, LEFT, RIGHT)]
    found = whole(found)
    azimuth = np.rad2deg(np.arctan2(found.position[:, 1], found.position[:, 0]))
    assert azimuth[:2] == pytest.approx([11, 20], abs=0.1)
    assert abs(azimuth[2]) == pytest.approx(180, abs=0.1)
    assert np.linalg.norm(found.position, axis=1) == pytest.approx([2 / (1 / 8 + 1 / 30), 8, 12], rel=1e-3)
    assert found.extent == pytest.approx(np.array([[4, 2], [2, 2], [2, 2]]), abs=0.05)


def test_neighbours_of_different_classes_are_different_objects() -> None:
    found = cloud_objects([scanned((C.VEHICLE, patch(0, 0, 9)), (C.POLE, patch(2, 0, 9)))])
    assert whole(found).cls.tolist() == [C.VEHICLE, C.POLE]
    nothing = cloud_objects([ClassView(COARSE, np.zeros((60, 100), np.uint8), NO_POINTS, NO_LABELS)])
    assert (len(nothing.cls), nothing.position.shape, nothing.extent.shape) == (0, (0, 3), (0, 2))
