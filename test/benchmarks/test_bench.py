"""The benchmark of speed prints a figure for each thing that it measures."""

from __future__ import annotations

import sys

import pytest

from benchmarks import bench


def test_figures_are_printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    source = "synthetic:frames=2,width=320,height=160,rings=16"
    monkeypatch.setattr(sys, "argv", ["bench", source, "--only", "classes"])
    assert bench.main() == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("classes of one frame")]
    assert len(lines) == 3
    assert all(float(line[64:].split()[0]) > 0 for line in lines)
