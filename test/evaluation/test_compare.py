"""Comparison of two tables of trials, with numbers that can be checked by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib_ros.errors import BadInputError
from calib_ros_evaluation.compare import ClusterBootstrap, Comparison, PairedChange, as_text, compare, interval
from calib_ros_evaluation.csv_files import read_trials, write_trials
from calib_ros_evaluation.results import COLUMNS, Trial


def trial(frame: int, rotation: float = 0.3, translation: float = 0.05, cpu: float = 2.0, **changes: object) -> Trial:
    one = Trial(
        "single", "edges", "street", (frame,), 1.0, 0.2, 0, "done", "", rotation, translation, 1.7, 0.3,
        (0.1, -0.2, 1 / 3, 0.01, -0.02, 0.03), (1.0, 1.0, 1.0, 0.2, 0.2, 0.2), 0.5, 0.75, float("nan"), 120, cpu, 0.25,
    )  # fmt: skip
    return replace(one, **changes)


def table(rotations: Sequence[float], **changes: object) -> list[Trial]:
    """One trial for each frame."""
    return [trial(n, rotation, **changes) for n, rotation in enumerate(rotations)]


def only(found: list[Comparison]) -> Comparison:
    assert len(found) == 1
    return found[0]


# --- tables


def test_trials_are_read_as_written(tmp_path: Path) -> None:
    trials = [
        trial(3, np.float64(0.1) * 3, reason='says "no",\nand ends', status="refused"),
        trial(4, frames=(4, 7, 11), seed=12, translation=1e-17, status="failed"),
    ]
    write_trials(tmp_path / "trials.csv", trials)
    assert repr(read_trials(tmp_path / "trials.csv")) == repr([replace(t, rotation_deg=float(t.rotation_deg)) for t in trials])
    header = (tmp_path / "trials.csv").read_text().splitlines()[0]
    assert header == ",".join(COLUMNS)


def test_columns_may_stand_in_any_order(tmp_path: Path) -> None:
    trials = table([0.1, 0.2])
    rows = [[*map(str, one.row()), "more"][::-1] for one in trials]
    path = tmp_path / "other.csv"
    path.write_text("\n".join(",".join(row) for row in [[*COLUMNS, "new"][::-1], *rows, ""]), encoding="utf-8-sig")
    assert repr(read_trials(path)) == repr(trials)


def written(folder: Path) -> list[str]:
    """Lines of a table of three trials."""
    write_trials(folder / "trials.csv", table([0.1, 0.2, 0.3]))
    return (folder / "trials.csv").read_text().splitlines(keepends=True)


def test_damaged_tables_are_refused_by_line(tmp_path: Path) -> None:
    for damage, words in (
        (lambda lines: [], "is empty"),
        (lambda lines: lines[:1], "holds no trials"),
        (lambda lines: [lines[0].replace("seed", "sed"), *lines[1:]], "line 1: no column seed"),
        (lambda lines: [*lines[:2], lines[2].replace(",done,", ",maybe,")], "line 3: status must be one of .* got 'maybe'"),
        (lambda lines: [*lines[:2], lines[2].replace(",0.2,0.05,", ",much,0.05,")], "line 3: rotation_deg .* got 'much'"),
        (lambda lines: [*lines[:2], lines[2].replace("street,1,", "street,1.5,")], "line 3: frames .* got '1.5'"),
        (lambda lines: [*lines[:3], lines[3][:60]], "line 4: [0-9]+ values in 32 columns"),
        (lambda lines: [*lines[:3], lines[3][:-1]], "line 4: the last line is cut off"),
        (lambda lines: [*lines[:3], lines[3].replace("edges", '"edges')], "line 4: .*cut off or damaged"),
        (lambda lines: [*lines, lines[2]], "line 5: the same trial as in line 3"),
        (lambda lines: ["\x89PNG\udcff\udcff"], "no text"),
    ):
        lines = damage(written(tmp_path))
        path = tmp_path / "trials.csv"
        path.write_bytes("".join(lines).encode(errors="surrogateescape"))
        with pytest.raises(BadInputError, match=words) as caught:
            read_trials(path)
        assert str(path) in str(caught.value)


def test_a_missing_table(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="No such file"):
        read_trials(tmp_path / "none.csv")
    with pytest.raises(BadInputError, match="cannot read"):
        read_trials(tmp_path)


# --- comparison


def test_differences_by_hand() -> None:
    a = [trial(0, 0.4, 0.02, 1.0), trial(1, 0.6, 0.04, 2.0), trial(2, 0.2, 0.20, 4.0), trial(3, 3.0, 0.5, 1.0)]
    b = [trial(0, 0.1, 0.03, 2.0), trial(1, 0.4, 0.04, 4.0), trial(2, 0.6, 0.01, 8.0), trial(3, 2.0, 0.5, 2.0)]
    found = only(compare([*a, trial(9)], [*b, trial(10), trial(11)]))
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
    assert not found.estimates["rotation_mean"].reliable


def values(estimate: PairedChange) -> tuple[float, float, float]:
    return estimate.a, estimate.b, estimate.change


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
    assert found.reliable

    single = ClusterBootstrap(np.arange(400), 0, 4000)
    low, high = interval(single.medians(difference), 400)
    assert high - low == pytest.approx(2 * half * np.sqrt(np.pi / 2), rel=0.25)


def test_the_interval_of_few_clusters_is_as_wide_as_students() -> None:
    """8 values: t(0.975, 7) = 2.365 times the standard error, where plain percentiles would give 1.96 sqrt(7 / 8) times."""
    numbers = np.array([-1.2, -0.8, -0.5, -0.1, 0.2, 0.4, 0.7, 1.3])
    low, high = interval(ClusterBootstrap(np.arange(8), 0, 20000).means(numbers), 8)
    assert high - low == pytest.approx(2 * 2.365 * numbers.std(ddof=1) / np.sqrt(8), rel=0.04)


def test_the_interval_knows_that_trials_on_the_same_frames_belong_together() -> None:
    """30 sets of frames with 10 starts each, all of a set alike: the interval is that of 30 differences, not of 300."""
    shift = np.random.default_rng(6).normal(0, 0.2, 30)
    a = [trial(n, 1.0, seed=k) for n in range(30) for k in range(10)]
    b = [trial(n, 1.0 + shift[n], seed=k) for n in range(30) for k in range(10)]
    found = only(compare(a, b)).estimates["rotation_mean"]
    assert found.clusters == 30
    assert found.high - found.low == pytest.approx(2 * 1.96 * shift.std() / np.sqrt(30), rel=0.1)
    assert only(compare([replace(t, scene=str(t.seed)) for t in a], [replace(t, scene=str(t.seed)) for t in b])).pairs == 300


def test_identical_tables_show_no_difference() -> None:
    a = table(np.random.default_rng(2).uniform(0, 2, 40))
    found = only(compare(a, list(a)))
    assert (found.only_a, found.only_b, found.gained, found.lost) == (0, 0, 0, 0)
    for name, one in found.estimates.items():
        none = 1 if name == "cpu" else 0
        assert (one.change, one.low, one.high, one.verdict) == (none, none, none, "no difference shown")
    assert not any(word in as_text([found], "a", "b").split("\n\n")[1] for word in ("better", "worse", "*"))


def test_the_order_of_rows_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    base = rng.uniform(0, 2, 60)
    a, b = table(base), table(base * rng.uniform(0.5, 1.2, 60))
    a += [replace(one, method="planes") for one in a]
    b += [replace(one, method="planes", rotation_deg=2 * one.rotation_deg) for one in b]
    mixed = [[one[i] for i in rng.permutation(len(one))] for one in (a, b)]
    found = compare(a, b)
    assert found == compare(*mixed)
    assert [one.method for one in found] == ["edges", "planes"]
    assert found[0].estimates["rotation_mean"].verdict == "better"
    assert found[1].estimates["rotation_mean"].verdict == "worse"
    assert found != compare(a, b, seed=1)


def test_values_that_are_no_numbers_are_left_out_pair_by_pair() -> None:
    a, b = table([0.1, 0.2, float("nan"), 0.4, 0.5, 0.6]), table([0.1, float("nan"), 0.3, 0.4, 0.5, 0.6])
    b[0] = replace(b[0], cpu_s=0.0)
    found = only(compare(a, b))
    assert (found.pairs, found.estimates["rotation_mean"].clusters, found.estimates["cpu"].clusters) == (6, 4, 5)
    assert values(found.estimates["rotation_mean"]) == pytest.approx((0.4, 0.4, 0))
    nothing = only(compare(table([float("nan")]), table([float("nan")])))
    assert nothing.estimates["rotation_median"].verdict == "no difference shown"
    assert np.isnan(nothing.estimates["rotation_median"].a)


def test_one_set_of_frames_proves_nothing() -> None:
    a = [trial(0, 2.0, seed=k) for k in range(9)]
    found = only(compare(a, [replace(one, rotation_deg=0.1) for one in a]))
    assert np.isnan(found.estimates["rotation_mean"].low)
    assert found.estimates["rotation_mean"].verdict == "no difference shown"
    assert "* the interval is not reliable: fewer than 5 sets of frames" in as_text([found], "a", "b")


@pytest.mark.parametrize(
    ("b", "words"),
    [
        (table([0.1], experiment="multi"), "experiment is single in A, multi in B"),
        (table([0.1], scene="field"), "scene is street in A, field in B"),
        (table([0.1, 0.1], seed=5), "seed is 0 in A, 5 in B"),
        ([trial(n) for n in range(7, 12)], "frames is 0, 1 in A, 10, 11, 7 and 2 more in B"),
        ([], "experiment is single in A, missing in B"),
    ],
)
def test_tables_without_a_common_trial(b: list[Trial], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        compare(table([0.1, 0.2]), b)


def test_comparison_text() -> None:
    a, b = table([1.0] * 6), table([0.25] * 6, cpu=3.0)
    a.append(replace(a[0], method="planes"))
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
