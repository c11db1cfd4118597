"""Broken messages and files are refused in one line or used; they never cause a crash, a hang or excessive memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from typing import Any

import pytest
from paths import ROOT, SUPPORT

RUNNER = SUPPORT / "fuzz_runner.py"
pytestmark = pytest.mark.usefixtures("ros_in_this_process")
compression = pytest.mark.skipif(not (find_spec("av") and find_spec("DracoPy")), reason="PyAV or DracoPy is not installed")


def fuzz(what: str, count: int) -> dict[str, Any]:
    """A run of the fuzzer in its own process: it ends itself where a case hangs, and has 1.5 GiB to work with."""
    command = [sys.executable, "-W", "error", str(RUNNER), what, "0", str(count)]
    environment = {**os.environ, "PYTHONPATH": f"{SUPPORT}{os.pathsep}{ROOT}"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    report: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    assert not report["failures"], "\n".join(report["failures"][:5])
    assert report["grown"] < 150, "MiB that were not given back"
    return report


def total(report: dict[str, Any], *kinds: str) -> int:
    return sum(count for name, count in report["outcomes"].items() if name.rpartition(" ")[0] in kinds)


def cases(short: int, long: int) -> pytest.MarkDecorator:
    """So many cases in `make test`, and instead at length in `make test-all`."""
    return pytest.mark.parametrize(
        "count", [pytest.param(short, marks=pytest.mark.short), pytest.param(long, marks=pytest.mark.slow)]
    )


@compression
@cases(840, 4200)
def test_mutated_messages(count):
    report = fuzz("messages", count)
    decoded = ("cloud", "image", "compressed", "camera_info", "video", "compressed_cloud")
    assert total(report, *decoded) == count
    assert report["most"][0] < 150, f"{report['most']}: more MiB than the 774,000 cells of the range image of 3,200 points take"
    # Mutations that leave nothing to decode, or nothing to refuse, would show nothing.
    for kind in (*decoded, "scan in use"):
        assert min(report["outcomes"][f"{kind} {what}"] for what in ("taken", "refused")) >= count // 210


@compression
@cases(150, 1200)
def test_mutated_files_through_the_command_line(count):
    report = fuzz("commands", count)
    kinds = ("bag_mcap", "bag_sqlite3", "bag_ros1", "bag_compressed", "raw", "odometry", "object", "nuscenes")
    kinds += ("plain", "plain_otherwise")
    codes = {kind: [report["outcomes"].get(f"{kind} code {code}", 0) for code in (0, 1, 2)] for kind in kinds}
    assert sum(map(sum, codes.values())) == count
    assert min(refused for *_, refused in codes.values()) > 0
    assert sum(sum(taken) for *taken, _ in codes.values()) > count // 5
