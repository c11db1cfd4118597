"""From a recording to the graph: the halves of a synthetic drive's pictures as two cameras around its LiDAR."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import QUICK, RenderedDrive
from two_halves import HALVES, TwoHalves

from calib_ros import se3
from calib_ros.cli.main import main
from calib_ros.config import MotionConfig
from calib_ros.errors import BadInputError
from calib_ros.registration.features import FeatureExtractor, ScanEdges, ScanKey
from calib_ros.result import CONVERGED, Result
from calib_ros.rig.description import RigDescription, Sensor
from calib_ros.rig.edges import Measurement, RigMeasurer, box_of, in_step, priors_of, seen_share
from calib_ros.rig.graph import Edge
from calib_ros.rig.report import RigReport


@pytest.fixture(scope="module")
def halves(drive: RenderedDrive) -> TwoHalves:
    return TwoHalves(drive)


@pytest.fixture
def description(halves: TwoHalves) -> RigDescription:
    """Cameras are believed 1 deg and several cm from where they are, each in another direction."""
    off = {"left": ([0.6, -0.5, 0.6], [0.06, -0.05, 0.06]), "right": ([-0.6, 0.5, 0.3], [-0.05, 0.05, 0.03])}
    priors = {n: se3.inverse(se3.perturb(se3.inverse(halves.reference(n)), *by)) for n, by in off.items()}  # type: ignore[arg-type]
    cameras = [Sensor(n, "camera", prior=T, sigma_deg=0.7, sigma_m=0.05) for n, T in priors.items()]
    return RigDescription((Sensor("top", "lidar"), *cameras), "top")


def test_two_cameras_are_found_around_their_lidar(halves: TwoHalves, description: RigDescription) -> None:
    measurer = RigMeasurer(halves, description, QUICK)
    measured = measurer.measure()
    report = RigReport.of(measurer, measured)
    assert [(m.target, m.source, m.kind) for m in measured] == [("left", "top", "registration"), ("right", "top", "registration")]
    assert report.converged, report.text()
    for name in ("left", "right"):
        deg, m = se3.error(report.truth[name], report.solution.poses[name])
        assert deg < 0.2, name
        assert m < 0.04, name
    # The baseline of two cameras that are one.
    T, C = report.solution.between("left", "right")
    xi = se3.log(T)
    assert xi @ np.linalg.solve(C, xi) < 22.5
    assert len(measurer.shared["top"]) == len(halves.scans("top"))


def test_a_scan_is_searched_once_for_all_cameras(halves: TwoHalves, monkeypatch: pytest.MonkeyPatch) -> None:
    shared: ScanEdges = {}
    frames = [halves.pair(name, "top")[0] for name in HALVES]
    alone = [FeatureExtractor(frame.camera, QUICK)(frame) for frame in frames]
    together = [FeatureExtractor(frames[0].camera, QUICK, shared)(frames[0])]
    monkeypatch.setattr("calib_ros.registration.features.range_image", None)  # a second search fails
    together.append(FeatureExtractor(frames[1].camera, QUICK, shared)(frames[1]))
    for one, other in zip(alone, together, strict=True):
        assert np.array_equal(one.points.xyz, other.points.xyz)
        assert all(np.array_equal(a.maps, b.maps) for a, b in zip(one.levels, other.levels, strict=True))


def test_scans_of_a_driver_that_does_not_stamp_are_told_apart(halves: TwoHalves) -> None:
    pair, shared = halves.pair("left", "top"), dict[ScanKey, Any]()
    frames = [replace(pair[k], stamp=0, cloud_stamp=0) for k in range(2)]
    found = [FeatureExtractor(frames[0].camera, QUICK, shared)(frame).points.xyz for frame in frames]
    assert not np.array_equal(*found)
    assert len(shared) == 2


def test_what_fails_is_told_and_the_rest_is_solved(halves: TwoHalves, description: RigDescription) -> None:
    away = Sensor("right", "camera", prior=halves.reference("right") @ se3.exp([0, np.pi, 0, 0, 0, 0]), sigma_deg=0.7)
    measurer = RigMeasurer(halves, replace(description, sensors=(*description.sensors[:2], away)), QUICK, "0:3")
    points = measurer.scans["top"].still(0)[0]
    assert seen_share(halves.camera("left"), se3.inverse(halves.reference("left")), points) > 0.3  # type: ignore[arg-type]
    assert measurer.camera_pairs(measurer.solution([])) == [("left", "top"), ("right", "top")]  # a full turn is seen by all
    measured = measurer.measure()
    assert [m.edge is not None for m in measured if m.target == "left"] == [True]
    assert all(m.edge is None and m.reason for m in measured if m.target == "right")
    report = RigReport.of(measurer, measured)
    assert report.status("left")[0] == "converged", report.text()
    assert report.status("right")[0] == "insufficient"


@pytest.mark.parametrize(("passed", "seen"), [((1, 2), True), ((0, 1, 2, 3), False)])
def test_a_pair_shares_a_view_although_some_scans_pass_a_gap(
    halves: TwoHalves, description: RigDescription, passed: tuple[int, ...], seen: bool
) -> None:
    measurer = RigMeasurer(halves, description, QUICK)
    own = measurer.scans["top"]
    glimpses = [np.zeros((0, 3)) if k in passed else points for k, points in enumerate(own.glimpses)]
    assert len(glimpses) == 5
    own.glimpses = glimpses
    assert measurer.camera_pairs(measurer.solution([])) == [("left", "top"), ("right", "top")] * seen


def test_clocks_and_lens_of_a_sensor_are_the_same_for_all_its_pairs() -> None:
    """A camera whose clock is 4 ms off, which one pair has found and the other one has not, 5 m/s ahead; its lens is off by one
    unit, which turns either extrinsic, one of them by half as much again. Its LiDARs' clocks are 1 ms apart."""
    forward, alone, motion = np.eye(6)[5] * 5, np.eye(6) * 1e-6, MotionConfig()
    truth = {lidar: se3.exp([0.1, 0.2, 0.3, k, 0, 1]) for k, lidar in enumerate("ab")}
    shared, measured = 0.01**2 * np.outer(forward, forward), []
    for lidar, late_s, used, turn in (("a", 0.004, True, 1.0), ("b", 0.003, False, 1.5)):
        lens = np.eye(6)[:, :1] * turn, np.array([[0.005**2]])
        at = late_s if used else 0.0
        T = se3.exp(forward * (at - late_s) + lens[0][:, 0] * 0.005) @ truth[lidar]
        C = alone + shared
        whole = C + lens[0] @ lens[1] @ lens[0].T
        clocks = {"clock_direction": forward, "clock_sigma_s": 1e-3, "clock_offset_s": late_s, "time_offset_s": at}
        r = Result(
            T, CONVERGED, covariance=C, covariance_with_intrinsics=whole, shared_covariance=shared, lens_effect=lens, **clocks
        )
        measured.append(Measurement("c", lidar, "registration", Edge("c", lidar, T, whole, "registration", at, 1e-3), "", r))
    measured.append(Measurement("a", "b", "scans", Edge("a", "b", np.eye(4), alone, "scans", -0.001, 1e-5)))
    a, b, scans = in_step(measured, motion)
    assert scans.edge is measured[2].edge
    assert a.edge is not None
    assert b.edge is not None
    assert a.edge.time_offset_s == pytest.approx(0.004, abs=2e-5)
    assert b.edge.time_offset_s == pytest.approx(0.003, abs=2e-5)
    assert a.edge.time_sigma_s == pytest.approx(1e-3 / np.sqrt(2), rel=0.02)
    # What is left is the lens, alike but for half of it, by which b may be off.
    for edge, turn in ((a.edge, 1.0), (b.edge, 1.5)):
        np.testing.assert_allclose(se3.log(edge.T @ se3.inverse(truth[edge.source])), np.eye(6)[0] * turn * 0.005, atol=1e-4)
    np.testing.assert_allclose(a.edge.covariance[:5, :5], alone[:5, :5], atol=1e-12)
    assert b.edge.covariance[0, 0] == pytest.approx(1e-6 + 0.0025**2)


