"""`calib-ros calibrate` of bags of video and compressed clouds, and of ROS 1."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from bag_recorder import as_ros1
from compressed_bags import FFMPEG, FOXGLOVE, compressed_bag

from calib_ros.cli.main import main

# Narrow; in `make test-all` once the search around a nominal start of a user, and each type and codec.
NARROW = ["--search-deg", "2", "--search-m", "0.1"]
KINDS = [(FOXGLOVE, "h264"), (FFMPEG, "hevc_nvenc;yuv420p;bgr8;bgr8"), (FOXGLOVE, "av1"), (FFMPEG, "libvpx-vp9")]


@pytest.mark.parametrize(
    ("kind", "layout", "search"),
    [
        pytest.param(*KINDS[0], NARROW, marks=pytest.mark.short),
        pytest.param(*KINDS[0], [], marks=pytest.mark.slow),
        *(pytest.param(*kind, NARROW, marks=pytest.mark.slow) for kind in KINDS[1:]),
    ],
)
def test_calibration_from_video_converges(kind: str, layout: str, search: list[str], street_bag: Path, tmp_path: Path) -> None:
    pytest.importorskip("av", reason="PyAV is not installed")
    codec = "h265" if "hevc" in layout else layout.rpartition("-")[2]
    assert_converges(compressed_bag(street_bag, tmp_path / "bag", kind, layout, codec), tmp_path / "result.json", search)


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
