"""Is a miscalibration told from a right extrinsic? Published perturbations of KITTI odometry 00, each a verdict of the check."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd

from calib_ros import se3
from calib_ros.errors import BadInputError
from calib_ros_check.jobs.pool import Answer
from calib_ros_check.outcome import CheckVerdict
from calib_ros_evaluation.evaluate import Study, StudyReport
from calib_ros_evaluation.experiments.job import EvaluationJob, job
from calib_ros_evaluation.experiments.setup import Setup, SourceSummary, WorkerCache
from calib_ros_evaluation.protocols.definitions import ACCURACIES, MISCALIBRATION, ROTATION, SHIFT
from calib_ros_evaluation.protocols.trials import protocol_report
from calib_ros_evaluation.report.table import NONE, Rows, Table, interval, percent, plural
from calib_ros_evaluation.report.tables import median
from calib_ros_evaluation.results import Answers, numbers, read_answers, read_table

RIGHT_SET = "pos"  # holds right extrinsics, all others wrong ones
ADVICE = "give the table of published perturbations by --table"
COLUMNS = ("set", "frame", *SHIFT, *ROTATION)
LARGEST = dict.fromkeys(SHIFT, se3.MAX_TRANSLATION_M) | dict.fromkeys(ROTATION, 360.0)
RIGHT, WRONG, INCONCLUSIVE = "right", "wrong", "inconclusive"


@dataclass(frozen=True, eq=False)
class Detection(Study):
    """A check of every row of the published table whose frame the source has, with every number of frames in `counts`:
    its own and those that follow in the source, the first after the last."""

    rows: pd.DataFrame
    counts: tuple[int, ...]

    about: ClassVar[dict[str, str]] = {"protocol": MISCALIBRATION}

    def jobs(self, setup: Setup, summaries: Sequence[SourceSummary]) -> list[EvaluationJob]:
        """See Study. BadInputError for several sources, or for one without a frame of the table."""
        if len(summaries) != 1:
            raise BadInputError(f"--protocol {MISCALIBRATION} takes one source, the folder of KITTI odometry sequence 00")
        (source,), cache = summaries, WorkerCache(setup)
        names = {cache.frame(source.label, position).name: position for position in source.frames}
        return detection_jobs(self.rows, names, source, self.counts)

    def report(self, setup: Setup, planned: Sequence[EvaluationJob], answers: Answers) -> StudyReport:
        """See Study. Decisions by set and in all, beside the published accuracies."""
        found = pd.DataFrame(read_answers(decision_of, planned, answers))
        cpu = [f"{median(own.cpu_s):.1f} s with {count}" for count, own in found.groupby("frames")]
        notes = [f"CPU: median of a check, features included, {', '.join(cpu)}."]
        made = protocol_report(MISCALIBRATION, [sets_table(found), accuracy_table(found)], notes, "decisions.csv", found)
        said = []
        for one in found[found.kind != RIGHT].itertuples():
            off = f"{one.error_deg:.2f} deg, {100 * one.error_m:.1f} cm off"
            said.append(f"{one.set} {one.frame}, {plural(one.frames)} ({off}) is {one.kind}: {one.reason}.")
        used = {one.option("row") for one in planned}
        missing = [frame for number, frame in enumerate(self.rows.frame) if number not in used]
        text = f"{len(missing)} of {len(self.rows)} rows are of frames that the source does not have, such as {[*missing, ''][0]}"
        return replace(made, sections=[replace(made.sections[0], sentences=said)], notes=[text] if missing else [])


def read_perturbations(path: Path) -> pd.DataFrame:
    """Rows of a CSV file with COLUMNS: m, and deg as printed. BadInputError for a file that cannot be read or is none of these,
    or without rows."""
    table = read_table(path, COLUMNS, ADVICE)
    if table.empty:
        raise BadInputError(f"{path} has no rows; {ADVICE}")
    for name, most in LARGEST.items():
        table[name] = numbers(table, name, float, path, ADVICE)
        if not (table[name].abs() <= most).all():  # NaN neither
            raise BadInputError(f"{path}, column {name}: give numbers of at most {most:g}")
    return table


def detection_jobs(
    rows: pd.DataFrame, names: Mapping[str, int], source: SourceSummary, counts: Sequence[int]
) -> list[EvaluationJob]:
    """See Detection. names: of the source's frames, and their positions. Leading zeros of a number, which spreadsheets drop, do
    not count. BadInputError if there is no such row, or for more frames than the source has."""
    by_number = {int(name): position for name, position in names.items() if name.isdecimal()}
    known = []
    for number, row in enumerate(rows[list(COLUMNS)].to_dict("records")):
        frame = row["frame"]
        position = names.get(frame, by_number.get(int(frame)) if frame.isdecimal() else None)
        known += [] if position is None else [(source.frames.index(position), {"row": number, **row})]
    if not known:
        raise BadInputError(
            f"{source.label} has no frame {rows.frame[0]}, nor any other of the table's {rows.frame.nunique()}; its "
            f"frames are {', '.join(list(names)[:3])}, ...; give the folder of KITTI odometry sequence 00 (sequences/00)"
        )
    n = len(source.frames)
    if max(counts) > n:
        raise BadInputError(
            f"--frames-per-trial {max(counts)}: {source.label} has only {n} frames; give fewer, or another source"
        )
    return [
        job(MISCALIBRATION, "check", source.label, [source.frames[(first + k) % n] for k in range(count)], values)
        for count in counts
        for first, values in known
    ]


def decision_of(one: EvaluationJob, answer: Answer) -> dict[str, Any]:
    """What the check said about a row. frames: how many. error_deg, error_m: of the extrinsic that was checked (eq. 2.19)."""
    verdict, name = CheckVerdict(answer["verdict"]), one.option("set")
    told = {"set": name, "frame": one.option("frame"), "frames": len(one.frames)}
    told |= {key: float(answer[key]) for key in ("error_deg", "error_m")}
    told |= {"verdict": verdict.value, "kind": kind_of(name, verdict), "reason": answer["reason"]}
    return told | {"cpu_s": float(answer["cpu_s"])}


def kind_of(set_name: str, verdict: CheckVerdict) -> str:
    """RIGHT, WRONG or INCONCLUSIVE."""
    if verdict is CheckVerdict.INCONCLUSIVE:
        return INCONCLUSIVE
    return RIGHT if verdict is (CheckVerdict.PASS if set_name == RIGHT_SET else CheckVerdict.FAIL) else WRONG


def sets_table(found: pd.DataFrame) -> Table:
    """A row for each set and one for all: decisions that are right, wrong, inconclusive, for each number of frames."""
    counts = sorted(found.frames.unique())
    rows: Rows = []
    for name in (*found.set.unique(), "all"):
        own = [found[(found.frames == count) & ((found.set == name) | (name == "all"))].kind for count in counts]
        cells = [", ".join(str((kind == which).sum()) for which in (RIGHT, WRONG, INCONCLUSIVE)) for kind in own]
        rows.append([name, str(len(own[0])), *cells])
    header = ["set", "decisions", *(f"{plural(count)}: right, wrong, inconclusive" for count in counts)]
    return Table("Decisions by set", header, rows)


def accuracy_table(found: pd.DataFrame) -> Table:
    """Shares of right decisions beside the published ones. An inconclusive decision is not right."""
    rows: Rows = []
    for system, published in ACCURACIES.items():
        # With the digits that are published: 99.97 % is not 100.0 %.
        whole, rot_hard, trans_easy = (f"{share:.4g} %" for share in published)
        rows.append([system, "1", NONE, whole, NONE, rot_hard, trans_easy, NONE])
    for count, own in found.groupby("frames"):
        right, alarms = own.kind == RIGHT, own[own.set == RIGHT_SET]
        shares = [percent(part.mean(), 1) for part in (right, right[own.set == "rot_hard"], right[own.set == "trans_easy"])]
        shares.insert(1, f"{interval(right.sum(), len(own))} %")
        rows.append(["this project", str(count), str(len(own)), *shares, f"{(alarms.kind == WRONG).sum()} of {len(alarms)}"])
    header = ("system", "frames", "decisions", "all", "95 %", "rot_hard", "trans_easy", "false alarms")
    return Table("Share of right decisions", header, rows)
