"""Is what is accepted right, and what is right accepted, on every vehicle? A table per set, and a CSV line per trial.

    python -m benchmarks.vehicle_study SOURCE ... [--soft FOLDER ...] [--rigs [SCENE ...]] [--trials 1]
        [--without PART ...] [--csv FILE] [--workers N]

SOURCE: what `calib-ros` takes, with a reference that is exact, or KITTI's: right = within 0.5 deg and 10 cm of it. --soft:
sources whose reference is no better than that: right = within 0.9 deg and 25 cm. --rigs: the synthetic rigs as well, in these
scenes, or in all three.

Every set gives trials with one frame from 5 deg / 0.3 m (every frame in turn, at most 12), and, where it has so many, with 5
spread frames and with all (at most 12) from 5 deg / 0.3 m, 10 deg / 0.5 m and 20 deg / 1 m; starts are uniform per axis around
the reference, by the seed of the trial. All trials count. --without: the same trials again with each of these parts switched off
in turn, to see what it brings, and a table of totals.

NEES: normalised error squared of the accepted ones, 6 on average if the covariance is right; it means little with --soft. Halves:
how far halves of the data end apart, about 1 where they agree as well as their covariances let expect.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.records import append_records, markdown
from calib_ros import se3
from calib_ros.config import Config, update
from calib_ros.datasets import open_dataset
from calib_ros.errors import CalibrationError
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_synthetic.rigs import RIGS

Matrix = NDArray[np.float64]
EXACT, SOFT = (0.5, 10.0), (0.9, 25.0)  # deg, cm
SINGLE, SEVERAL = ((5.0, 0.3),), ((5.0, 0.3), (10.0, 0.5), (20.0, 1.0))  # deg, m
MOST_SINGLE, MOST, FEW = 12, 12, 5
SCENES = ("street", "park", "warehouse")
# The classes are off throughout, so that edges alone are judged.
BASE = {"semantics": {"image_classes": "", "cloud_classes": ""}}
# Intrinsics and clocks of rendered drives are exact, and their covariances are to be compared with the errors that remain.
EXACT_SENSORS = {"camera": {"focal_sigma": 0.0}, "motion": {"time_offset_sigma_s": 0.0}}
# Each part has its own way to be switched off: by the configuration, or, where users have no reason to, from outside.
WITHOUT: dict[str, dict[str, dict[str, object]]] = {
    "": {},
    "contrast": {},
    "rings": {"lidar": {"layout": "projection"}},
    "scanner_pose": {"lidar": {"scanner_pose": "given"}},
    "decoy": {"refine": {"max_p_value": 1.0}},
    "tolerance": {"refine": {"tolerance_deg": 180.0, "tolerance_m": 100.0}},
    "split_half": {},
    "trust_region": {},
}
PATCHES: dict[str, tuple[str, Callable[..., Any]]] = {
    "contrast": ("calib_ros.image.edges._normalised", lambda edge, sigma: edge),
    "split_half": ("calib_ros.registration.acceptance.checks.disagreement", lambda score, T, limits: 1.0),
    "trust_region": (
        "calib_ros.registration.search.constraints.PoseConstraints.within_trust_region",
        lambda self, T, max_deg, max_m: self,
    ),
}


@dataclass(frozen=True)
class Trial:
    """frames: their positions in the source. box: half widths in deg and m."""

    source: str
    soft: bool
    frames: tuple[int, ...]
    box: tuple[float, float]
    seed: int
    without: str


@dataclass(frozen=True)
class Outcome:
    """deg, cm: error of the estimate, or of the optimum that was refused. score_near_reference: of the refinement from the
    reference; where it is clearly larger than the score, the search has missed it."""

    source: str
    without: str
    frames: int
    box_deg: float
    seed: int
    verdict: str
    refusal: str
    deg: float
    cm: float
    nees: float
    z_score: float
    p_value: float
    disagreement: float
    sigma_deg: float
    sigma_cm: float
    rounds_of_starts: int
    cpu_s: float
    score: float
    score_near_reference: float


def trials_of(source: str, soft: bool, repeats: int, without: str) -> Iterator[Trial]:
    """All trials of a source. Frames of several calibrations make no set."""
    data = open_dataset(source)
    n = len(data)
    spread = [tuple(int(k) for k in np.unique(np.linspace(0, n - 1, size).round().astype(int))) for size in (FEW, MOST)]
    # All frames make a set of their own only where they are clearly more than the few.
    sets = spread[: 2 if len(spread[1]) >= 1.5 * FEW else 1] if n >= FEW else ([tuple(range(n))] if n > 1 else [])
    if not source.startswith("synthetic") and n > 1 and data[0].camera != data[1].camera:
        sets = []
    for seed in range(repeats):
        for frame in spread[1] if n > MOST_SINGLE else range(n):
            yield from (Trial(source, soft, (frame,), box, seed, without) for box in SINGLE)
        for frames in sets:
            yield from (Trial(source, soft, frames, box, seed, without) for box in SEVERAL)


@lru_cache(maxsize=1)
def frames_of(source: str) -> list[Frame]:
    """All frames of a source."""
    data = open_dataset(source)
    return [data[k] for k in range(len(data))]


@lru_cache(maxsize=1)
def opened(source: str, without: str) -> list[tuple[Calibrator, FrameFeatures, Matrix]]:
    """For every frame of a source the calibrator of its camera, its features, and its reference."""
    calibrators: list[Calibrator] = []
    out = []
    for frame in frames_of(source):
        if frame.reference is None:
            raise CalibrationError(f"{source} has no reference extrinsic; nothing can be compared")
        own = [c for c in calibrators if c.extract.source_camera == frame.camera]
        if not own:
            config = update(update(Config(), BASE), WITHOUT[without])
            own = [Calibrator(frame.camera, update(config, EXACT_SENSORS) if source.startswith("synthetic") else config)]
            calibrators += own
        with switched_off(without):
            out.append((own[0], own[0].extract(frame), frame.reference))
    return out


def switched_off(part: str) -> AbstractContextManager[object]:
    """Within it, the part of PATCHES is off."""
    return patch(*PATCHES[part]) if part in PATCHES else nullcontext()


def run(trial: Trial) -> Outcome:
    """One trial."""
    cv2.setNumThreads(1)
    frames = [opened(trial.source, trial.without)[k] for k in trial.frames]
    calibrator, _, reference = frames[0]
    features = [f for _, f, _ in frames]
    deg, m = trial.box
    xi = np.random.default_rng([trial.seed, *trial.frames]).uniform(-1, 1, 6) * ([np.deg2rad(deg)] * 3 + [m] * 3)
    with switched_off(trial.without):
        started = time.process_time()
        result = calibrator.estimate(features, se3.exp(xi) @ reference, SearchBox(deg, m))
        spent = time.process_time() - started
        near = calibrator.estimate(features, reference)
    T = result.T_camera_lidar if result.optimum is None else result.optimum
    error = se3.rotation_error_deg(reference, T), 100 * se3.translation_error_m(reference, T)
    limit = SOFT if trial.soft else EXACT
    right = error[0] < limit[0] and error[1] < limit[1]
    accepted = "accepted" if result.converged else "refused"
    sigma, squared = np.full(6, np.nan), float("nan")
    if result.covariance is not None:
        away = se3.log(T @ se3.inverse(reference))
        sigma, squared = np.sqrt(np.diag(result.covariance)), float(away @ np.linalg.solve(result.covariance, away))
    evidence = result.evidence
    return Outcome(
        trial.source,
        trial.without,
        len(trial.frames),
        deg,
        trial.seed,
        f"{accepted} {'right' if right else 'wrong'}",
        result.refusal.value if result.refusal else "",
        *error,
        squared,
        evidence.z_score if evidence else float("nan"),
        evidence.p_value if evidence else 1.0,
        evidence.disagreement if evidence else float("nan"),
        float(np.rad2deg(sigma[:3].max())),
        float(100 * sigma[3:].max()),
        result.starts[1] if result.starts else 0,
        spent,
        result.score,
        near.score,
    )


def table(outcomes: Sequence[Outcome]) -> str:
    """A line per source, number of frames and box."""
    head = (
        "set, frames, from, trials, accepted right, accepted wrong, refused, right of these, median (deg cm), 90 %, NEES, halves"
    )
    rows = []
    for (source, frames, deg), own in sorted(grouped(outcomes, "source").items()):
        kept = np.array([(o.deg, o.cm) for o in own if o.verdict.startswith("accepted")]).reshape(-1, 2)
        quantiles = [f"{a:.2f} {b:.1f}" for a, b in np.percentile(kept, [50, 90], axis=0)] if len(kept) else ["", ""]
        halves = [o.disagreement for o in own if np.isfinite(o.disagreement)]
        name = source if source.startswith("synthetic") else "/".join(Path(source).parts[-2:])
        right, wrong, left = (counted(own, v) for v in ("accepted right", "accepted wrong", "refused right"))
        counts = [len(own), right, wrong, len(own) - right - wrong, left]
        rows.append(
            [name, frames, f"{deg:g} deg", *counts, *quantiles, nees(own), f"{np.mean(halves):.1f}" if halves else "", cpu(own)]
        )
    return markdown([*head.split(", "), "CPU s"], rows)


def totals(outcomes: Sequence[Outcome]) -> str:
    """A line per part that is switched off, and one with all parts: over all sources."""
    head = ["without", "frames", "from", "trials", "accepted right", "accepted wrong", "refused right", "NEES", "CPU s"]
    rows = []
    for (without, frames, deg), own in grouped(outcomes, "without").items():
        counts = [counted(own, v) for v in ("accepted right", "accepted wrong", "refused right")]
        rows.append([without or "nothing", frames, f"{deg:g} deg", len(own), *counts, nees(own), cpu(own)])
    return markdown(head, rows)


def grouped(outcomes: Sequence[Outcome], by: str) -> dict[tuple[str, str, float], list[Outcome]]:
    """By a field, whether there is one frame or several, and the box."""
    groups: dict[tuple[str, str, float], list[Outcome]] = {}
    for o in outcomes:
        groups.setdefault((getattr(o, by), "1" if o.frames == 1 else "several", o.box_deg), []).append(o)
    return groups


def counted(own: Sequence[Outcome], verdict: str) -> int:
    return sum(o.verdict == verdict for o in own)


def nees(own: Sequence[Outcome]) -> str:
    known = [o.nees for o in own if np.isfinite(o.nees)]
    return f"{np.mean(known):.1f}" if known else ""


def cpu(own: Sequence[Outcome]) -> str:
    return f"{np.median([o.cpu_s for o in own]):.1f}, at most {max(o.cpu_s for o in own):.1f}"


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*")
    parser.add_argument("--soft", nargs="*", default=[])
    parser.add_argument("--rigs", nargs="*", choices=SCENES, metavar="SCENE")
    parser.add_argument("--trials", type=int, default=1)
    parser.add_argument(
        "--without", nargs="*", default=[], choices=list(WITHOUT), metavar="PART", help=", ".join(filter(None, WITHOUT))
    )
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    sources = [(s, False) for s in args.sources] + [(s, True) for s in args.soft]
    if args.rigs is not None:
        sources += [(f"synthetic:rig={rig},scene={s},frames={FEW}", False) for s in args.rigs or SCENES for rig in RIGS]
    if args.csv and args.csv.exists():
        parser.error(f"{args.csv} exists already; give another file")
    if not sources:
        parser.error("give a source, or --rigs")
    parts = list(dict.fromkeys(["", *args.without]))
    trials = [t for source, soft in sources for part in parts for t in trials_of(source, soft, args.trials, part)]
    outcomes: list[Outcome] = []
    with ProcessPoolExecutor(args.workers) as pool:
        # Whole sources go to a worker, so that their features are made once.
        pending = {pool.submit(run_all, [t for t in trials if t.source == source]): source for source, _ in sources}
        for done in tqdm(as_completed(pending), total=len(pending), disable=not sys.stderr.isatty()):
            try:
                outcomes += done.result()
                append_records(args.csv, done.result())
            except CalibrationError as error:
                print(f"{pending[done]}: {error}", file=sys.stderr)
    print(table([o for o in outcomes if not o.without]))
    if len(parts) > 1:
        print(totals(sorted(outcomes, key=lambda o: (parts.index(o.without), o.frames > 1, o.box_deg))))


def run_all(trials: Sequence[Trial]) -> list[Outcome]:
    """Trials of one source, one after the other."""
    return [run(t) for t in trials]


if __name__ == "__main__":
    main()
