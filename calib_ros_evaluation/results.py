"""What an evaluation does piece by piece, its jobs: a method, or all of them, on frames of a source; and its results, read from
their answers: the table of trials, also as a CSV file, and what other experiments measured. Tables and plots need no more."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calib_ros.errors import BadInputError
from calib_ros.io import write_atomically
from calib_ros_check.jobs.pool import Answer
from calib_ros_evaluation.curves import Curves

T = TypeVar("T")
Matrix = NDArray[np.float64]
Answers = Mapping[str, Answer]  # by the keys of their jobs
OF_TRIALS = ("single", "starts", "frames")  # experiments that consist of trials
SUCCESS_DEG, SUCCESS_M = 0.5, 0.1  # a trial that ends nearer than both to the reference has found it
SET = 3  # frames whose curves are averaged, as in figure 4.16
THESIS_THRESHOLD = 0.7  # of similarity (section 3.6)
# What makes a trial the same in two evaluations, which are compared trial by trial. frames: positions in the scene, "0 4 8".
# start_deg, start_m: half width per axis of the start error.
IDENTITY = ("experiment", "method", "scene", "frames", "start_deg", "start_m", "seed")
STATUSES = ("done", "refused", "failed")  # refused: by the method itself: it then ends where it started; failed: with an error
TWIST_AXES = ("rx_deg", "ry_deg", "rz_deg", "tx_m", "ty_m", "tz_m")
END, START = ([f"{name}_{axis}" for axis in TWIST_AXES] for name in ("end", "start"))  # twists log(T T_ref^-1)
COSTS = ("features_ms_per_frame", "evaluation_ms", "memory_mb")
SCORES = ("score_start", "score_end", "score_reference")  # by the method's own score; NaN where there is none
# Of the table of trials: a row for each calibration from a wrong start. Errors are those of eq. 2.19, cpu_s is without features.
COLUMNS = (
    *IDENTITY,
    *("status", "reason", "success", "rotation_deg", "translation_m", "start_rotation_deg", "start_translation_m"),
    *(*END, *START, *SCORES, "evaluations", "cpu_s", "features_cpu_s"),
)
TRIALS = "trials.csv"
TEXTS = ("experiment", "method", "scene", "frames", "status", "reason")
WHOLE = ("seed", "success", "evaluations")
ADVICE = "give the trials.csv of an evaluation"


@dataclass(frozen=True)
class EvaluationJob:
    """experiment: what it belongs to. method: name of a Method, empty where none is asked. scene: which source, by the label that
    it has in the evaluation. frames: positions in it. options: further numbers and texts, by name, in the order of their names.
    """

    experiment: str
    method: str
    scene: str
    frames: tuple[int, ...]
    options: tuple[tuple[str, float | int | str], ...] = ()

    @property
    def key(self) -> str:
        """The same for the same piece of work, whoever makes it up; no other has it."""
        frames = ",".join(map(str, self.frames))
        options = " ".join(f"{name}={value}" for name, value in self.options)
        return f"{self.experiment}|{self.method}|{self.scene}|{frames}|{options}"

    def option(self, name: str) -> Any:
        """Value of an option; KeyError if it has none of that name."""
        return dict(self.options)[name]


def job(
    experiment: str, method: str, scene: str, frames: Sequence[int], options: Mapping[str, float | int | str] | None = None
) -> EvaluationJob:
    """A job with its options in order."""
    return EvaluationJob(experiment, method, scene, tuple(frames), tuple(sorted((options or {}).items())))


def trials_table(rows: Sequence[Mapping[str, Any]], limit_deg: float = SUCCESS_DEG, limit_m: float = SUCCESS_M) -> pd.DataFrame:
    """Rows with COLUMNS as a table. success: done, and within the limits of the reference. A refused trial stays at its start,
    which is no success even where it happens to be near."""
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    near = (table.rotation_deg < limit_deg) & (table.translation_m < limit_m)
    return table.assign(success=((table.status == "done") & near).astype(int))


def write_table(path: Path, table: pd.DataFrame) -> None:
    """A row for each of the table's under a header; floats so that reading gives the same ones. The file is replaced as a whole;
    BadInputError if its folder cannot be written."""
    write_atomically(path, table.to_csv(index=False, na_rep="nan").encode())


def read_table(path: Path, columns: Sequence[str], advice: str) -> pd.DataFrame:
    """Texts of a CSV file; columns may stand in any order, with others between.

    BadInputError, with the advice, if it cannot be read, a column is missing or a line is cut off.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
        table = pd.read_csv(io.StringIO(text), dtype=object, keep_default_na=False)
    except OSError as error:
        raise BadInputError(f"cannot read {path}: {error.strerror}; {advice}") from None
    except UnicodeDecodeError:
        raise BadInputError(f"{path} is no text; {advice}") from None
    except (pd.errors.EmptyDataError, pd.errors.ParserError) as error:
        raise BadInputError(f"{path} is empty, cut off or damaged ({str(error).strip()}); {advice}") from None
    missing = [name for name in columns if name not in table]
    if missing:
        raise BadInputError(f"{path}: no column {', '.join(missing)}; {advice}")
    if not text.endswith("\n"):
        raise BadInputError(f"{path}: the last line is cut off; copy the file again")
    return table


