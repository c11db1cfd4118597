"""A small synthetic drive with its features and exact extrinsic, and assertions on results of the calibrator."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np

from calib_ros import se3
from calib_ros.datasets.synthetic.drive import SyntheticDrive
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.result import CONVERGED, REFUSED, Result

SIZE = {"width": 640, "height": 240, "rings": 64, "speed": 0, "stride": 30}
NEAR, FAR = ([0.6, -0.5, 0.6], [0.06, -0.05, 0.06]), ([4, -3, 5], [0.3, -0.2, 0.25])  # 1 deg / 10 cm, 7 deg / 44 cm


class RenderedDrive(SyntheticDrive):
    """A drive that renders each frame once."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._rendered: dict[int, Frame] = {}

    def __getitem__(self, index: int) -> Frame:
        k = range(len(self))[index]
        if k not in self._rendered:
            self._rendered[k] = super().__getitem__(k)
        frame = self._rendered[k]
        return replace(deepcopy(frame), camera=frame.camera)  # a test may draw on its frame


class Scene:
    def __init__(self, seed: int, frames: int = 4, **options) -> None:
        drive = SyntheticDrive(seed=seed, frames=frames, **{**SIZE, **options})
        self.truth, self.camera = drive.reference, drive.camera
        self.frames = [drive[k] for k in range(frames)]
        self.calibrator = Calibrator(self.camera)
        self.features = [self.calibrator.extract(f) for f in self.frames]

    def off(self, by) -> np.ndarray:
        return se3.perturb(self.truth, *by)

    def is_near(self, T: np.ndarray, deg: float, m: float) -> bool:
        return se3.rotation_error_deg(self.truth, T) < deg and se3.translation_error_m(self.truth, T) < m

    def assert_found(self, result: Result, deg: float = 0.15, m: float = 0.03) -> None:
        assert result.status == CONVERGED, result.reason
        assert self.is_near(result.T_camera_lidar, deg, m)


def assert_not_used(result: Result, initial: np.ndarray, status: str = REFUSED) -> None:
    """A failure says why, in a line, and hands back the start."""
    assert result.status == status
    assert not result.converged
    assert np.allclose(result.T_camera_lidar, initial, atol=1e-12)
    assert result.covariance is None
    assert result.reason
    assert "\n" not in result.reason


def same(a: Result, b: Result) -> bool:
    return a.T_camera_lidar.tobytes() == b.T_camera_lidar.tobytes() and (a.score, a.status, a.reason, a.frame_scores) == (
        *(b.score, b.status, b.reason),
        b.frame_scores,
    )
