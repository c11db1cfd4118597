"""Studies of the registration: its accuracy, other vehicles, its covariances."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.records import markdown
from benchmarks.study_runner import NEAR, Case, End, FeaturesOf, Record, Study, frames_of
from calib_ros import se3
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import Frame
from calib_ros.lidar.edges import UPWARD, upward_parts
from calib_ros.lidar.range_image import range_image
from calib_ros.lidar.rings import rings_by_order
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_synthetic.rigs import PAIRS

Matrix = NDArray[np.float64]
DRIVE, ODOMETRY = "raw/2011_09_26/2011_09_26_drive_0005_sync", "odometry/sequences/00"
SYNTHETIC = ("synthetic:seed=3,frames=20,stride=8", "synthetic:seed=5,frames=20,stride=8", "synthetic:seed=8,frames=20,rings=32")
SCENES = ("street", "park", "warehouse")


def spread(count: int, total: int) -> list[int]:
    """Positions spread evenly over a source."""
    return [int(i) for i in np.linspace(0, total - 1, count).round()]


def short(source: str) -> str:
    """A source's name without the folders that differ between machines."""
    return source if source.startswith("synthetic") else "/".join(Path(source).parts[-2:])


def rigs_of(args: argparse.Namespace) -> list[str]:
    """The synthetic rigs, in the scenes of --rigs."""
    scenes = () if args.rigs is None else args.rigs or SCENES
    return [f"synthetic:rig={rig},scene={scene},frames={FEW}" for scene in scenes for rig in PAIRS]


def subset(frames: Sequence[Frame], size: int, number: int, rng: np.random.Generator) -> list[Frame]:
    """So many frames: spread, or consecutive where the number is odd."""
    first = int(rng.integers(0, len(frames) - size + 1))
    chosen = range(first, first + size) if number % 2 else np.sort(rng.choice(len(frames), size, replace=False))
    return [frames[k] for k in chosen]


# ------------------------------------------------------------------------------------------------ accuracy


@dataclass(frozen=True)
class Row:
    """Frames of a source (0 = one frame per trial, each in turn), box of the starts around the reference, part of the rings."""

    source: str
    frames: int
    rotation_deg: float
    translation_m: float
    every_ring: int = 1


ROWS = {
    "drive16": Row(DRIVE, 16, 10, 0.5),
    "odo10": Row(ODOMETRY, 10, 10, 0.5),
    "drive5": Row(DRIVE, 5, 10, 0.5),
    "odo5": Row(ODOMETRY, 5, 10, 0.5),
    "drive16-wide": Row(DRIVE, 16, 20, 1.0),
    "odo10-wide": Row(ODOMETRY, 10, 20, 1.0),
    "drive1": Row(DRIVE, 0, 5, 0.3),
    "odo1": Row(ODOMETRY, 0, 5, 0.3),
    "drive16-16rings": Row(DRIVE, 16, 5, 0.3, 4),
    "odo10-16rings": Row(ODOMETRY, 10, 5, 0.3, 4),
    "synthetic16": Row("synthetic:seed=11,frames=16", 16, 10, 0.5),
}


def rows(args: argparse.Namespace) -> Iterator[Case]:
    """A case for each row; without --kitti only for synthetic ones."""
    if unknown := set(args.sources) - set(ROWS):
        raise BadInputError(f"no row {', '.join(sorted(unknown))}; there are {', '.join(ROWS)}")
    for name in args.sources or ROWS:
        row = ROWS[name]
        is_synthetic = row.source.startswith("synthetic")
        if not args.kitti and not is_synthetic:
            continue
        source = open_dataset(row.source if is_synthetic else str(args.kitti / row.source))
        frames = [thinned(source[i], row.every_ring) for i in spread(row.frames or min(len(source), 16), len(source))]
        yield Case(name, frames, box=SearchBox(row.rotation_deg, row.translation_m))


