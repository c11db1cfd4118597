"""Solids are cast on the rays of their windows only: trying each on every ray finds no more."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros_synthetic import rays, wide, windows
from calib_ros_synthetic.rays import ORIGIN, Jobs, Rays, cast, unmet
from calib_ros_synthetic.rigs import OPTICAL, RIGS
from calib_ros_synthetic.scanners import PLAIN, PlainScanner, scanner
from calib_ros_synthetic.scenes import SCENES
from calib_ros_synthetic.solids import Solids
from calib_ros_synthetic.wide import WideView

BARREL = np.array([-0.3, 0.09, 1e-3, -5e-4, -0.01])
LENS = Camera(np.array([[45.0, 0, 39.6], [0, 45.2, 30.3], [0, 0, 1]]), 80, 60, "plumb_bob", BARREL)
Cast = tuple[Rays, Jobs, np.ndarray | bool]  # and the rays that the sensor shows


def directions(R: np.ndarray, beams: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.tensordot(R[k], beams, 1).astype(np.float32) for k in range(3))


def camera_rays(solids: Solids) -> Iterator[Cast]:
    view = rays.CameraView(LENS)
    for yaw in (0.4, 2.4):
        R = se3.rotation_from_euler(yaw, 0.02, -0.015) @ OPTICAL
        yield view.rays(R), view.jobs(solids, R), view.seen


def fisheye_rays(solids: Solids) -> Iterator[Cast]:
    lens = RIGS["os1_128_fisheye"].lens
    view = WideView(lens.camera(96), lens.field)
    for yaw in (0.0, 2.0):
        R = se3.rotation_from_euler(yaw, 0.3, 0.1) @ OPTICAL
        yield view.rays(R), view.jobs(solids, R), view.seen


def scanner_rays(solids: Solids) -> Iterator[Cast]:
    for roll, pitch in ((0.0, 1.0), (170.0, 20.0), (90.0, 10.0)):
        pose = se3.from_parts(se3.rotation_from_euler(0.4, np.deg2rad(pitch), np.deg2rad(roll)), np.zeros(3))
        for name in ("vlp16", "mid360"):
            device = scanner(name, 200.0)
            beams, _ = device.beams()
            yield Rays(ORIGIN, directions(pose[:3, :3], beams)), device.jobs(solids, beams, pose, 0.0, 0.0), True  # type: ignore[arg-type]


def grid_rays(solids: Solids) -> Iterator[Cast]:
    """Of the scanner of the plain drive: rows of one elevation, columns that start at different places."""
    device = PlainScanner(replace(PLAIN[16], firings=240))
    beams, _ = device.beams()
    pose = se3.from_parts(se3.rotation_from_euler(0.4, 0.02, -0.015), np.zeros(3))
    origin = tuple(np.random.default_rng(0).uniform(-0.2, 0.2, (1, 240)).astype(np.float32) for _ in range(3))
    jobs = device.jobs(solids, beams, pose, 0.35, 0.0)
    yield Rays(origin, directions(pose[:3, :3], beams)), jobs, True  # type: ignore[arg-type]


@pytest.mark.parametrize("sensor", [camera_rays, fisheye_rays, scanner_rays, grid_rays])
def test_no_solid_is_hit_outside_its_window(sensor, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (rays, windows, wide):
        monkeypatch.setattr(module, "SMALLEST", 0.0)
    street = SCENES["street"](4, 60.0)
    x, y, _ = street.path.place(30.0, street.lane)
    solids = street.around(30.0).moved(-np.array([x, y, 1.7]))
    for own, jobs, seen in sensor(solids):
        found = []
        for tried in (jobs, Jobs.whole(len(solids), own.shape)):
            t, ids = unmet(own.shape)
            cast(own, solids, tried, t, ids)
            found.append(np.where(seen, t, 0))
        assert np.isfinite(t).mean() > 0.1
        np.testing.assert_array_equal(*found)
