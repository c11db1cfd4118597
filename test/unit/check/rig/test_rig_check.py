"""What the checks of a rig's pairs say of its sensors, and what the page of a rig shows."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from graphs import RIGS, edges, priors, rig
from html_pages import Page
from scenes import QUICK, RenderedDrive
from two_halves import TwoHalves

from calib_ros import se3
from calib_ros.cli.main import main
from calib_ros.errors import BadInputError
from calib_ros.extensions import PAGES, load
from calib_ros.result import Cause
from calib_ros.rig.description import CAMERA, LIDAR, RigDescription, Sensor, prior_covariance
from calib_ros.rig.edges import Measurement, RigMeasurer
from calib_ros.rig.graph import Edge, RigSolution, at_sensor, solve, worst_sigmas
from calib_ros.rig.report import RigReport
from calib_ros_check.cli import rig_summary
from calib_ros_check.fleet.history import row_of
from calib_ros_check.fleet.recordings import Recording
from calib_ros_check.outcome import CauseFinding, CauseState, CheckResult, CheckVerdict, Tolerance
from calib_ros_check.report import write_rig_check
from calib_ros_check.rig import shown as html
from calib_ros_check.rig.check import PairCheck, RigCheck, as_given, as_row, check_rig, judged
from calib_ros_check.rig.shown import BAD, DOUBTFUL, GOOD, NEUTRAL, EdgeShown, RigShown, compared, of_priors, of_report
from calib_ros_check.tolerance import judge, unknown

TOLERANCE = Tolerance(0.5, 0.1)
PASS, FAIL, INCONCLUSIVE = CheckVerdict.PASS, CheckVerdict.FAIL, CheckVerdict.INCONCLUSIVE


def known_of(poses: dict[str, np.ndarray]) -> RigSolution:
    return solve([], {n: (T, prior_covariance(T, 3, 0.2)) for n, T in poses.items() if n != "l0"}, "l0")


def pair_of(known: RigSolution, edge: Edge, seconds: float | None = None) -> PairCheck:
    """A pair as it is checked by an edge. seconds: wrong clocks that were found."""
    T = known.between(edge.target, edge.source)[0]
    judgement = judge(T, edge.T, edge.covariance, TOLERANCE)
    pair = PairCheck(edge.target, edge.source, "check", judgement, "as measured", edge)
    if seconds is None:
        return pair
    late = (CauseFinding(Cause.TIME_OFFSET, CauseState.FOUND, "the clocks are apart"),)
    fields = vars(judgement) | {"verdict": FAIL}
    check = CheckResult(**fields, reason="", tolerance=TOLERANCE, T_checked=T, T_estimated=edge.T, covariance=None, causes=late)
    return replace(pair, check=check, edge=replace(edge, time_offset_s=seconds, time_sigma_s=0.002))


def checked(name: str, groups: Sequence[Sequence[str]], pairs: Sequence[tuple[str, str]] | None = None) -> RigCheck:
    """The check of a rig of which each group is displaced, by 1.5 deg and 15 cm, from where it is said to be."""
    poses, own = RIGS[name]
    actual = dict(poses)
    for k, group in enumerate(groups):
        centre = se3.from_parts(np.eye(3), np.mean([poses[n][:3, 3] for n in group], axis=0))
        D = centre @ se3.exp(np.r_[np.roll([np.deg2rad(1.5), 0, 0], k), np.roll([0.15, 0, 0], k)]) @ se3.inverse(centre)
        actual |= {n: D @ poses[n] for n in group}
    known = known_of(poses)
    measured = edges(actual, own if pairs is None else pairs, np.random.default_rng(0))
    return judged(known, described(poses), [pair_of(known, e) for e in measured], TOLERANCE, source="a drive")


def described(poses: dict[str, np.ndarray]) -> RigDescription:
    return RigDescription(tuple(Sensor(n, LIDAR if n[0] == "l" else CAMERA, prior=T) for n, T in poses.items()), "l0")


@pytest.mark.parametrize("name", RIGS)
def test_a_right_rig_passes(name: str) -> None:
    found = checked(name, [])
    assert found.verdict is PASS, found.reason
    assert {own.verdict for own in found.sensors.values()} == {PASS}
    assert not found.blame.off
    assert len(found.solution.loops) == (2 if name == "loops" else 0)


@pytest.mark.parametrize(
    ("name", "groups"),
    [
        ("loops", [["c0"]]),
        ("loops", [["l1"]]),
        ("ring", [["c3"]]),
        ("ring", [["l0"]]),  # the reference itself
        ("ring", [["c1", "c2"]]),
        ("ring", [["c0"], ["c4"]]),
        ("loops", [["l0"]]),
    ],
)
def test_the_sensor_is_named_that_is_off_and_no_other(name: str, groups: list[list[str]]) -> None:
    found = checked(name, groups)
    off = {n for group in groups for n in group}
    assert found.verdict is FAIL
    assert {n for n, own in found.sensors.items() if own.verdict is FAIL} == off, rig_summary(found)
    assert {n for n, own in found.sensors.items() if own.verdict is PASS} == found.sensors.keys() - off
    assert set(found.blame.off) == off
    for group in groups:
        assert f"{group[0] if len(group) == 1 else 'the bracket of ' + ', '.join(group)} is off by 1." in found.reason


def test_one_pair_does_not_tell_which_of_its_two_sensors_is_off() -> None:
    found = checked("stereo", [["c0"]], [("c0", "l0")])
    assert found.verdict is FAIL
    assert "cannot tell between: c0 is off by 1." in found.reason
    verdicts = {n: own.verdict for n, own in found.sensors.items()}
    assert verdicts == {"l0": INCONCLUSIVE, "c0": FAIL, "c1": INCONCLUSIVE}
    assert "no pair joins it" in found.sensors["c1"].reason


def test_a_sensor_without_a_verdict_leaves_the_rig_open() -> None:
    poses, pairs = RIGS["ring"]
    known = known_of(poses)
    measured = [pair_of(known, e) for e in edges(poses, pairs, np.random.default_rng(0))]
    measured[2] = PairCheck("c2", "l0", "check", unknown(), "nothing matches beyond chance")
    found = judged(known, described(poses), measured, TOLERANCE)
    assert found.verdict is INCONCLUSIVE
    assert "whether c2 is right" in found.reason
    assert found.sensors["c2"].reason == "nothing matches beyond chance"


def test_a_clock_that_all_pairs_share_is_the_lidars() -> None:
    poses, pairs = RIGS["ring"]
    known = known_of(poses)
    measured = [pair_of(known, e, 0.05) for e in edges(poses, pairs, np.random.default_rng(0))]
    found = judged(known, described(poses), measured, TOLERANCE)
    assert {n for n, own in found.sensors.items() if own.verdict is FAIL} == {"l0"}, rig_summary(found)
    assert found.reason.startswith("the clock of l0 is off by +")
    # Only one camera is late; then the same, where nothing is known of the clocks of the others.
    for offset in (0.0, None):
        one = [p if p.target == "c1" else replace(p, check=None, edge=replace(p.edge, time_offset_s=offset)) for p in measured]
        found = judged(known, described(poses), one, TOLERANCE)
        assert {n for n, own in found.sensors.items() if own.verdict is FAIL} == {"c1"}, rig_summary(found)
        assert ("cannot tell between: the clock of c1" if offset is None else "the clock of c1 is off by -") in found.reason


def test_result_and_page_hold_every_sensor_and_pair(tmp_path: Path) -> None:
    found = checked("loops", [["c0"]])
    data = json.loads(found.dumps())
    assert (data["verdict"], data["reference"], list(data["off"])) == ("fail", "l0", ["c0"])
    assert data["sensors"]["c0"]["rotation"]["error"] == pytest.approx(1.5, abs=0.2)
    assert [(p["target"], p["source"]) for p in data["pairs"]] == list(RIGS["loops"][1])
    assert all(loop["closes"] for loop in data["loops"])
    write_rig_check(tmp_path / "check.html", found, QUICK)
    page = (tmp_path / "check.html").read_text()
    assert all(f"<tr><td>{name}</td>" in page for name in found.sensors)
    assert (page.count("<svg"), page.count("<h2>Loops</h2>")) == (2, 1)


def test_a_fleet_shows_the_worst_pair_of_a_rig() -> None:
    poses, pairs = RIGS["ring"]
    known = known_of(poses)
    measured = [pair_of(known, e, 0.05 if e.target == "c1" else None) for e in edges(poses, pairs, np.random.default_rng(0))]
    found = judged(known, described(poses), measured, TOLERANCE)
    row = row_of(Recording("/data/van/drive"), {"result": as_row(found)})
    assert (row.verdict, row.cause, row.message) == ("fail", "time_offset", found.reason)
    assert row.errors["rotation_deg"] < 0.2
    with pytest.raises(BadInputError, match="a drive: as measured; as measured"):
        as_row(checked("stereo", []))


def test_a_result_of_rig_may_be_what_is_checked(tmp_path: Path) -> None:
    poses, _ = RIGS["stereo"]
    report = RigReport(described(poses), known_of(poses), [], dict.fromkeys(poses, ""), {})
    report.save(str(tmp_path / "rig.json"))
    other = as_given(replace(described(poses), reference="c0"), str(tmp_path / "rig.json"))
    np.testing.assert_allclose(other["l0"].prior, se3.inverse(poses["c0"]), atol=1e-9)
    assert as_given(other, "tf")["c1"].prior is None
    assert as_given(other) is other
    more = replace(other, sensors=(*other.sensors, Sensor("c9", CAMERA)))
    with pytest.raises(BadInputError, match="has no c9, but l0, c0, c1; give a result of this rig"):
        as_given(more, str(tmp_path / "rig.json"))


def test_two_cameras_are_checked_around_their_lidar(drive: RenderedDrive) -> None:
    halves = TwoHalves(drive)
    off = halves.reference("right") @ se3.exp([0, np.deg2rad(2.0), 0, 0, 0, 0])
    description = RigDescription((Sensor("top", LIDAR), Sensor("left", CAMERA), Sensor("right", CAMERA, prior=off)), "top")
    found = check_rig(RigMeasurer(halves, description, QUICK, 3), TOLERANCE)
    assert [pair.check is not None for pair in found.pairs] == [True, True]
    assert {n: own.verdict for n, own in found.sensors.items()} == {"top": PASS, "left": PASS, "right": FAIL}, rig_summary(found)
    assert found.reason.startswith("right is off by ")


def test_the_page_of_an_estimated_rig_shows_every_camera(drive: RenderedDrive, tmp_path: Path) -> None:
    description = RigDescription((Sensor("top", LIDAR), Sensor("left", CAMERA), Sensor("right", CAMERA)), "top")
    measurer = RigMeasurer(TwoHalves(drive), description, QUICK, 3)
    report = RigReport.of(measurer, [Measurement("left", "top", "registration", None, "too <dark>")])
    load(PAGES, "rig")(str(tmp_path / "rig.html"))(replace(report, source="synthetic:seed=1,frames=4"), measurer)
    page = Page((tmp_path / "rig.html").read_text())
    assert [caption.strip() for caption in page.captions][-len(page.sources) // 2 :] == ["left with top", "right with top"]
    for told in ("Rig of synthetic\n", "synthetic:seed=1,frames=4", "cameras: 2, LiDARs: 1", "1 of 3 sensors usable", "<dark>"):
        assert told in page.text, told


RIG = "reference: lidar_left\nsensors:\n  lidar_left: {kind: lidar}\n  front: {kind: camera}\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["synthetic:rig=two_lidars_three_cameras", "--camera", "front"], "--camera is of one pair; name topics in"),
        (["nowhere"], "nowhere does not exist"),
        (["synthetic:rig=two_lidars_three_cameras", "--extrinsic", "missing.json"], "missing.json"),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.yaml").write_text(RIG)
    assert main(["check", *arguments, "--rig", str(tmp_path / "rig.yaml")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


@pytest.mark.slow
@pytest.mark.usefixtures("rendered_once")
def test_the_command_checks_a_rig_with_two_lidars(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.yaml").write_text(RIG + "  lidar_right: {kind: lidar}\n")
    files = tmp_path / "check.json", tmp_path / "check.html"
    source = "synthetic:rig=two_lidars_three_cameras,frames=6,stride=2,ride=weaving,seed=2,width=480"
    given = ["--rig", str(tmp_path / "rig.yaml"), "--json", str(files[0]), "--report", str(files[1])]
    assert main(["check", source, *given]) == 0, capsys.readouterr().out
    data = json.loads(files[0].read_text())
    assert {own["verdict"] for own in data["sensors"].values()} == {"pass"}
    assert all(loop["closes"] for loop in data["loops"])
    assert "data:image/jpeg;base64," in files[1].read_text()


# --- what the page of a rig shows -----------------------------------------------------------------------------------------


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
