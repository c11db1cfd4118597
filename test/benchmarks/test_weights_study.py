"""What the study of weights counts, and how."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.records import append_records, read_records
from benchmarks.weights_study import EDGES, NONE, Place, Row, Weights, mcnemar, tables, trials_of

ROW = Row(EDGES, "KITTI", "there", "single", "0", 0, "refused wrong", "not_significant", 3.0, 20.0, 5.0, True, 0.5)


def test_uneven_splits_are_told_from_chance() -> None:
    assert mcnemar(np.array([1.0] * 8 + [0.0] * 20)) == pytest.approx(2 * 0.5**8)
    assert mcnemar(np.array([1.0, -1.0, 0.0])) == 1
    assert mcnemar(np.zeros(5)) == 1


def test_rows_come_back_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    rows = [ROW, replace(ROW, weights=NONE, doubt=False, frames="1+3", z_score=-1.25)]
    append_records(path, rows[:1])
    append_records(path, rows[1:])
    assert read_records(path, Row) == rows
    assert read_records(tmp_path / "none.csv", Row) == []


@pytest.mark.parametrize("cut", [1, 5, 60, 10_000])
def test_a_file_whose_writer_was_killed_is_gone_on_with(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "rows.csv"
    append_records(path, [ROW, replace(ROW, trial=1)])
    path.write_bytes(path.read_bytes()[: -min(cut, path.stat().st_size)])
    left = [] if cut > 1000 else [ROW]
    assert read_records(path, Row) == left
    append_records(path, [replace(ROW, trial=2)])
    assert read_records(path, Row) == [*left, replace(ROW, trial=2)]


def test_what_classes_make_of_doubt_is_counted_by_its_kind() -> None:
    ends = {  # of the edges, and of the weights
        0: ("refused wrong", "accepted right"),
        1: ("refused right", "accepted wrong"),
        2: ("accepted right", "refused right"),
        3: ("accepted wrong", "refused wrong"),
        4: ("accepted right", "accepted right"),
    }
    rows = []
    for k, (before, after) in ends.items():
        rows += [replace(ROW, frames=str(k), verdict=before), replace(ROW, frames=str(k), weights=NONE, verdict=after)]
    rows += [replace(ROW, frames="9", doubt=False, verdict="accepted right", weights=w) for w in (EDGES, NONE)]
    text = tables(rows, [Weights(NONE)])
    assert "| all | none | 5 | 1 | 1 | 1 | 1 |" in text
    assert "| single | all | edges alone | 6 | 3 | 1 | 2 | 0.5 |" in text
    assert "| single | all | none | 6 | 3 | 1 | 2 | 0.5 |" in text
    assert "| single | none | edges alone | +0.0 (" in text


def test_trials_are_the_same_every_time_and_no_larger_than_the_source() -> None:
    place = Place("there", "KITTI", guesses=2)
    trials = list(trials_of(place, 4, 3))
    assert trials == list(trials_of(place, 4, 3))
    assert [len(t.frames) for t in trials if t.part == "guess"] == [1, 1, 3, 3]
    assert sum(t.part == "single" for t in trials) == 12
