"""What the page of a rig shows: of priors, of a result, and as HTML."""

from __future__ import annotations

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from graphs import edges, priors, rig

from calib_ros import se3
from calib_ros.rig.description import RigDescription, Sensor
from calib_ros.rig.edges import Measurement
from calib_ros.rig.graph import at_sensor, solve, worst_sigmas
from calib_ros.rig.report import RigReport
from calib_ros_check.rig import shown as html
from calib_ros_check.rig.shown import BAD, DOUBTFUL, GOOD, NEUTRAL, EdgeShown, RigShown, compared, of_priors, of_report

POSES = rig(2, 3)
PAIRS = [("c0", "l0"), ("c1", "l0"), ("c0", "l1"), ("c1", "l1"), ("l1", "l0")]
DESCRIPTION = RigDescription(tuple(Sensor(n, "lidar" if n[0] == "l" else "camera") for n in POSES), "l0")


@pytest.fixture(scope="module")
def shown() -> RigShown:
    """By a result in which l1-l0 is 3 deg off, and nothing is measured of c2."""
    rng = np.random.default_rng(0)
    measured = edges(POSES, PAIRS, rng)
    measured[4] = replace(measured[4], T=se3.perturb(measured[4].T, [0, 0, 3.0], [0, 0, 0]))
    out = [Measurement(e.target, e.source, "", e) for e in measured] + [Measurement("c2", "l0", "", None, "too <dark>")]
    return of_report(RigReport(DESCRIPTION, solve(measured, priors(POSES, rng), "l0"), out, dict.fromkeys(POSES, ""), {}))


def test_a_result_is_shown_with_what_contradicts_it(shown: RigShown) -> None:
    assert {own.name: (own.status, own.level, own.usable) for own in shown.sensors} == {
        **{"l0": ("reference", GOOD, True), "l1": ("converged", GOOD, True), "c0": ("converged", GOOD, True)},
        **{"c1": ("converged", GOOD, True), "c2": ("insufficient", DOUBTFUL, False)},
    }
    assert [(e.fate, e.level) for e in shown.edges] == [("used", GOOD)] * 4 + [("rejected", BAD), ("failed", NEUTRAL)]
    wrong = shown.edges[4]
    assert wrong.residual is not None
    assert wrong.residual[0] == pytest.approx(3.0, abs=0.3)
    assert wrong.excess > 10 > max(e.excess for e in shown.edges if e.fate == "used")
    assert shown.edges[5].residual is None
    assert [closes for *_, closes in shown.loops] != [True, True]
    assert shown.text.startswith("4 of 5 sensors usable; l1-l0 contradicts the others; loop ")


def test_an_edge_that_is_used_but_lies_far_off_is_doubtful() -> None:
    T, C = se3.inverse(POSES["c0"]) @ POSES["l0"], np.diag(np.r_[np.full(3, np.deg2rad(0.1)), np.full(3, 0.01)] ** 2)
    edge = EdgeShown("c0", "l0", "", "used", GOOD)
    assert compared(edge, T, C, POSES).level == GOOD
    off = compared(edge, se3.perturb(T, [0.5, 0, 0], [0, 0, 0]), C, POSES)
    assert (off.level, off.excess) == (DOUBTFUL, pytest.approx(5 / np.sqrt(6), rel=1e-3))
    assert compared(replace(edge, target="other"), T, C, POSES).residual is None


def test_priors_are_shown_with_their_spread_and_are_not_usable() -> None:
    known = priors(POSES, np.random.default_rng(0))
    shown = of_priors(DESCRIPTION, solve([], known, "l0"))
    assert {own.status for own in shown.sensors} == {"reference", "prior"}
    assert not any(own.usable for own in shown.sensors)
    own = shown.sensors[-1]
    assert own.sigma == pytest.approx(worst_sigmas(at_sensor(*known[own.name])))
    assert "nothing is estimated" in shown.text


def test_the_graph_names_all_sensors_and_tells_levels_without_colour(shown: RigShown) -> None:
    svg = ElementTree.fromstring(html.graph_svg(shown))
    plan = ElementTree.fromstring(html.plan_svg(shown))
    places = [(own.get("text-anchor"), own.get("y")) for own in plan.iter("text")]
    assert len(set(places)) == len(places) == 5, "names do not lie on each other"
    assert [own.get("class") for own in plan.iter("g") if own.find("path") is not None] == [e.level for e in shown.edges]
    texts = [own.text for own in svg.iter("text")]
    assert texts.count("✕") == 1, "the mark of the wrong edge"
    assert {"l0", "l1", "c0", "c1", "c2", "insufficient, not usable"} <= set(texts)
    assert [own.get("class") for own in svg.iter("g") if own.find("path") is not None] == [e.level for e in shown.edges]
    boxes = [(float(own.get("x", 0)), float(own.get("y", 0))) for own in svg.iter("rect")]
    assert len(set(boxes)) == 5
    assert {x for x, _ in boxes} == {0.0, 248.0}


def test_tables_escape_what_they_are_told_and_have_whole_names(shown: RigShown) -> None:
    table = ElementTree.fromstring(html.edges_html(shown))
    rows = [[("".join(cell.itertext())) for cell in row] for row in table.iter("tr")]
    assert rows[0] == ["edge", "", "1σ", "residual", "why"]
    assert rows[6][0] == "c2 – l0"
    assert rows[6][4] == "too <dark>"
    assert html.loops_html(shown).count("does not close") == sum(not closes for *_, closes in shown.loops)
    longer = replace(shown, sensors=tuple(replace(own, name=own.name + "_with_a_very_long_name") for own in shown.sensors))
    assert ">c0_with_a_very_lo…<" in html.graph_svg(longer)
    assert "c0_with_a_very_long_name" in ElementTree.fromstring(html.sensors_html(longer)).itertext()
