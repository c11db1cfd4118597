"""What a small study is, and how it runs: sources x variants x trials -> a record each -> a table."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.records import markdown
from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config, update
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.classes import FrameSemantics
from calib_ros.registration.features import FrameFeatures
from calib_ros.result import CONVERGED

Matrix = NDArray[np.float64]
BOOTSTRAP = 2000
KEPT = 100  # features of frames that are kept for the next cases
NEAR, RIGHT = (0.5, 10.0), (0.3, 8.0)  # deg, cm: success from a start, and from nothing


@dataclass(frozen=True, eq=False)
class Case:
    """Frames that are estimated together. group: a row of the table. number: from which starts are drawn. lidar: (4, 4) by which
    the LiDAR's frame is moved. semantics: of each frame; None = what the configured models say. said: what is right."""

    group: str
    frames: Sequence[Frame]
    number: int = 0
    lidar: Matrix = field(default_factory=partial(np.eye, 4))
    semantics: Sequence[FrameSemantics] | None = None
    said: str = ""

    @property
    def truth(self) -> Matrix:
        """T_camera_lidar (4, 4) of the recording."""
        reference = self.frames[0].reference
        assert reference is not None
        return reference


class End(NamedTuple):
    """Where a trial ended, what would have been right, whether it was accepted, and what else it says."""

    T: Matrix
    truth: Matrix
    status: str = CONVERGED
    said: str = ""


class Variant(NamedTuple):
    """Changes of the configuration and of the frames. replaced: by the place of a name, what users have no option for."""

    config: dict[str, Any] = {}  # noqa: RUF012
    frame: Callable[[Frame], Frame] = lambda frame: frame
    replaced: Mapping[str, object] = {}


FeaturesOf = Callable[[], list[FrameFeatures]]
Estimate = Callable[[Calibrator, Case, FeaturesOf, int], End]


@dataclass(frozen=True)
class Study:
    """cases: by the command line. trials: of each case. limits: deg and cm of a success. remark: of the records of a row."""

    cases: Callable[[argparse.Namespace], Iterable[Case]]
    estimate: Estimate
    variants: Mapping[str, Variant] = field(default_factory=lambda: {"": Variant()})
    trials: int = 1
    limits: tuple[float, float] = NEAR
    remark: Callable[[Sequence[Record]], str] = lambda records: ""


@dataclass(frozen=True)
class Record:
    """The end of one trial."""

    group: str
    variant: str
    case: int
    trial: int
    deg: float
    cm: float
    status: str
    cpu_s: float
    said: str


class Prepared:
    """The calibrator of a variant, and the latest features that it has made."""

    def __init__(self, variant: Variant, camera: Camera) -> None:
        self.variant, self.calibrator = variant, Calibrator(camera, update(Config(), variant.config))
        self._made: list[tuple[Frame, FrameFeatures]] = []

    def changed(self, case: Case) -> Case:
        """The case as the variant has it."""
        return replace(case, frames=[self.variant.frame(frame) for frame in case.frames])

    def features(self, case: Case) -> list[FrameFeatures]:
        """Of all frames."""
        return [self._of(frame, case.semantics[k] if case.semantics else None) for k, frame in enumerate(case.frames)]

    def _of(self, frame: Frame, semantics: FrameSemantics | None) -> FrameFeatures:
        found = next((features for own, features in self._made if own is frame), None)
        if found is None:
            models, changed = self.calibrator.segmentation, self.variant.frame(frame)
            seen = models(changed) if semantics is None and models.active else semantics
            found = self.calibrator.extract(changed, seen)
            self._made = [*self._made[-KEPT:], (frame, found)]
        return found


def run(study: Study, args: argparse.Namespace, done: Sequence[Record]) -> Iterator[Record]:
    """Records that are not done yet; features of a frame are made once for each variant."""
    known = {(r.group, r.variant, r.case, r.trial) for r in done}
    chosen = {name: study.variants[name] for name in args.variants or study.variants}
    kept: dict[str, Prepared] = {}
    for number, case in enumerate(tqdm(islice(study.cases(args), args.cases), disable=not sys.stderr.isatty())):
        for name, variant in chosen.items():
            if name not in kept or kept[name].calibrator.extract.source_camera != case.frames[0].camera:
                kept[name] = Prepared(variant, case.frames[0].camera)
            own = kept[name]
            for trial in range(study.trials if study.trials == 1 else args.trials or study.trials):
                if (case.group, name, number, trial) in known:
                    continue
                began = time.process_time()
                with ExitStack() as stack:
                    for place, value in variant.replaced.items():
                        stack.enter_context(patch(place, value))
                    found = study.estimate(own.calibrator, own.changed(case), partial(own.features, case), trial)
                cpu = time.process_time() - began
                deg = se3.rotation_error_deg(found.truth, found.T)
                cm = 100 * se3.translation_error_m(found.truth, found.T)
                yield Record(case.group, name, number, trial, deg, cm, found.status, cpu, found.said)


def table(study: Study, records: Sequence[Record]) -> str:
    """A row for each group and variant."""
    rows = []
    for group in dict.fromkeys(r.group for r in records):
        own = [r for r in records if r.group == group]
        first = {(r.case, r.trial): good(r, study.limits) for r in own if r.variant == own[0].variant}
        for variant in dict.fromkeys(r.variant for r in own):
            found = [r for r in own if r.variant == variant]
            right = np.array([good(r, study.limits) for r in found])
            accepted = np.array([r.status == CONVERGED for r in found])
            deg, cm = np.array([r.deg for r in found]), np.array([r.cm for r in found])
            pairs = [(r.case, float(g) - first[r.case, r.trial]) for r, g in zip(found, right, strict=True)]
            rows.append(
                [
                    group,
                    variant,
                    f"{right.sum()} of {len(found)}",
                    f"{np.median(deg):.3f}, {np.percentile(deg, 90):.2f}",
                    f"{np.median(cm):.1f}, {np.percentile(cm, 90):.1f}",
                    (accepted & ~right).sum(),
                    (~accepted).sum(),
                    f"{np.median([r.cpu_s for r in found]):.2f}",
                    "" if variant == own[0].variant else interval(pairs),
                    study.remark(found),
                ]
            )
    head = "cases, variant, success, deg: median 90 %, cm: median 90 %, accepted wrong, refused, CPU s, more successes, remark"
    return markdown(head.split(", "), rows)


def good(record: Record, limits: tuple[float, float]) -> bool:
    """Near enough, accepted or not."""
    return record.deg < limits[0] and record.cm < limits[1]


def interval(pairs: Sequence[tuple[int, float]]) -> str:
    """Mean of paired differences with its 95 % interval, by a bootstrap over the cases."""
    groups = [[d for case, d in pairs if case == one] for one in dict.fromkeys(case for case, _ in pairs)]
    rng = np.random.default_rng(0)
    drawn = [np.mean(np.concatenate([groups[k] for k in rng.integers(len(groups), size=len(groups))])) for _ in range(BOOTSTRAP)]
    low, high = np.percentile(drawn, (2.5, 97.5))
    return f"{100 * np.mean([d for _, d in pairs]):+.0f} % ({100 * low:+.0f} to {100 * high:+.0f})"
