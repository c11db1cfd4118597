"""Blind and frozen sensors."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from calib_ros.camera import Camera
from calib_ros.config import MonitorConfig
from calib_ros.frame import Frame, PointCloud
from calib_ros.online.sensor_health import ACCUSTOMED, HISTORY, MIN_HISTORY, SensorHealth

SHAPE = (240, 320)


def street(seed: int = 0, contrast: float = 60.0, shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    """Blocks of 20 px, as of houses and cars, and a little noise."""
    rng = np.random.default_rng(seed)
    rows, columns = -(-shape[0] // 20), -(-shape[1] // 20)
    blocks = np.kron(rng.normal(0, contrast / 2, (rows, columns)), np.ones((20, 20)))[: shape[0], : shape[1]]
    grey = 110 + blocks + rng.normal(0, 2, shape[:2])
    image = grey if len(shape) == 2 else np.dstack([grey, grey + 5, grey - 5])
    return image.clip(0, 255).astype(np.uint8)


def scan(seed: int = 0, n: int = 2000) -> PointCloud:
    return PointCloud(np.random.default_rng(seed).uniform(2, 40, (n, 3)).astype(np.float32))


def frame(image: np.ndarray, cloud: PointCloud | None = None, k: int = 0) -> Frame:
    height, width = image.shape[:2]
    camera = Camera(np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]), width, height)
    return Frame(image, scan(k) if cloud is None else cloud, camera, k)


def watched(config: MonitorConfig | None = None, frames: int = 10, shape: tuple[int, ...] = SHAPE) -> SensorHealth:
    """It knows what is usual here."""
    watch = SensorHealth(config or MonitorConfig())
    assert [check(watch, frame(street(k, shape=shape), k=k)) for k in range(frames)] == [""] * frames
    return watch


def check(watch: SensorHealth, frame: Frame) -> str:
    """The message of the problem; "" if there is none."""
    problem = watch.check(frame)
    return "" if problem is None else problem.message


def dark(seed: int = 0, noise: float = 4.0) -> np.ndarray:
    return np.abs(np.random.default_rng(seed).normal(3, noise, SHAPE)).astype(np.uint8)


# --- the camera -----------------------------------------------------------------------------------------------------------


def test_an_image_that_shows_nothing():
    for first, image in itertools.product(
        (True, False),
        (
            np.zeros(SHAPE, np.uint8),
            np.full(SHAPE, 255, np.uint8),
            np.full((*SHAPE, 3), 255, np.uint8),
            dark(),
            np.full(SHAPE, 90, np.uint8),
        ),
    ):
        watch = SensorHealth(MonitorConfig()) if first else watched()
        problem = check(watch, frame(image, k=99))
        assert problem.startswith("the camera shows nothing (contrast ")
        assert ("usually" in problem) != first
        assert problem.endswith("a covered lens, no light, or overexposed")
        assert check(watch, frame(street(50), k=100)) == ""


@pytest.mark.parametrize("k", range(3))
def test_the_reason_of_a_black_image_stays_the_lens(k):
    """Black images do not change either, and no driver has to be restarted."""
    watch = watched()
    problems = [check(watch, frame(np.full(SHAPE, (0, 255, 90)[k], np.uint8), k=20 + j)) for j in range(12)]
    assert all("a covered lens" in p for p in problems)


def test_an_image_with_a_small_share_of_the_usual_contrast():
    """Mud on the lens: hardly more than a quarter of the contrast is seen, and hardly less is not."""

    def through_mud(share: float) -> str:
        return check(watched(), frame(street(77, 60 * share), k=99))

    assert "the camera shows nothing" in through_mud(0.15)
    assert through_mud(0.5) == ""
    unlearned = watched(frames=MIN_HISTORY - 1)
    assert check(unlearned, frame(street(77, 60 * 0.15), k=99)) == ""


def test_dusk_is_not_reported_as_blind():
    """From full contrast to an eighth, a third of a percent from frame to frame: dusk never falls as fast."""
    watch = watched()
    contrast, k = 60.0, 20
    while contrast > 8:
        contrast *= 0.99
        for _ in range(3):
            k += 1
            assert check(watch, frame(street(k, contrast), k=k)) == "", contrast
    assert k > HISTORY
    assert "usually" in check(watch, frame(dark(), k=k + 1))


def test_blind_frames_do_not_update_the_baseline_contrast():
    watch = watched()
    for k in range(3 * HISTORY):
        assert "a covered lens" in check(watch, frame(dark(k), k=100 + k))
    assert check(watch, frame(street(3), k=999)) == ""


def test_colour_and_grey_images_of_any_size_are_watched_alike():
    for shape, colour in itertools.product(((480, 640), (180, 240), (60, 80)), (False, True)):
        shape = (*shape, 3) if colour else shape
        watch = watched(shape=shape)
        assert "the camera shows nothing" in check(watch, frame(np.zeros(shape, np.uint8), k=50))
        assert check(watch, frame(street(60, shape=shape), k=60)) == ""


def test_tiny_images_are_no_error():
    for shape in ((1, 1), (1, 9), (7, 3), (2, 2, 3), (8, 8), (9, 17, 3)):
        watch = SensorHealth(MonitorConfig())
        rng = np.random.default_rng(0)
        for k in range(8):
            assert isinstance(check(watch, frame(rng.integers(0, 256, shape).astype(np.uint8), k=k)), str)
        assert "the camera shows nothing" in check(watch, frame(np.zeros(shape, np.uint8), k=9))


def test_changed_image_size_or_colours_restart_the_check():
    watch = watched()
    for shape in ((120, 160), (120, 160, 3), SHAPE):
        assert check(watch, frame(street(30, shape=shape), k=30)) == ""


# --- frozen ---------------------------------------------------------------------------------------------------------------


def test_a_frozen_image():
    """The image stays, the scans do not: from the fifth repetition on, until it changes."""
    watch = watched()
    still = street(40)
    problems = [check(watch, frame(still.copy(), k=40 + k)) for k in range(8)]
    assert problems[:5] == [""] * 5
    assert problems[5] == "the image has not changed for 5 frames while the scans do: restart the camera driver"
    assert "for 7 frames" in problems[7]
    assert check(watch, frame(street(41), k=60)) == ""
    assert check(watch, frame(street(41), k=61)) == ""


def test_one_changed_pixel_is_not_frozen():
    """A good camera at rest in good light: every image is nearly the last, and alive."""
    watch = watched()
    still = street(40)
    for k in range(20):
        alive = still.copy()
        alive[k, 5] ^= 1
        assert check(watch, frame(alive, k=40 + k)) == ""


def test_simulation_at_rest_is_not_frozen():
    watch = watched()
    still, cloud = street(40), scan(40)
    for k in range(20):
        assert check(watch, frame(still.copy(), PointCloud(cloud.xyz.copy()), k)) == ""
    # With lost returns, which are NaN and equal nothing.
    holes = scan(41)
    holes.xyz[::7] = np.nan
    for k in range(20):
        assert check(watch, frame(still.copy(), PointCloud(holes.xyz.copy()), k)) == ""


def test_number_of_frozen_images_is_configurable():
    still = street(40)
    for config, expected in ((MonitorConfig(frozen_images=2), 2), (MonitorConfig(frozen_images=0), None)):
        watch = watched(config)
        problems = [check(watch, frame(still.copy(), k=40 + k)) for k in range(10)]
        assert next((k for k, p in enumerate(problems) if p), None) == expected


# --- the scanner ----------------------------------------------------------------------------------------------------------


def test_few_returns():
    watch = watched()
    said = check(watch, frame(street(40), scan(40, 300), 40))
    assert said == "the LiDAR shows nothing (300 returns, usually 2000): a covered or failing scanner"
    assert check(watch, frame(street(41), scan(41, 500), 41)) == ""  # an open field
    # Where no more is usual, and where nothing is known yet.
    watch = SensorHealth(MonitorConfig())
    assert [check(watch, frame(street(k), scan(k, 300), k)) for k in range(9)] == [""] * 9


@pytest.mark.parametrize("kind", ["empty", "nan", "zero"])
def test_no_return_at_all(kind):
    """Drivers leave lost returns out, or mark them by NaN or by the sensor's own place."""
    cloud = {
        "empty": PointCloud(np.zeros((0, 3), np.float32)),
        "nan": PointCloud(np.full((2000, 3), np.nan, np.float32)),
        "zero": PointCloud(np.zeros((2000, 3), np.float32)),
    }[kind]
    for watch in (SensorHealth(MonitorConfig()), watched()):
        said = check(watch, frame(street(40), cloud, 40))
        assert said.startswith("the LiDAR shows nothing (0 returns, usually")
        assert check(watch, frame(street(41), k=41)) == ""


