"""What packages beside the core bring: services of the node, of which one may lack its libraries."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from calib_ros import extensions


def test_a_service_whose_libraries_are_missing_is_told_and_left_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "needs_a_library.py").write_text("import a_library_that_nobody_has\n")
    monkeypatch.syspath_prepend(tmp_path)
    group = extensions.NODE_SERVICES
    entries = [EntryPoint("absent", "needs_a_library:Server", group), EntryPoint("there", "fractions:Fraction", group)]
    monkeypatch.setattr(extensions, "_entries", lambda group: {entry.name: entry for entry in entries})
    lines: list[str] = []
    assert list(extensions.node_services(lines.append)) == ["there"]
    (line,) = lines
    assert "~/absent" in line
    assert "a_library_that_nobody_has" in line
