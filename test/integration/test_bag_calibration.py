"""`calib-ros calibrate` of bags of video and compressed clouds, and of ROS 1."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from bag_recorder import as_ros1
from compressed_bags import FOXGLOVE, compressed_bag

from calib_ros.cli.main import main

NARROW = ["--search-deg", "2", "--search-m", "0.1"]


# Narrow; in `make test-all` once the search around a nominal start of a user.
@pytest.mark.parametrize("search", [pytest.param(NARROW, marks=pytest.mark.short), pytest.param([], marks=pytest.mark.slow)])
def test_calibration_from_video_converges(search: list[str], street_bag: Path, tmp_path: Path) -> None:
    pytest.importorskip("av", reason="PyAV is not installed")
    assert_converges(compressed_bag(street_bag, tmp_path / "bag", FOXGLOVE, "h264", "h264"), tmp_path / "result.json", search)


def test_calibration_from_a_bag_of_ros_1_converges(street_bag: Path, tmp_path: Path) -> None:
    as_ros1(street_bag, tmp_path / "street.bag")
    assert_converges(tmp_path / "street.bag", tmp_path / "result.json", NARROW)


def assert_converges(bag: Path, result: Path, search: list[str]) -> None:
    frames = ["--frames", "0:6"] if search else []
    assert main(["calibrate", str(bag), *frames, *search, "--initial", "reference", "--json", str(result)]) == 0
    found = json.loads(result.read_text())
    assert found["status"] == "converged"
    assert found["reference_error"]["rotation_deg"] < 0.3
    assert found["reference_error"]["translation_m"] < 0.08
