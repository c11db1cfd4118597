"""How near the first guess from motion is, and what the registration makes of it.

    python -m benchmarks.motion_guess_study [--windows 40] [--seed 900] [--cache FOLDER] [--registration]
                               [--offset-ms 0] [--mismatched] [--essential] [--kitti FOLDER] [--turns 4]

Synthetic: every window is 5 s (26 frames at 5 Hz) of a drive of its own. Of every ten, five have a generic scanner of 16, 32 or
64 rings and a camera of any yaw (ahead, backward, left, 60 deg right, random), up to 4 deg off level and up to 1 m from the LiDAR
along each axis; five are rigs. Scenes change every ten. The velocities that the drive knows are taken away: the motion is that of
the scans. Frames for the registration are every fourth.

--offset-ms: images are stamped late by this. --mismatched: the images of a window with the scans of another one, for which there
is no right answer. --essential: instead of the guess, the closed form of the hand-eye equation, with rotations and directions of
travel by essential matrices. --kitti: drive 2011_09_26_drive_0005, whose first 16 frames follow each other, whole and in halves,
the cloud turned by random yaws.

Columns: error of the best guess, deg; its standard deviations; error' inverse(covariance) error of its rotation, 2.4 in the
median if they fit; hidden axes; error of the clocks' offset, ms, and its standard deviation; seconds of the guess; after the
registration deg and cm, and seconds.
"""

from __future__ import annotations

import argparse
import pickle
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.datasets.kitti import KittiSource
from calib_ros.datasets.source import WithMotion
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.initial_guess import nominal
from calib_ros.registration.motion_guess.guess import MotionGuess, motion_guess
from calib_ros.registration.motion_guess.hand_eye import HandEye
from calib_ros.registration.motion_guess.lidar_motion import lidar_runs
from calib_ros.registration.motion_guess.tracks import tracked_points
from calib_ros_synthetic.drive import SyntheticDrive

