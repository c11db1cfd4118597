"""Tables of a protocol: our trials beside the published figures, for the terminal, the page and Markdown; and a row per trial."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calib_ros.io import write_atomically
from calib_ros_evaluation.csv_files import as_csv
from calib_ros_evaluation.protocols.definitions import MISCALIBRATION, Protocol, Size
from calib_ros_evaluation.protocols.detection import INCONCLUSIVE, RIGHT, RIGHT_SET, WRONG, Decision
from calib_ros_evaluation.protocols.published import ACCURACIES, CAVEATS, INTRODUCTIONS, OURS, TITLES, Published, rows_of
from calib_ros_evaluation.report.sections import Section
from calib_ros_evaluation.report.statistics import median, wilson
from calib_ros_evaluation.report.table import NONE, Rows, Table, degrees, number, percent, table
from calib_ros_evaluation.results import Trial

DECISIONS = "decisions.csv"
THIS = "this project"
HEADER = (
    *("system", "data", "frames", "trials", "success", "95 %", "refused", "wrong"),
    *("accepted: mean deg", "cm", "all: mean deg", "cm"),
)


def trial_section(protocol: Protocol, trials: Sequence[Trial]) -> Section:
    """The protocol's section of the report: a table for each size of start error."""
    tables = tuple(size_table(protocol, size, trials) for size in protocol.sizes)
    notes = (*CAVEATS[protocol.name], *OURS, f"CPU: {_cpu(trials)}.")
    tables = (*tables[:-1], Table(tables[-1].title, tables[-1].header, tables[-1].rows, notes=notes))
    return Section(protocol.name, TITLES[protocol.name], INTRODUCTIONS[protocol.name], tables=tables)


def size_table(protocol: Protocol, size: Size, trials: Sequence[Trial]) -> Table:
    """Published rows, then a row for each of our sources and numbers of frames. wrong: accepted, but beyond the limits."""
    rows: Rows = [_published(row) for row in rows_of(protocol.name, size)]
    cells: dict[tuple[str, int], list[Trial]] = {}
    for trial in trials:
        if (trial.start_deg, trial.start_m) == (size.deg, size.m):
            cells.setdefault((trial.scene, len(trial.frames)), []).append(trial)
    rows += [[THIS, scene, str(count), *_figures(protocol, own)] for (scene, count), own in cells.items()]
    return table(f"From {size.words}", HEADER, rows)


def _published(row: Published) -> list[str]:
    system = f"{row.system} ({'learned' if row.learned else 'classical'})"
    errors = degrees(row.rotation_deg), number(100 * row.translation_m, 2)
    return [system, row.data, str(row.frames or NONE), NONE, percent(row.success, 1), *([NONE] * 5), *errors]


def _figures(protocol: Protocol, own: Sequence[Trial]) -> list[str]:
    n, succeeded = len(own), sum(map(protocol.succeeded, own))
    accepted = [t for t in own if t.status == "done"]
    return [
        str(n),
        percent(succeeded / n, 1),
        _interval(succeeded, n),
        str(n - len(accepted)),
        str(sum(map(protocol.wrong, own))),
        *_means(accepted),
        *_means(own),
    ]


def _means(trials: Sequence[Trial]) -> list[str]:
    """Mean errors. A refused trial ends at its start, and counts with its error."""
    if not trials:
        return [NONE, NONE]
    deg, m = np.mean([(t.rotation_deg, t.translation_m) for t in trials], axis=0).tolist()
    return [degrees(deg), number(100 * m, 2)]


def _cpu(trials: Sequence[Trial]) -> str:
    counts = sorted({len(t.frames) for t in trials})
    medians = [(count, [t.cpu_s for t in trials if len(t.frames) == count]) for count in counts]
    parts = [
        f"{median(own):.1f} s (mean {np.mean(own):.1f} s) with {count} frame{'s' if count > 1 else ''}" for count, own in medians
    ]
    return f"median of a trial without features {', '.join(parts)}"


