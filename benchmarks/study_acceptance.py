"""Does the acceptance test accept by chance as rarely as it says?"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
from scipy.stats import binomtest

from benchmarks.records import markdown
from benchmarks.study_registration import EXACT_SENSORS, FEW, rigs_of, short, spread
from benchmarks.study_runner import Case, End, FeaturesOf, Record, Study, frames_of
from calib_ros import se3
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.search.constraints import SearchBox

BOX = SearchBox(5.0, 0.3)
CLAIMED = (0.1, 0.02, 0.005)  # p values, whose shares are counted
MIRRORED = "mirrored"


@cache
def few_frames(name: str) -> tuple[Frame, ...]:
    """Some frames of a source, spread over it."""
    frames = frames_of(name)
    return tuple(frames[k] for k in np.unique(spread(min(4 * FEW, len(frames)), len(frames))))


def sensors(name: str) -> str:
    """The rig of a synthetic drive; recordings are of much the same ones."""
    return name.split(",")[0] if name.startswith("synthetic") else ""


def shuffled(args: argparse.Namespace) -> Iterator[Case]:
    """Images with scans of another place, and mirrored ones with their own: of every source with those of each other, and of a
    rig with those of its other scenes. No extrinsic is right."""
    names = [*args.sources, *rigs_of(args)]
    for name in names:
        own = few_frames(name)
        is_synthetic = name.startswith("synthetic")
        elsewhere = [other for other in names if other != name and sensors(other) == sensors(name)]
        group = sensors(name) or short(name)
        flipped = [replace(f, image=np.ascontiguousarray(cv2.flip(f.image, 1))) for f in own]
        wrong = [(MIRRORED, pair) for pair in flipped]
        for other in elsewhere:
            clouds = itertools.cycle(few_frames(other))
            wrong += [("elsewhere", replace(f, cloud=next(clouds).cloud, twist=None, compensated=True)) for f in own]
        for number, (how, frame) in enumerate(wrong):
            rng = np.random.default_rng([number, len(own)])
            case = Case(f"{group}, {how}", [frame], box=BOX, config=EXACT_SENSORS if is_synthetic else {})
            starts = [
                np.asarray(se3.perturb(case.truth, *rng.uniform(-1, 1, (2, 3)) * [[5.0], [0.3]])) for _ in range(args.trials or 1)
            ]
            yield case.begun(starts)


def searched(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """deg, cm: of the estimate, or of the optimum that was refused. said: the p value."""
    result = calibrator.estimate(features(), case.starts[trial], case.box)
    T = result.T_camera_lidar if result.optimum is None else result.optimum
    p = np.nan if result.evidence is None else result.evidence.p_value
    return End.at(T, case.truth, result.status, f"{p:.3g}", result)


def chance_table(records: Sequence[Record]) -> str:
    """By source and over all: how often p values of what cannot be right are below those that are claimed, with the 95 % interval
    of that share, and how much is accepted."""
    groups = {group: [r for r in records if r.group == group] for group in dict.fromkeys(r.group for r in records)}
    rows = []
    for group, own in [*groups.items(), ("all", list(records))]:
        p = np.array([float(r.said) for r in own if r.said != "nan"])
        cells = []
        for claimed in CLAIMED:
            count = int((p <= claimed).sum())
            low, high = binomtest(count, max(len(p), 1)).proportion_ci(method="wilson")
            cells.append(f"{100 * count / max(len(p), 1):.1f} % ({100 * low:.1f} to {100 * high:.1f})")
        rows.append([group, len(p), *cells, sum(r.accepted for r in own)])
    return markdown(["images with scans", "trials", *(f"p <= {claimed:g}" for claimed in CLAIMED), "accepted"], rows)


STUDY = Study(shuffled, searched, chance_table)
