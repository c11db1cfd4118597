"""Broken messages and files are refused in one line or used; they never cause a crash, a hang or excessive memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from typing import Any, NamedTuple

import pytest
from paths import ROOT, SUPPORT

RUNNER = SUPPORT / "fuzz_runner.py"
pytestmark = pytest.mark.usefixtures("ros_in_this_process")


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


class Fuzzed(NamedTuple):
    """short, long: cases in `make test`, and instead at length in `make test-all`. kinds: of inputs, one in each case. least:
    outcome -> of so many cases more than one has it: mutations that leave nothing to decode, or nothing to refuse, would show
    nothing. mib: that a case may take at most."""

    short: int
    long: int
    kinds: tuple[str, ...]
    least: dict[str, int]
    mib: float = float("inf")


def both(share: int, *kinds: str) -> dict[str, int]:
    return {f"{kind} {what}": share for kind in kinds for what in ("taken", "refused")}


MESSAGES, PACKED = ("cloud", "image", "compressed", "camera_info"), ("video", "compressed_cloud")
TEXTS = ("config", "result", "state")
FOLDERS = ("bag_mcap", "bag_sqlite3", "bag_ros1", "bag_compressed", "raw", "odometry", "object", "nuscenes", "plain")
FUZZED = {
    "messages": Fuzzed(300, 1500, MESSAGES, both(200, *MESSAGES, "scan in use", "camera in use"), mib=100),  # of at most 200 kB
    "packed": Fuzzed(200, 1500, PACKED, both(10, *PACKED), mib=100),
    "pipeline": Fuzzed(80, 300, ("pair",), {"pipeline says": 6, "extrinsics": 60}),
    "texts": Fuzzed(180, 900, TEXTS, {f"{kind} taken": 180 for kind in TEXTS}),
    "folders": Fuzzed(200, 600, (*FOLDERS, "plain_otherwise"), both(201, *FOLDERS, "plain_otherwise")),
    "cli": Fuzzed(30, 150, ("code",), {"code 0": 16, "code 2": 16}),
}
NEED_CODECS = ("packed", "folders", "cli")
HAS_CODECS = find_spec("av") and find_spec("DracoPy")


@pytest.mark.parametrize("length", [pytest.param("short", marks=pytest.mark.short), pytest.param("long", marks=pytest.mark.slow)])
@pytest.mark.parametrize("what", FUZZED)
def test_mutated_inputs(what: str, length: str) -> None:
    if what in NEED_CODECS and not HAS_CODECS:
        pytest.skip("PyAV or DracoPy is not installed")
    own = FUZZED[what]
    count = getattr(own, length)
    report = fuzz(what, count)
    outcomes = report["outcomes"]
    assert report["most"][0] < own.mib
    assert sum(n for name, n in outcomes.items() if name.rpartition(" ")[0] in own.kinds) == count
    assert {name: outcomes[name] for name, share in own.least.items() if outcomes[name] <= count // share} == {}
