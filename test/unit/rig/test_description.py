"""rig.yaml: what it means, and one clear line for every mistake."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.errors import BadInputError
from calib_ros.result import Result
from calib_ros.rig.description import prior_covariance, read_rig

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