def test_camera_is_named_first_when_both_sensors_are_blind():
    said = check(watched(), frame(dark(), PointCloud(np.zeros((0, 3), np.float32)), 40))
    assert said.startswith("the camera")


def test_new_configuration_takes_effect_at_once():
    watch, still = watched(), street(40)
    watch.config = MonitorConfig(frozen_images=2)
    problems = [check(watch, frame(still.copy(), k=40 + k)) for k in range(3)]
    assert [bool(p) for p in problems] == [False, False, True]


def test_health_check_adapts_to_a_garage_and_an_open_field():
    """Little contrast and few returns for half a minute are what is usual; a black picture is never."""
    watch = SensorHealth(MonitorConfig())
    rng = np.random.default_rng(0)
    street = rng.integers(0, 256, (24, 32, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    garage = (street // 8 + 20).astype(np.uint8)
    camera = Camera(np.array([[200.0, 0, 128], [0, 200, 96], [0, 0, 1]]), 256, 192)
    cloud = PointCloud(rng.uniform(2, 30, (4000, 3)).astype(np.float32))
    few = cloud.select(np.arange(300))

    def seen(image, points, k):
        image = image.copy()
        image[0, k % 256] ^= 1  # else it were frozen
        return check(watch, Frame(image, points.select(rng.permutation(len(points))), camera, k))

    assert not any(seen(street, cloud, k) for k in range(20))
    answers = [seen(garage, cloud, k) for k in range(ACCUSTOMED + 20)]
    assert all(answers[: ACCUSTOMED - 10])
    assert not any(answers[ACCUSTOMED + 1 :])
    answers = [seen(street, few, k) for k in range(ACCUSTOMED + 20)]
    assert all(answers[: ACCUSTOMED - 10])
    assert not any(answers[ACCUSTOMED + 1 :])
    assert all(seen(np.zeros_like(street), cloud, k) for k in range(ACCUSTOMED + 50))
