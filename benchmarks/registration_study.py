"""Success and accuracy of the registration over random starts: the table by which every change is judged.

    python -m benchmarks.registration_study --kitti FOLDER [ROW ...] [--trials 30] [--config YAML] [--ablation] [--csv FILE]
        [--workers N]

FOLDER holds raw/2011_09_26/2011_09_26_drive_0005_sync and odometry/sequences/00; without it only the synthetic rows run.
Each trial has its own seed: start = reference, disturbed uniformly per axis; all trials count. Rows that begin at nominal have
one start only; their trials differ in the seed of the search. A trial is a success within 0.5 deg and 10 cm of the reference.
--ablation: the same trials with one part of the method switched off at a time.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from tqdm import tqdm

from benchmarks.records import append_records
from calib_ros import se3
from calib_ros.config import Config, update
from calib_ros.datasets import open_dataset
from calib_ros.datasets.source import Source
from calib_ros.frame import Frame
from calib_ros.image.edges import blurred_levels, oriented_edges
from calib_ros.lidar.rings import rings_by_order
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.initial_guess import nominal
from calib_ros.registration.search.constraints import NOMINAL_BOX, SearchBox

SUCCESS_DEG, SUCCESS_M = 0.5, 0.1
DRIVE, ODOMETRY = "raw/2011_09_26/2011_09_26_drive_0005_sync", "odometry/sequences/00"
SYNTHETIC = "synthetic:seed=11,frames=16"


@dataclass(frozen=True)
class Row:
    """One line of the table: frames of a source (0 = one frame per trial, each in turn), box, part of the rings; from nominal, or
    from starts anywhere in the box around the reference."""

    source: str
    frames: int
    rotation_deg: float
    translation_m: float
    every_ring: int = 1
    nominal: bool = False


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
    "drive15-nominal": Row(DRIVE, 15, *NOMINAL_BOX.reach, nominal=True),
    "odo10-nominal": Row(ODOMETRY, 10, *NOMINAL_BOX.reach, nominal=True),
    "synthetic16": Row(SYNTHETIC, 16, 10, 0.5),
}
ABLATION_ROWS = ("drive16", "odo10", "drive5", "odo10-wide")
ABLATION: dict[str, dict[str, dict[str, Any]]] = {
    "": {},
    "edges of any direction": {},
    "edge points where they were measured": {},
    "upward edges not spread": {},
    "no de-skewing": {"motion": {"deskew": "off"}},
    # All of the starts are optimised on all levels; their number must be a power of two.
    "no halving": {"search": {"starts": 64}},
    "levels from 8 px": {},
    "one round": {"search": {"rounds": 1}},
}
# What users have no reason to switch off is switched off from outside.
PATCHES: dict[str, dict[str, Any]] = {
    "edges of any direction": {
        "calib_ros.image.edges.oriented_edges": lambda *args: (np.sum(oriented_edges(*args), axis=0),) * 2,
    },
    "edge points where they were measured": {
        "calib_ros.lidar.edges.OUTWARD_SHIFT": 0.0,
        "calib_ros.lidar.edges.TOP_SPREAD": 0.0,
    },
    "upward edges not spread": {"calib_ros.lidar.edges.TOP_SPREAD": 0.0},
    "no halving": {
        "calib_ros.registration.search.search.DISTINCT": 64,
        "calib_ros.registration.search.search.CLIMBED": 64,
    },
    "levels from 8 px": {"calib_ros.image.edges.blurred_levels": partial(blurred_levels, sigmas=(8.0, 8.0, 4.0, 2.0, 1.2))},
}
HEAD = "| frames | success | failures called converged | deg median / p90 | cm median / p90 | CPU s |\n|---|---|---|---|---|---|"

_work: dict[str, Any] = {}  # inherited by the forked workers


@dataclass(frozen=True)
class Trial:
    """How one ended."""

    seed: int
    deg: float
    m: float
    converged: bool
    cpu_s: float
    score: float
    agreed: int
    climbed: int
    reason: str
    row: str = ""
    variant: str = ""


def spread(count: int, total: int) -> list[int]:
    """Positions spread evenly over a source."""
    return [int(i) for i in np.linspace(0, total - 1, count).round()]


def thinned(frame: Frame, every: int) -> Frame:
    """Only every n-th ring of a scan that is stored ring by ring."""
    if every == 1:
        return frame
    xyz = frame.cloud.xyz
    azimuth, elevation = np.arctan2(xyz[:, 1], xyz[:, 0]), np.arcsin(xyz[:, 2] / np.linalg.norm(xyz, axis=1))
    ring = frame.cloud.ring if frame.cloud.ring is not None else rings_by_order(azimuth, elevation)
    assert ring is not None
    return dataclasses.replace(frame, cloud=frame.cloud.select(ring % every == 0))


def start_of(seed: int, T: np.ndarray, row: Row) -> np.ndarray:
    """Where a trial begins."""
    if row.nominal:
        return nominal()
    rng = np.random.default_rng(seed)
    deg, m = rng.uniform(-row.rotation_deg, row.rotation_deg, 3), rng.uniform(-row.translation_m, row.translation_m, 3)
    return se3.perturb(T, deg, m)


def trial(seed: int) -> Trial:
    """One estimate; the frames' features wait in _work."""
    row, features, T = _work["row"], _work["features"], _work["reference"]
    chosen = features if row.frames else [features[seed % len(features)]]
    calibrator: Calibrator = copy.copy(_work["calibrator"])
    if row.nominal:
        calibrator.config = update(calibrator.config, {"search": {"seed": seed}})
    began = time.process_time()
    result = calibrator.estimate(chosen, start_of(seed, T, row), SearchBox(row.rotation_deg, row.translation_m))
    used = time.process_time() - began
    found, (agreed, climbed) = result.T_camera_lidar, result.starts or (0, 0)
    deg, m = se3.rotation_error_deg(T, found), se3.translation_error_m(T, found)
    return Trial(seed, deg, m, result.converged, used, result.score, agreed, climbed, result.reason)


