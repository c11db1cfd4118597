"""Are right intrinsics ever refused, and wrong ones ever accepted? Single frames and sets, searched from up to 2 deg / 15 cm."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarks.records import markdown
from benchmarks.study_runner import CLASSES_OFF, Case, End, FeaturesOf, Record, Study, Variant, frames_of
from calib_ros import se3
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import CONVERGED, RefusalCode
from calib_ros_synthetic.rigs import PAIRS

BOX = SearchBox(2.5, 0.2)
START_DEG, START_M = 2.0, 0.15
SINGLES, SIZES, SETS = 6, (2, 3, 5, 10), 3  # single frames, and frames of how many sets each
SIZE_NAMES = ((1, "1"), (3, "2-3"), (10, "5-10"))


def start_of(case: Case, trial: int) -> NDArray[np.float64]:
    """Half the largest start error or more beside the truth, (4, 4)."""
    rng = np.random.default_rng([case.number, trial])
    turn, shift = (v / np.linalg.norm(v) * rng.uniform(0.5, 1.0) for v in rng.normal(size=(2, 3)))
    return se3.perturb(case.truth, START_DEG * turn, START_M * shift)


def claimed(frame: Frame, focal: float = 0.0, centre: Sequence[float] = (0.0, 0.0), corner: float = 0.0) -> Frame:
    """The same picture with a CameraInfo that is wrong, by shares of focal length, image width and the corner's radius."""
    K, D = frame.camera.K.copy(), frame.camera.D
    if corner:
        ray = np.linalg.solve(K, [0.0, 0.0, 1.0])[:2]
        D = np.array([corner / (ray @ ray), 0.0, 0.0, 0.0, 0.0])
    K[[0, 1], [0, 1]] *= 1 + focal
    K[:2, 2] += frame.camera.width * np.array(centre)
    return replace(frame, camera=replace(frame.camera, K=K, D=D))


VARIANTS = {
    "as given": Variant(CLASSES_OFF),
    "focal +1 %": Variant(CLASSES_OFF, partial(claimed, focal=0.01)),
    "focal +3 %": Variant(CLASSES_OFF, partial(claimed, focal=0.03)),
    "focal -3 %": Variant(CLASSES_OFF, partial(claimed, focal=-0.03)),
    "focal +5 %": Variant(CLASSES_OFF, partial(claimed, focal=0.05)),
    "distortion of 5 %": Variant(CLASSES_OFF, partial(claimed, corner=0.05)),
    "centre 2 % across": Variant(CLASSES_OFF, partial(claimed, centre=(0.02, 0.0))),
    "centre 2 % down": Variant(CLASSES_OFF, partial(claimed, centre=(0.0, 0.02))),
}


def sets(args: argparse.Namespace) -> Iterator[Case]:
    """Of the sources; without any, of the synthetic rigs."""
    for number, name in enumerate(args.sources or [f"synthetic:rig={rig},frames=10" for rig in PAIRS]):
        frames, rng = frames_of(name), np.random.default_rng(number)
        chosen = [[k] for k in range(min(len(frames), SINGLES))]
        for size in SIZES:
            if size <= len(frames):
                draws = 1 if size == len(frames) else SETS
                chosen += [sorted(rng.choice(len(frames), size, replace=False)) for _ in range(draws)]
        for k, own in enumerate(chosen):
            yield Case(name, [frames[i] for i in own], 1000 * number + k, source=name)


def searched(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """By a calibrator of the intrinsics that are claimed."""
    own = Calibrator(case.frames[0].camera, calibrator.config)
    result = own.estimate([own.extract(frame) for frame in case.frames], start_of(case, trial), BOX)
    T = result.T_camera_lidar if result.optimum is None else result.optimum
    return End.at(T, case.truth, result.status, result=result)


def table(records: Sequence[Record]) -> str:
    """A line per variant and size of the sets, of all sources."""
    rows = []
    for variant in dict.fromkeys(r.variant for r in records):
        least = 0
        for most, name in SIZE_NAMES:
            own = [r for r in records if r.variant == variant and least < r.frames <= most]
            least = most
            if own:
                accepted = [r for r in own if r.status == CONVERGED]
                named = sum(r.refusal == RefusalCode.WRONG_INTRINSICS.value for r in own)
                wrong = sum(not r.right for r in accepted)
                rows.append([variant, name, len(own), len(accepted), wrong, named, len(own) - len(accepted) - named])
    head = "intrinsics, frames, sets, accepted, of them beyond 0.5 deg or 10 cm, wrong_intrinsics, refused otherwise"
    return markdown(head.split(", "), rows)


STUDY = Study(sets, searched, table, VARIANTS)
