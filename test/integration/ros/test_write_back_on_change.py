"""export.on_converged over DDS: a converged extrinsic goes into the files of others, and what goes wrong there stops nothing."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import yaml
from vehicle import Vehicle, vehicle_fixture  # noqa: F401  # a fixture

from calib_ros.export import FORMER, has_changed
from calib_ros.result import load
from calib_ros.ros.client import result_from_message

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
URDF = '<robot name="car"><joint name="lidar" type="fixed"><parent link="camera"/><child link="velodyne"/></joint></robot>\n'
KIT = "camera:\n  velodyne: {x: 0.0, y: 0.0, z: 0.0, roll: 0.0, pitch: 0.0, yaw: 0.0}  # by hand\n"


def test_files_are_written_and_again_when_the_extrinsic_has_changed(vehicle: Vehicle, tmp_path: Path) -> None:
    peer = vehicle.peer
    result, urdf, kit = (tmp_path / name for name in ("result.json", "car.urdf", "sensor_kit_calibration.yaml"))
    urdf.write_text(URDF)
    kit.write_text(KIT)
    peer.change(export__on_converged=[str(path) for path in (result, urdf, kit)], export__joint="lidar")
    peer.until(lambda: Path(f"{kit}{FORMER}").exists() and kit.read_text() != KIT, "the files")
    T = result_from_message(peer.get_extrinsic().extrinsic).T_camera_lidar
    np.testing.assert_allclose(load(result).T_camera_lidar, T, atol=1e-9)
    xyz = ET.parse(urdf).getroot().find("joint/origin").get("xyz")
    np.testing.assert_allclose([float(v) for v in xyz.split()], T[:3, 3], atol=1e-9)
    entry = yaml.safe_load(kit.read_text())["camera"]["velodyne"]
    np.testing.assert_allclose([entry[k] for k in "xyz"], T[:3, 3], atol=1e-9)
    assert kit.read_text().endswith("}  # by hand\n")
    assert (Path(f"{urdf}{FORMER}").read_text(), Path(f"{kit}{FORMER}").read_text()) == (URDF, KIT)

    vehicle.assert_recovers()  # another estimate
    peer.calibration.files.submit(int).result()  # files are written one after the other
    assert not has_changed(peer.recalibrator.current.result, load(result))


def test_what_cannot_be_written_is_one_line_and_the_node_goes_on(vehicle: Vehicle, tmp_path: Path) -> None:
    peer, urdf, result = vehicle.peer, tmp_path / "car.urdf", tmp_path / "result.json"
    urdf.write_text(URDF)
    assert "export.joint must name" in peer.set(export__on_converged=[str(urdf)], export__joint="")
    assert "the kind of 'car.txt' is none of .json" in peer.set(export__on_converged=["car.txt"])
    peer.change(export__on_converged=[str(urdf), str(result)], export__joint="radar")
    peer.until(result.exists, "the file that can be written")
    peer.until(lambda: "has no joints named 'radar'; set export.joint to one of: lidar" in peer.last_error(), "the reason")
    assert urdf.read_text() == URDF
    vehicle.assert_recovers()
    peer.change(export__joint="lidar")
    peer.until(lambda: urdf.read_text() != URDF, "the right joint")
    peer.change(export__on_converged=[])
