"""What is told of a rig, and the files of other tools; rig.yaml, what it means, and one clear line for every mistake."""

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
from calib_ros.result import Result
from calib_ros.rig.description import RigDescription, Sensor, prior_covariance, read_rig
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


# --- rig.yaml -------------------------------------------------------------------------------------------------------------


GOOD = """
reference: top
sensors:
  top: {kind: lidar, topic: /top/points, frame: top}
  front: {kind: camera, topic: /front/image, camera_info: /front/info, frame: front_optical, sigma_deg: 2, sigma_m: 0.1,
          prior: {translation_m: [1, 0, -0.2], quaternion_xyzw: [-0.5, 0.5, -0.5, 0.5]}}
  rear: {kind: camera}
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "rig.yaml"
    path.write_text(text)
    return path


def test_sensors_priors_and_defaults(tmp_path: Path) -> None:
    rig = read_rig(written(tmp_path, GOOD + "pairs: [[top, front]]\n"))
    assert (rig.reference, rig.cameras, rig.lidars) == ("top", ("front", "rear"), ("top",))
    assert rig.pairs == (("front", "top"),)  # the camera first
    front = rig["front"]
    assert (front.topic, front.camera_info, front.frame) == ("/front/image", "/front/info", "front_optical")
    assert (front.sigma_deg, front.sigma_m) == (2.0, 0.1)
    assert front.prior is not None
    np.testing.assert_allclose(front.prior[:3, 2], [1, 0, 0], atol=1e-12)  # looks ahead
    assert (rig["rear"].topic, rig["rear"].prior) == ("", None)


def test_a_result_file_is_a_prior_of_camera_or_lidar(tmp_path: Path) -> None:
    T = se3.exp([0.1, 0.2, 0.3, 1, 2, 3])
    Result(T, "converged").save(tmp_path / "front.json")
    rig = read_rig(written(tmp_path, "reference: top\nsensors: {top: {kind: lidar}, front: {kind: camera, prior: front.json}}"))
    np.testing.assert_allclose(rig["front"].prior, se3.inverse(T), atol=1e-9)
    rig = read_rig(written(tmp_path, "reference: front\nsensors: {top: {kind: lidar, prior: front.json}, front: {kind: camera}}"))
    np.testing.assert_allclose(rig["top"].prior, T, atol=1e-9)
    both = "reference: a\nsensors: {a: {kind: lidar}, b: {kind: lidar, prior: front.json}}"
    with pytest.raises(BadInputError, match="is a result of camera and LiDAR, but the reference is a lidar, too"):
        read_rig(written(tmp_path, both))


def test_the_prior_turns_a_sensor_about_itself() -> None:
    T = se3.from_parts(np.eye(3), [5.0, 0, 0])
    C = prior_covariance(T, 2.0, 0.1)
    J = se3.parts_jacobian(T)
    np.testing.assert_allclose(J @ C @ J.T, np.diag(np.repeat([np.deg2rad(2) ** 2, 0.01], 3)), atol=1e-12)


MISTAKES = {
    "[": "is no valid YAML in line",
    "- a": "must be a mapping such as reference: lidar_top",
    "sensors: {a: {kind: lidar}, b: {kind: camera}}": "reference is missing; name a sensor",
    "reference: a": "sensors is missing; list the sensors by name",
    GOOD + "pair: [[a, b]]": "pair is not known; do you mean pairs?",
    GOOD.replace("reference: top", "reference: tpo"): "reference names 'tpo', which is no sensor here; do you mean top?",
    GOOD.replace("kind: camera}", "knd: camera}"): "sensors.rear.knd is not known; do you mean kind?",
    GOOD + "  front: {kind: camera}": "front is given again in line 8; leave one of them",
    GOOD.replace("kind: camera}", "frame: x}"): "sensors.rear.kind is missing; give camera or lidar",
    GOOD.replace("kind: camera}", "kind: radar}"): "sensors.rear.kind is 'radar'; give camera or lidar",
    GOOD.replace("sigma_deg: 2", "sigma_deg: 0"): "sensors.front.sigma_deg = 0 is no standard deviation; give a number above 0",
    GOOD.replace("sigma_m: 0.1", "sigma_m: 200"): "up to 5",
    GOOD.replace("{kind: camera}", "{kind: camera, topic: 3}"): "sensors.rear.topic must be a text, got 3; quote it",
    GOOD.replace("{kind: camera}", "{kind: camera, topic: /front/image}"): "is /front/image, as of front; give each its own",
    GOOD.replace("{kind: camera}", "{kind: camera, mask: m.png}"): "which is no file; give a path from the folder of rig.yaml",
    GOOD.replace("{kind: camera}", "{kind: camera, prior: x.json}"): "sensors.rear.prior names",
    GOOD.replace("[1, 0, -0.2]", "[1, 0]"): "sensors.front.prior needs translation_m of 3 and quaternion_xyzw of 4 numbers",
    GOOD.replace("[1, 0, -0.2]", "[1000, 0, 0]"): "sensors.front.prior has a translation of 1000, as if in millimetres",
    GOOD.replace("[-0.5, 0.5, -0.5, 0.5]", "[0, 0, 0, 0]"): "is no rotation; give x, y, z, w with a norm of 1",
    GOOD.replace("frame: top}", "frame: top, mask: m.png}"): "sensors.top.mask is of cameras; leave it out",
    GOOD + "pairs: [front, top]": "pairs must be a list such as [[front, lidar_top]]",
    GOOD + "pairs: [[front, rear]]": "pairs[0] is front and rear; pair a camera with a LiDAR, or two LiDARs",
    GOOD + "pairs: [[front, top], [top, front]]": "pairs[1] lists top and front again; leave it out",
    GOOD + "pairs: [[front, tip]]": "pairs[0] names 'tip', which is no sensor here; do you mean top?",
    "reference: a\nsensors: [a, b]": "sensors must be a mapping such as front: {kind: camera, topic: /front/image}",
    "reference: a\nsensors: {a: lidar, b: {kind: camera}}": "sensors.a must be a mapping such as {kind: camera",
    "reference: 3\nsensors: {a: {kind: lidar}, b: {kind: camera}}": "reference names 3, which is no sensor here",
    GOOD.replace("frame: top}", "frame: top, camera_info: /top/info}"): "sensors.top.camera_info is of cameras; leave it out",
    GOOD.replace("frame: top}", "frame: front_optical}"): "is front_optical, as of top; give each its own",
    GOOD.replace("frame: top}", "prior: {translation_m: [1, 0, 0], quaternion_xyzw: [0, 0, 0, 1]}}"): "of the reference itself",
    GOOD.replace("{kind: camera}", "{kind: camera, prior: ''}"): "sensors.rear.prior is empty; give tf, a result file, or",
    GOOD.replace("{kind: camera}", "{kind: camera, prior: 3}"): "sensors.rear.prior must be a mapping such as {translation_m",
    GOOD.replace("[1, 0, -0.2]", "[1, 0, .nan]"): "sensors.front.prior",
    GOOD.replace("sigma_m: 0.1", "sigma_m: far"): "sensors.front.sigma_m = 'far' is no standard deviation",
    GOOD + "pairs: []": "pairs must be a list such as [[front, lidar_top]]; leave it out for all that share a view",
    GOOD + "pairs: [[top, top]]": "pairs[0] is top and top; pair a camera with a LiDAR, or two LiDARs",
    "reference: a\nsensors: {a: {kind: camera}, b: {kind: camera}}": "sensors must hold two or more, one of them of kind: lidar",
}


@pytest.mark.parametrize("text", MISTAKES)
def test_a_mistake_is_told_in_one_line_with_the_remedy(text: str, tmp_path: Path) -> None:
    with pytest.raises(BadInputError) as raised:
        read_rig(written(tmp_path, text))
    assert MISTAKES[text] in str(raised.value)
    assert str(raised.value).startswith(str(tmp_path / "rig.yaml"))
    assert "\n" not in str(raised.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"cannot read rig .*nothing.yaml: No such file"):
        read_rig(tmp_path / "nothing.yaml")
