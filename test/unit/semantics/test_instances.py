"""Objects among classes: where they are, and which are left out."""

from __future__ import annotations

import numpy as np
import pytest

from calib_ros.camera import Camera
from calib_ros.frame import UNLABELLED, SemanticClass
from calib_ros_semantics.first_guess.centroids import LEFT, RIGHT, Objects, cloud_objects, image_objects
from calib_ros_semantics.first_guess.view import ClassView

C = SemanticClass
CAMERA = Camera(np.array([[100.0, 0, 49.5], [0, 100, 29.5], [0, 0, 1]]), 100, 60)  # 0.57 deg a pixel
NO_POINTS, NO_LABELS = np.empty((0, 3), np.float32), np.empty(0, np.uint8)


def seen(classes: np.ndarray) -> ClassView:
    return ClassView(CAMERA, classes, NO_POINTS, NO_LABELS)


def scanned(*parts: tuple[SemanticClass, np.ndarray]) -> ClassView:
    xyz = np.concatenate([points for _, points in parts]).astype(np.float32)
    label = np.concatenate([np.full(len(points), c, np.uint8) for c, points in parts])
    return ClassView(CAMERA, np.full((60, 100), UNLABELLED, np.uint8), xyz, label)


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
    uv = found.position[:, :2] / found.position[:, 2:] * 100 + CAMERA.K[:2, 2]
    assert np.allclose(uv, middles)
    assert np.allclose(np.deg2rad(found.extent[:2]) * 100, [[25, 14], [4, 10]])
    small = Camera(CAMERA.K * [[4], [4], [1]], 100, 60)  # a pixel is 0.02 square degrees
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
    nothing = cloud_objects([ClassView(CAMERA, np.zeros((60, 100), np.uint8), NO_POINTS, NO_LABELS)])
    assert (len(nothing.cls), nothing.position.shape, nothing.extent.shape) == (0, (0, 3), (0, 2))
