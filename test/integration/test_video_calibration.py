"""`calib-ros calibrate` of bags of video and compressed clouds."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from compressed_bags import FFMPEG, FOXGLOVE, compressed_bag

from calib_ros.cli.main import main

# Narrow in `make test`; else the search around a nominal start of a user, from each type and codec.
NARROW = ["--search-deg", "2", "--search-m", "0.1"]
KINDS = [(FOXGLOVE, "h264"), (FFMPEG, "hevc_nvenc;yuv420p;bgr8;bgr8"), (FOXGLOVE, "av1"), (FFMPEG, "libvpx-vp9")]


@pytest.mark.parametrize(
    ("kind", "layout", "search"),
    [
        pytest.param(*KINDS[0], NARROW, marks=pytest.mark.short),
        *(pytest.param(*kind, [], marks=pytest.mark.slow) for kind in KINDS),
    ],
)
def test_calibration_from_video_converges(kind: str, layout: str, search: list[str], street_bag: Path, tmp_path: Path) -> None:
    pytest.importorskip("av", reason="PyAV is not installed")
    codec = "h265" if "hevc" in layout else layout.rpartition("-")[2]
    bag, result = compressed_bag(street_bag, tmp_path / "bag", kind, layout, codec), tmp_path / "result.json"
    frames = ["--frames", "0:6"] if search else []
    assert main(["calibrate", str(bag), *frames, *search, "--initial", "reference", "--json", str(result)]) == 0
    found = json.loads(result.read_text())
    assert found["status"] == "converged"
    assert found["reference_error"]["rotation_deg"] < 0.3
    assert found["reference_error"]["translation_m"] < 0.08
