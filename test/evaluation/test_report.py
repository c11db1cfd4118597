"""The report of `calib-ros evaluate`: its figures, its page, its Markdown."""

from __future__ import annotations

import builtins
import dataclasses
import math
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from html_pages import Page
from trial_rows import row, table

from calib_ros.errors import MissingDependencyError
from calib_ros_evaluation.curves import Curves
from calib_ros_evaluation.report import tables
from calib_ros_evaluation.report.page import sections, write_report
from calib_ros_evaluation.report.table import Table, escaped, figures
from calib_ros_evaluation.report.tables import area, basins, called_right, hits, median, peak_distances, quantile
from calib_ros_evaluation.results import Averaging, CurveResult, Results, Similarity, Trust, algorithm_6

# Frame 1 is like 0; frame 2 is unlike 0, though like 1; frame 3 is like 2.
ALIKE = np.array([[1, 0.8, 0.5, 0.1], [0.8, 1, 0.8, 0.2], [0.5, 0.8, 1, 0.9], [0.1, 0.2, 0.9, 1]])
FACTS = {"Source": "drive & <odd> name", "Command": "calib-ros evaluate drive --out x"}


def trial(method: str = "ours", end: tuple[float, ...] = (0, 0, 0, 0, 0, 0), **options) -> dict[str, Any]:
    """A trial that ended at `end`, deg and m, with errors to match."""
    return row(end, method=method, **options)


def bell(at: float = 0.0, width: float = 1.0, samples: int = 41) -> Curves:
    """Curves with a peak at `at` half widths."""
    unit = np.linspace(-1, 1, samples)
    offsets = np.repeat([2.0, 30.0], 3)[:, None] * unit
    return Curves(offsets, np.tile(np.exp(-0.5 * ((unit - at) / width) ** 2), (6, 1)))


