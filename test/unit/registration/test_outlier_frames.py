"""Outlier frames are found, named and left out; good frames never are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scenes import FAR, NEAR, Scene, assert_not_used

from calib_ros import se3
from calib_ros.frame import Frame
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import Result


def covered(frame: Frame, seed: int = 0, level: float = 90, noise: float = 6) -> np.ndarray:
    """What a camera sees behind a cap: grey, with the noise of its chip."""
    noisy = np.random.default_rng(seed).normal(level, noise, frame.image.shape)
    return np.asarray(np.clip(noisy, 0, 255), np.uint8)


def with_images(frames: Sequence[Frame], images: dict[int, np.ndarray]) -> list[Frame]:
    return [replace(f, image=images[k]) if k in images else f for k, f in enumerate(frames)]


def assert_left_out(result: Result, clean: Result, bad: Sequence[int], names: Sequence[str]) -> None:
    """The bad frames and no others; and the result is what it is without them."""
    assert result.converged, result.reason
    assert result.frames_left_out == tuple(names[k] for k in bad)
    assert result.frame_names == tuple(names)
    assert result.frames_used == len(names) - len(bad)
    assert np.flatnonzero(np.isnan(result.frame_scores)).tolist() == list(bad)
    assert f"matching no better than chance where the others match: {', '.join(names[k] for k in bad)};" in result.reason
    assert [f["name"] for f in result.to_dict()["frames"] if f["left_out"]] == [names[k] for k in bad]
    assert se3.rotation_error_deg(clean.T_camera_lidar, result.T_camera_lidar) < 0.1
    assert se3.translation_error_m(clean.T_camera_lidar, result.T_camera_lidar) < 0.02
    # Of the good frames the scores are as good as without the bad ones.
    good = np.delete(result.frame_scores, bad)
    assert good == pytest.approx(clean.frame_scores, abs=0.05)


@pytest.fixture(scope="module")
def eight() -> Scene:
    return Scene(1, 8, width=480, height=180)


@pytest.fixture(scope="module")
def other() -> Scene:
    return Scene(2, 2, width=480, height=180)


def estimate(
    scene: Scene, images: dict[int, np.ndarray], start: np.ndarray, box: SearchBox | None = None
) -> tuple[Result, Result]:
    """The result with the changed images, and the one without these frames."""
    frames = with_images(scene.frames, images)
    features = [scene.calibrator.extract(f) if k in images else scene.features[k] for k, f in enumerate(frames)]
    kept = [f for k, f in enumerate(scene.features) if k not in images]
    return scene.calibrator.estimate(features, start, box), scene.calibrator.estimate(kept, start, box)


@pytest.mark.parametrize(
    ("what", "box"),
    [*((what, None) for what in ("another scene", "another moment", "black", "mirrored", "two")), ("covered", SearchBox(5, 0.3))],
)
def test_outlier_frames_of_eight_are_named_and_left_out(eight, other, what, box):
    frames = eight.frames
    images = {
        "another scene": {3: other.frames[0].image},
        "another moment": {3: frames[6].image},
        "covered": {3: covered(frames[3])},
        "black": {3: np.zeros_like(frames[3].image)},
        "mirrored": {3: np.ascontiguousarray(frames[3].image[:, ::-1])},
        "two": {1: other.frames[1].image, 6: covered(frames[6], 1)},
    }[what]
    result, clean = estimate(eight, images, eight.off(NEAR if box is None else FAR), box)
    assert_left_out(result, clean, list(images), [f.name for f in frames])
    eight.assert_found(result)


def test_the_last_frame_can_be_the_outlier_and_is_named_by_its_number_without_a_name(eight, other):
    frames = [replace(f, name="") for f in with_images(eight.frames[:5], {4: other.frames[0].image})]
    result = eight.quick.calibrate(frames, eight.off(NEAR))
    assert result.frames_left_out == ("4",)
    assert result.frame_names == ("0", "1", "2", "3", "4")
    first = eight.quick.calibrate([replace(frames[4]), *frames[:4]], eight.off(NEAR))
    assert first.frames_left_out == ("0",)


@pytest.mark.parametrize(
    ("seed", "options"), [(7, {"rings": 16}), pytest.param(8, {"rings": 32, "speed": 5.0}, marks=pytest.mark.slow)]
)
def test_no_frame_of_a_clean_drive_is_left_out(seed, options):
    drive = Scene(seed, 5, **{"width": 480, "height": 180, **options})
    for by in (([0, 0, 0], [0, 0, 0]), NEAR):
        result = drive.calibrator.estimate(drive.features, drive.off(by))
        assert result.converged, result.reason
        assert result.frames_left_out == ()
        assert np.isfinite(result.frame_scores).all()


def test_shuffled_images_are_refused_without_naming_outliers(eight):
    frames = [replace(f, image=eight.frames[(k + 4) % 8].image) for k, f in enumerate(eight.frames)]
    result = eight.quick.calibrate(frames, eight.off(NEAR))
    assert_not_used(result, eight.off(NEAR))
    assert result.frames_left_out == ()
    assert result.frames_used == 8


def test_three_frames_are_too_few_to_find_an_outlier(eight, other):
    frames = with_images(eight.frames[:3], {1: other.frames[0].image})
    assert eight.quick.calibrate(frames, eight.off(NEAR)).frames_left_out == ()
