"""Edge maps of pictures whose edges are known."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from calib_ros.image.edges import (
    LARGEST,
    MIN_MAGNITUDE,
    EdgeLevel,
    blurred_levels,
    edge_levels,
    oriented_edges,
    smallest_magnitude,
)
from calib_ros.image.enhance import prepare, to_gray

FOCAL = 720.0


def half_plane(angle_deg: float, offset: float = 0.0, shape: tuple[int, int] = (240, 320), width: float = 1.0) -> np.ndarray:
    """Dark and bright halves; the gradient points along `angle_deg` (0 = right, 90 = down) and the border passes `offset` px
    right of, or below, the middle. The brightness rises over `width` px."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    a = np.deg2rad(angle_deg)
    d = (x - (shape[1] - 1) / 2) * np.cos(a) + (y - (shape[0] - 1) / 2) * np.sin(a) - offset
    return np.round(60 + 120 * np.clip(d / width + 0.5, 0, 1)).astype(np.uint8)


def texture(seed: int = 0, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


def blocks(seed: int = 0, shape: tuple[int, int] = (240, 320), size: int = 5) -> np.ndarray:
    cells = np.random.default_rng(seed).integers(0, 256, (shape[0] // size + 1, shape[1] // size + 1)).astype(np.uint8)
    return np.ascontiguousarray(np.kron(cells, np.ones((size, size), np.uint8))[: shape[0], : shape[1]])


def full_size(level: EdgeLevel, axis: int) -> np.ndarray:
    """Full-size pixel of each column (axis 1) or row (axis 0) of a level."""
    n = level.maps.shape[1 + axis]
    return (np.arange(n) + 0.5) * level.scale - 0.5


@pytest.mark.parametrize("angle", [0, 20, 45, 70, 90, 110, 160, 180, 250, 270])
def test_an_edge_is_shared_out_by_its_direction(angle):
    """One along the columns or rows shows in the map of its gradient alone."""
    horizontal, vertical = (m[20:-20, 20:-20] for m in oriented_edges(half_plane(angle, width=10)))
    share = horizontal.sum() / (horizontal.sum() + vertical.sum())
    assert share == pytest.approx(np.cos(np.deg2rad(angle)) ** 2, abs=0.02)
    if angle % 90 == 0:
        maps = oriented_edges(half_plane(angle))
        own = angle // 90 % 2
        assert maps[own].max() > 0.9
        assert maps[1 - own].max() < 1e-4


def test_strengths_lie_between_nothing_and_a_full_edge():
    horizontal, vertical = oriented_edges(blocks())
    total = horizontal + vertical
    assert (horizontal >= 0).all()
    assert (vertical >= -1e-6).all()
    assert total.max() == pytest.approx(1)
    # Above the percentile an edge is full, or half if it is no ridge.
    full = np.isclose(total, 1) | np.isclose(total, 0.5)
    assert full.mean() == pytest.approx(0.03, abs=0.01)


def noisy(image: np.ndarray, sigma: float) -> np.ndarray:
    noise = np.random.default_rng(5).normal(0, sigma, image.shape)
    return np.clip(image + noise, 0, 255).round().astype(np.uint8)


@pytest.mark.parametrize("sigma", [3.0, 8.0, 15.0])
def test_noise_is_no_edge_and_edges_stand_out_of_it(sigma):
    """The limit follows the noise: about two pixels in a hundred of a flat picture pass, whatever its strength."""
    flat = sum(oriented_edges(noisy(np.full((240, 320), 120, np.uint8), sigma)))
    assert (flat > 0).mean() == pytest.approx(0.02, abs=0.01)
    step = sum(oriented_edges(noisy(half_plane(0), sigma)))
    assert (step[:, 159:161] > 0).mean() > 0.95
    assert (np.delete(step, np.s_[157:163], axis=1) > 0).mean() < 0.03


def test_what_is_everywhere_is_not_taken_for_noise_where_some_of_the_picture_is_flat():
    """Leaves on two thirds of a picture, a road on the rest."""
    leaves = blocks(size=3)
    leaves[160:] = 120
    found = sum(oriented_edges(noisy(leaves, 3.0)))
    assert (found[:150] > 0).mean() > 0.6
    assert (found[170:] > 0).mean() < 0.03


def test_the_limit_of_a_clean_picture_is_its_rounding():
    for image in (blocks(size=20), np.zeros((240, 320), np.uint8), half_plane(30), np.full((5, 7), 9, np.uint8)):
        gx, gy = (cv2.Sobel(image, cv2.CV_32F, *d) for d in ((1, 0), (0, 1)))
        assert smallest_magnitude(np.hypot(gx, gy)) == MIN_MAGNITUDE


@pytest.mark.parametrize("axis", [1, 0], ids=["vertical line", "horizontal line"])
def test_ridge_of_a_soft_edge_exceeds_its_flanks(axis, monkeypatch):
    """Its gradient falls by a few per cent to the next pixel, the edge strength by half."""
    x = np.arange(160)
    row = np.round(40 + 180 / (1 + np.exp(-(x - 80.0) / 3))).astype(np.uint8)  # steepest at pixel 80
    picture = np.tile(row, (160, 1)) if axis else np.tile(row[:, None], (1, 160))
    monkeypatch.setattr("calib_ros.image.edges.GRADIENT_PERCENTILE", 100.0)
    profile = oriented_edges(picture)[1 - axis][80] if axis else oriented_edges(picture)[1][:, 80]
    assert profile.argmax() == 80
    assert profile[80] == pytest.approx(1, abs=0.01)
    assert profile[[78, 79, 81, 82]] == pytest.approx(0.47, abs=0.04)


@pytest.mark.parametrize(
    ("focal", "scales", "blurs"),
    [
        (720, [8, 4, 2, 1, 1], [16, 8, 4, 2, 1.2]),
        (1440, [16, 8, 4, 2, 1], [32, 16, 8, 4, 2.4]),
        (700, [8, 4, 2, 1, 1], [s * 700 / 720 for s in (16, 8, 4, 2, 1.2)]),  # nearly the same focal length, the same sizes
        (740, [8, 4, 2, 1, 1], [s * 740 / 720 for s in (16, 8, 4, 2, 1.2)]),
        (360, [4, 2, 1, 1, 1], [8, 4, 2, 1, 0.8]),
        (100, [1, 1, 1, 1, 1], [16 / 7.2, 8 / 7.2, 0.8, 0.8, 0.8]),
    ],
)
def test_the_blur_is_an_angle_and_sets_the_size(focal, scales, blurs):
    levels = edge_levels(texture(), focal)
    assert [level.scale for level in levels] == scales
    assert [level.sigma for level in levels] == pytest.approx(blurs)
    assert [level.maps.shape for level in levels] == [(2, 240 // s, 320 // s) for s in scales]


def test_no_level_is_sharper_than_what_meets_it_is_placed():
    levels = edge_levels(texture(), 720, least=2.5 / 720)
    assert [level.sigma for level in levels] == pytest.approx([16, 8, 4, 2.5, 2.5])
    assert [level.scale for level in levels] == [8, 4, 2, 1, 1]
    assert edge_levels(texture(), 1e9, least=0.01)[-1].sigma <= 320  # no wider than the picture, whatever the focal length


def test_maps_are_standardised():
    for shape in ((240, 320), (239, 317), (61, 83), (50, 400)):
        for level in edge_levels(texture(shape=shape), FOCAL):
            assert level.maps.dtype == np.float32
            assert level.maps.mean(axis=(1, 2)) == pytest.approx([0, 0], abs=1e-3)
            assert level.maps.std(axis=(1, 2)) == pytest.approx([1, 1], abs=1e-3)


def without_local_contrast(picture: np.ndarray, focal: float) -> list[EdgeLevel]:
    return blurred_levels(oriented_edges(prepare(picture)), focal)


@pytest.mark.parametrize("axis", [1, 0], ids=["vertical line", "horizontal line"])
def test_no_level_is_off_by_half_a_pixel(axis):
    """The centre of the blurred edge is the edge. Single ones snap to the middle of their cell, but not to one side."""
    errors = np.zeros((16, 5))
    for k, offset in enumerate(range(-8, 8)):
        for j, level in enumerate(without_local_contrast(half_plane(0 if axis else 90, offset), FOCAL)):
            profile = level.maps[1 - axis].astype(float).mean(axis=1 - axis)
            profile -= profile.min()
            place = (profile * full_size(level, axis)).sum() / profile.sum()
            errors[k, j] = place - (((240, 320)[axis] - 1) / 2 + offset)
    assert np.abs(errors).max(axis=0) == pytest.approx([3, 1, 0, 0, 0], abs=0.05)
    assert errors.mean(axis=0) == pytest.approx([0] * 5, abs=0.05)


@pytest.mark.parametrize("focal", [720, 1440])
def test_the_blur_is_as_wide_as_it_says(focal):
    """A step answers as a bell whose variance is the blur's, and that of the edge, which is two pixels wide."""
    variance = np.zeros((16, 5))
    for k, offset in enumerate(range(-8, 8)):
        for j, level in enumerate(without_local_contrast(half_plane(0, offset, (80, 640)), focal)):
            profile = level.maps[0].astype(float).mean(axis=0)
            profile -= np.median(profile)
            profile[profile < 1e-4 * profile.max()] = 0
            distance = full_size(level, 1) - (319.5 + offset)
            variance[k, j] = (profile * distance**2).sum() / profile.sum()
    expected = np.array([16, 8, 4, 2, 1.2]) ** 2 * (focal / 720) ** 2 + 0.25
    assert variance.mean(axis=0) == pytest.approx(expected, rel=0.005)


def test_a_colour_picture_of_grey_is_a_grey_picture_and_one_without_contrast_has_no_edges():
    for value, shape in itertools.product((0, 128, 255), ((120, 160), (120, 160, 3))):
        assert not any(level.maps.any() for level in edge_levels(np.full(shape, value, np.uint8), FOCAL))
    grey = texture()
    first, again, colour = (edge_levels(picture, FOCAL) for picture in (grey, grey, np.dstack([grey] * 3)))
    for a, b, c in zip(first, again, colour, strict=True):
        assert np.array_equal(a.maps, b.maps)
        assert np.abs(a.maps - c.maps).max() < 0.05
    blue_green_red = np.eye(3, dtype=np.uint8)[None] * 255
    assert to_gray(blue_green_red).tolist() == [[29, 150, 76]]


def test_maps_are_kept_as_whole_numbers_that_end_at_a_limit() -> None:
    maps = np.array([[[0.5, -1.25], [1000.0, -1000.0]]], np.float32)
    level = EdgeLevel.of(maps, 1, 2.0)
    assert level.packed.dtype == np.int16
    assert level.maps.tolist() == [[[0.5, -1.25], [LARGEST, -LARGEST]]]
    one_edge = np.zeros((200, 300), np.float32)
    one_edge[100, 150] = 1.0  # far more than LARGEST deviations
    (level,) = blurred_levels((one_edge, one_edge), 721.0, (1.2,))
    assert level.maps.max() == pytest.approx(64, abs=0.01)
    assert level.maps.min() > -1