WINDOW, STRIDE = 26, 2  # frames, and tenths of a second between them
YAWS = (0.0, 180.0, 90.0, -60.0)  # deg; the next mount has a random one
RIGS = (
    ("vlp32c_roof", "hdl32e_side", "os1_64_robot", "os1_128_windshield", "mid360_90"),
    ("hdl32e_front", "vlp32c_roof", "vls128_wide", "os1_128_fisheye", "os1_64_portrait"),
)
SCENES = ("street", "street", "trees", "park")
EVERY = 4  # frame of a window is registered
FLAT, FEWEST = 0.17, 15  # depth of a direction that a pinhole sees, and tracks for an essential matrix
TURN_DEG, TRAVEL_DEG = 0.2, 5.0  # standard deviations of its rotation and direction of travel
NEAR_DEG, RIGHT = 3.0, (0.3, 0.08)  # deg; deg and m
HEAD = (
    "| window | guess, deg | sigma | nees | hidden | clock, ms | s | after, deg | cm | s |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def drive_of(seed: int) -> tuple[str, SyntheticDrive]:
    """Description and drive of a window."""
    k, part = seed % 10, (seed // 10) % 4
    scene = SCENES[part]
    if k >= 5:
        rig = RIGS[part % 2][k - 5]
        return f"{seed} {rig}, {scene}", SyntheticDrive(seed, WINDOW, rig=rig, scene=scene, stride=STRIDE)
    rng = np.random.default_rng([seed, 78])
    yaw = YAWS[k] if k < 4 else float(rng.uniform(-180, 180))
    T = se3.perturb(nominal(yaw), rng.uniform(-4, 4, 3), np.zeros(3))
    T[:3, 3] = -T[:3, :3] @ rng.uniform(-1, 1, 3)
    rings = int(rng.choice([16, 32, 64]))
    drive = SyntheticDrive(seed, WINDOW, rings, width=640, height=240, stride=STRIDE, scene=scene, T_camera_lidar=T)
    return f"{seed} {rings} rings, yaw {yaw:.0f}, {scene}", drive


def window(seed: int, cache: Path | None) -> tuple[str, list[Frame]]:
    """Description and frames of a window without velocities; frame.reference is the truth."""
    file = cache / f"{seed}.pkl" if cache else None
    name, drive = drive_of(seed)
    if file and file.is_file():
        frames: list[Frame] = pickle.loads(file.read_bytes())
    else:
        frames = [drive[k] for k in range(len(drive))]
        if file:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(pickle.dumps(frames))
    return name, [replace(frame, twist=None) for frame in frames]


class _Listed:
    """Frames in memory as a source."""

    name, camera_frame, lidar_frame = "window", "camera", "lidar"

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames = frames
        self.camera, self.reference = frames[0].camera, frames[0].reference

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Frame:
        return self._frames[index]

    def describe(self) -> dict[str, str]:
        return {}


@dataclass(frozen=True)
class Trial:
    """What came of a window; nan where there was none. clock_ms: error and standard deviation."""

    name: str
    guess_deg: float = np.nan
    nees: float = np.nan
    sigma_deg: tuple[float, ...] = ()
    hidden: int = 0
    clock_ms: tuple[float, float] | None = None
    guess_s: float = np.nan
    status: str = ""
    deg: float = np.nan
    m: float = np.nan
    registration_s: float = np.nan

    @property
    def right(self) -> bool:
        return self.status == "converged" and self.deg <= RIGHT[0] and self.m <= RIGHT[1]

    def row(self) -> str:
        """One line of the table."""
        clock = "" if self.clock_ms is None else f"{self.clock_ms[0]:.0f} +-{self.clock_ms[1]:.0f}"
        sigma = " ".join(f"{s:.1f}" for s in self.sigma_deg)
        return (
            f"| {self.name} | {self.guess_deg:.2f} | {sigma} | {self.nees:.1f} | {self.hidden} | {clock} | {self.guess_s:.1f} "
            f"| {self.deg:.3f} {self.status} | {100 * self.m:.1f} | {self.registration_s:.1f} |"
        )


def trial(name: str, frames: Sequence[Frame], registration: bool, offset_s: float = 0.0) -> Trial:
    """The guess from a window, and the registration from there; only the references are the truth."""
    truth, calibrator = frames[0].reference, Calibrator(frames[0].camera)
    assert truth is not None
    late = [replace(f, stamp=f.stamp + round(1e9 * offset_s), cloud_stamp=f.moment_of_cloud) for f in frames]
    started = time.perf_counter()
    try:
        guess = motion_guess(late, calibrator.extract)
    except TooFewFeaturesError as error:
        return Trial(f"{name}: {error}")
    seconds = time.perf_counter() - started
    error_deg, nees = _error(guess, truth)
    clock = None
    if guess.time_offset_s is not None and guess.time_sigma_s is not None:
        clock = (1e3 * (guess.time_offset_s - offset_s), 1e3 * guess.time_sigma_s)
    found = Trial(name, error_deg, nees, tuple(guess.sigma_deg.tolist()), len(guess.hidden), clock, seconds)
    if not registration:
        return found
    moving = WithMotion(_Listed(frames), calibrator.config.motion)
    chosen = [moving[k] for k in range(0, len(frames), EVERY)]
    result = calibrator.calibrate(chosen, "motion", consecutive=frames)
    deg, m = se3.rotation_error_deg(truth, result.T_camera_lidar), se3.translation_error_m(truth, result.T_camera_lidar)
    return replace(found, status=result.status, deg=deg, m=m, registration_s=result.elapsed_s - seconds)


def _error(guess: MotionGuess, truth: NDArray[np.float64]) -> tuple[float, float]:
    """Error of the best hypothesis, deg, and its square in units of the covariance."""
    turn = se3.from_parts(truth[:3, :3] @ guess.hypotheses[0][:3, :3].T, np.zeros(3))
    xi = se3.log(turn)[:3]
    return float(np.rad2deg(np.linalg.norm(xi))), float(xi @ np.linalg.solve(guess.covariance, xi))


def essential(name: str, frames: Sequence[Frame]) -> Trial:
    """The rotation by the closed form of the hand-eye equation (Wahba's problem, weights iterated), from rotations and directions
    of travel by essential matrices (five points, MAGSAC)."""
    extract, truth = FeatureExtractor(frames[0].camera), frames[0].reference
    assert truth is not None
    runs, _ = lidar_runs(frames, extract.config.motion)
    tracks = tracked_points(frames, runs, extract)
    motions, unit = HandEye(tracks, runs).motions(), np.eye(3)
    known, seen, weight = [], [], []
    for k, A in enumerate(motions):
        flat = (tracks.pair == k) & (tracks.first[:, 2] > FLAT) & (tracks.second[:, 2] > FLAT)
        if flat.sum() < FEWEST:
            continue
        a, b = (np.ascontiguousarray(rays[flat, :2] / rays[flat, 2:]) for rays in (tracks.first, tracks.second))
        E, mask = cv2.findEssentialMat(a, b, unit, method=cv2.USAC_MAGSAC, prob=0.999, threshold=tracks.pixel)
        if E is None or E.shape != (3, 3):
            continue
        _, R, t, _ = cv2.recoverPose(E, a, b, unit, mask=mask)
        turn = se3.log(se3.from_parts(R, np.zeros(3)))[:3]
        distance = float(np.linalg.norm(A[:3, 3]))
        known += [se3.log(A)[:3], A[:3, 3] / max(distance, 1e-9)]
        seen += [turn, np.ravel(t)]
        weight += [np.deg2rad(TURN_DEG) ** -2, np.deg2rad(TRAVEL_DEG) ** -2 * (distance > 0.1)]
    x, y, w = np.array(known), np.array(seen), np.array(weight)
    R, trust = unit, np.ones(len(w))
    for _ in range(20):
        u, _, vt = np.linalg.svd((y * (w * trust)[:, None]).T @ x)
        R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        trust = 1 / (1 + w * ((y - x @ R.T) ** 2).sum(axis=1) / 4)
    return Trial(name, se3.rotation_error_deg(truth, R))


def turned(frame: Frame, yaw: float) -> Frame:
    """The frame as if the LiDAR were mounted turned right by yaw (rad)."""
    R = se3.rotation_from_euler(yaw, 0, 0)
    assert frame.reference is not None
    cloud = replace(frame.cloud, xyz=np.asarray(frame.cloud.xyz @ R.T, np.float32))
    twist = None if frame.twist is None else np.r_[R @ frame.twist[:3], R @ frame.twist[3:]]
    return replace(frame, cloud=cloud, reference=frame.reference @ se3.from_parts(R.T, np.zeros(3)), twist=twist)


def kitti_windows(root: Path, turns: int) -> Iterator[tuple[str, list[Frame]]]:
    """Runs of a KITTI drive, with the velocity of its GPS and inertial unit or without, by random yaws."""
    source = KittiSource(root)
    run = [source[k] for k in range(16)]
    rng = np.random.default_rng(0)
    for name, part in (("16 frames", run), ("first 8", run[:8]), ("last 8", run[8:])):
        for oxts in (False, True):
            for _ in range(turns):
                yaw = float(rng.uniform(-np.pi, np.pi))
                frames = [turned(f if oxts else replace(f, twist=None), yaw) for f in part]
                yield f"KITTI {name}, {'oxts' if oxts else 'scans'}, yaw {np.rad2deg(yaw):.0f}", frames


def summary(trials: Sequence[Trial], registration: bool) -> str:
    """The shares of a table."""
    errors = np.array([t.guess_deg for t in trials])
    near = np.nan_to_num(errors, nan=np.inf) <= NEAR_DEG
    text = f"within {NEAR_DEG:g} deg: {near.sum()}/{len(trials)}; median {np.nanmedian(errors):.2f} deg"
    sizes = [t.nees for t in trials if np.isfinite(t.nees)]
    text += f"; median nees {np.median(sizes):.1f} (2.4 if exact)" if sizes else ""
    clocks = np.array([t.clock_ms for t in trials if t.clock_ms is not None]).reshape(-1, 2)
    if len(clocks):
        text += f"; clocks told {len(clocks)}: rms {np.sqrt(np.mean((clocks[:, 0] / clocks[:, 1]) ** 2)):.1f} sigma"
    if registration:
        wrong = sum(t.status == "converged" and not t.right for t in trials)
        text += f"; registered within {RIGHT[0]:g} deg and {100 * RIGHT[1]:g} cm: {sum(t.right for t in trials)}, wrong: {wrong}"
    return text


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--windows", type=int, default=40, help="0 = no synthetic ones")
    parser.add_argument("--seed", type=int, default=900, help="of the first window")
    parser.add_argument("--cache", type=Path, metavar="FOLDER", help="keep rendered windows there (60 MB each)")
    parser.add_argument("--registration", action="store_true", help="register, too")
    parser.add_argument("--offset-ms", type=float, default=0.0, help="images are stamped late by this")
    parser.add_argument("--mismatched", action="store_true", help="images and scans of different windows")
    parser.add_argument("--essential", action="store_true", help="essential matrices instead of the guess, for comparison")
    parser.add_argument("--kitti", type=Path, metavar="FOLDER", help="folder of KITTI's drive 2011_09_26_drive_0005")
    parser.add_argument("--turns", type=int, default=4, help="yaws of every KITTI window")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    trials: list[Trial] = []
    print(HEAD, flush=True)
    for seed in range(args.seed, args.seed + args.windows):
        name, frames = window(seed, args.cache)
        if args.mismatched:
            others = window(seed + (10 if seed % 10 < 5 else 20), args.cache)[1]
            frames = [replace(f, cloud=o.cloud, compensated=o.compensated) for f, o in zip(frames, others, strict=True)]
        trials.append(
            essential(name, frames) if args.essential else trial(name, frames, args.registration, args.offset_ms / 1000)
        )
        print(trials[-1].row(), flush=True)
    if trials:
        print(summary(trials, args.registration))
    if args.kitti:
        trials = []
        for name, frames in kitti_windows(args.kitti, args.turns):
            trials.append(trial(name, frames, args.registration))
            print(trials[-1].row(), flush=True)
        print(summary(trials, args.registration))


if __name__ == "__main__":
    main()
