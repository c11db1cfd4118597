"""What a study is, and how it runs: cases x variants x trials -> a record each -> a table."""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby, islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config, MotionConfig, update
from calib_ros.datasets import open_dataset
from calib_ros.datasets.source import Source, WithMotion
from calib_ros.errors import CalibrationError
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import CONVERGED, Result

Matrix = NDArray[np.float64]
KEPT = 100  # features of frames that are kept for the next cases
NEAR = (0.5, 10.0)  # deg, cm: success
CLASSES_OFF = {"semantics": {"image_classes": "", "cloud_classes": ""}}
NAN = float("nan")


def frames_of(name: str, motion: MotionConfig | None = None) -> list[Frame]:
    """All frames of a source by its name; with the vehicle's motion from neighbouring scans, if that is wanted."""
    source: Source = open_dataset(name)
    source = source if motion is None else WithMotion(source, motion)
    return [source[k] for k in range(len(source))]


@dataclass(frozen=True, eq=False)
class Case:
    """Frames that are estimated together. group: a row of the table. number: from which starts are drawn.

    source: cases of one, in a row, have frames in common, whose features are made once; "" = alone. starts, box: (4, 4) of every
    trial, and how far off it may be, where the case fixes them. config: changes for this case. limits: deg and cm of a success.
    """

    group: str
    frames: Sequence[Frame]
    number: int = 0
    source: str = ""
    starts: Sequence[Matrix] = ()
    box: SearchBox | None = None
    config: dict[str, Any] = field(default_factory=dict)
    limits: tuple[float, float] = NEAR

    @property
    def truth(self) -> Matrix:
        """T_camera_lidar (4, 4) of the recording. CalibrationError if it states none."""
        if (reference := self.frames[0].reference) is None:
            raise CalibrationError(f"{self.group} knows no extrinsic to compare with; give a KITTI folder or a synthetic drive")
        return reference

    def begun(self, starts: Sequence[Matrix]) -> Case:
        """The case with a trial from each of these starts."""
        return replace(self, starts=starts)


class End(NamedTuple):
    """How a trial ended: error, whether it was accepted, what else it says, the estimate. cpu_s: where not all of it counts."""

    deg: float
    cm: float
    status: str = CONVERGED
    said: str = ""
    result: Result | None = None
    cpu_s: float = NAN

    @staticmethod
    def at(T: Matrix, truth: Matrix, status: str = CONVERGED, said: str = "", result: Result | None = None) -> End:
        """At an extrinsic T (4, 4), where truth (4, 4) would have been right."""
        return End(se3.rotation_error_deg(truth, T), 100 * se3.translation_error_m(truth, T), status, said, result)


class Variant(NamedTuple):
    """Changes of the configuration and of the frames."""

    config: dict[str, Any] = {}  # noqa: RUF012
    frame: Callable[[Frame], Frame] = lambda frame: frame


FeaturesOf = Callable[[], list[FrameFeatures]]
Estimate = Callable[[Calibrator, Case, FeaturesOf, int], End]


@dataclass(frozen=True)
class Study:
    """cases: by the command line. table: of the records, for people. trials: of each case."""

    cases: Callable[[argparse.Namespace], Iterable[Case]]
    estimate: Estimate
    table: Callable[[Sequence[Record]], str]
    variants: Mapping[str, Variant] = field(default_factory=lambda: {"": Variant(CLASSES_OFF)})
    trials: int = 1


@dataclass(frozen=True)
class Record:
    """The end of one trial. right: within the limits, accepted or not. cpu_s: without features. From refusal on, what the
    estimate says of itself; nees: its error squared, normalised by its covariance."""

    group: str
    variant: str
    case: int
    trial: int
    right: bool
    deg: float
    cm: float
    status: str
    cpu_s: float
    said: str
    frames: int = 1
    refusal: str = ""
    nees: float = NAN
    disagreement: float = NAN

    @property
    def accepted(self) -> bool:
        return self.status == CONVERGED


def _of_result(result: Result, truth: Matrix) -> dict[str, Any]:
    """What a record takes from an estimate."""
    known: dict[str, Any] = {"refusal": result.refusal.value if result.refusal else ""}
    if result.evidence is not None:
        known["disagreement"] = result.evidence.disagreement
    if result.covariance is not None:
        T = result.T_camera_lidar if result.optimum is None else result.optimum
        off = se3.log(T @ se3.inverse(truth))
        known["nees"] = float(off @ np.linalg.solve(result.covariance, off))
    return known


