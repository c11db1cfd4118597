"""Comparison of two tables of trials, with numbers that can be checked by hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from trial_rows import row
from trial_rows import table as table_of

from calib_ros.errors import BadInputError
from calib_ros_evaluation.compare import Comparison, PairedChange, as_text, compare, draws, interval, means, medians
from calib_ros_evaluation.results import COLUMNS, read_trials, write_table


def trial(frame: int, rotation: float = 0.3, translation: float = 0.05, cpu: float = 2.0, **changes: object) -> dict[str, Any]:
    known = {"method": "edges", "scene": "street", "frames": str(frame)}
    known |= {"rotation_deg": rotation, "translation_m": translation, "cpu_s": cpu}
    return row((0.1, -0.2, 1 / 3, 0.01, -0.02, 0.03), **known | changes)


def table(rotations: Sequence[float], **changes: object) -> pd.DataFrame:
    """One trial for each frame."""
    return table_of(*(trial(n, rotation, **changes) for n, rotation in enumerate(rotations)))


def only(found: list[Comparison]) -> Comparison:
    assert len(found) == 1
    return found[0]


# --- tables


def test_trials_are_read_as_written(tmp_path: Path) -> None:
    trials = table_of(
        trial(3, 0.1 * 3, reason='says "no",\nand ends', status="refused"),
        trial(4, frames="4 7 11", seed=12, translation=1e-17, status="failed"),
    )
    path = tmp_path / "trials.csv"
    write_table(path, trials)
    assert repr(read_trials(path).to_dict("records")) == repr(trials.to_dict("records"))
    assert path.read_text().splitlines()[0] == ",".join(COLUMNS)
    text = path.read_text()
    # Columns may stand in any order, with others between, and a mark of the byte order before them.
    trials.assign(new="more")[[*COLUMNS, "new"][::-1]].to_csv(path, index=False, na_rep="nan", encoding="utf-8-sig")
    write_table(path, read_trials(path))
    assert path.read_text() == text


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda lines: [], "is empty"),
        (lambda lines: lines[:1], "holds no trials"),
        (lambda lines: [lines[0].replace("seed", "sed"), *lines[1:]], "no column seed"),
        (lambda lines: [*lines[:2], lines[2].replace(",done,", ",maybe,")], "row 2: status must be one of done, refused, failed"),
        (lambda lines: [*lines[:2], lines[2].replace(",0.2,0.05,", ",much,0.05,")], "column rotation_deg: .*'much'"),
        (lambda lines: [*lines[:2], lines[2].replace("street,1,", "street,1.5,")], "column frames: .*'1.5'"),
        (lambda lines: [*lines[:3], lines[3][:60]], "the last line is cut off"),
        (lambda lines: [*lines[:3], lines[3][:60] + "\n"], "column [a-z_]+: could not convert string to float: ''"),
        (lambda lines: [*lines[:3], lines[3][:-1]], "the last line is cut off"),
        (lambda lines: [*lines[:3], lines[3].replace("edges", '"edges')], "cut off or damaged"),
        (lambda lines: [*lines, lines[2]], "row 4: a trial that is there already"),
        (lambda lines: ["\x89PNG\udcff\udcff"], "no text"),
    ],
)
def test_damaged_tables_are_refused(tmp_path: Path, damage: Callable[[list[str]], list[str]], words: str) -> None:
    path = tmp_path / "trials.csv"
    write_table(path, table([0.1, 0.2, 0.3]))
    path.write_bytes("".join(damage(path.read_text().splitlines(keepends=True))).encode(errors="surrogateescape"))
    with pytest.raises(BadInputError, match=words) as caught:
        read_trials(path)
    assert str(path) in str(caught.value)


# --- comparison


def values(estimate: PairedChange) -> tuple[float, float, float]:
    return estimate.a, estimate.b, estimate.change


def test_differences_by_hand() -> None:
    a = [trial(0, 0.4, 0.02, 1.0), trial(1, 0.6, 0.04, 2.0), trial(2, 0.2, 0.20, 4.0), trial(3, 3.0, 0.5, 1.0)]
    b = [trial(0, 0.1, 0.03, 2.0), trial(1, 0.4, 0.04, 4.0), trial(2, 0.6, 0.01, 8.0), trial(3, 2.0, 0.5, 2.0)]
    found = only(compare(table_of(*a, trial(9)), table_of(*b, trial(10), trial(11))))
    assert (found.experiment, found.method, found.pairs, found.only_a, found.only_b) == ("single", "edges", 4, 1, 2)
    assert (found.gained, found.lost) == (1, 0)  # frame 1; frame 0 in both, 2 and 3 in none
    assert values(found.estimates["rotation_mean"]) == pytest.approx((1.05, 0.775, -0.275))  # -0.3 -0.2 +0.4 -1.0
    assert values(found.estimates["rotation_median"]) == pytest.approx((0.5, 0.5, 0.0))
    assert values(found.estimates["translation_mean"]) == pytest.approx((0.19, 0.145, -0.045))  # +0.01 0 -0.19 0
    assert values(found.estimates["translation_median"]) == pytest.approx((0.12, 0.035, -0.085))
    assert values(found.estimates["success"]) == pytest.approx((0.25, 0.5, 0.25))
    assert values(found.estimates["cpu"]) == pytest.approx((8**0.25, 2 * 8**0.25, 2.0))
    assert (found.estimates["cpu"].low, found.estimates["cpu"].high) == pytest.approx((2.0, 2.0))
    assert found.estimates["cpu"].verdict == "worse"
    assert found.estimates["rotation_mean"].verdict == "no difference shown"


def test_the_interval_of_a_normal_mean_and_median() -> None:
    """400 independent differences: the mean's interval is 1.96 s / sqrt(n) to both sides, the median's variance pi / 2 times."""
    rng = np.random.default_rng(5)
    difference = rng.normal(0.1, 0.5, 400)
    base = rng.uniform(1, 2, 400)
    found = only(compare(table(base), table(base + difference), resamples=4000)).estimates["rotation_mean"]
    half = 1.96 * difference.std() / 20
    assert found.change == pytest.approx(difference.mean())
    assert (found.low, found.high) == pytest.approx((difference.mean() - half, difference.mean() + half), abs=0.08 * half)
    assert found.verdict == "worse"
    low, high = interval(medians(difference, np.arange(400), draws(400, 0, 4000)), 400)
    assert high - low == pytest.approx(2 * half * np.sqrt(np.pi / 2), rel=0.25)


def test_the_interval_of_few_clusters_is_as_wide_as_students() -> None:
    """8 values: t(0.975, 7) = 2.365 times the standard error, where plain percentiles would give 1.96 sqrt(7 / 8) times."""
    numbers = np.array([-1.2, -0.8, -0.5, -0.1, 0.2, 0.4, 0.7, 1.3])
    low, high = interval(means(numbers, np.arange(8), draws(8, 0, 20000)), 8)
    assert high - low == pytest.approx(2 * 2.365 * numbers.std(ddof=1) / np.sqrt(8), rel=0.04)


def test_the_interval_knows_that_trials_on_the_same_frames_belong_together() -> None:
    """30 sets of frames with 10 starts each, all of a set alike: the interval is that of 30 differences, not of 300."""
    shift = np.random.default_rng(6).normal(0, 0.2, 30)
    a = table_of(*(trial(n, 1.0, seed=k) for n in range(30) for k in range(10)))
    b = table_of(*(trial(n, 1.0 + shift[n], seed=k) for n in range(30) for k in range(10)))
    found = only(compare(a, b)).estimates["rotation_mean"]
    assert found.clusters == 30
    assert found.high - found.low == pytest.approx(2 * 1.96 * shift.std() / np.sqrt(30), rel=0.1)


def test_the_order_of_rows_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    base = rng.uniform(0, 2, 60)
    a, b = table(base), table(base * rng.uniform(0.5, 1.2, 60))
    a = pd.concat([a, a.assign(method="planes")])
    b = pd.concat([b, b.assign(method="planes", rotation_deg=2 * b.rotation_deg)])
    found = compare(a, b)
    assert found == compare(a.sample(frac=1, random_state=1), b.sample(frac=1, random_state=2))
    assert [one.method for one in found] == ["edges", "planes"]
    assert found[0].estimates["rotation_mean"].verdict == "better"
    assert found[1].estimates["rotation_mean"].verdict == "worse"
    assert found != compare(a, b, seed=1)


def test_values_that_are_no_numbers_are_left_out_pair_by_pair() -> None:
    nan = float("nan")
    a, b = table([0.1, 0.2, nan, 0.4, 0.5, 0.6]), table([0.1, nan, 0.3, 0.4, 0.5, 0.6])
    b.loc[0, "cpu_s"] = 0.0
    found = only(compare(a, b))
    assert (found.pairs, found.estimates["rotation_mean"].clusters, found.estimates["cpu"].clusters) == (6, 4, 5)
    assert values(found.estimates["rotation_mean"]) == pytest.approx((0.4, 0.4, 0))
    nothing = only(compare(table([nan]), table([nan])))
    assert nothing.estimates["rotation_median"].verdict == "no difference shown"
    assert np.isnan(nothing.estimates["rotation_median"].a)


def test_one_set_of_frames_proves_nothing() -> None:
    a = table_of(*(trial(0, 2.0, seed=k) for k in range(9)))
    found = only(compare(a, a.assign(rotation_deg=0.1)))
    assert np.isnan(found.estimates["rotation_mean"].low)
    assert found.estimates["rotation_mean"].verdict == "no difference shown"
    assert "* the interval is not reliable: fewer than 5 sets of frames" in as_text([found], "a", "b")


@pytest.mark.parametrize(
    ("b", "words"),
    [
        (table([0.1], experiment="multi"), "experiment is single in A, multi in B"),
        (table([0.1], scene="field"), "scene is street in A, field in B"),
        (table([0.1, 0.1], seed=5), "seed is 0 in A, 5 in B"),
        (table_of(*(trial(n) for n in range(7, 12))), "frames is 0, 1 in A, 10, 11, 7 and 2 more in B"),
    ],
)
def test_tables_without_a_common_trial(b: pd.DataFrame, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        compare(table([0.1, 0.2]), b)


def test_comparison_text() -> None:
    a, b = table([1.0] * 6), table([0.25] * 6, cpu=3.0)
    a = pd.concat([a, a[:1].assign(method="planes")])
    lines = as_text(compare(a, b), "old.csv", "new.csv").splitlines()
    assert lines[:3] == ["A: old.csv", "B: new.csv", ""]
    assert " ".join(lines[3].split()) == "experiment method trials measure A B B - A 95 % interval verdict"
    assert " ".join(lines[4].split()) == "single edges 6 rotation error, mean, deg 1.000 0.250 -0.750 -0.750 .. -0.750 better"
    assert " ".join(lines[8].split()) == "success, % (6 gained, 0 lost) 0.0 100.0 +100.0 +100.0 .. +100.0 better"
    assert " ".join(lines[9].split()) == "CPU time, geometric mean, s 2 3 x 1.50 x 1.50 .. x 1.50 worse"
    assert lines[10] == ""  # the method that has no trial in common stands below
    starts = [lines[n].index(word) for n, word in ((3, "measure"), (4, "rotation"), (9, "CPU"))]
    assert len(set(starts)) == 1
    assert lines[-1] == "Only in A, not compared: 1 of single planes"
