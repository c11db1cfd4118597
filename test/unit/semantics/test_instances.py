"""Objects among classes: where they are, how large, and which are cut."""

from __future__ import annotations

import numpy as np

from calib_ros.frame import UNLABELLED, SemanticClass
from calib_ros_semantics.models.instances import cloud_instances, image_instances

C = SemanticClass


def picture() -> np.ndarray:
    classes = np.full((60, 100), C.GROUND, np.uint8)
    classes[10:20, 30:50] = C.VEHICLE
    classes[20:24, 50:54] = C.VEHICLE  # touches the first by a corner
    classes[40:50, 70:74] = C.VEHICLE
    classes[5:30, 98:100] = C.POLE
    classes[50:52, 5:7] = C.PERSON
    return classes


def ball(rng: np.random.Generator, centre: tuple[float, float, float], n: int = 60) -> np.ndarray:
    return (rng.uniform(-0.5, 0.5, (n, 3)) + centre).astype(np.float32)


def test_regions_have_their_centroid_area_and_box() -> None:
    found = image_instances(picture(), 10)
    assert found.cls.tolist() == [C.VEHICLE, C.VEHICLE, C.POLE]
    assert found.area.tolist() == [216, 40, 50]
    assert found.box.tolist() == [[30, 10, 24, 14], [70, 40, 4, 10], [98, 5, 2, 25]]
    assert np.allclose(found.centroid[1], [71.5, 44.5])
    assert np.allclose(found.centroid[0], [(200 * 39.5 + 16 * 51.5) / 216, (200 * 14.5 + 16 * 21.5) / 216])
    assert found.cut.tolist() == [False, False, True]


def test_regions_at_the_border_are_cut() -> None:
    for rows, columns in ((slice(0, 5), slice(40, 50)), (slice(55, 60), slice(40, 50)), (slice(20, 30), slice(0, 5))):
        classes = np.zeros((60, 100), np.uint8)
        classes[rows, columns] = C.PERSON
        assert image_instances(classes, 10).cut.tolist() == [True]


def test_small_regions_and_other_classes_are_left_out() -> None:
    assert len(image_instances(picture(), 4)) == 4
    assert image_instances(picture(), 4, [C.PERSON]).area.tolist() == [4]
    assert image_instances(picture(), 10, [C.GROUND]).area.tolist() == [6000 - 216 - 40 - 50 - 4]


def test_clusters_have_their_centroid_and_class() -> None:
    rng = np.random.default_rng(0)
    parts = [ball(rng, (10, 0, 0)), ball(rng, (10, 5, 0), 40), ball(rng, (0, -8, 1))]
    xyz, label = np.concatenate(parts), np.repeat([C.VEHICLE, C.VEHICLE, C.PERSON], [60, 40, 60]).astype(np.uint8)
    found = cloud_instances(xyz, label)
    assert found.cls.tolist() == [C.VEHICLE, C.VEHICLE, C.PERSON]
    assert found.points.tolist() == [60, 40, 60]
    for centroid, own in zip(found.centroid, parts, strict=True):
        assert np.allclose(centroid, own.mean(axis=0), atol=1e-5)


def test_neighbours_of_different_classes_are_different_objects_and_strays_are_none() -> None:
    xyz = ball(np.random.default_rng(0), (10, 0, 0))
    label = np.where(np.arange(60) < 30, C.VEHICLE, C.POLE).astype(np.uint8)
    assert cloud_instances(xyz, label).points.tolist() == [30, 30]
    strays = np.array([[5, 0, 0], [5, 5, 0], [-9, 0, 0]], np.float32)
    assert len(cloud_instances(strays, np.full(3, C.SIGN, np.uint8))) == 0


def test_nothing_labelled_holds_no_objects() -> None:
    assert len(image_instances(np.full((20, 30), UNLABELLED, np.uint8), 1)) == 0
    empty = cloud_instances(np.empty((0, 3), np.float32), np.empty(0, np.uint8))
    assert (len(empty), empty.centroid.shape, empty.points.shape) == (0, (0, 3), (0,))
