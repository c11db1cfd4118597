"""The extrinsic goes back into the files that others read: they read it there by their own rules, and find all else as it was."""

from __future__ import annotations

import difflib
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.cli.main import main
from calib_ros.errors import BadInputError
from calib_ros.export import FORMER, has_changed, write_back
from calib_ros.registration.initial_guess import nominal
from calib_ros.result import CONVERGED, Result, load

T = se3.perturb(nominal(), [1.0, -2.0, 0.5], [0.27, -0.08, -1.125])
RESULT = Result(T, CONVERGED, camera_frame="camera_optical", lidar_frame="velo", covariance=np.diag([1e-6] * 3 + [1e-4] * 3))
URDF = b"""\xef\xbb\xbf<?xml version="1.0"?>\r
<robot name="car" xmlns:xacro="http://ros.org/wiki/xacro">
  <!-- <joint name="camera" type="fixed"><origin xyz="9 9 9"/></joint> -->
  <xacro:property name="h" value="1.7"/>
  <joint name="roof" type="fixed"><parent link="base"/><child link="velo"/><origin xyz="0 0 ${h}"/></joint>
  <joint name='camera' type="fixed">
    <origin note="a > b" rpy='0 0
      0' xyz = "1 2  3" />  <!-- by hand -->
    <parent link='velo'/>
    <child link="camera_optical" />
  </joint>
  <transmission name="t"><joint name="camera"><hardwareInterface/></joint></transmission>
</robot>
"""
KIT = """# Autoware
sensor_kit_base_link:
  camera0/camera_link:   # front
    {x: 0.1, y: 0.5, z: -0.3, roll: -0.025, pitch: 0.315, yaw: 1.035}
  velo: &roof
    yaw: 1.575   # turned
    x: 0.0
    y: 0.0
    z: 0.0
    roll: 0.0
    pitch: 0.0
"""


def pose(xyz: str | list[float], rpy: str | list[float]) -> np.ndarray:
    """By the rule of URDF."""
    numbers = [[float(v) for v in (part.split() if isinstance(part, str) else part)] for part in (xyz, rpy)]
    return se3.from_parts(Rotation.from_euler("xyz", numbers[1]).as_matrix(), numbers[0])


def joint(path: Path, name: str) -> np.ndarray:
    (found,) = (j for j in ET.parse(path).getroot().findall("joint") if j.get("name") == name)
    origin = found.find("origin")
    return pose(origin.get("xyz"), origin.get("rpy"))


def entry(path: Path, parent: str, child: str) -> np.ndarray:
    values = yaml.safe_load(path.read_text())[parent][child]
    return pose([values[k] for k in "xyz"], [values[k] for k in ("roll", "pitch", "yaw")])


def kept(before: bytes, after: bytes) -> bytes:
    """What of a file has stayed, but for numbers."""
    blocks = difflib.SequenceMatcher(None, before, after, autojunk=False).get_matching_blocks()
    return b"".join(before[b.a : b.a + b.size] for b in blocks).translate(None, b"0123456789.-e")


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    path = tmp_path / "car.urdf.xacro"
    path.write_bytes(URDF)
    return path


@pytest.fixture
def kit(tmp_path: Path) -> Path:
    path = tmp_path / "sensor_kit_calibration.yaml"
    path.write_text(KIT)
    return path


def test_the_joint_of_a_description_changes_and_nothing_else(urdf: Path) -> None:
    write_back(str(urdf), RESULT, {}, "camera")
    np.testing.assert_allclose(joint(urdf, "camera"), se3.inverse(T), atol=1e-12)
    after = urdf.read_bytes()
    begin, end = URDF.index(b"rpy='"), URDF.index(b" />  <!-- by hand")
    assert after.startswith(URDF[:begin])
    assert after.endswith(URDF[end:])
    assert Path(f"{urdf}{FORMER}").read_bytes() == URDF

    Path(f"{urdf}{FORMER}").write_text("older")
    write_back(str(urdf), RESULT, {}, "camera")
    assert Path(f"{urdf}{FORMER}").read_text() == "older"  # the same again changes nothing
    write_back(str(urdf), replace(RESULT, T_camera_lidar=nominal()), {}, "camera")
    assert Path(f"{urdf}{FORMER}").read_bytes() == after  # only the last one is kept


