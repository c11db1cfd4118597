"""One name means one thing: no two public classes of the packages share theirs."""

from __future__ import annotations

import ast
from collections import defaultdict

from paths import ROOT

PACKAGES = [f"calib_ros{suffix}" for suffix in ("", "_thesis", "_semantics", "_check", "_view", "_synthetic", "_evaluation")]


def test_class_names_are_unique() -> None:
    """Of classes at the top of a module; a leading underscore makes a name the module's own."""
    found = defaultdict(list)
    for path in (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert len(found) > 300
    assert {name: places for name, places in found.items() if len(places) > 1} == {}
