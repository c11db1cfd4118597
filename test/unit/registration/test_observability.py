"""Unobservable directions: their names and their treatment, by hand and through the calibrator."""

from __future__ import annotations

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import CameraConfig, Config, ConstraintsConfig, RefineConfig
from calib_ros.image.edges import EdgeLevel
from calib_ros.lidar.edges import EdgeKind, EdgePoints
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.covariance import free_axes, fused, open_directions
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.initial_guess import nominal
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import CONVERGED

T = se3.exp([0.1, -1.2, 0.9, 0.27, -0.05, 0.1])
DEG = np.deg2rad(1.0)


def diagonal(deg: list[float], m: list[float]) -> np.ndarray:
    return np.diag(np.concatenate([np.deg2rad(deg), m]) ** 2)


# --- names ----------------------------------------------------------------------------------------------------------------


def names(C: np.ndarray) -> list[str]:
    return list(map(str, open_directions(C, 0.25, 0.05)))


def test_every_axis_has_its_name():
    words = [f"{name} (0.40 deg)" for name in ("pitch", "yaw", "roll")]
    words += [f"{name} shift (8 cm)" for name in ("sideways", "vertical", "forward")]
    for axis, limit in enumerate([0.25 * DEG] * 3 + [0.05] * 3):
        sigma = np.repeat([0.2 * DEG, 0.04], 3)
        sigma[axis] *= 2
        assert names(np.diag(sigma**2)) == [words[axis]]
        # Just known well enough, and just not.
        sigma[axis] = limit * 0.99
        assert names(np.diag(sigma**2)) == []
        sigma[axis] *= 1.02
        assert len(names(np.diag(sigma**2))) == 1


def test_weakest_direction_comes_first_and_unobservable_ones_have_no_sigma():
    C = diagonal([0.1, 40, 0.5], [0.15, 0.001, 5])
    # In units of the limits: 160, 100, 3 and 2 times.
    assert names(C) == ["yaw (unknown)", "forward shift (unknown)", "sideways shift (15 cm)", "roll (0.50 deg)"]
    assert names(np.zeros((6, 6))) == []


def test_correlated_axes_are_named_together():
    """All edges 10 m away: a pitch of 1 deg and a vertical shift of 17 cm cannot be told apart, but every other."""
    together = np.zeros(6)
    together[[0, 4]] = DEG, -10 * DEG
    C = diagonal([0.02] * 3, [0.004] * 3) + np.outer(together, together)
    assert names(C) == ["pitch (1.00 deg) with vertical shift (17 cm)"]
    assert names(np.diag(np.diag(C))) == ["pitch (1.00 deg)", "vertical shift (17 cm)"]  # the same variances apart


# --- fusion ---------------------------------------------------------------------------------------------------------------


def test_fusion_keeps_unobservable_directions():
    prior, C = diagonal([3] * 3, [0.3] * 3), diagonal([0.03, 0.03, 60], [0.01, 0.01, 10])
    xi = np.concatenate([np.deg2rad([1.0, -0.5, 2]), [0.05, -0.03, 0.2]])
    found, after = fused(se3.exp(xi) @ T, C, T, prior)
    moved = se3.log(found @ se3.inverse(T))
    assert moved[[0, 1, 3, 4]] == pytest.approx(xi[[0, 1, 3, 4]], rel=0.01)
    assert abs(moved[2]) < 0.01 * xi[2]
    assert abs(moved[5]) < 0.01 * xi[5]
    sigma = np.sqrt(np.diag(after))
    assert sigma[[2, 5]] == pytest.approx([3 * DEG, 0.3], rel=0.01)
    assert sigma[[0, 1]] == pytest.approx(0.03 * DEG, rel=0.01)


def test_fused_with_fixed_axes():
    """One that is fixed on both sides stays; one that only the estimate fixes takes its value."""
    prior, C = diagonal([3, 3, 0], [0.3, 0.3, 0.3]), diagonal([0.1, 0.1, 0], [0.01, 0.01, 0])
    xi = np.array([0.01, 0.02, 0, 0.05, 0, 0.02])
    found, after = fused(se3.exp(xi) @ T, C, T, prior)
    moved = se3.log(found @ se3.inverse(T))
    assert moved == pytest.approx(xi, rel=0.01, abs=1e-5)
    assert moved[5] == pytest.approx(0.02, abs=1e-12)
    assert not free_axes(after)[[2, 5]].any()
    assert free_axes(after)[[0, 1, 3, 4]].all()
    still, none = fused(se3.exp(xi) @ T, np.zeros((6, 6)), T, np.zeros((6, 6)))
    assert np.array_equal(still, T)
    assert not none.any()