def test_export_changes_the_joint_of_a_file_that_exists(urdf: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    RESULT.save(tmp_path / "result.json")
    command = ["export", str(tmp_path / "result.json"), "--format", "urdf", "--out", str(urdf)]
    assert main(command) == 0
    np.testing.assert_allclose(joint(urdf, "camera"), se3.inverse(T), atol=1e-12)
    assert Path(f"{urdf}{FORMER}").read_bytes() == URDF
    after = urdf.read_bytes()
    assert main([*command, "--camera-frame", "other"]) == 2
    assert "has no joint between the sensors" in capsys.readouterr().err
    assert urdf.read_bytes() == after


@pytest.mark.parametrize("origin", [b"", b'<origin rpy="0 0 0"/>', b"<origin/>", b"<origin></origin>"])
def test_an_origin_or_its_attributes_may_be_missing(urdf: Path, origin: bytes) -> None:
    before = URDF[: URDF.index(b"<origin note")] + origin + URDF[URDF.index(b"  <!-- by hand") :]
    urdf.write_bytes(before)
    write_back(str(urdf), RESULT, {}, "camera")
    np.testing.assert_allclose(joint(urdf, "camera"), se3.inverse(T), atol=1e-12)
    assert kept(before, urdf.read_bytes()) == before.translate(None, b"0123456789.-e")


def test_a_joint_between_other_frames_gets_what_the_tree_says(urdf: Path) -> None:
    """The mount of the LiDAR, by the edges that a tree of frames has between the sensors."""
    T_base_velo = pose("0.1 0.2 1.7", "0 0.1 0")
    write_back(str(urdf), RESULT, {("base", "velo"): T_base_velo}, "roof")
    np.testing.assert_allclose(joint(urdf, "roof"), T_base_velo, atol=1e-12)


def test_the_entry_of_a_sensor_kit_changes_and_nothing_else(kit: Path) -> None:
    edges = {("camera0/camera_link", "camera_optical"): np.eye(4), ("sensor_kit_base_link", "velo"): T}
    write_back(str(kit), RESULT, edges, "")
    np.testing.assert_allclose(entry(kit, "sensor_kit_base_link", "velo"), T, atol=1e-12)
    after = kit.read_bytes()
    assert after.startswith(KIT[: KIT.index("1.575")].encode())
    assert b"   # turned\n" in after
    assert kept(KIT.encode(), after) == KIT.encode().translate(None, b"0123456789.-e")
    assert Path(f"{kit}{FORMER}").read_text() == KIT


def test_results_and_missing_files_are_written_as_a_whole(tmp_path: Path) -> None:
    for name in ("new/result.json", "sensor_kit_calibration.yaml"):
        write_back(str(tmp_path / name), RESULT, {}, "")
        assert not (tmp_path / f"{name}{FORMER}").exists()
    np.testing.assert_allclose(load(tmp_path / "new/result.json").T_camera_lidar, T, atol=1e-12)
    np.testing.assert_allclose(entry(tmp_path / "sensor_kit_calibration.yaml", "camera_optical", "velo"), T, atol=1e-12)
    write_back(str(tmp_path / "sensor_kit_calibration.yaml"), replace(RESULT, T_camera_lidar=nominal()), {}, "")
    np.testing.assert_allclose(entry(tmp_path / "sensor_kit_calibration.yaml", "camera_optical", "velo"), nominal(), atol=1e-12)


def test_what_cannot_be_written_is_said_in_a_line_and_stays(urdf: Path, kit: Path, tmp_path: Path) -> None:
    (tmp_path / "folder.json").mkdir()
    twice = tmp_path / "twice.urdf"
    twice.write_bytes(URDF.replace(b'"roof"', b'"camera"'))
    wide, broken, alias, bare = (tmp_path / name for name in ("wide.urdf", "broken.urdf", "alias.yaml", "bare.yaml"))
    wide.write_bytes(URDF[3:].decode().replace("?>", ' encoding="utf-16"?>').encode("utf-16"))
    broken.write_bytes(URDF[:-10])
    alias.write_text("camera_optical: &a {velo: *a}")
    bare.write_text("camera_optical: {velo: {x: 0, y: 0, z: [1]}}")
    for path, joint_name, says in (
        (urdf, "kamera", "no joints named 'kamera'; set export.joint to one of: camera, roof"),
        (urdf, "roof", "connects 'base' and 'velo'; name one of camera_optical -> velo, velo -> camera_optical"),
        (twice, "camera", "has 2 joints named"),
        (wide, "camera", "not in UTF-8"),
        (broken, "camera", "is no valid XML"),
        (tmp_path / "none.urdf", "camera", "does not exist"),
        (tmp_path / "folder.json", "", "cannot read"),
        (kit, "", "has no entry of the extrinsic"),
        (alias, "", "is no valid YAML"),
        (bare, "", "must hold x, y, z, roll, pitch, yaw"),
    ):
        before = path.read_bytes() if path.is_file() else None
        with pytest.raises(BadInputError, match=says) as error:
            write_back(str(path), RESULT, {}, joint_name)
        assert "\n" not in str(error.value)
        assert (path.read_bytes() if path.is_file() else None) == before
        assert not Path(f"{path}{FORMER}").exists()


def test_more_than_a_standard_deviation_is_a_change() -> None:
    for turn, shift, changed in (
        ([0, 0, 0], 0, False),
        ([0, 0.05, 0], 0.009, False),
        ([0, 0.06, 0], 0, True),
        ([0, 0, 0], 0.011, True),
    ):
        assert has_changed(replace(RESULT, T_camera_lidar=se3.perturb(T, turn, [0, 0, shift])), RESULT) is changed
    assert has_changed(replace(RESULT, lidar_frame="other"), RESULT)
    assert has_changed(replace(RESULT, covariance=None), RESULT)
