"""The core without the packages beside it: no thesis, semantics, check, view, synthetic."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest
from ros_processes import REMAP, Observer, initial, play

from calib_ros import se3

pytestmark = pytest.mark.ros
WITHOUT = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"calib_ros_" + n for n in ("thesis", "semantics", "check", "view", "synthetic")}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
"""
NODE = WITHOUT + "from calib_ros.ros.process import calib_node\nsys.exit(calib_node())"


def test_the_node_calibrates_without_the_packages_beside_it(street_bag, drive):
    start = se3.perturb(drive.reference, [1.0, -1.5, 0.5], [0.05, 0.08, -0.05])
    quick = ["search.rounds:=1", "search.starts:=64", "online.min_keyframes:=4", "tracker.confirmations:=0"]
    parameters = [*initial(start), *quick, "overlay_period_s:=0.0", "max_data_age_s:=300.0"]
    command = [sys.executable, "-c", NODE, "--ros-args", *REMAP, *(word for p in parameters for word in ("-p", p))]
    node = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        with Observer() as client:
            client.get_extrinsic()
            player = play(street_bag, "--rate", "4", "--follow", "/calib_ros", "--loop")
            client.until(lambda: client.get_extrinsic()[2].converged, "an estimate")
            found = client.get_extrinsic()[2]
            player.send_signal(signal.SIGINT)
            player.communicate(timeout=120)
            services = dict(client._node.get_service_names_and_types())
        node.send_signal(signal.SIGINT)
        text, _ = node.communicate(timeout=120)
    finally:
        node.kill()
    assert node.returncode == 0, text
    assert "Traceback" not in text
    assert se3.rotation_error_deg(drive.reference, found.T_camera_lidar) < 0.3
    assert se3.translation_error_m(drive.reference, found.T_camera_lidar) < 0.08
    assert "/calib_ros/get_extrinsic" in services
    assert "/calib_ros/check" not in services


@pytest.mark.parametrize(
    ("arguments", "code"), [(["--help"], 0), (["info", "synthetic"], 2), (["calibrate", "x", "--objective", "thesis"], 2)]
)
def test_the_command_line_does_without_what_the_packages_bring(arguments, code):
    program = WITHOUT + f"from calib_ros.cli.main import main\nsys.exit(main({arguments!r}))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert "evaluate" in done.stdout or code == 2
    assert " demo" not in done.stdout
