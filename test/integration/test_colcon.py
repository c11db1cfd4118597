"""The repository in a colcon workspace, laid out as the README says."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from catkin_pkg.packages import find_packages
from paths import ROOT


@pytest.fixture
def workspace(tmp_path):
    """The commands of the README, with a link in place of the clone."""
    (link,) = re.findall(r"^ln -s (\S+) \.", (ROOT / "README.md").read_text(), re.MULTILINE)
    source = tmp_path / "src"
    source.mkdir()
    (source / "calib_ros").symlink_to(ROOT)
    (source / Path(link).name).symlink_to(link)
    return tmp_path


def test_rosdep_finds_both_packages(workspace):
    found = {path: package.name for path, package in find_packages(str(workspace / "src")).items()}
    assert found == {"calib_ros": "calib_ros", "calib_ros_msgs": "calib_ros_msgs"}


@pytest.mark.skipif(shutil.which("colcon") is None, reason="colcon is not installed; see requirements-colcon.txt")
def test_plain_colcon_finds_both_packages(workspace):
    done = subprocess.run(["colcon", "list"], cwd=workspace, capture_output=True, text=True)
    assert [line.split("\t") for line in done.stdout.splitlines()] == [
        ["calib_ros", "src/calib_ros", "(ros.ament_python)"],
        ["calib_ros_msgs", "src/calib_ros_msgs", "(ros.ament_cmake)"],
    ], done.stderr