# --- the calibrator -------------------------------------------------------------------------------------------------------


WIDTH, HEIGHT = 320, 120
CAMERA = Camera(np.array([[200.0, 0, 160], [0, 200, 60], [0, 0, 1]]), WIDTH, HEIGHT)


def level_lines(seed: int, upright: bool = False) -> FrameFeatures:
    """Points 4 to 25 m away on four level lines, all that the picture has; upright: half of them on six upright ones."""
    rng = np.random.default_rng(seed)
    n, rows = 600, (15, 40, 80, 105)
    z, u, v = rng.uniform(4, 25, n), rng.uniform(10, WIDTH - 10, n), rng.choice(rows, n).astype(float)
    kind, columns = np.full(n, EdgeKind.TOP, np.uint8), rng.uniform(20, WIDTH - 20, 6)
    if upright:
        u[::2], v[::2], kind[::2] = rng.choice(columns, n // 2), rng.uniform(10, HEIGHT - 10, n // 2), EdgeKind.SIDE
    seen = np.c_[(np.c_[u, v] - CAMERA.K[:2, 2]) / 200, np.ones(n)] * z[:, None]
    xyz = se3.transform(se3.inverse(nominal()), seen).astype(np.float32)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    maps = [sum(np.exp(-((at - line) ** 2) / (2 * 3.0**2)) for line in lines) for at, lines in ((x, columns), (y, rows))]
    level = EdgeLevel.of(3 * np.stack([maps[0] * upright, maps[1]]).astype(np.float32), 1, 3.0)
    return FrameFeatures(EdgePoints(xyz, np.ones(n, np.float32), kind), [level] * 5, CAMERA, 0, str(seed), True)


START = se3.exp(np.array([0.3 * DEG, 0.5 * DEG, 0.2 * DEG, 0.05, 0.03, 0.1])) @ nominal()


def calibrator(constraints: ConstraintsConfig | None = None) -> Calibrator:
    """Level lines stand out less than is asked of a whole scene, and of an exact lens; the directions are what counts here."""
    accepting = RefineConfig(max_p_value=1.0, tolerance_deg=180.0, tolerance_m=100.0)
    exact = CameraConfig(focal_sigma=0.0)
    return Calibrator(CAMERA, Config(constraints=constraints or ConstraintsConfig(), refine=accepting, camera=exact))


def twist(T: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    xi = se3.log(T @ se3.inverse(start))
    return np.rad2deg(xi[:3]), xi[3:]


@pytest.mark.parametrize(("box", "reach"), [(None, 0.5), (SearchBox(2.0, 0.2, 1), 0.2)])
def test_unobservable_direction_keeps_its_initial_value(box, reach):
    whole = calibrator().estimate([level_lines(k, upright=True) for k in range(3)], START, box)
    assert (whole.status, whole.reason) == (CONVERGED, "")
    deg, m = twist(whole.T_camera_lidar, nominal())
    assert np.abs(deg).max() < 0.1
    assert np.abs(m).max() < 0.02
    part = calibrator().estimate([level_lines(k) for k in range(3)], START, box)
    assert part.status == CONVERGED
    assert part.reason == "not shown by the scenes, and kept from the start: sideways shift (unknown)"
    deg, m = twist(part.T_camera_lidar, nominal())
    assert np.abs(deg).max() < 0.1  # everything else is as good as with upright lines
    assert np.abs(m[1:]).max() < 0.02
    assert twist(part.T_camera_lidar, START)[1][0] == pytest.approx(0, abs=0.002)
    # Known no better than that it lies within reach, and no worse.
    sigma = np.sqrt(np.diag(part.covariance))
    assert sigma[3] == pytest.approx(reach, rel=0.01)
    assert (sigma[[0, 1, 2, 4, 5]] < [0.005, 0.005, 0.005, 0.03, 0.03]).all()
    assert np.sqrt(whole.covariance[3, 3]) < 0.02


def test_fixed_axes_are_not_named_as_weak():
    fixed = ConstraintsConfig(limit_deg=(180, 180, 180), limit_m=(0.0, 100.0, 100.0))
    result = calibrator(fixed).estimate([level_lines(k) for k in range(3)], START)
    assert (result.status, result.reason) == (CONVERGED, "")
    assert twist(result.T_camera_lidar, START)[1][0] == pytest.approx(0, abs=1e-9)
    assert not result.covariance[3].any()
    assert twist(result.T_camera_lidar, nominal())[1][2] == pytest.approx(0, abs=0.02)
