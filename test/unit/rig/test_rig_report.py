"""What is told of a rig, and the files of other tools."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from graphs import edges, priors, rig

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.errors import BadInputError
from calib_ros.export import xyz_rpy
from calib_ros.rig.description import RigDescription, Sensor
from calib_ros.rig.edges import Measurement
from calib_ros.rig.graph import solve
from calib_ros.rig.report import RigReport, check_out, load

POSES = rig(1, 3)
CAMERA = Camera(np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]]), 640, 480, "plumb_bob", np.array([-0.3, 0.1, 1e-3, 0, 0]))


@pytest.fixture(scope="module")
def report() -> RigReport:
    """c0 and c1 are measured; of c2 there is nothing."""
    rng = np.random.default_rng(0)
    measured = edges(POSES, [("c0", "l0"), ("c1", "l0")], rng)
    out = [Measurement(e.target, e.source, "registration", e) for e in measured]
    out.append(Measurement("c2", "l0", "registration", None, "too dark"))
    sensors = tuple(Sensor(n, "lidar" if n[0] == "l" else "camera", f"/{n}") for n in POSES)
    solution = solve(measured, priors(POSES, rng), "l0")
    frames = {n: f"{n}_link" for n in POSES}
    cameras = dict.fromkeys(("c0", "c1", "c2"), CAMERA)
    return RigReport(RigDescription(sensors, "l0"), solution, out, frames, cameras, POSES, source="a drive")


def test_every_sensor_has_a_status_with_its_reason(report: RigReport) -> None:
    assert [report.status(n)[0] for n in POSES] == ["reference", "converged", "converged", "insufficient"]
    assert report.status("c2")[1] == "no edge joins it to the reference, its pose is the prior; too dark"
    assert not report.converged


def test_what_rests_on_the_prior_is_named_by_axis() -> None:
    rng = np.random.default_rng(1)
    measured = edges(POSES, [("c0", "l0")], rng, np.r_[np.full(3, 1e-3), np.full(3, 10.0)])
    only = {"c0": priors(POSES, rng)["c0"]}
    description = RigDescription((Sensor("l0", "lidar"), Sensor("c0", "camera")), "l0")
    told = RigReport(description, solve(measured, only, "l0"), [], {"l0": "l0", "c0": "c0"}, {}).status("c0")
    assert told[0] == "insufficient"
    assert "its place along x (20 cm)" in told[1]
    assert "rotation" not in told[1]


def test_json_holds_poses_covariances_edges_and_loops(report: RigReport) -> None:
    data = json.loads(report.dumps())
    assert (data["reference"], data["status"]) == ("l0", "refused")
    assert data["covariance_of"] == ["c0", "c1", "c2"]
    assert np.array(data["covariance"]).shape == (18, 18)
    sensor = data["sensors"]["c1"]
    np.testing.assert_allclose(sensor["T_reference_sensor"], report.solution.poses["c1"])
    np.testing.assert_allclose(sensor["covariance"], np.array(data["covariance"])[6:12, 6:12])
    assert sensor["frame"] == "c1_link"
    assert sensor["reference_error"]["rotation_deg"] < 0.3
    assert [e["fate"] for e in data["edges"]] == ["used", "used", "failed"]


def test_a_former_result_tells_what_has_moved(report: RigReport, tmp_path: Path) -> None:
    path = tmp_path / "before.json"
    report.save(str(path))
    before = load(path)
    assert np.array_equal(before.covariance, report.solution.covariance)
    assert replace(report, before=before).changes[1] == "nothing has changed; nothing is known of c2"
    assert replace(report, before=before, measured=[]).changes == ((), "nothing was measured that could be compared")
    knock = se3.exp([0, 0.02, 0, 0.05, 0, 0])
    moved = [m if m.target != "c1" else replace(m, edge=replace(m.edge, T=knock @ m.edge.T)) for m in report.measured if m.edge]
    told = replace(report, measured=moved, before=before)
    assert told.to_dict()["changes"][0]["sensors"] == ["c1"]
    assert "Since the former result: c1 moved by 1.1" in told.text()
    path.write_text('{"sensors": {}}')
    with pytest.raises(BadInputError, match="is no result of calib-ros rig; give the file that --json wrote"):
        load(path)


def test_words_name_every_sensor(report: RigReport) -> None:
    assert all(name in report.text() for name in POSES)
    assert "too dark" in report.text()


def test_a_description_of_a_robot_is_made_and_changed_in_place(report: RigReport, tmp_path: Path) -> None:
    path = tmp_path / "rig.urdf"
    report.write(str(path))
    joints = {j.get("name"): j for j in ElementTree.parse(path).getroot().iter("joint")}
    assert set(joints) == {"l0_link_to_c0_link", "l0_link_to_c1_link", "l0_link_to_c2_link"}
    text = path.read_text()
    # The other way round, as a robot's description may have it, and beside a joint that is none of ours.
    links = '<parent link="{}"/>\n  <child link="{}"/>'
    turned = text.replace(links.format("l0_link", "c1_link"), links.format("c1_link", "l0_link"))
    wheel = '<joint name="wheel" type="fixed"><parent link="a"/><child link="b"/></joint>'
    path.write_text(turned.replace("</robot>", f"{wheel}</robot>"))
    assert report.write(str(path)) == ""
    after = {j.get("name"): j for j in ElementTree.parse(path).getroot().iter("joint")}
    origin = after["l0_link_to_c1_link"].find("origin")
    assert origin is not None
    written = [float(v) for name in ("xyz", "rpy") for v in origin.get(name, "").split()]
    np.testing.assert_allclose(written, xyz_rpy(se3.inverse(report.solution.poses["c1"])))
    assert wheel in path.read_text()
    assert "l0_link_to_c1_link" in (tmp_path / "rig.urdf.former").read_text()
    one = text[: text.index("<joint")] + text[text.index("<joint") : text.index("</joint>")] + "</joint></robot>"
    path.write_text(one)
    assert report.write(str(path)).endswith("has no joint for c1, c2, which are not written; add joints of their frames")


def test_autoware_has_all_sensors_below_the_reference(report: RigReport, tmp_path: Path) -> None:
    report.write(str(tmp_path / "sensor_kit_calibration.yaml"))
    data = yaml.safe_load((tmp_path / "sensor_kit_calibration.yaml").read_text())
    assert set(data["l0_link"]) == {"c0_link", "c1_link", "c2_link"}
    assert data["l0_link"]["c0_link"]["x"] == pytest.approx(report.solution.poses["c0"][0, 3])


def test_of_autowares_file_the_entries_of_sensors_change_and_others_stay(report: RigReport, tmp_path: Path) -> None:
    path, entry = tmp_path / "kit.yaml", "{x: 0, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}"
    text = f"base_link:\n  imu: {entry}  # by hand\nl0_link:\n  c1_link: {entry}\nc0_link:\n  l0_link: {entry}\n"
    path.write_text(text)
    assert report.write(str(path)).endswith("has no entry for c2, which are not written; add entries of their frames")
    data, poses = yaml.safe_load(path.read_text()), report.solution.poses
    assert data["l0_link"]["c1_link"]["x"] == poses["c1"][0, 3]
    assert data["c0_link"]["l0_link"]["x"] == pytest.approx(se3.inverse(poses["c0"])[0, 3])
    assert path.read_text().splitlines()[1] == text.splitlines()[1]
    assert (tmp_path / "kit.yaml.former").read_text() == text


def test_a_solution_has_changed_by_more_than_its_standard_deviation(report: RigReport) -> None:
    solution, sigma = report.solution, np.sqrt(report.solution.marginal("c1")[4, 4])
    for by, changed in ((0.9, False), (1.1, True)):
        poses = {**solution.poses, "c1": se3.exp([0, 0, 0, 0, by * sigma, 0]) @ solution.poses["c1"]}
        assert replace(report, solution=replace(solution, poses=poses)).has_changed(report) == changed
    assert replace(report, frames={**report.frames, "c1": "other"}).has_changed(report)


def test_kalibr_chains_the_cameras(report: RigReport, tmp_path: Path) -> None:
    report.write(str(tmp_path / "camchain.yaml"))
    data = yaml.safe_load((tmp_path / "camchain.yaml").read_text())
    assert list(data) == ["cam0", "cam1", "cam2"]
    assert "T_cn_cnm1" not in data["cam0"]
    np.testing.assert_allclose(data["cam1"]["T_cn_cnm1"], report.solution.between("c1", "c0")[0], atol=1e-12)
    assert data["cam0"]["intrinsics"] == [500, 510, 320, 240]
    assert (data["cam0"]["distortion_model"], data["cam0"]["distortion_coeffs"]) == ("radtan", [-0.3, 0.1, 1e-3, 0])
    assert (data["cam0"]["resolution"], data["cam0"]["rostopic"]) == ([640, 480], "/c0")


def test_another_ending_is_refused() -> None:
    with pytest.raises(BadInputError, match=r"--out rig.txt: the ending tells the format; give one of .urdf"):
        check_out("rig.txt")
