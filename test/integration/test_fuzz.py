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


@cases(300, 1500)
def test_mutated_messages(count):
    report = fuzz("messages", count)
    assert total(report, "cloud", "image", "compressed", "camera_info") == count
    assert report["most"][0] < 100, "MiB for a message of at most 200 kB"
    # Mutations that leave nothing to decode, or nothing to refuse, would show nothing.
    for kind in ("cloud", "image", "compressed", "camera_info", "scan in use", "camera in use"):
        assert min(report["outcomes"][f"{kind} {what}"] for what in ("taken", "refused")) > count // 200


@compression
@cases(200, 1500)
def test_mutated_videos_and_compressed_clouds(count):
    report = fuzz("packed", count)
    assert report["most"][0] < 100, "MiB for a message of at most 200 kB"
    for kind in ("video", "compressed_cloud"):
        assert min(report["outcomes"][f"{kind} {what}"] for what in ("taken", "refused")) > count // 10


@cases(80, 300)
def test_mutated_messages_in_the_pipeline(count):
    report = fuzz("pipeline", count)
    assert total(report, "pair") == count
    assert report["outcomes"]["pipeline says"] > count // 6
    assert report["outcomes"]["extrinsics"] > count // 60


@cases(180, 900)
def test_mutated_texts(count):
    report = fuzz("texts", count)
    assert total(report, "config", "result", "state") == count
    assert min(report["outcomes"][f"{kind} taken"] for kind in ("config", "result", "state")) > count // 180


@compression
@cases(200, 600)
def test_mutated_bags_and_folders(count):
    report = fuzz("folders", count)
    kinds = ("bag_mcap", "bag_sqlite3", "bag_ros1", "bag_compressed", "raw", "odometry", "object", "nuscenes")
    kinds += ("plain", "plain_otherwise")
    assert total(report, *kinds) == count
    assert min(report["outcomes"][f"{kind} {what}"] for kind in kinds for what in ("taken", "refused")) >= count // 200


@compression
@cases(30, 150)
def test_mutated_files_through_the_command_line(count):
    report = fuzz("cli", count)
    assert sum(report["outcomes"][f"code {code}"] for code in (0, 1, 2)) == count
    assert min(report["outcomes"][f"code {code}"] for code in (0, 2)) >= count // 15