def test_the_search_follows_the_prior() -> None:
    box = box_of(np.diag(np.r_[np.deg2rad([1.0, 2, 0.01]), 0.1, 0.2, 0.001] ** 2))
    np.testing.assert_allclose(box.rotation_deg, [2, 4, 0.5])
    np.testing.assert_allclose(box.translation_m, [0.2, 0.4, 0.05])


def test_a_sensor_without_a_prior_is_named(halves: TwoHalves, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(halves, "reference", lambda name: None)
    description = RigDescription((Sensor("top", "lidar"), Sensor("left", "camera")), "top")
    with pytest.raises(BadInputError, match=r"two halves does not state where left is; set sensors.left.prior"):
        priors_of(description, halves)


@pytest.mark.slow
@pytest.mark.usefixtures("rendered_once")
def test_the_command_estimates_a_rig_with_two_lidars(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sensors = "lidar_left: {kind: lidar}, front: {kind: camera}, lidar_right: {kind: lidar}"
    (tmp_path / "rig.yaml").write_text(f"reference: lidar_left\nsensors: {{{sensors}}}\n")
    out = {k: str(tmp_path / v) for k, v in {"--json": "rig.json", "--report": "rig.html", "--out": "rig.urdf"}.items()}
    source = "synthetic:rig=two_lidars_three_cameras,frames=6,stride=2,ride=weaving,seed=2,width=480"
    code = main(["rig", source, "--rig", str(tmp_path / "rig.yaml"), *(text for pair in out.items() for text in pair)])
    data = json.loads(Path(out["--json"]).read_text())
    assert {name for name, s in data["sensors"].items() if s["status"] == "converged"} >= {"front", "lidar_right"}, data
    assert code == (0 if data["status"] == "converged" else 1)
    assert all(loop["closes"] for loop in data["loops"])
    assert len(data["loops"]) == 1
    for name in ("front", "lidar_right"):
        assert data["sensors"][name]["reference_error"]["rotation_deg"] < 0.15
    assert "lidar_right" in capsys.readouterr().out
    page = Path(out["--report"]).read_text()
    assert (page.count("<svg"), page.count("data:image/jpeg;base64,")) == (2, 2)  # before and after
    assert "lidar_left_to_front_optical" in Path(out["--out"]).read_text()
