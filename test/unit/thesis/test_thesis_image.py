"""Image preparation and edge operators of the thesis (3.2, 3.4.1, 3.4.2) against hand-made and library values."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from scipy import ndimage

from calib_ros.errors import BadInputError
from calib_ros.image.enhance import equalize, prepare, smooth, to_gray
from calib_ros_thesis.config import ThesisConfig
from calib_ros_thesis.image import OPERATORS, blend, edges, gradient_edges, gradients, magnitude, smoothed


def noise(seed: int = 0, shape: tuple[int, ...] = (40, 56), high: int = 256) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, high, shape, np.uint8)


def sobel(image: np.ndarray, full_step: float) -> np.ndarray:
    return edges(image, "sobel", full_step, 0.0, 0.0)


def canny(image: np.ndarray, full_step: float, low: float, high: float) -> np.ndarray:
    return edges(image, "canny", full_step, low, high)


def step(height: float, shape: tuple[int, int] = (12, 16), at: int = 8, dtype: type = np.uint8) -> np.ndarray:
    """Dark left of column `at`, `height` levels brighter from there on."""
    picture = np.full(shape, 20, dtype)
    picture[:, at:] += dtype(height)
    return picture


def test_a_4x4_picture_is_equalised_as_computed_by_hand():
    gray = np.array([[10, 10, 10, 10], [10, 10, 20, 20], [20, 20, 20, 30], [30, 30, 30, 200]], np.uint8)
    # H = 6, 5, 4, 1; CDF = 6, 11, 15, 16; 255 * CDF / 16 = 95.625, 175.3125, 239.0625, 255.
    expected = [[96, 96, 96, 96], [96, 96, 175, 175], [175, 175, 175, 239], [239, 239, 239, 255]]
    assert equalize(gray, "global").tolist() == expected
    # The darkest level is part of the distribution: 255 * 2 / 4 = 127.5, rounded to even; cv2.equalizeHist leaves it at 0.
    assert equalize(np.array([[0, 0], [255, 255]], np.uint8), "global").tolist() == [[128, 128], [255, 255]]
    for value in (0, 7, 255):
        assert (equalize(np.full((3, 5), value, np.uint8), "global") == 255).all()  # CDF is 1


@pytest.mark.parametrize(("method", "limit"), [("clahe", 3.5), ("adaptive", 0.0)])
@pytest.mark.parametrize("tiles", [1, 3, 8])
def test_clahe_is_opencvs_with_its_clip_limit_and_tiles(method, limit, tiles, monkeypatch):
    gray = noise(6, (48, 72), 128)
    monkeypatch.setattr("calib_ros.image.enhance.CLAHE_CLIP", 3.5)
    monkeypatch.setattr("calib_ros.image.enhance.CLAHE_TILES", tiles)
    expected, other = (cv2.createCLAHE(limit, (n, n)).apply(gray) for n in (tiles, tiles + 1))
    assert np.array_equal(equalize(gray, method), expected)
    assert not np.array_equal(other, expected)


@pytest.mark.parametrize("method", ["none", "global", "adaptive", "clahe"])
def test_colours_are_equalised_one_by_one(method):
    picture = np.dstack([noise(k, high=high) for k, high in enumerate((50, 120, 256))])
    alone = [equalize(picture[:, :, k].copy(), method) for k in range(3)]
    assert np.array_equal(equalize(picture, method), np.dstack(alone))


def test_preparing_equalises_grey_levels_not_colours():
    picture = np.dstack([noise(k, high=high) for k, high in enumerate((30, 120, 256))])
    grey = equalize(to_gray(picture))
    assert not np.array_equal(to_gray(equalize(picture)), grey)
    for image in (picture, to_gray(picture)):  # noise is filtered after the equalisation
        assert np.array_equal(prepare(image), smooth(grey))


@pytest.mark.parametrize(("diameter", "color", "space"), [(5, 40.0, 5.0), (7, 100.0, 2.0)])
def test_the_bilateral_filter_is_equation_3_5(diameter, color, space, monkeypatch):
    """The neighbourhood is the disc of the diameter, the picture mirrored at its border."""
    gray, radius = noise(8, (9, 11), 120), diameter // 2
    wide = np.pad(gray.astype(float), radius, mode="reflect")
    square = (np.mgrid[:diameter, :diameter] - radius) ** 2
    near, expected = square.sum(axis=0), np.empty(gray.shape)
    for y, x in np.ndindex(*gray.shape):
        values = wide[y : y + diameter, x : x + diameter]
        w = np.exp(-((values - gray[y, x]) ** 2) / (2 * color**2) - near / (2 * space**2)) * (near <= radius**2)
        expected[y, x] = (w * values).sum() / w.sum()
    for name, value in (("DIAMETER", diameter), ("COLOR", color), ("SPACE", space)):
        monkeypatch.setattr(f"calib_ros.image.enhance.BILATERAL_{name}", value)
    assert np.abs(smooth(gray) - expected).max() < 0.51
    assert np.abs(gray - expected).max() > 5


@pytest.mark.parametrize("sigma", [0.8, 1.0, 2.3])
def test_the_gaussian_filter_is_equations_3_6_and_3_7(sigma, monkeypatch):
    gray = noise(9)
    radius = round(3 * sigma)
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    kernel = np.exp(-(x**2 + y**2) / (2 * sigma**2)) / (2 * np.pi * sigma**2)
    kernel /= kernel.sum()  # the rest lies beyond three sigma
    expected = ndimage.convolve(gray.astype(float), kernel, mode="mirror")
    monkeypatch.setattr("calib_ros.image.enhance.GAUSSIAN_SIGMA", sigma)
    filtered = smooth(gray, "gaussian")
    assert np.abs(filtered - expected).max() < 2  # fixed point arithmetic
    assert np.abs(filtered - expected).mean() < 0.5


@pytest.mark.parametrize("dtype", [np.uint8, np.int16])
def test_gradients_are_the_kernels_of_equation_3_9(dtype):
    image = noise(10).astype(dtype)
    gx, gy = gradients(image)
    assert np.array_equal(gx, ndimage.sobel(image.astype(int), axis=1, mode="mirror"))
    assert np.array_equal(gy, ndimage.sobel(image.astype(int), axis=0, mode="mirror"))
    # At one pixel by hand.
    image = np.array([[1, 2, 3], [4, 5, 60], [7, 80, 9]], dtype)
    gx, gy = gradients(image)
    assert (gx[1, 1], gy[1, 1]) == ((3 + 2 * 60 + 9) - (1 + 2 * 4 + 7), (7 + 2 * 80 + 9) - (1 + 2 * 2 + 3))  # 116, 168
    assert magnitude(gx, gy)[1, 1] == pytest.approx(np.hypot(116, 168))
    assert sobel(image, 100.0)[1, 1] == pytest.approx(np.hypot(116, 168) / 400)


@pytest.mark.parametrize(("height", "strength"), [(25, 0.25), (50, 0.5), (100, 1.0), (200, 1.0)])
def test_a_step_counts_as_its_share_of_a_full_step_and_no_more_than_one(height, strength):
    found = sobel(step(height), 100.0)
    assert found[:, 7:9] == pytest.approx(np.full((12, 2), strength))
    assert not np.delete(found, [7, 8], axis=1).any()
    assert found.dtype == np.float32


def test_the_highest_level_does_not_overflow():
    high = np.zeros((8, 8), np.int16)
    high[:, 4:] = 8191
    assert gradients(high)[0][4].tolist() == [0, 0, 0, 32764, 32764, 0, 0, 0]
    corner = np.zeros((8, 8), np.int16)
    corner[4:, 4:] = 8191  # three of the four weights on one side of both gradients
    gx, gy = gradients(corner)
    assert magnitude(gx, gy)[4, 4] == pytest.approx(8191 * np.hypot(3, 3), rel=1e-6)
    assert canny(corner, 8191.0, 0.3, 0.6).any()


@pytest.mark.parametrize(("low", "high"), [(0.3, 0.6), (0.1, 0.9), (0.5, 0.5)])
def test_canny_is_opencvs_of_the_picture_itself(low, high):
    picture = np.full((60, 80), 90, np.uint8)  # the two treat the border differently, so it is flat
    picture[4:-4, 4:-4] = cv2.GaussianBlur(noise(11, (52, 72)), (0, 0), 1.5)
    full = 60.0
    expected = cv2.Canny(picture, 4 * full * low, 4 * full * high, apertureSize=3, L2gradient=True) / 255
    assert np.array_equal(canny(picture, full, low, high), expected)
    assert 0.01 < expected.mean() < 0.4


def test_the_detector_gives_each_operator_or_the_mean_of_both():
    image = cv2.GaussianBlur(noise(12), (0, 0), 1.0)
    full, low, high = 80.0, 0.2, 0.5
    by_sobel, by_canny = sobel(image, full), canny(image, full, low, high)
    assert by_canny.any()
    for operator, expected in (("sobel", by_sobel), ("canny", by_canny), ("mix", (by_sobel + by_canny) / 2)):
        found = edges(image, operator, full, low, high)
        assert found == pytest.approx(expected, abs=1e-6)
        assert found.dtype == np.float32
        # Neither the type nor where the picture lies in memory changes a bit.
        assert np.array_equal(edges(image.astype(np.int16), operator, full, low, high), found)
        for offset in range(1, 18, 4):
            moved = np.empty(image.size + offset, np.uint8)[offset:].reshape(image.shape)
            moved[:] = image
            assert np.array_equal(edges(moved, operator, full, low, high), found)


def two_steps(first: int, second: int) -> np.ndarray:
    """Edges of these heights at columns 20 and 40."""
    picture = np.full((30, 60), 10, np.uint8)
    picture[:, 20:] += np.uint8(first)
    picture[:, 40:] -= np.uint8(second)
    return picture


@pytest.mark.parametrize("height", [8, 40, 200])
def test_the_strongest_edge_of_a_dull_picture_is_a_full_one_too(height):
    config = ThesisConfig(operator="sobel")
    found = gradient_edges(two_steps(height, height // 2), config, 100.0)
    assert found[:, 19:21] == pytest.approx(np.ones((30, 2)))
    assert found[:, 39:41] == pytest.approx(np.full((30, 2), 0.5))
    assert np.count_nonzero(found) == 4 * 30
    # Two columns of 60 answer with the height, two with half of it: the 95th percentile is that of the weaker edge.
    found = gradient_edges(two_steps(height, height // 2), config, 95.0)
    assert found[:, 39:41] == pytest.approx(np.ones((30, 2)))
    assert found.max() == 1


def test_rounding_step_is_not_scaled_to_a_full_edge():
    found = gradient_edges(step(1), ThesisConfig(operator="mix"), 100.0)
    assert found.max() == pytest.approx(0.25)  # half a full edge for Sobel, none for Canny
    assert gradient_edges(step(2), ThesisConfig(operator="mix"), 100.0).max() == 1
    for value, operator in itertools.product((0, 128, 255), OPERATORS):  # a flat picture has no edges
        flat = gradient_edges(np.full((20, 30), value, np.uint8), ThesisConfig(operator=operator))
        assert flat.shape == (20, 30)
        assert not flat.any()


@pytest.mark.parametrize(("high", "there"), [(0.44, [True, True]), (0.46, [True, False]), (1.0, [False, False])])
def test_nothing_is_an_edge_to_canny_below_its_thresholds(high, there, monkeypatch):
    """Nothing is stronger than a full edge."""
    monkeypatch.setattr(ThesisConfig, "canny_high", high)
    found = gradient_edges(two_steps(100, 45), ThesisConfig(operator="canny"), 100.0)
    assert [bool(found[:, c : c + 2].any()) for c in (19, 39)] == there


def test_semantic_edges_are_blended_in_by_their_share():
    gradient, semantic = np.array([[0, 1], [0.5, 0.25]], np.float32), np.array([[1, 0], [0.5, 0.75]], np.float32)
    assert blend(gradient, semantic, 0.25) == pytest.approx(np.array([[0.25, 0.75], [0.5, 0.375]]))
    assert blend(gradient, semantic, 0.25).dtype == np.float32
    assert np.array_equal(blend(gradient, semantic, 0.0), gradient)
    assert np.array_equal(blend(gradient, semantic, 1.0), semantic)
    assert np.array_equal(blend(gradient, None, 0.9), gradient)  # without, the gradient keeps its full strength


@pytest.mark.parametrize("shape", [(3, 2), (2, 2), (2, 3, 1)])
def test_semantic_edges_of_another_picture_are_refused(shape):
    with pytest.raises(BadInputError, match="semantic edges are"):
        blend(np.zeros((2, 3), np.float32), np.zeros(shape, np.float32), 0.5)


@pytest.mark.parametrize("sigma", [0.5, 1.5, 4.0])
def test_smoothing_is_a_gaussian(sigma):
    edges = np.random.default_rng(15).random((50, 70)).astype(np.float32)
    assert smoothed(edges, sigma) == pytest.approx(ndimage.gaussian_filter(edges, sigma, mode="mirror", truncate=4.0), abs=2e-4)
    assert np.array_equal(smoothed(edges, 0.0), edges)
    assert np.array_equal(smoothed(edges, 1e7), smoothed(edges, 70.0))  # no wider than the picture