def detection_section(found: Sequence[Decision]) -> Section:
    """The section of MISCALIBRATION: decisions by set and in all, beside the published accuracies."""
    counts = sorted({one.count for one in found})
    notes = (*CAVEATS[MISCALIBRATION], f"CPU: {_check_cpu(found, counts)}.")
    by_set, overall = sets_table(found, counts), accuracy_table(found, counts)
    tables = (by_set, Table(overall.title, overall.header, overall.rows, notes=notes))
    said = [
        f"{one.set_name} {one.frame}, {one.count} frame{'s' if one.count > 1 else ''} ({one.error_deg:.2f} deg, "
        f"{100 * one.error_m:.1f} cm off) is {one.kind}: {one.reason}."
        for one in found
        if one.kind != RIGHT
    ]
    return Section(MISCALIBRATION, TITLES[MISCALIBRATION], INTRODUCTIONS[MISCALIBRATION], tuple(said), tables=tables)


def sets_table(found: Sequence[Decision], counts: Sequence[int]) -> Table:
    """A row for each set and one for all: decisions that are right, wrong, inconclusive, for each number of frames."""
    names = [*dict.fromkeys(one.set_name for one in found), "all"]
    rows: Rows = []
    for name in names:
        own = [one for one in found if name in (one.set_name, "all")]
        kinds = [Counter(one.kind for one in own if one.count == count) for count in counts]
        cells = [", ".join(str(kind[which]) for which in (RIGHT, WRONG, INCONCLUSIVE)) for kind in kinds]
        rows.append([name, str(sum(one.count == counts[0] for one in own)), *cells])
    header = ["set", "decisions", *(f"{count} frame{'s' if count > 1 else ''}: right, wrong, inconclusive" for count in counts)]
    return table("Decisions by set", header, rows)


def accuracy_table(found: Sequence[Decision], counts: Sequence[int]) -> Table:
    """Shares of right decisions beside the published ones. An inconclusive decision is not right."""
    rows: Rows = [
        [one.system, "1", NONE, _stated(one.all_sets), NONE, _stated(one.rot_hard), _stated(one.trans_easy), NONE]
        for one in ACCURACIES
    ]
    for count in counts:
        own = [one for one in found if one.count == count]
        right = sum(one.kind == RIGHT for one in own)
        alarms = [one for one in own if one.set_name == RIGHT_SET]
        shares = [_right(own, name) for name in ("rot_hard", "trans_easy")]
        false = f"{sum(one.kind == WRONG for one in alarms)} of {len(alarms)}"
        rows.append([THIS, str(count), str(len(own)), percent(right / len(own), 1), _interval(right, len(own)), *shares, false])
    header = ("system", "frames", "decisions", "all", "95 %", "rot_hard", "trans_easy", "false alarms")
    return table("Share of right decisions", header, rows)


def _right(found: Sequence[Decision], name: str) -> str:
    own = [one for one in found if one.set_name == name]
    return percent(sum(one.kind == RIGHT for one in own) / len(own) if own else math.nan, 1)


def _check_cpu(found: Sequence[Decision], counts: Sequence[int]) -> str:
    parts = [f"{median([one.cpu_s for one in found if one.count == count]):.1f} s with {count}" for count in counts]
    return f"median of a check, features included, {', '.join(parts)}"


def write_decisions(folder: Path, found: Sequence[Decision]) -> Path:
    """decisions.csv, a row per decision; BadInputError if the folder cannot be written."""
    header = ("set", "frame", "frames", "error_deg", "error_m", "verdict", "kind", "reason", "cpu_s")
    rows = [
        (d.set_name, d.frame, d.count, repr(d.error_deg), repr(d.error_m), d.verdict.value, d.kind, d.reason, d.cpu_s)
        for d in found
    ]
    write_atomically(folder / DECISIONS, as_csv(header, rows))
    return folder / DECISIONS


def _stated(share: float) -> str:
    """With the digits that are published: 99.97 % is not 100.0 %."""
    return f"{100 * share:.4g} %"


def _interval(successes: int, n: int) -> str:
    low, high = wilson(successes, n)
    return f"{100 * low:.0f} to {100 * high:.0f} %"