class Prepared:
    """The calibrator of a variant, and the latest features that it has made. spent: CPU s, for features so far."""

    def __init__(self, name: str, variant: Variant, case: Case, config: Config) -> None:
        self.name, self.variant, self._own = name, variant, case.config
        self.calibrator = Calibrator(case.frames[0].camera, update(update(config, variant.config), case.config))
        self.spent = 0.0
        self._made: list[tuple[Frame, FrameFeatures]] = []

    def fits(self, case: Case) -> bool:
        """True if the case has the same camera and the same changes."""
        camera: Camera = self.calibrator.extract.source_camera
        return camera == case.frames[0].camera and self._own == case.config

    def changed(self, case: Case) -> Case:
        """The case as the variant has it."""
        return replace(case, frames=[self.variant.frame(frame) for frame in case.frames])

    def features(self, case: Case) -> list[FrameFeatures]:
        """Of all frames."""
        began = time.process_time()
        try:
            return [self._of(frame) for frame in case.frames]
        finally:
            self.spent += time.process_time() - began

    def _of(self, frame: Frame) -> FrameFeatures:
        found = next((features for own, features in self._made if own is frame), None)
        if found is None:
            models, changed = self.calibrator.segmentation, self.variant.frame(frame)
            found = self.calibrator.extract(changed, models(changed) if models.active else None)
            self._made = [*self._made[-KEPT:], (frame, found)]
        return found


Task = tuple[str, list[tuple[int, Case, list[int]]]]  # a variant, and the trials of numbered cases


class Worker:
    """Does tasks of a study; what it has prepared is kept for the next ones."""

    def __init__(self, study: Study, config: Config) -> None:
        self.study, self.config = study, config
        self._kept: dict[str, Prepared] = {}

    def __call__(self, task: Task) -> list[Record]:
        name, cases = task
        records = []
        for number, case, trials in cases:
            if name not in self._kept or not self._kept[name].fits(case):
                self._kept[name] = Prepared(name, self.study.variants[name], case, self.config)
            for trial in trials:
                try:
                    records.append(self._record(self._kept[name], number, case, trial))
                except CalibrationError as error:
                    print(f"{case.group}, {name}: {error}", file=sys.stderr)
        if cases[0][1].source:  # no other task has its frames
            self._kept.pop(name, None)
        return records

    def _record(self, own: Prepared, number: int, case: Case, trial: int) -> Record:
        changed = own.changed(case)
        began, before = time.process_time(), own.spent
        end = self.study.estimate(own.calibrator, changed, partial(own.features, case), trial)
        cpu = time.process_time() - began - (own.spent - before) if np.isnan(end.cpu_s) else end.cpu_s
        right = end.deg < case.limits[0] and end.cm < case.limits[1]
        known = {} if end.result is None else _of_result(end.result, changed.truth)
        about = case.group, own.name, number, trial, right, end.deg, end.cm, end.status, cpu, end.said, len(case.frames)
        return Record(*about, **known)


_worker: Worker | None = None  # of the study that runs; its processes inherit it


def _done(task: Task) -> list[Record]:
    assert _worker is not None
    return _worker(task)


def run(study: Study, args: argparse.Namespace, done: Sequence[Record]) -> Iterator[Record]:
    """Records that are not done yet, in the order of cases and variants. Trials that fail are told on stderr."""
    global _worker
    _worker = Worker(study, Config.from_yaml(args.config) if args.config else Config())
    tasks, shown = _tasks(study, args, done), not sys.stderr.isatty()
    if args.workers == 1:
        for task in tqdm(tasks, disable=shown):
            yield from _worker(task)
        return
    with multiprocessing.get_context("fork").Pool(args.workers) as pool:
        for records in tqdm(pool.imap(_done, tasks), disable=shown):
            yield from records


def _tasks(study: Study, args: argparse.Namespace, done: Sequence[Record]) -> Iterator[Task]:
    known = {(r.group, r.variant, r.case, r.trial) for r in done}
    trials = range(study.trials if study.trials == 1 else args.trials or study.trials)
    numbered = enumerate(islice(study.cases(args), args.cases))
    for _, part in groupby(numbered, lambda pair: pair[1].source or pair[0]):
        cases = list(part)
        for name in args.variants or study.variants:
            left = []
            for n, case in cases:
                own = range(len(case.starts)) if case.starts else trials
                left.append((n, case, [t for t in own if (case.group, name, n, t) not in known]))
            if any(own for _, _, own in left):
                yield name, left
