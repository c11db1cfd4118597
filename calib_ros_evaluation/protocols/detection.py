"""Is a miscalibration told from a right extrinsic? Published perturbations of KITTI odometry 00, each a verdict of the check."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros_check.checker import Checker
from calib_ros_check.jobs.journal import Answer
from calib_ros_check.outcome import CheckVerdict, Tolerance
from calib_ros_evaluation.csv_files import read_rows
from calib_ros_evaluation.experiments.answers import read_answer
from calib_ros_evaluation.experiments.job import EvaluationJob, job
from calib_ros_evaluation.experiments.setup import NOT_THE_METHODS, Setup, SourceSummary, worker_cache
from calib_ros_evaluation.protocols.definitions import MISCALIBRATION

Matrix = NDArray[np.float64]
RIGHT_SET = "pos"  # holds right extrinsics, all others wrong ones
DOUBLED = 2.0  # the published code turns by twice the degrees of its table, and so do the published figures
TOLERANCE = Tolerance(1.0, 0.05)  # what the set of right ones lies within: up to 1.0 deg and 3.5 cm
ADVICE = "give the table of published perturbations by --table"
COLUMNS = ("set", "frame", "x_m", "y_m", "z_m", "rx_deg", "ry_deg", "rz_deg")
LARGEST = {"m": se3.MAX_TRANSLATION_M, "deg": 360.0}
RIGHT, WRONG, INCONCLUSIVE = "right", "wrong", "inconclusive"


@dataclass(frozen=True)
class Perturbed:
    """A row of the published table. shift: m. rotation_deg: as printed, before it is doubled."""

    set_name: str
    frame: str
    shift: tuple[float, ...]
    rotation_deg: tuple[float, ...]

    @property
    def D(self) -> Matrix:
        """(4, 4) that the right extrinsic is multiplied with from the right, T_camera_lidar D: a rotation vector of DOUBLED the
        printed degrees, and the shift."""
        turn = DOUBLED * np.deg2rad(self.rotation_deg)
        return se3.from_parts(Rotation.from_rotvec(turn).as_matrix(), self.shift)


@dataclass(frozen=True)
class Decision:
    """What the check said about a row. count: of frames. error_deg, error_m: of the extrinsic that was checked (eq. 2.19)."""

    set_name: str
    frame: str
    count: int
    error_deg: float
    error_m: float
    verdict: CheckVerdict
    reason: str
    cpu_s: float

    @property
    def kind(self) -> str:
        """RIGHT, WRONG or INCONCLUSIVE."""
        if self.verdict is CheckVerdict.INCONCLUSIVE:
            return INCONCLUSIVE
        return RIGHT if self.verdict is (CheckVerdict.PASS if self.set_name == RIGHT_SET else CheckVerdict.FAIL) else WRONG


def read_table(path: Path) -> list[Perturbed]:
    """Rows of a CSV file with COLUMNS. BadInputError, with the line, for a file that cannot be read or is none of these, or
    without rows."""
    rows = []
    for where, row in read_rows(path, COLUMNS, ADVICE):
        values = tuple(_value(row[name], name, where) for name in COLUMNS[2:])
        rows.append(Perturbed(row["set"], row["frame"], values[:3], values[3:]))
    if not rows:
        raise BadInputError(f"{path} has no rows; {ADVICE}")
    return rows


def _value(text: str | None, name: str, where: str) -> float:
    """A number of the table, m or deg."""
    most = LARGEST[name.rpartition("_")[2]]
    try:
        value = float(text) if text else math.nan
    except ValueError:
        value = math.nan
    if not abs(value) <= most:  # NaN neither
        raise BadInputError(f"{where}: {name} is {text or 'missing'}; give a number of at most {most:g}")
    return value


def positions_of(rows: Sequence[Perturbed], names: Mapping[str, int]) -> dict[str, int]:
    """Positions of the frames of the rows, by their names in the table; those are left out that the source has not.

    names: of the source's frames, and their positions. Leading zeros of a number, which spreadsheets drop, do not count.
    """
    numbers = {int(name): position for name, position in names.items() if name.isdecimal()}
    found = {}
    for frame in dict.fromkeys(row.frame for row in rows):
        position = names.get(frame, numbers.get(int(frame)) if frame.isdecimal() else None)
        if position is not None:
            found[frame] = position
    return found


def detection_jobs(
    rows: Sequence[Perturbed], names: Mapping[str, int], source: SourceSummary, counts: Sequence[int]
) -> list[EvaluationJob]:
    """A check of every row whose frame the source has, with every number of frames: its own and those that follow in the source,
    the first after the last. names: of the source's frames, and their positions.

    BadInputError if there is no such row, or for more frames than the source has.
    """
    positions = positions_of(rows, names)
    known = [(number, row) for number, row in enumerate(rows) if row.frame in positions]
    if not known:
        raise BadInputError(
            f"{source.label} has no frame {rows[0].frame}, nor any other of the table's {len({row.frame for row in rows})}; its "
            f"frames are {', '.join(list(names)[:3])}, ...; give the folder of KITTI odometry sequence 00 (sequences/00)"
        )
    out = []
    for count in counts:
        if count > len(source.frames):
            raise BadInputError(
                f"--frames-per-trial {count}: {source.label} has only {len(source.frames)} frames; give fewer, or another source"
            )
        for number, row in known:
            first = source.frames.index(positions[row.frame])
            frames = [source.frames[(first + k) % len(source.frames)] for k in range(count)]
            values: dict[str, float | int | str] = {"row": number, "set": row.set_name, "frame": row.frame}
            values |= dict(zip(COLUMNS[2:], (*row.shift, *row.rotation_deg), strict=True))
            out.append(job(MISCALIBRATION, "check", source.label, frames, values))
    return out


def run_checks(setup: Setup, jobs: Sequence[EvaluationJob]) -> list[Answer]:
    """The answers, in order: a check that cannot use its frames does not tell."""
    return [_checked(setup, one) for one in jobs]


def _checked(setup: Setup, one: EvaluationJob) -> Answer:
    cache, row = worker_cache(setup), _row(one)
    reference = cache.reference(one.scene, one.frames[0])
    T = reference @ row.D
    answer = {"error_deg": se3.rotation_error_deg(reference, T), "error_m": se3.translation_error_m(reference, T)}
    try:
        result = _checker(setup, one.scene).check([cache.frame(one.scene, k) for k in one.frames], T, TOLERANCE)
    except NOT_THE_METHODS:
        raise
    except CalibrationError as error:
        return {**answer, "verdict": CheckVerdict.INCONCLUSIVE.value, "reason": str(error), "cpu_s": 0.0}
    return {**answer, "verdict": result.verdict.value, "reason": result.reason, "cpu_s": result.cpu_s}


@lru_cache(maxsize=1)
def _checker(setup: Setup, label: str) -> Checker:
    """The checker of a process, whose look-up tables and models are kept."""
    return Checker(worker_cache(setup).source(label).camera, setup.config)


def _row(one: EvaluationJob) -> Perturbed:
    shift, rotation = (tuple(float(one.option(name)) for name in names) for names in (COLUMNS[2:5], COLUMNS[5:]))
    return Perturbed(str(one.option("set")), str(one.option("frame")), shift, rotation)


def decisions(jobs: Sequence[EvaluationJob], answers: Mapping[str, Answer]) -> list[Decision]:
    """Of all jobs that have an answer. BadInputError for an answer that cannot be one."""
    return [read_answer(_decision, one, answers[one.key]) for one in jobs if one.key in answers]


def _decision(one: EvaluationJob, answer: Answer) -> Decision:
    row, values = _row(one), (float(answer["error_deg"]), float(answer["error_m"]), CheckVerdict(answer["verdict"]))
    return Decision(row.set_name, row.frame, len(one.frames), *values, answer["reason"], float(answer["cpu_s"]))