def thinned(frame: Frame, every: int) -> Frame:
    """Only every n-th ring of a scan that is stored ring by ring."""
    if every == 1:
        return frame
    xyz = frame.cloud.xyz
    azimuth, elevation = np.arctan2(xyz[:, 1], xyz[:, 0]), np.arcsin(xyz[:, 2] / np.linalg.norm(xyz, axis=1))
    ring = frame.cloud.ring if frame.cloud.ring is not None else rings_by_order(azimuth, elevation)
    assert ring is not None
    return replace(frame, cloud=frame.cloud.select(ring % every == 0))


def from_row(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """Each trial has its own seed."""
    row, own, rng = ROWS[case.group], features(), np.random.default_rng(trial)
    start = se3.perturb(case.truth, *(rng.uniform(-half, half, 3) for half in (row.rotation_deg, row.translation_m)))
    result = calibrator.estimate(own if row.frames else [own[trial % len(own)]], start, case.box)
    return End.at(result.T_camera_lidar, case.truth, result.status, result=result)


def accuracy_table(records: Sequence[Record]) -> str:
    """A line per row."""
    lines = []
    for group in dict.fromkeys(r.group for r in records):
        own = [r for r in records if r.group == group]
        success = f"{sum(r.right for r in own)} of {len(own)}"
        deg, cm = (np.percentile(values, (50, 90)) for values in ([r.deg for r in own], [r.cm for r in own]))
        counts = sum(r.accepted and not r.right for r in own), sum(not r.accepted for r in own)
        cpu_s = np.median([r.cpu_s for r in own])
        lines.append([group, success, f"{deg[0]:.3f}, {deg[1]:.2f}", f"{cm[0]:.1f}, {cm[1]:.1f}", *counts, f"{cpu_s:.2f}"])
    head = ["cases", "success", "deg: median, 90 %", "cm: median, 90 %", "accepted wrong", "refused", "CPU s"]
    return markdown(head, lines)


# ------------------------------------------------------------------------------------------------ vehicles

SOFT = (0.9, 25.0)  # deg, cm
SINGLE, SEVERAL = ((5.0, 0.3),), ((5.0, 0.3), (10.0, 0.5), (20.0, 1.0))  # deg, m
MOST_SINGLE, MOST, FEW = 12, 12, 5
# Intrinsics and clocks of rendered drives are exact, and their covariances are to be compared with the errors that remain.
EXACT_SENSORS = {"camera": {"focal_sigma": 0.0}, "motion": {"time_offset_sigma_s": 0.0}}


def vehicles(args: argparse.Namespace) -> Iterator[Case]:
    """Of every source one frame at a time, and sets of 5 spread frames and of all. Frames of several calibrations make no set."""
    sources = [(source, NEAR) for source in args.sources] + [(source, SOFT) for source in args.soft]
    sources += [(source, NEAR) for source in rigs_of(args)]
    if not sources:
        raise BadInputError("this study needs a source, or --rigs")
    for name, limits in sources:
        try:
            yield from _sets(name, limits, args.trials or 1)
        except CalibrationError as error:  # the other sources go on
            print(f"{name}: {error}", file=sys.stderr)


def _sets(name: str, limits: tuple[float, float], repeats: int) -> Iterator[Case]:
    frames = frames_of(name)
    is_synthetic = name.startswith("synthetic")
    n, several = len(frames), not is_synthetic and len(frames) > 1 and frames[0].camera != frames[1].camera
    wide = [tuple(np.unique(spread(size, n)).tolist()) for size in (FEW, MOST)]
    # All frames make a set of their own only where they are clearly more than the few.
    sets = wide[: 2 if len(wide[1]) >= 1.5 * FEW else 1] if n >= FEW else ([tuple(range(n))] if n > 1 else [])
    single = [(k,) for k in (wide[1] if n > MOST_SINGLE else range(n))]
    for seed in range(repeats):
        for chosen, boxes in [*((k, SINGLE) for k in single), *((own, SEVERAL) for own in sets if not several)]:
            for deg, m in boxes:
                xi = np.random.default_rng([seed, *chosen]).uniform(-1, 1, 6) * ([np.deg2rad(deg)] * 3 + [m] * 3)
                group = f"{short(name)}, {'1' if len(chosen) == 1 else 'several'}, {deg:g} deg"
                case = Case(group, [frames[k] for k in chosen], source=name, box=SearchBox(deg, m), limits=limits)
                yield replace(case, starts=[se3.exp(xi) @ case.truth], config=EXACT_SENSORS if is_synthetic else {})


def from_start(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """deg, cm: of the estimate, or of the optimum that was refused. said: the score of the refinement from the reference; where
    it is clearly larger than the score, the search has missed it."""
    own = features()
    began = time.process_time()
    result = calibrator.estimate(own, case.starts[trial], case.box)
    spent = time.process_time() - began
    near = calibrator.estimate(own, case.truth)
    T = result.T_camera_lidar if result.optimum is None else result.optimum
    return End.at(T, case.truth, result.status, f"{near.score:.6g}", result)._replace(cpu_s=spent)


def vehicle_table(records: Sequence[Record]) -> str:
    """A line per source, number of frames and box."""
    groups: dict[str, list[Record]] = {}
    for r in records:
        groups.setdefault(r.group, []).append(r)
    counts = ("trials", "accepted right", "accepted wrong", "refused", "of these right")
    last = ("median (deg cm)", "90 %", "NEES", "halves", "CPU s")
    lines = [[*group.rsplit(", ", 2), *_counts(own), *_figures(own)] for group, own in groups.items()]
    return markdown(["set", "frames", "from", *counts, *last], lines)


def _counts(own: Sequence[Record]) -> list[int]:
    right, wrong = (sum(r.accepted and r.right is wanted for r in own) for wanted in (True, False))
    return [len(own), right, wrong, len(own) - right - wrong, sum(r.right and not r.accepted for r in own)]


def _figures(own: Sequence[Record]) -> list[str]:
    """Errors of the accepted; NEES, 6 on average if the covariance is right; how far halves of the data end apart, about 1 where
    they agree as well as their covariances let expect."""
    kept = np.array([(r.deg, r.cm) for r in own if r.accepted]).reshape(-1, 2)
    quantiles = [f"{deg:.2f} {cm:.1f}" for deg, cm in np.percentile(kept, [50, 90], axis=0)] if len(kept) else ["", ""]
    means = []
    for values in ([r.nees for r in own], [r.disagreement for r in own]):
        known = [value for value in values if np.isfinite(value)]
        means.append(f"{np.mean(known):.1f}" if known else "")
    cpu = [r.cpu_s for r in own]
    return [*quantiles, *means, f"{np.median(cpu):.1f}, at most {max(cpu):.1f}"]


# ------------------------------------------------------------------------------------------------ covariances

SIZES = {1: 10, 2: 6, 3: 8, 5: 10, 8: 8, 12: 6, 20: 4}  # frames of a subset: how many subsets of a source
QUANTILE = float(chi2.ppf(0.975, 6))


def subsets(args: argparse.Namespace) -> Iterator[Case]:
    """Spread and consecutive frames in turn, from starts up to 0.3 deg / 3 cm per axis beside the reference."""
    for name in args.sources or [*SYNTHETIC, *(str(args.kitti / name) for name in (DRIVE, ODOMETRY) if args.kitti)]:
        frames = frames_of(name, Config().motion)
        rng, starts = np.random.default_rng(1), np.random.default_rng(2)
        for size, count in SIZES.items():
            for t in range(count if size <= len(frames) else 0):
                exact = EXACT_SENSORS if name.startswith("synthetic") else {}
                case = Case(short(name), subset(frames, size, t, rng), source=name, config=exact)
                off = starts.uniform(-1, 1, 6)
                yield case.begun([se3.perturb(case.truth, 0.3 * off[:3], 0.03 * off[3:])])


def refined(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """said: the error in standard deviations (6,), and those of rotation and translation as multiples of their bound."""
    own = features()
    result = calibrator.estimate(own, case.starts[trial])
    said = ""
    if result.covariance is not None:
        off = se3.log(result.T_camera_lidar @ se3.inverse(case.truth))
        unrolled = own[0].camera.is_sphere
        least = np.full((6, 6), np.nan) if unrolled else bound(own, case.frames, case.truth, calibrator.config)
        parts = [np.linalg.norm(off[k]) / np.sqrt(np.trace(least[k, k])) for k in (slice(0, 3), slice(3, 6))]
        said = " ".join(f"{value:.3g}" for value in (*off / np.sqrt(np.diag(result.covariance)), *parts))
    return End.at(result.T_camera_lidar, case.truth, result.status, said, result)


def bound(features: Sequence[FrameFeatures], frames: Sequence[Frame], T: Matrix, config: Config) -> Matrix:
    """The least covariance (6, 6) of any unbiased estimate of T (4, 4), Cramer-Rao's, from the edge points in view of a pinhole.

    Each tells its place across its edge, along the image's rows or, of upward edges, columns, to within a step of the scanner and
    a pixel, anywhere in these alike. All of its edges are thought to be in the image, and nothing else to be wrong.
    """
    information = np.zeros((6, 6))
    for own, frame in zip(features, frames, strict=True):
        points, camera = own.points, own.camera
        p = se3.transform(T, points.xyz.astype(float))
        inside = camera.project(p)[1]
        p, axis, reach = p[inside], np.isin(points.kind[inside], UPWARD).astype(int), np.linalg.norm(points.xyz[inside], axis=1)
        each, f, z = np.arange(len(p)), np.array([camera.K[0, 0], camera.K[1, 1]]), p[:, 2]
        slope = np.zeros_like(p)  # d(u or v) / d(point), which a twist (w, v) moves by w x point + v
        slope[each, axis], slope[:, 2] = f[axis] / z, -f[axis] * p[each, axis] / z**2
        J = np.hstack([np.cross(p, slope), slope])
        parts = upward_parts(points.ring_spacing)  # points of one edge, which tells no more than one of them
        step = np.where(axis, points.ring_spacing * np.sqrt(parts), range_image(frame.cloud, config.lidar).azimuth_step)
        variance = ((f[axis] * step * reach / z) ** 2 + 1) / 12
        information += (J / variance[:, None]).T @ J
    return np.asarray(np.linalg.inv(information))


def nees_table(records: Sequence[Record]) -> str:
    """Normalised errors squared: 6 on average and above 14.4 in 2.5 % of the cases if the covariances are right; 1 per axis. Root
    mean squares of the errors as multiples of their bound."""
    groups = {name: [r for r in records if r.group == name] for name in dict.fromkeys(r.group for r in records)}
    groups |= {f"{size} frames": [r for r in records if r.frames == size] for size in SIZES}
    groups |= {"2 and more frames": [r for r in records if r.frames > 1], "all": list(records)}
    lines = []
    for name, own in groups.items():
        values = np.array([r.nees for r in own if np.isfinite(r.nees)])
        cells = ["-"] * 5
        if len(values):
            said = np.array([[float(part) for part in r.said.split()] for r in own if r.said])
            squares = (said**2).mean(axis=0)
            cells = [f"{values.mean():.1f}", f"{np.median(values):.1f}", f"{100 * np.mean(values > QUANTILE):.0f} %"]
            cells += [
                " ".join(f"{value:.1f}" for value in squares[:6]),
                " ".join(f"{np.sqrt(value):.1f}" for value in squares[6:]),
            ]
        lines.append([name, f"{len(values)} of {len(own)}", *cells])
    axes = "per axis (rx ry rz tx ty tz)"
    return markdown(["source", "estimates", "mean", "median", "above 97.5 %", axes, "error by its bound (deg m)"], lines)


STUDIES = {
    "registration": Study(rows, from_row, accuracy_table, trials=30),
    "vehicles": Study(vehicles, from_start, vehicle_table),
    "covariance": Study(subsets, refined, nees_table),
}
