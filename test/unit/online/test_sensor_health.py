"""Blind and frozen sensors."""

from __future__ import annotations

import numpy as np
import pytest

from calib_ros.camera import Camera
from calib_ros.frame import Frame, PointCloud
from calib_ros.online.sensor_health import ACCUSTOMED, HISTORY, MIN_HISTORY, SensorFault, SensorHealth

SHAPE = (120, 160)
BLACK = np.zeros(SHAPE, np.uint8)
BLIND, FROZEN, NO_SCAN = SensorFault.CAMERA_BLIND, SensorFault.IMAGE_FROZEN, SensorFault.LIDAR_BLIND


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


def check(watch: SensorHealth, image: np.ndarray, k: int = 99, cloud: PointCloud | None = None) -> SensorFault | None:
    """The fault of a frame with the k-th scan, or with this one."""
    height, width = image.shape[:2]
    camera = Camera(np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]), width, height)
    problem = watch.check(Frame(image, scan(k) if cloud is None else cloud, camera, k))
    return None if problem is None else problem.fault


def watched(frames: int = 10, shape: tuple[int, ...] = SHAPE) -> SensorHealth:
    """It knows what is usual here."""
    watch = SensorHealth()
    assert [check(watch, street(k, shape=shape), k) for k in range(frames)] == [None] * frames
    return watch


def dark(seed: int = 0) -> np.ndarray:
    return np.abs(np.random.default_rng(seed).normal(3, 4.0, SHAPE)).astype(np.uint8)


# --- the camera -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frames", [0, 10])
@pytest.mark.parametrize(
    "image",
    [BLACK, np.full(SHAPE, 255, np.uint8), np.full((*SHAPE, 3), 255, np.uint8), dark(), np.full(SHAPE, 90, np.uint8)],
    ids=["black", "white", "white, colour", "dark", "grey"],
)
def test_an_image_that_shows_nothing_is_blind_and_never_frozen(image, frames):
    watch = watched(frames=frames)
    for k in range(12):
        assert check(watch, image, 20 + k) is BLIND
    assert check(watch, street(50), 100) is None


@pytest.mark.parametrize(
    ("contrast", "returns", "frames", "fault"),
    [
        (0.15 * 60, 2000, 10, BLIND),  # mud on the lens
        (0.5 * 60, 2000, 10, None),
        (0.15 * 60, 2000, MIN_HISTORY - 1, None),
        (60, 300, 10, NO_SCAN),
        (60, 500, 10, None),  # an open field
        (60, 300, 0, None),  # nothing is usual yet
        (0.15 * 60, 0, 10, BLIND),  # the camera is named first
    ],
)
def test_a_small_share_of_what_is_usual(contrast, returns, frames, fault):
    assert check(watched(frames=frames), street(77, contrast), 40, scan(40, returns)) is fault


def test_dusk_is_not_reported_as_blind():
    """From full contrast to an eighth, a third of a percent from frame to frame: dusk never falls as fast."""
    watch = watched()
    contrast, k = 60.0, 20
    while contrast > 8:
        contrast *= 0.99
        for _ in range(3):
            k += 1
            assert check(watch, street(k, contrast), k) is None, contrast
    assert k > HISTORY
    assert check(watch, dark(), k + 1) is BLIND


@pytest.mark.parametrize("shape", [(240, 320), (60, 80, 3), (1, 1), (1, 9), (7, 3), (2, 2, 3), (8, 8), (9, 17, 3)])
def test_images_of_any_size_and_colour_are_watched_and_a_change_restarts_the_check(shape):
    watch = SensorHealth()
    for k in range(8):
        check(watch, np.random.default_rng(k).integers(0, 256, shape).astype(np.uint8), k)
    assert check(watch, np.zeros(shape, np.uint8), 9) is BLIND
    other = watched()
    for image in (street(30, shape=(60, 80)), street(30, shape=(60, 80, 3)), street(30)):
        assert check(other, image, 30) is None


# --- frozen ---------------------------------------------------------------------------------------------------------------


def test_a_frozen_image():
    """The image stays, the scans do not: reported from a number of repetitions on, until it changes."""
    watch, still = watched(), street(40)
    faults = [check(watch, still.copy(), 40 + k) for k in range(8)]
    assert faults == [FROZEN if k >= 5 else None for k in range(8)]
    assert check(watch, street(41), 60) is None
    assert check(watch, street(41), 61) is None


@pytest.mark.parametrize("lost", [slice(0), slice(None, None, 7)], ids=["no lost returns", "lost returns"])
def test_simulation_at_rest_is_not_frozen(lost):
    """It repeats images and scans, also those whose lost returns are NaN, which equals nothing."""
    watch, still, cloud = watched(), street(40), scan(40)
    cloud.xyz[lost] = np.nan
    for k in range(20):
        assert check(watch, still.copy(), k, PointCloud(cloud.xyz.copy())) is None


# --- the scanner ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("xyz", [np.zeros((0, 3)), np.full((2000, 3), np.nan), np.zeros((2000, 3))], ids=["none", "nan", "zero"])
def test_no_return_at_all(xyz):
    """Drivers leave lost returns out, or mark them by NaN or by the sensor's own place."""
    for watch in (SensorHealth(), watched()):
        assert check(watch, street(40), 40, PointCloud(xyz.astype(np.float32))) is NO_SCAN
        assert check(watch, street(41), 41) is None


def test_health_check_adapts_to_a_garage_and_an_open_field():
    """Little contrast and few returns for half a minute are what is usual; a black picture is never."""
    watch, rng = SensorHealth(), np.random.default_rng(0)
    bright = rng.integers(0, 256, (24, 32, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    garage = (bright // 8 + 20).astype(np.uint8)

    def seen(image: np.ndarray, returns: int, frames: int = ACCUSTOMED + 20) -> list[SensorFault | None]:
        faults = []
        for k in range(frames):
            alive = image.copy()
            alive[0, k % 256] ^= 1  # else it were frozen
            faults.append(check(watch, alive, k, scan(k, returns)))
        return faults

    assert seen(bright, 4000, 20) == [None] * 20
    for image, returns, fault in ((garage, 4000, BLIND), (bright, 300, NO_SCAN)):
        faults = seen(image, returns)
        assert faults[: ACCUSTOMED - 10] == [fault] * (ACCUSTOMED - 10)
        assert not any(faults[ACCUSTOMED + 1 :])
    assert set(seen(np.zeros_like(bright), 4000, ACCUSTOMED + 50)) == {BLIND}