def prepared(source: Source, row: Row, config: Config, change: Callable[[Frame], Frame] | None = None) -> None:
    """Features of the row's frames into _work."""
    assert source.reference is not None
    calibrator = Calibrator(source.camera, config)
    frames = (source[i] for i in spread(row.frames or min(len(source), 16), len(source)))
    features = [calibrator.extract(thinned(change(f) if change else f, row.every_ring)) for f in frames]
    _work.update(row=row, calibrator=calibrator, features=features, reference=source.reference)


def run(name: str, row: Row, config: Config, root: str, trials: int, workers: int) -> list[Trial]:
    """All trials of a row."""
    path = row.source if row.source.startswith("synthetic") else str(Path(root) / row.source)
    prepared(open_dataset(path), row, config)
    with multiprocessing.get_context("fork").Pool(workers) as pool:
        return list(tqdm(pool.imap(trial, range(trials)), name, trials, leave=False))


def line(name: str, trials: Sequence[Trial]) -> str:
    """One line of the table."""
    deg, cm = np.array([t.deg for t in trials]), np.array([100 * t.m for t in trials])
    good = (deg < SUCCESS_DEG) & (cm < 100 * SUCCESS_M)
    false = int((np.array([t.converged for t in trials]) & ~good).sum())
    used = np.median([t.cpu_s for t in trials])
    return (
        f"| {name} | {good.sum()}/{len(trials)} | {false} of {int((~good).sum())} | "
        f"{np.median(deg):.3f} / {np.percentile(deg, 90):.3f} | {np.median(cm):.1f} / {np.percentile(cm, 90):.1f} | {used:.2f} |"
    )


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=f"of {', '.join(ROWS)}; default all, or those of the ablation")
    parser.add_argument("--kitti", help="folder of the KITTI recordings")
    parser.add_argument("--trials", type=int, default=30)
    parser.add_argument("--config", help="YAML")
    parser.add_argument("--ablation", action="store_true", help=f"one part switched off at a time; {', '.join(ABLATION_ROWS)}")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="add every trial")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), metavar="N", help="processes (default one per core)")
    args = parser.parse_args()
    if unknown := set(args.rows) - set(ROWS):
        parser.error(f"no row {', '.join(sorted(unknown))}; there are {', '.join(ROWS)}")
    cv2.setNumThreads(1)  # before any work: a forked worker would wait for ever for threads that only its parent has
    config = Config.from_yaml(args.config) if args.config else Config()
    print(HEAD, flush=True)
    for name in args.rows or (ABLATION_ROWS if args.ablation else ROWS):
        if not args.kitti and ROWS[name].source != SYNTHETIC:
            continue
        for variant, change in (ABLATION if args.ablation else {"": {}}).items():
            label = f"{name}, {variant}" if variant else name
            with ExitStack() as stack:
                for target, other in PATCHES.get(variant, {}).items():
                    stack.enter_context(patch(target, other))
                trials = run(label, ROWS[name], update(config, change), args.kitti or "", args.trials, args.workers)
            print(line(label, trials), flush=True)
            append_records(args.csv, [dataclasses.replace(t, row=name, variant=variant) for t in trials])


if __name__ == "__main__":
    main()
