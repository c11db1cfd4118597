"""`calib-ros calibrate` of a bag of video and compressed clouds."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from compressed_bags import compressed_bag

from calib_ros.cli.main import main


def test_calibration_from_video_and_compressed_clouds_converges(street_bag: Path, tmp_path: Path) -> None:
    pytest.importorskip("av", reason="PyAV is not installed")
    bag, result = compressed_bag(street_bag, tmp_path / "bag"), tmp_path / "result.json"
    search = ["--frames", "0:6", "--initial", "reference", "--search-deg", "2", "--search-m", "0.1"]
    assert main(["calibrate", str(bag), *search, "--json", str(result)]) == 0
    found = json.loads(result.read_text())
    assert found["status"] == "converged"
    assert found["reference_error"]["rotation_deg"] < 0.3
    assert found["reference_error"]["translation_m"] < 0.08
