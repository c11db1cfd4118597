"""Pixels that are not used: given by a picture or by boxes, and without edges, nor one along their border."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import GROUND, Plane, Spinner

from calib_ros.camera import Camera
from calib_ros.config import Config, ImageConfig
from calib_ros.errors import BadInputError, ConfigError
from calib_ros.frame import Frame
from calib_ros.image.edges import edge_levels
from calib_ros.image.mask import filled, used_pixels, without_border
from calib_ros.registration.features import FeatureExtractor

BONNET = (0.0, 0.75, 1.0, 1.0)  # the lower quarter of the picture


def picture(shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    """Evenly textured: without a mask, no place has more edges than another."""
    cells = np.random.default_rng(4).integers(100, 130, (shape[0] // 4 + 1, shape[1] // 4 + 1)).astype(np.uint8)
    return np.ascontiguousarray(np.kron(cells, np.ones((4, 4), np.uint8))[: shape[0], : shape[1]])


def with_bonnet(image: np.ndarray) -> np.ndarray:
    """The image with a bright, smooth lower quarter, whose outline is its strongest edge."""
    out = image.copy()
    out[3 * len(out) // 4 :] = 255
    return out


def written(path: Path, mask: np.ndarray) -> str:
    cv2.imwrite(str(path), mask)
    return str(path)


def test_a_picture_says_which_pixels_are_used(tmp_path):
    assert used_pixels(ImageConfig(), 320, 240) is None
    mask = np.full((240, 320), 255, np.uint8)
    mask[200:, 40:90] = 0
    for name, stored in {
        "grey.png": mask,
        "colour.png": np.dstack([0 * mask, mask, 0 * mask]),
        "clear.png": np.dstack([mask] * 3 + [0 * mask + 255]),
        "labels.png": mask // 255,
        "deep.png": mask.astype(np.uint16) * 200,
        "lossy.jpg": mask,
    }.items():
        used = used_pixels(ImageConfig(mask=written(tmp_path / name, stored)), 320, 240)
        assert np.mean(used != (mask > 0)) < (0.002 if name == "lossy.jpg" else 1e-9), name


def test_boxes_are_shares_of_the_picture():
    used = used_pixels(ImageConfig(ignored_boxes=(*BONNET, 0.0, 0.0, 0.1, 0.5)), 320, 240)
    expected = np.ones((240, 320), bool)
    expected[180:] = expected[:120, :32] = False
    assert np.array_equal(used, expected)
    for boxes in ((0.0, 0.5, 1.0), (0.5, 0.5, 0.5, 1.0), (0.0, 0.9, 1.0, 0.5), (0.1, 0.1, 0.2, 0.2, 0.0, 0.0, 1.0, 0.0)):
        with pytest.raises(ConfigError, match="ignored_boxes"):
            Config(image=ImageConfig(ignored_boxes=boxes))


def test_a_mask_that_does_not_fit_says_what_to_do(tmp_path):
    small = written(tmp_path / "small.png", np.full((120, 160), 255, np.uint8))
    black = written(tmp_path / "black.png", np.zeros((240, 320), np.uint8))
    (tmp_path / "cut.png").write_bytes(Path(small).read_bytes()[:60])
    for mask, says in (
        (small, "small.png is 160x120, the camera's image is 320x240; draw it"),
        (black, "leave 0.0 % of the image; in the mask"),
        (str(tmp_path / "cut.png"), "is no complete PNG"),
        (str(tmp_path / "none.png"), "cannot read image.mask .*none.png: No such file"),
        (str(tmp_path), "Is a directory"),
    ):
        with pytest.raises(BadInputError, match=says):
            used_pixels(ImageConfig(mask=mask), 320, 240)


def test_the_outline_of_what_is_not_used_is_no_edge(monkeypatch):
    """What is not used neither shows nor moves the scale of the rest; only equalisation sees it, tile by tile."""
    monkeypatch.setattr("calib_ros.image.enhance.equalize", lambda gray: gray)
    image, config = picture(), ImageConfig(ignored_boxes=BONNET)
    used = used_pixels(config, 320, 240)
    plain = edge_levels(with_bonnet(image), 720.0)
    masked, other = (edge_levels(given, 720.0, used=used) for given in (with_bonnet(image), image))
    for before, after, same in zip(plain, masked, other, strict=True):
        border = slice(180 // after.scale - 1, 180 // after.scale + 1)
        if after.scale <= 2:
            assert before.maps[1][border].mean() > 1.0, before.scale
        assert abs(after.maps[1][border].mean()) < 0.7, after.scale
        assert np.array_equal(after.maps, same.maps)


def test_unused_pixels_get_the_mean_around_them():
    x = np.tile(np.linspace(0.2, 0.8, 320, dtype=np.float32), (240, 1))
    used = np.ones((240, 320), bool)
    used[100:140, 150:190] = False
    out = filled(x, used)
    assert np.array_equal(out[used], x[used])
    assert np.abs(out - x).max() < 0.05
    assert not filled(x, np.zeros_like(used)).any()
    # And nothing is left of those near the border of the mask, but the picture's own border is none.
    used = np.ones((20, 30), bool)
    used[:, 10] = False
    kept = without_border(used, 3)
    assert np.array_equal(np.flatnonzero(~kept[5]), np.arange(7, 14))
    assert kept[:, 0].all()


def test_the_mask_is_rectified_and_shrunk_with_the_picture():
    lens = Camera(np.array([[400.0, 0, 318], [0, 400, 243], [0, 0, 1]]), 640, 480, "plumb_bob", np.array([-0.2, 0.05, 0, 0]))
    frame = Frame(picture((480, 640)), Spinner().scan([GROUND, Plane((1, 0, 0), 12)]), lens)
    config = Config(image=ImageConfig(ignored_boxes=(0.0, 0.5, 1.0, 1.0), max_width=320))
    extract = FeatureExtractor(frame.camera, config)
    assert extract.used.shape == (extract.camera.height, extract.camera.width)
    middle = extract.used[:, extract.camera.width // 2]
    expected = (0.5 * frame.camera.height - frame.camera.K[1, 2]) / frame.camera.K[1, 1] * extract.camera.K[1, 1]
    assert np.argmin(middle) == pytest.approx(expected + extract.camera.K[1, 2], abs=2)
    below = extract(frame).levels[-1].maps[:, extract.camera.height // 2 + 20 :]
    above = extract(frame).levels[-1].maps[:, : extract.camera.height // 2 - 20]
    assert below.std() < 0.3 * above.std()
