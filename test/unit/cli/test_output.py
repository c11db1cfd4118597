"""What the commands have found is lost neither with a closed pipe nor on a full disk."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from calib_ros.cli.output import checked_by, print_or_save
from calib_ros.errors import BadInputError
from calib_ros.result import Result, load


@pytest.fixture
def no_reader(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Standard output whose reader has gone, also of commands that are started."""
    read, write = os.pipe()
    os.close(read)
    with open(write, "w", closefd=False) as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        yield write
    os.close(write)


@pytest.mark.parametrize("path", ["out.json", "-"])
def test_a_result_is_saved_though_nobody_reads_on(path: str, no_reader: int, tmp_path: Path, capfd) -> None:
    where = path if path == "-" else str(tmp_path / path)
    print_or_save(Result(np.eye(4), "converged"), "in words", where)
    assert capfd.readouterr().err == ("in words\n" if path == "-" else "")
    if path != "-":
        assert np.array_equal(load(where).T_camera_lidar, np.eye(4))


@pytest.mark.parametrize(
    ("positions", "count", "others"),
    [(range(4), 8, "4,5,6,7"), (range(0, 8, 2), 8, "1,3,5,7"), (range(0, 40, 10), 40, "2,6,11,14,18,22,26,31,34,38")],
)
def test_what_was_estimated_is_to_be_checked_by_other_frames(positions: range, count: int, others: str) -> None:
    told = checked_by(["calibrate", "drive", "--frames", "some", "--initial", "start.yaml"], "result.json", positions, count)
    assert told == f"judged by other frames: calib-ros check drive --extrinsic result.json --frames {others}"


def test_a_result_that_cannot_be_saved_is_still_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(BadInputError):
        print_or_save(Result(np.eye(4), "converged"), "in words", str(tmp_path))
    assert capsys.readouterr().out == "in words\n"


@pytest.mark.parametrize("command", [["--version"], ["info", "synthetic:frames=2"]])
def test_commands_end_cleanly_when_nobody_reads_on(command: list[str], no_reader: int) -> None:
    started = [sys.executable, "-m", "calib_ros", *command]
    done = subprocess.run(started, stdout=no_reader, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
