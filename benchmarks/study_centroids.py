"""First guesses from centroids (thesis 3.5), before the registration: of which scenes, and what they owe to maps of classes."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.sources import frames_of
from benchmarks.study_registration import DRIVE, ODOMETRY
from benchmarks.study_runner import Case, End, FeaturesOf, Record, Study, Variant
from calib_ros import se3
from calib_ros.errors import TooFewFeaturesError
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import views_of
from calib_ros.registration.initial_guess import nominal
from calib_ros.result import INSUFFICIENT
from calib_ros_semantics.first_guess.centroids import agreed_poses, find_pairs
from calib_ros_semantics.first_guess.guess import first_guess
from calib_ros_synthetic.drive import SyntheticDrive

Matrix = NDArray[np.float64]
ROUGH = (5.0, 50.0)  # deg and cm
OBJECT_SCENES = ("street", "car_park", "park", "street", "highway", "street", "warehouse", "trees")
OBJECT_RIGS = (
    "vlp32c_roof", "hdl64e_kitti", "pandar64_roof", "os1_64_robot", "os1_128_windshield", "hdl32e_side", "vls128_wide",
    "hdl32e_front", "mid360_90", "vls128_roof", "pandar40p_roof", "os1_128_fisheye",
)  # fmt: skip


def any_yaw(args: argparse.Namespace) -> Iterator[Case]:
    """Ten places of a drive of its own each, of a generic scanner whose camera looks anywhere and of a rig in turn."""
    for number in range(args.trials or 72):
        rng, scene = np.random.default_rng([number, 43]), OBJECT_SCENES[number // 2 % len(OBJECT_SCENES)]
        yaw, off, centre = rng.uniform(-180, 180), rng.uniform(-4, 4, 3), rng.uniform(-0.7, 0.7, 3)
        if number % 2:
            rig = OBJECT_RIGS[number // 2 % len(OBJECT_RIGS)]
            drive = SyntheticDrive(number + 500, 10, stride=20, scene=scene, rig=rig)
        else:
            T = se3.perturb(nominal(yaw), off, np.zeros(3))
            T[:3, 3] = -T[:3, :3] @ centre
            rings = int(rng.choice([16, 32, 64]))
            drive = SyntheticDrive(number + 500, 10, rings, width=640, height=240, stride=20, scene=scene, T_camera_lidar=T)
        yield Case(scene, [drive[k] for k in range(len(drive))], number, _turned_lidar(np.random.default_rng([number, 44])))
    for name in (DRIVE, ODOMETRY) if args.kitti else ():
        frames = frames_of(str(args.kitti / name))
        for trial in range(8):
            rng = np.random.default_rng([10, trial])
            chosen = np.sort(rng.choice(len(frames), 10, replace=False))
            yield Case(Path(name).name, [frames[k] for k in chosen], trial, _turned_lidar(rng, 0.7))


def _turned_lidar(rng: np.random.Generator, shift_m: float = 0.0) -> Matrix:
    turn = se3.rotation_from_euler(rng.uniform(-np.pi, np.pi), 0, 0)
    return se3.from_parts(turn, rng.uniform(-shift_m, shift_m, 3))


def from_centroids(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """said: error of the consensus of centroids alone, deg and cm."""
    views = [replace(v, xyz=np.asarray(se3.transform(case.lidar, v.xyz), np.float32)) for v in views_of(features())]
    truth, began = case.truth @ se3.inverse(case.lidar), time.process_time()
    try:
        alone = End.at(agreed_poses(find_pairs(views), 0)[0], truth)
        began = time.process_time()  # which the next line does again
        guess = End.at(first_guess(views, 0, sweep=False)[0].T, truth)
    except TooFewFeaturesError:
        return End(180.0, 1000.0, INSUFFICIENT, "none")
    return guess._replace(said=f"{alone.deg:.2f} {alone.cm:.1f}", cpu_s=time.process_time() - began)


def centroids_alone(records: Sequence[Record]) -> str:
    errors = [tuple(map(float, r.said.split())) for r in records if r.said != "none"]
    alone = sum(deg < ROUGH[0] and cm < ROUGH[1] for deg, cm in errors)
    return f"by centroids alone {alone}, insufficient {len(records) - len(errors)}"


STUDY = Study(
    any_yaw,
    from_centroids,
    {"exact": Variant({"semantics": {"image_classes": "source", "cloud_classes": "source"}}), "network": Variant()},
    limits=ROUGH,
    remark=centroids_alone,
)
