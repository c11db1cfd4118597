"""Objects among classes: where they are, and which are left out."""

from __future__ import annotations

import numpy as np

from calib_ros.frame import UNLABELLED, SemanticClass
from calib_ros_semantics.first_guess.guess import cloud_objects, image_objects

C = SemanticClass


def ball(rng: np.random.Generator, centre: tuple[float, float, float], n: int = 60) -> np.ndarray:
    return (rng.uniform(-0.5, 0.5, (n, 3)) + centre).astype(np.float32)


def test_regions_have_their_centroid_unless_small_or_cut_by_the_border() -> None:
    classes = np.full((60, 100), C.GROUND, np.uint8)
    classes[10:20, 30:50] = C.VEHICLE
    classes[20:24, 50:54] = C.VEHICLE  # touches the first by a corner
    classes[40:50, 70:74] = C.VEHICLE
    classes[50:52, 5:7] = C.PERSON
    for border in (np.s_[5:30, 98:], np.s_[:5, 40:50], np.s_[55:, 40:50], np.s_[20:30, :5]):
        classes[border] = C.POLE
    cls, centroid = image_objects(classes, 10)
    assert cls.tolist() == [C.VEHICLE, C.VEHICLE]
    assert np.allclose(centroid, [[(200 * 39.5 + 16 * 51.5) / 216, (200 * 14.5 + 16 * 21.5) / 216], [71.5, 44.5]])
    assert image_objects(classes, 4)[0].tolist() == [C.VEHICLE, C.VEHICLE, C.PERSON]
    assert len(image_objects(np.full((20, 30), UNLABELLED, np.uint8), 1)[0]) == 0


def test_clusters_have_their_centroid_and_class_and_strays_are_none() -> None:
    rng = np.random.default_rng(0)
    parts = [ball(rng, (10, 0, 0)), ball(rng, (10, 5, 0), 40), ball(rng, (0, -8, 1)), np.array([[5, 9, 0]], np.float32)]
    xyz, label = np.concatenate(parts), np.repeat([C.VEHICLE, C.VEHICLE, C.PERSON, C.SIGN], [60, 40, 60, 1]).astype(np.uint8)
    cls, centroid = cloud_objects(xyz, label)
    assert cls.tolist() == [C.VEHICLE, C.VEHICLE, C.PERSON]
    assert np.allclose(centroid, [own.mean(axis=0) for own in parts[:3]], atol=1e-5)
    # Neighbours of different classes are different objects.
    assert sorted(cloud_objects(parts[0], np.repeat([C.VEHICLE, C.POLE], 30).astype(np.uint8))[0]) == [C.VEHICLE, C.POLE]
    empty, middles = cloud_objects(np.empty((0, 3), np.float32), np.empty(0, np.uint8))
    assert (len(empty), middles.shape) == (0, (0, 3))
