"""The benchmark of speed saves its figures and sets them beside those of another run."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from benchmarks import bench


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(bench, "FIGURES", bench.Figures())
    monkeypatch.setattr(
        sys, "argv", ["bench", "synthetic:frames=2,width=320,height=160,rings=16", "--only", "classes", *arguments]
    )
    return bench.main()


def test_figures_are_compared_with_those_of_another_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    saved = tmp_path / "bench.json"
    assert run(monkeypatch, "--json", str(saved)) == 0
    assert "ratio" not in capsys.readouterr().out
    figures = json.loads(saved.read_text())
    assert figures[bench.YARDSTICK] > 0
    label = "classes of one frame, all points"
    # Another machine, on which everything takes ten times as long, and the classes a hundred times.
    saved.write_text(json.dumps({name: ms * (100 if name == label else 10) for name, ms in figures.items()}))
    assert run(monkeypatch, "--compare", str(saved)) == 0
    lines = {line.split("  ")[0]: line for line in capsys.readouterr().out.splitlines()}
    ratio = float(lines[label].partition("ratio")[2].split()[0])
    assert 0.01 < ratio < 0.4
    assert f"before {figures[label] * 100:9.3f}" in lines[label]


@pytest.mark.parametrize("text", [None, "[1, 2]", "no json", '{"yardstick": "fast"}'])
def test_figures_that_cannot_be_read_are_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], text: str | None
) -> None:
    saved = tmp_path / "bench.json"
    if text is not None:
        saved.write_text(text)
    assert run(monkeypatch, "--compare", str(saved)) == 2
    assert "save some with --json" in capsys.readouterr().err
