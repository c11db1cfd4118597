"""Small synthetic drives, rendered once for all tests; their features and exact extrinsics; assertions on results."""

from __future__ import annotations

import hashlib
import itertools
import os
import pickle
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros import se3
from calib_ros.config import Config, SearchConfig, SemanticsConfig, TrackerConfig
from calib_ros.datasets.recent import Recent
from calib_ros.frame import NANOSECONDS
from calib_ros.lidar.deskew import moved
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.result import CONVERGED, REFUSED, Result
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_synthetic.rig import RigPair, SyntheticRig

SIZE = {"width": 640, "height": 240, "rings": 64, "speed": 0, "stride": 30}
NEAR, FAR = ([0.6, -0.5, 0.6], [0.06, -0.05, 0.06]), ([4, -3, 5], [0.3, -0.2, 0.25])  # 1 deg / 10 cm, 7 deg / 44 cm


# The smallest search that still finds the way from NEAR, and from FAR; a refused estimate searches a decoy as well.
QUICK_SEARCH = SearchConfig(rounds=1, starts=64)
QUICK = Config(search=QUICK_SEARCH, semantics=SemanticsConfig(segmentation="none"), tracker=TrackerConfig(confirmations=0))
RENDERINGS = "CALIB_ROS_TEST_RENDERINGS"  # environment variable: folder of this run, for all of its processes


_scan, _picture = SyntheticRig._scan, SyntheticRig._picture


def made_once(key: object, make: Callable[[], Any]) -> Any:
    """What is made by whatever test, file and process of a run needs it first; key: all that it depends on."""
    folder = os.environ.get(RENDERINGS)
    if folder is None:
        return make()
    path = Path(folder) / hashlib.sha256(repr(key).encode()).hexdigest()
    if not path.exists():
        with tempfile.NamedTemporaryFile(dir=folder, delete=False) as file:
            pickle.dump(make(), file)
        Path(file.name).rename(path)
    return pickle.loads(path.read_bytes())


def scan_once(rig: SyntheticRig, lidar: str, index: int) -> Any:
    """In place of SyntheticRig._scan. Not for tests of the renderer, nor for a drive with an empty stretch."""
    return made_once((_key(rig, *OF_PICTURES), lidar, index), lambda: _scan(rig, lidar, index))


def picture_once(rig: SyntheticRig, camera: str, index: int, hung: Any = None, age_s: float = 0.0) -> Any:
    """In place of SyntheticRig._picture."""
    lens, where = rig.camera(camera), hung or rig._hung(camera, False)
    key = (_key(rig, *OF_SCANS), lens.K.tolist(), lens.width, lens.height, lens.model, np.asarray(lens.D).tolist())
    key = (*key, camera, index, [T.tolist() for T in where], age_s)
    return made_once(key, lambda: _picture(rig, camera, index, hung, age_s))


OF_PICTURES = ("width", "height", "tilt_deg", "image_late_ms", "jitter_ms")  # what the scans of a pair do not depend on
OF_SCANS = ("rings", "spin", "stamp_at")  # what its pictures do not depend on


def _key(rig: SyntheticRig, *not_of: str) -> object:
    """What measurements depend on: those of a pair not on their number."""
    left_out = ("frames", *not_of) if rig.model.is_pair else ()
    return sorted((name, value) for name, value in rig.parameters.items() if name not in left_out)


class RenderedDrive(SyntheticDrive):
    """A drive whose frames are rendered once in a run of the tests, and all kept."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.rig._scan, self.rig._picture = partial(scan_once, self.rig), partial(picture_once, self.rig)  # type: ignore[method-assign]
        self.rig._made = Recent(1000)


def is_near(reference: np.ndarray, T: np.ndarray, deg: float, m: float) -> bool:
    return se3.rotation_error_deg(reference, T) < deg and se3.translation_error_m(reference, T) < m


def on_pixels_of_their_class(
    drive: RigPair, index: int, T: np.ndarray, reach: int = 0, ahead_s: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Classes (n,) of a frame's points in the picture, and whether a pixel within `reach` px has the same one. ahead_s: of the
    camera's clock before the LiDAR's; points are moved to the image's moment then, else taken as they are."""
    frame = drive[index]
    xyz = frame.cloud.xyz
    if ahead_s is not None:
        late = (frame.stamp - frame.moment_of_cloud) / NANOSECONDS - ahead_s
        xyz = moved(xyz, frame.twist, frame.cloud.time - late)
    uv, inside = drive.camera.project(se3.transform(T, xyz))
    u, v = np.rint(uv[inside]).astype(int).T
    own = frame.cloud.label[inside]
    same = np.zeros(len(own), bool)
    for dv, du in itertools.product(range(-reach, reach + 1), repeat=2):
        row, column = np.clip(v + dv, 0, drive.camera.height - 1), np.clip(u + du, 0, drive.camera.width - 1)
        same |= frame.classes[row, column] == own
    return own, same


class Scene:
    def __init__(self, seed: int, frames: int = 4, **options) -> None:
        drive = RenderedDrive(seed=seed, frames=frames, **{**SIZE, **options})
        self.truth, self.camera = drive.reference, drive.camera
        self.frames = [drive[k] for k in range(frames)]
        self.calibrator = Calibrator(self.camera)
        self.quick = Calibrator(self.camera, QUICK)

    @cached_property
    def features(self) -> list[FrameFeatures]:
        return [self.calibrator.extract(f) for f in self.frames]

    def off(self, by) -> np.ndarray:
        return se3.perturb(self.truth, *by)

    def is_near(self, T: np.ndarray, deg: float, m: float) -> bool:
        return is_near(self.truth, T, deg, m)

    def assert_found(self, result: Result, deg: float = 0.15, m: float = 0.03) -> None:
        assert result.status == CONVERGED, result.reason
        assert self.is_near(result.T_camera_lidar, deg, m)


def driven(scene: Scene, twists: list[np.ndarray], late_s: float = 0.0) -> list[FrameFeatures]:
    """The scene's features with these velocities, and the images late by so much."""
    out: list[FrameFeatures] = []
    for f, twist in zip(scene.features, twists, strict=True):
        points = f.points
        xyz = moved(points.xyz, twist, np.full(len(points), -late_s)).astype(np.float32)
        out.append(replace(f, points=replace(points, xyz=xyz), twist=twist))
    return out


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
