"""Protocols of calibrations from wrong starts: frames and starts are drawn, each is calibrated as `calib-ros calibrate` does, and
our trials stand beside the published figures."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from calib_ros.errors import BadInputError
from calib_ros_evaluation.evaluate import Study, StudyReport
from calib_ros_evaluation.experiments.job import EvaluationJob, job
from calib_ros_evaluation.experiments.setup import Setup, SourceSummary
from calib_ros_evaluation.methods.own import Own
from calib_ros_evaluation.protocols.definitions import PUBLISHED, TEXTS, Protocol, Size
from calib_ros_evaluation.report.sections import Section
from calib_ros_evaluation.report.table import NONE, Rows, Table, degrees, interval, number, percent, plural
from calib_ros_evaluation.report.tables import extended, median
from calib_ros_evaluation.results import TRIALS, Answers, read_answers, trial_of, trials_table

HEADER = (
    *("system", "data", "frames", "trials", "success", "95 %", "refused", "wrong"),
    *("accepted: mean deg", "cm", "all: mean deg", "cm"),
)
OURS = (
    "This project: the frames of each trial are drawn uniformly of all frames of the source, good or bad. Starts are left "
    "perturbations in the camera's frame, the region searched is the size of the start error. A refused trial counts as a "
    "failure; it hands back its start, whose error counts in the mean of all trials. Wrong: accepted, but beyond the limits. "
    "Constants were chosen on KITTI drive 0005, odometry 00 and synthetic drives.",
)


@dataclass(frozen=True)
class Calibrations(Study):
    """So many trials of every source, size of start error and number of frames in `counts`. Trial k has the seed `seed`
    + k."""

    protocol: Protocol
    counts: tuple[int, ...]
    trials: int
    seed: int = 0

    @property
    def about(self) -> dict[str, str]:
        """See Study."""
        return {"protocol": self.protocol.name}

    def jobs(self, setup: Setup, summaries: Sequence[SourceSummary]) -> list[EvaluationJob]:
        """See Study. BadInputError for a source without so many frames of one calibration."""
        for one in summaries:
            check_counts(one, self.counts)
        return [
            job(self.protocol.name, Own.name, one.label, drawn(one, count, k), {"start_deg": s.deg, "start_m": s.m, "seed": k})
            for one in summaries
            for s in self.protocol.sizes
            for count in self.counts
            for k in range(self.seed, self.seed + self.trials)
        ]

    def report(self, setup: Setup, planned: Sequence[EvaluationJob], answers: Answers) -> StudyReport:
        """See Study. A table for each size of start error."""
        trials = trials_table(read_answers(trial_of, planned, answers), self.protocol.limit_deg, self.protocol.limit_m)
        tables = [size_table(self.protocol, size, trials) for size in self.protocol.sizes]
        cpu = [
            f"{median(own.cpu_s):.1f} s (mean {own.cpu_s.mean():.1f} s) with {plural(count)}"
            for count, own in extended(trials).groupby("n")
        ]
        notes = [*OURS, f"CPU: median of a trial without features {', '.join(cpu)}."]
        return protocol_report(self.protocol.name, tables, notes, TRIALS, trials)


def check_counts(source: SourceSummary, counts: Sequence[int]) -> None:
    """BadInputError for more frames per trial than a source has of one camera and reference."""
    most = max(map(len, source.groups))
    fitting = ",".join(str(count) for count in counts if count <= most) or str(most)
    if max(counts) > most:
        raise BadInputError(
            f"--frames-per-trial {min(count for count in counts if count > most)}: {source.label} has only {plural(most)} of one "
            f"calibration; give --frames-per-trial {fitting}, or another source"
        )


def drawn(source: SourceSummary, count: int, seed: int) -> list[int]:
    """Positions of the frames of a trial, ascending: uniformly of all frames, good or bad, without putting back. Of a source with
    several calibrations, all of the one that the first frame has."""
    rng = np.random.default_rng([seed, zlib.crc32(source.label.encode()), count])
    enough = [group for group in source.groups if len(group) >= count]
    first = rng.choice([position for group in enough for position in group])
    group = next(group for group in enough if first in group)
    others = rng.permutation([position for position in group if position != first])[: count - 1]
    return sorted(int(position) for position in (first, *others))


def size_table(protocol: Protocol, size: Size, trials: pd.DataFrame) -> Table:
    """Published rows, then a row for each of our sources and numbers of frames. wrong: accepted, but beyond the limits."""
    rows: Rows = []
    of_size = PUBLISHED[(PUBLISHED.protocol == protocol.name) & (PUBLISHED.start_deg == size.deg) & (PUBLISHED.start_m == size.m)]
    for row in of_size.itertuples():
        told = [row.system, row.data, str(row.frames or NONE), NONE, percent(row.success_percent / 100, 1)]
        rows.append([*told, *[NONE] * 5, degrees(row.deg), number(row.cm, 2)])
    ours = extended(trials[(trials.start_deg == size.deg) & (trials.start_m == size.m)])
    for (scene, count), own in ours.groupby(["scene", "n"], sort=False):
        n, done, succeeded = len(own), own[own.status == "done"], own.success.sum()
        cells = [percent(succeeded / n, 1), f"{interval(succeeded, n)} %", str(n - len(done)), str((done.success == 0).sum())]
        # A refused trial ends at its start, and counts with its error.
        errors = [text for part in (done, own) for text in (degrees(part.rotation_deg.mean()), number(part.cm.mean(), 2))]
        rows.append(["this project", scene, str(count), str(n), *cells, *errors])
    return Table(f"From {size.words}", HEADER, rows)


def protocol_report(name: str, tables: Sequence[Table], notes: Sequence[str], file: str, rows: pd.DataFrame) -> StudyReport:
    """The report of a protocol: one section, whose caveats and notes stand below its last table."""
    title, introduction, *caveats = TEXTS[name]
    tables = [*tables[:-1], replace(tables[-1], notes=(*caveats, *notes))]
    said = [line for one in tables for line in (one.title, one.text(), "")]
    return StudyReport(f"Published protocol: {title}", [Section(name, title, introduction, tables=tables)], said, file, rows)
