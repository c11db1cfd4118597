"""Is anything that is wrong ever called usable? A recording played to the recalibrator with one fault of a vehicle at a time.

Every run begins up to 2 deg / 0.2 m per axis beside the extrinsic, as a TF tree may, and estimates whenever the node would.
Faults are those of the recording (intrinsics) or of the start; clocks that disagree, and clouds in another frame, tilted or
upside down are none, but have to be understood.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.records import markdown
from benchmarks.sources import frames_of, in_other_frame, late, turned, with_intrinsics
from benchmarks.study_runner import CLASSES_OFF, NEAR, Case, End, FeaturesOf, Record, Study, Variant
from calib_ros import se3
from calib_ros.errors import CalibrationError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.calibrator import Calibrator
from calib_ros.result import CONVERGED, INITIAL, Result

Matrix = NDArray[np.float64]
START_DEG, START_M = 2.0, 0.2


@dataclass(frozen=True)
class Fault:
    """wrong: nothing may be accepted. of_start: (4, 4) by which the start is wrong, on the LiDAR's side."""

    changed: Callable[[Frame], Frame] = lambda frame: frame
    wrong: bool = True
    of_start: Matrix | None = None


FAULTS = {
    "none": Fault(wrong=False),
    "focal +5 %": Fault(partial(with_intrinsics, focal=0.05)),
    "focal -5 %": Fault(partial(with_intrinsics, focal=-0.05)),
    "principal point 20 px": Fault(partial(with_intrinsics, centre_px=(20.0, 0.0))),
    "images 80 ms late": Fault(partial(late, seconds=0.08), wrong=False),
    "images 50 ms early": Fault(partial(late, seconds=-0.05), wrong=False),
    "images a scan late": Fault(partial(late, seconds=0.1), wrong=False),
    "cloud tilted 20 deg": Fault(partial(in_other_frame, T_other_cloud=turned((0, 1, 0), 20.0)), wrong=False),
    "cloud upside down": Fault(partial(in_other_frame, T_other_cloud=turned((1, 0, 0), 180.0)), wrong=False),
    "cloud in base_link": Fault(partial(in_other_frame, T_other_cloud=turned((0, 0, 1), 3.0, (1.2, 0.1, 1.6))), wrong=False),
    "start upside down": Fault(of_start=turned((1, 0, 0), 180.0)),
    "start yaw 180 deg": Fault(of_start=turned((0, 0, 1), 180.0)),
}


def beside(truth: Matrix, fault: Fault, seed: int) -> Matrix:
    """The start (4, 4) of a run."""
    off = np.random.default_rng([seed, 7]).uniform(-1, 1, 6)
    start = se3.exp(off * ([np.deg2rad(START_DEG)] * 3 + [START_M] * 3)) @ truth
    return start if fault.of_start is None else start @ fault.of_start


@dataclass
class Watch:
    """What is told of the extrinsic in the course of a run, and whether it is true. seconds: until the first verdict, NaN if
    there was none: a usable extrinsic where nothing is wrong, a refusal where something is."""

    fault: Fault
    ever_wrong: bool = False
    usable: bool = False
    status: str = ""
    deg: float = float("nan")
    cm: float = float("nan")
    seconds: float = float("nan")

    def tell(self, T: Matrix, truth: Matrix, status: str, usable: bool, refused: bool, seconds: float) -> None:
        """The extrinsic T (4, 4), `seconds` after the start."""
        self.deg, self.cm = se3.rotation_error_deg(truth, T), 100 * se3.translation_error_m(truth, T)
        self.usable, self.status = usable, status
        claimed = usable or status == CONVERGED
        self.ever_wrong |= claimed and (self.deg > NEAR[0] or self.cm > NEAR[1])
        if (refused if self.fault.wrong else usable) and not np.isfinite(self.seconds):
            self.seconds = seconds

    def end(self, result: Result | None = None) -> End:
        """Of the run. CalibrationError if nothing was ever told."""
        if not self.status:
            raise CalibrationError("none of its frames can be used")
        said = f"{self.ever_wrong:d} {self.usable:d} {self.seconds:.1f}"
        return End(self.deg, self.cm, self.status, said, result)


def recordings(args: argparse.Namespace) -> Iterator[Case]:
    for number, name in enumerate(args.sources):
        yield Case(name if name.startswith("synthetic") else Path(name).name, frames_of(name), number)


def played(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """The recalibrator after every frame."""
    fault, frames = FAULTS[case.variant], case.frames
    start = Result(beside(case.truth, fault, trial), INITIAL)
    recalibrator = Recalibrator(frames[0].camera, start, calibrator.config)
    watch, result = Watch(fault), start
    for frame in frames:
        try:
            recalibrator.ingest(frame)
        except CalibrationError:
            continue
        if recalibrator.ready():
            recalibrator.estimate()
        extrinsic, reference = recalibrator.current, frame.reference
        assert reference is not None
        result, seconds = extrinsic.result, (frame.stamp - frames[0].stamp) / NANOSECONDS
        T, refused = result.T_camera_lidar, result.refusal is not None
        watch.tell(T, reference, result.status, extrinsic.usable, refused, seconds)
    return watch.end(result)


def table(records: Sequence[Record]) -> str:
    """A line per source and fault: the runs in which the extrinsic ever was `usable` or `converged` more than 0.5 deg or 10 cm
    off; the status at the end; and the data's own time to the first verdict."""
    rows = []
    for source, fault in dict.fromkeys((r.group, r.variant) for r in records):
        own = [r for r in records if (r.group, r.variant) == (source, fault)]
        ends = Counter(" ".join(filter(None, (r.status, r.refusal))) for r in own)
        wrong, usable, seconds = np.array([[float(value) for value in r.said.split()] for r in own]).T
        found = seconds[np.isfinite(seconds)]
        times = f"{np.median(found):.1f}; {found.max():.1f}" if len(found) else "–"
        times += f" ({len(own) - len(found)} without)" if len(found) < len(own) else ""
        said = ", ".join(f"{n} {end}" for end, n in ends.most_common())
        rows.append([source, fault, len(own), int(wrong.sum()), int(usable.sum()), said, times])
    head = "source, fault, runs, ever wrong, usable at the end, status and refusal at the end, s to the verdict (median; most)"
    return markdown(head.split(", "), rows)


VARIANTS = {name: Variant(CLASSES_OFF, fault.changed) for name, fault in FAULTS.items()}
STUDY = Study(recordings, played, VARIANTS, trials=10, table=table)