def numbers(table: pd.DataFrame, name: str, kind: Callable[[str], float], path: Path, advice: str) -> pd.Series:
    """What `kind` makes of the texts of a column. BadInputError, with the advice, for one of which it makes nothing."""
    try:
        return table[name].map(kind)
    except ValueError as error:
        raise BadInputError(f"{path}, column {name}: {error}; {advice}") from None


def read_trials(path: Path) -> pd.DataFrame:
    """Trials of a file that an evaluation wrote, of this version or another. BadInputError as of read_table, and if there are
    none, a value is none, or a trial is there twice."""
    table = read_table(path, COLUMNS, ADVICE)
    if table.empty:
        raise BadInputError(f"{path} holds no trials, only a header; was its evaluation broken off?")
    for name in COLUMNS:
        if name not in TEXTS:
            table[name] = numbers(table, name, int if name in WHOLE else float, path, ADVICE)
    numbers(table, "frames", lambda text: sum(map(int, text.split())), path, ADVICE)
    for said, is_so in (
        (f"status must be one of {', '.join(STATUSES)}", ~table.status.isin(STATUSES)),
        ("a trial that is there already; give the trials.csv of one evaluation", table.duplicated(list(IDENTITY))),
    ):
        if is_so.any():
            raise BadInputError(f"{path}, row {is_so.to_numpy().argmax() + 1}: {said}")
    return trials_table(table)


class CurveResult(NamedTuple):
    """Loss curves of a method around the reference on one set of frames (figures 4.7, 4.10, 4.13). label: of the scene, for
    people."""

    method: str
    label: str
    curves: Curves