def fake(methods: tuple[str, ...], n: int) -> Results:
    """Results of everything, drawn at random; not of any real method."""
    rng = np.random.default_rng(0)

    def draw(k: int, method: str, experiment: str, number: int, start: float, frames: int) -> dict[str, Any]:
        end = rng.normal(0, 0.1 * (k + 1), 6) * [1, 0.5, 0.8, 0.1, 0.15, 0.1]
        status, reason = ("refused", "too few starts agree") if method == "ours" and number == 3 else ("done", "")
        size = {"start_deg": start, "start_m": 0.1 * start, "seed": number, "scene": ("drive 5", "drive 9")[number % 2]}
        positions = str(number) if frames == 1 else " ".join(map(str, range(frames)))
        return trial(method, tuple(end), experiment=experiment, frames=positions, status=status, reason=reason, **size)

    trials = []
    for own in enumerate(methods):
        trials += [draw(*own, "single", i, 2.0, 1) for i in range(n)]
        trials += [draw(*own, "starts", i, s, 1) for s in (0.5, 1.0, 2.0) for i in range(n // 2)]
        trials += [draw(*own, "frames", i, 2.0, count) for count in (1, 2, 4) for i in range(n // 2)]
    curves = [CurveResult(method, f"drive {k}", bell(0.1 * k)) for method in methods for k in range(2)]
    costs = [(method, 1, 20.0 * (k + 1), 0.05, 5.0) for k, method in enumerate(methods)]
    titles = {method: f"{method.capitalize()} and others: edges of the one with edges of the other" for method in methods}
    trusts = [Trust(0.99, ((0.5, 0.0, 0.6 + 0.02 * k), (0.0, 0.1, 0.8))) for k in range(4)]
    shape = tuple("abc"), np.array([0.1, 0.3, 0.2]), np.full((3, 10), 0.1), (bell(0.1), bell(), bell(-0.1)), "by points"
    averagings = [Averaging(method, "drive 5", *shape) for method in methods if method in ("thesis", "ours")]
    similarities = [Similarity("drive 5", (0, 2, 4, 6), ALIKE, 0.95, {0: np.full((3, 64), 1 / 64), 6: np.eye(1, 64)})]
    failures = [("curves|nid|drive 7|3|", "nothing to see")]
    return Results(titles, table(*trials), curves, costs, failures, trusts, averagings, similarities)


def written(folder: Path, results: Results) -> list[Path]:
    return write_report(folder, "methods compared", FACTS, "score: {a: 1 & 2}", sections(results))


def column(table: Table, name: str, key: int = 0) -> dict[str, str]:
    """Text of the cells of a column by that of another."""
    k = table.header.index(name)
    return {row[key]: row[k] for row in table.rows}


@pytest.fixture(scope="module")
def results() -> Results:
    return fake(("levinson", "thesis", "ours"), n=8)


@pytest.fixture(scope="module")
def report(results: Results, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return written(tmp_path_factory.mktemp("report"), results)


def test_nan_counts_as_infinite() -> None:
    assert quantile([4, 1, 2, 3], 0.5) == 2.5
    assert quantile([0, 10], 0.9) == pytest.approx(9)
    assert median([1, math.nan, 2]) == 2
    assert median([1, math.nan, math.nan]) == math.inf
    assert quantile([1, 2, math.nan, math.nan], 0.5) == math.inf
    assert math.isnan(median([]))


def test_a_curve_rises_up_to_its_first_step_back() -> None:
    x = np.tile(np.arange(-2.0, 3.0), (6, 1))
    shapes = [
        [0, 0.5, 1, 0.4, 0.6],  # to the right it ends at 1
        [0, 0.2, 0.1, 0.5, 1],  # the peak is at 2; to the left it ends at 0
        [1, 0.9, 0.5, 0.2, 0],  # the peak is at -2, and the whole curve rises towards it
        [0, 0.5, 1, 0.4, 0.405],  # a step back of less than 1 %
        [3, 3, 3, 3, 3],
        [0, 1, math.nan, 0, 0],
    ]
    curves = Curves(x, np.array(shapes))
    assert basins(curves)[:5] == pytest.approx([1.5, 1.0, 2.0, 2.0, 0.0])
    assert math.isnan(basins(curves)[5])
    assert peak_distances(curves)[:3] == pytest.approx([0.0454545, 2, 2], abs=1e-6)
    assert math.isnan(curves.peaks[4])  # flat: no peak, which is as bad as can be
    assert peak_distances(curves)[4] == 2
    assert math.isnan(peak_distances(curves)[5])


def test_table_4_4_beside_the_printed_one() -> None:
    ends = [(0.1, 0, 0, 0.01, 0, 0), (-0.3, 0, 0, 0.03, 0, 0)]
    refused = trial(end=(2, 0, 0, 0, 0, 0), status="refused", reason="flat")
    whole = tables.axes(Results({"ours": "Ours"}, table(*(trial(end=end) for end in ends), refused)))
    rows = {tuple(row[:2]): tuple(row[2:]) for row in whole.rows}
    assert rows["printed in the thesis", "mean"] == ("100", "-0.462", "0.390", "0.744", "-0.18", "-1.46", "-1.43")
    assert rows["printed in the thesis", "median"][5] == "-14.79"
    assert rows["ours", "mean"][:2] == ("3", "0.600")  # the refused trial ends where it began
    assert rows["ours", "median"][:5] == ("3", "0.100", "0.000", "0.000", "1.00")
    assert rows["ours, accepted", "mean"][:5] == ("2", "-0.100", "0.000", "0.000", "2.00")
    assert rows["ours, accepted", "mean of sizes"][1] == "0.200"
    assert any("-0.014786" in note for note in whole.notes)


def test_success_and_errors() -> None:
    own = [trial(end=(0.1 * k, 0, 0, 0.01 * k, 0, 0)) for k in range(8)]  # 0.5 deg and more is no success
    own += [
        trial(end=(2, 0, 0, 0.2, 0, 0), status="refused"),
        trial(status="failed", rotation_deg=math.nan, translation_m=math.nan),
    ]
    baseline = [trial("nid", end=(0.4, 0, 0, 0.04, 0, 0)) for _ in range(10)]
    found = tables.single(Results({"nid": "NID", "ours": "Ours"}, table(*own, *baseline)))
    assert column(found, "success") == {"nid": "100 %", "ours": "50 %", "ours, accepted": "62 %"}
    assert column(found, "95 % interval")["ours"] == "24 to 76 %"
    assert column(found, "rotation median deg") == {"nid": "0.400", "ours": "0.450", "ours, accepted": "0.350"}
    assert column(found, "translation median cm")["ours"] == "4.5"
    assert [row[5] for row in found.rows] == ["0.400", "∞", "0.630"]  # 90 %
    assert column(found, "refused") == {"nid": "0 %", "ours": "10 %", "ours, accepted": ""}
    assert column(found, "failed")["ours"] == "10 %"
    assert column(found, "accepted but wrong") == {"nid": "0 %", "ours": "30 %", "ours, accepted": "38 %"}


def test_success_by_start_frames_and_scene() -> None:
    good, bad = (0, 0, 0, 0, 0, 0), (1, 0, 0, 0, 0, 0)
    trials = [
        trial(end=end, experiment="starts", start_deg=d, start_m=0.1) for d, end in ((1, good), (1, good), (3, good), (3, bad))
    ]
    trials += [trial(end=(e, 0, 0, 0, 0, 0), experiment="frames", frames=f) for f, e in (("0", 1.0), ("1", 3.0), ("0 1", 0.4))]
    trials += [trial(end=end, scene=scene) for scene, end in (("a", good), ("b", bad))]
    found = Results({"ours": "Ours"}, table(*trials))
    starts = tables.starts(found)
    assert starts.header == ["method", "±1 deg, ±10 cm", "±3 deg, ±10 cm"]
    assert starts.rows == [["ours", "100 % (34 to 100)", "50 % (9 to 91)"], ["doing nothing", "0 %", "0 %"]]
    assert "Trials per cell: 2." in starts.notes[0]
    rotation, _, success = tables.frames(found)
    assert rotation.rows == [["ours", "2.000 (1.500 to 2.500)", "0.400 (0.400 to 0.400)"]]
    assert rotation.header == ["method", "1 frame", "2 frames"]
    assert success.rows[0][2].startswith("100 %")
    (scenes,) = tables.scenes(found)
    assert scenes.rows[0][1:] == ["100 % (21 to 100)", "0 % (0 to 79)"]


def test_peaks_and_basins_of_curves() -> None:
    curves = [CurveResult("ours", label, bell(at)) for label, at in (("a", 0.1), ("b", -0.2), ("c", 0.0))]
    curves += [CurveResult("nid", "a", bell(0.15))]
    found = Results({"nid": "NID", "ours": "Ours"}, curves=curves)
    rows = {tuple(row[:2]): tuple(row[2:]) for row in tables.peaks(found).rows}
    assert rows["ours", "mean"] == ("3", "0.200", "0.200", "0.200", "3.00", "3.00", "3.00")
    assert rows["ours", "median"][:2] == ("3", "0.200")
    assert rows["nid", "mean"][:2] == ("1", "0.300")
    assert tables.basin(found).rows[0][3:5] == ["2.000", "2.000"]
    assert "reach 2 deg and 30 cm" in tables.basin(found).notes[1]


def test_weighted_average_of_curves() -> None:
    """Eq. 3.16: two frames with peaks at -1 and +1; with weights 3 and 1 the average is 0.75 J_1 + 0.25 J_2."""
    offsets = np.tile([-1.0, 0, 1], (6, 1))
    single = Curves(offsets, np.tile([4.0, 0, 0], (6, 1))), Curves(offsets, np.tile([0.0, 0, 8], (6, 1)))
    one = Averaging("ours", "a", ("f", "g"), np.array([3.0, 1]), np.zeros((2, 10)), single, "told")
    assert one.average([0, 1], weighted=True).values[0] == pytest.approx([3, 0, 2])
    assert one.average([0, 1], weighted=False).values[0] == pytest.approx([2, 0, 4])
    without = dataclasses.replace(one, weights=np.zeros(2))  # nothing important: all alike
    assert without.average([0, 1], weighted=True).values[0] == pytest.approx([2, 0, 4])


def test_peaks_of_averages() -> None:
    (found,) = tables.averaging(fake(("ours",), n=4))
    kinds = column(found, "r_x deg", 2)
    assert kinds["3 single frames"] == "0.133"  # 0.2, 0 and 0.2
    assert abs(float(kinds["unweighted, 1 averages of 3"])) < 0.001
    assert float(kinds["weighted, 1 averages of 3"]) == pytest.approx(0.033, abs=0.002)  # (0.1 * 0.2 - 0.2 * 0.2) / 0.6


def test_algorithm_6_compares_with_the_last_keyframe() -> None:
    assert algorithm_6(ALIKE, 0.7) == [0, 2]
    assert algorithm_6(ALIKE, 0.95) == [0, 1, 2, 3]
    assert algorithm_6(ALIKE, 0.05) == [0]
    (found,) = tables.keyframes(Results({}, similarities=[Similarity("a", (0, 2, 4, 6), ALIKE, 0.95, {})]))
    assert found.rows == [["a", "0.7", "2 of 4", "frames 0, 4"], ["a", "0.95", "4 of 4", "frames 0, 2, 4, 6"]]


def test_cost_of_features_and_of_a_whole_estimate() -> None:
    costs = [("nid", 1, 5.0, 2.0, 9.0), ("ours", 3, 20.0, 0.5, 10.0)]
    found = tables.cost(Results({"ours": "Ours"}, table(*(trial(cpu_s=c) for c in (1.0, 2.0, 9.0))), costs=costs))
    assert found.rows == [["nid", "1", "5.00", "2.00", "9.00", "–", "–"], ["ours", "3", "20.0", "0.500", "10.0", "2.50", "100"]]


@pytest.mark.parametrize(("value", "text"), [(1234.5, "1234"), (12.34, "12.3"), (0.1, "0.100"), (0.00234, "0.00234"), (0, "0")])
def test_three_figures(value: float, text: str) -> None:
    assert figures(value) == text


def test_markdown_escapes_what_would_break_a_table() -> None:
    one = Table("T", ("method", "a|b"), (("x_1", "2*3"), ("<b>", "4")), ("note",))
    rows = r"| method | a\|b |", "| --- | --- |", r"| x\_1 | 2\*3 |", r"| \<b\> | 4 |"
    assert one.markdown().splitlines() == ["### T", "", *rows, "", "note"]
    assert escaped("two\nlines") == "two lines"


def test_the_report_is_one_page_and_its_parts(report: list[Path], results: Results) -> None:
    page, text = report[0], report[-1]
    assert (page.name, text.name) == ("report.html", "report.md")
    found = Page(page.read_text())
    assert found.sources
    assert all(re.match("data:image/(png|jpeg);base64,", source) for source in found.sources)
    assert not found.tags & {"script", "link", "iframe", "object"}
    assert "http" not in page.read_text()
    assert "url(" not in page.read_text()
    assert "@import" not in page.read_text()
    assert [f"#{key}" for key in found.ids] == found.links  # the navigation names every section
    assert found.ids == [
        "summary",
        "curves",
        "single",
        "starts",
        "frames",
        "averaging",
        "similarity",
        "trust",
        "cost",
        "troubles",
    ]
    assert "drive & <odd> name" in found.text
    assert "score: {a: 1 & 2}" in found.text
    assert "<odd>" not in page.read_text()
    style, body = page.read_text().split("</style>")
    used = {name for names in re.findall(r'class="([^"]+)"', body) for name in names.split()}
    assert {name for name in used if f".{name}" not in style} == set()  # every class has a style
    plots = sorted(path.name for path in report[1:-1])
    named = sorted(re.findall(r"\(plots/(\w+\.png)\)", text.read_text()))
    assert plots == named == sorted(path.name for path in (page.parent / "plots").iterdir())
    for path in report[1:-1]:
        assert cv2.imread(str(path)).shape[1] > 700
    for one in (tables.summary(results), tables.axes(results), *tables.averaging(results), *tables.keyframes(results)):
        assert one.markdown() in text.read_text()


def test_the_same_results_give_the_same_bytes(tmp_path: Path) -> None:
    one, other = (written(tmp_path / name, fake(("ours",), n=4)) for name in ("a", "b"))
    assert [path.read_bytes() for path in one] == [path.read_bytes() for path in other]


def test_empty_evaluation_reports_the_reason(tmp_path: Path) -> None:
    failures = [("cost|nid|drive|3|", "no <points> in sight")]
    page, text = written(tmp_path, Results({"nid": "NID"}, failures=failures))
    found = Page(page.read_text())
    assert found.ids == ["troubles"]
    assert "no <points> in sight" in found.text
    assert "in sight" in text.read_text()
    assert sections(Results({})) == []


def test_failed_trials_and_broken_scores_are_drawn_as_far_as_they_go() -> None:
    lost = {"end": (math.nan,) * 6, "status": "failed", "reason": "<i>dark</i>"}
    trials = [trial(experiment=name, **lost) for name in ("single", "starts", "frames") for _ in range(3)]
    broken = bell()
    broken.values[2] = math.nan
    found = Results({"ours": "O"}, table(*trials), [CurveResult("ours", "a", broken)])
    made = {section.key: section for section in sections(found)}
    assert list(made) == ["summary", "curves", "single", "starts", "frames", "troubles"]
    assert made["summary"].tables[0].rows == [["ours", "0 %", "∞", "∞", "0 %", "1.50", "0.000", "0.0"]]
    assert column(made["curves"].tables[0], "r_z deg", 1) == {"mean": "–", "median": "–"}
    assert made["troubles"].tables[0].rows[0] == ["3", "single", "ours", "failed", "<i>dark</i>"]


@pytest.mark.parametrize("missing", ["matplotlib", "jinja2"])
def test_without_a_library_nothing_is_written(missing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.split(".")[0] == missing:
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependencyError, match=missing):
        written(tmp_path / "out", Results({"ours": "O"}, table(trial())))
    assert not (tmp_path / "out").exists()


def test_reasons_that_differ_in_figures_are_one() -> None:
    said = ["1.65-fold, 1.96 is needed", "1.47-fold, 1.96 is needed", "the image is dark", "-0.2-fold, 1.96 is needed"]
    trials = table(*(trial(status="refused", reason=reason) for reason in said))
    (found,) = tables.troubles(Results({"ours": "Ours"}, trials))
    assert found.rows == [
        ["3", "single", "ours", "refused", "1.65-fold, 1.96 is needed"],
        ["1", "single", "ours", "refused", "the image is dark"],
    ]


def test_report_of_the_share_of_worse_neighbours() -> None:
    """Of 4 right and 2 wrong shares: 7 of the 8 pairs are in order and one is tied, (7 + 0.5 * 1) / 8."""
    assert area([0.9, 0.8, 0.7, 0.6], [0.5, 0.6]) == pytest.approx(7.5 / 8)
    assert area([0.5], [0.5]) == 0.5
    # Of 40 right ones, two may be below the threshold at 5 % false alarms: it is the third lowest.
    right = np.linspace(0.61, 1.0, 40)
    assert hits(right, [0.625, 0.635]) == 0.5
    trusts = [Trust(0.95 + 0.01 * k, ((0.5, 0.0, 0.5 + 0.05 * k), (0.0, 0.1, 0.6))) for k in range(4)]
    assert called_right(trusts, None) == 1.0
    assert called_right(trusts, (0.5, 0.0)) == 0.0
    found = tables.detection(trusts)
    assert found.rows[0][:2] == ["none", "0.965"]
    assert found.rows[1] == ["0.5 deg", "0.575", "1.00", "100 %", "1.00", "100 %", "0 %"]
    assert math.isnan(called_right(trusts[:2], None))