@dataclass(frozen=True, eq=False)
class Averaging:
    """Curves of n single frames, to be averaged by eq. 3.16 (figure 4.16). weights: (n,) w_j. shares: (n, 10) of each class among
    the pixels that have one (figures 4.5, 4.8, 4.11). classes_of: where these come from, for people."""

    method: str
    scene: str
    names: tuple[str, ...]
    weights: Matrix
    shares: Matrix
    single: tuple[Curves, ...]
    classes_of: str

    @property
    def shown(self) -> list[int]:
        """SET of the frames: the least, the middle and the most important one."""
        order = np.argsort(self.weights, kind="stable")
        return [int(order[k]) for k in (0, len(order) // 2, -1)]

    def average(self, frames: Sequence[int], weighted: bool) -> Curves:
        """Eq. 3.16: J is linear in the frames' J_j, and so are its curves. Weights that are all 0 count as alike."""
        w = self.weights[list(frames)]
        values = np.average([self.single[k].values for k in frames], axis=0, weights=w if weighted and w.any() else None)
        return Curves(self.single[0].offsets, values)


@dataclass(frozen=True, eq=False)
class Similarity:
    """How alike frames of a scene are (figures 3.22, 3.23). frames: positions (n,) in the scene. matrix: (n, n) rho of eq. 3.15.
    threshold: the configured one. histograms: position -> (channels, bins) shares of pixels by brightness, of some frames."""

    scene: str
    frames: tuple[int, ...]
    matrix: Matrix
    threshold: float
    histograms: dict[int, Matrix]

    @property
    def keyframes(self) -> dict[float, list[int]]:
        """Rows that algorithm 6 selects at the thesis's threshold and at the configured one."""
        return {threshold: algorithm_6(self.matrix, threshold) for threshold in sorted({THESIS_THRESHOLD, self.threshold})}


def algorithm_6(matrix: Matrix, threshold: float) -> list[int]:
    """Rows of similarities (n, n) that algorithm 6 selects: the first, then each below the threshold to the one before."""
    chosen = [0]
    for k in range(1, len(matrix)):
        if matrix[chosen[-1], k] < threshold:
            chosen.append(k)
    return chosen


class Trust(NamedTuple):
    """F_C of Levinson and Thrun on one frame, the share of neighbours that score worse. right: at the reference. wrong: (deg, m,
    F_C) of extrinsics that are off by so much."""

    right: float
    wrong: Sequence[Sequence[float]]


@dataclass(frozen=True)
class Results:
    """All that an evaluation found, in the order of its plan. titles: method name -> for people, in the order to be shown."""

    titles: dict[str, str]
    trials: pd.DataFrame = field(default_factory=lambda: trials_table([]))
    curves: Sequence[CurveResult] = ()
    # Method, frames, COSTS: on so many frames, CPU time of one core, and the most that arrays took meanwhile.
    costs: Sequence[tuple[str, int, float, float, float]] = ()
    failures: Sequence[tuple[str, str]] = ()  # what other job failed, and why
    trusts: Sequence[Trust] = ()
    averagings: Sequence[Averaging] = ()
    similarities: Sequence[Similarity] = ()


def collect_results(jobs: Sequence[EvaluationJob], answers: Answers, titles: Mapping[str, str]) -> Results:
    """Results of all jobs that have an answer, in their order. titles: method name -> for people.

    BadInputError for an answer that cannot be one of its job.
    """
    found: dict[str, list[Any]] = {name: [] for name, _ in READ.values()}
    failures: list[tuple[str, str]] = []
    for job in jobs:
        answer = answers.get(job.key)
        if answer is None:
            continue
        if "error" in answer:
            what = f"{job.experiment} of {job.method}" if job.method else job.experiment
            failures.append((f"{what}, {job.scene}, frames {' '.join(map(str, job.frames[:10]))}", answer["error"]))
        else:
            name, reader = READ[job.experiment]
            found[name] += read_answers(reader, [job], answers)
    return Results(dict(titles), failures=failures, **found | {"trials": trials_table(found["trials"])})


def read_answers(reader: Callable[[EvaluationJob, Answer], T], jobs: Sequence[EvaluationJob], answers: Answers) -> list[T]:
    """What a reader makes of the answers of all jobs that have one. BadInputError for one that cannot be one of its job."""
    found = []
    for job in jobs:
        try:
            found += [reader(job, answers[job.key])] if job.key in answers else []
        except (KeyError, TypeError, ValueError) as error:
            raise BadInputError(
                f"the answer of {job.key} is damaged ({type(error).__name__}: {error}); remove its line from results.jsonl, or "
                "give --fresh"
            ) from None
    return found


def trial_of(job: EvaluationJob, answer: Answer) -> dict[str, Any]:
    """The row of the table of trials that an answer of `trial` tells of."""
    twists = {f"{name}_{axis}": answer[name][k] for name in ("start", "end") for k, axis in enumerate(TWIST_AXES)}
    scores = {name: math.nan if answer[name] is None else float(answer[name]) for name in SCORES}
    known = {"experiment": job.experiment, "method": job.method, "scene": job.scene, "frames": " ".join(map(str, job.frames))}
    return known | dict(job.options) | {name: answer[name] for name in TOLD} | twists | scores


def _averaging(job: EvaluationJob, answer: Answer) -> Averaging:
    names, weights, shares, values = zip(*answer["frames"], strict=True)
    single = tuple(_curves(answer["offsets"], own) for own in values)
    return Averaging(job.method, job.scene, names, np.array(weights), np.array(shares), single, answer["classes_of"])


def _similarity(job: EvaluationJob, answer: Answer) -> Similarity:
    histograms = {int(position): np.array(shares, float) for position, shares in answer["histograms"].items()}
    return Similarity(job.scene, job.frames, np.array(answer["matrix"], float), answer["threshold"], histograms)


def _curves(offsets: Any, values: Any) -> Curves:
    return Curves(np.array(offsets, float), np.array(values, float))


TOLD = (
    *("status", "reason", "rotation_deg", "translation_m", "start_rotation_deg", "start_translation_m"),
    *("evaluations", "cpu_s", "features_cpu_s"),
)
# Experiment -> the field of Results that its results belong to, and what reads an answer.
READ: dict[str, tuple[str, Callable[[EvaluationJob, Answer], Any]]] = {
    **dict.fromkeys(OF_TRIALS, ("trials", trial_of)),
    "curves": ("curves", lambda j, a: CurveResult(j.method, a["label"], _curves(a["offsets"], a["values"]))),
    "averaging": ("averagings", _averaging),
    "similarity": ("similarities", _similarity),
    "cost": ("costs", lambda j, a: (j.method, len(j.frames), *(a[name] for name in COSTS))),
    "trust": ("trusts", lambda j, a: Trust(a["right"], [(deg, m, share) for deg, m, share in a["wrong"]])),
}
