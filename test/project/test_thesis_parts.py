"""The table of the thesis's parts names code and tests that are there."""

from __future__ import annotations

import csv
import importlib
import re

import pytest
from paths import ROOT

with (ROOT / "docs" / "figures" / "thesis_parts.csv").open(newline="") as file:
    PARTS = list(csv.DictReader(file))


@pytest.mark.parametrize("part", PARTS, ids=[row["part of the thesis"] for row in PARTS])
def test_code_and_test_of_a_part_exist(part: dict[str, str]) -> None:
    module, _, name = part["code"].partition(":")
    assert callable(getattr(importlib.import_module(module), name))
    path, _, test = part["test"].partition("::")
    assert (ROOT / path).exists()
    assert not test or f"def {test}(" in (ROOT / path).read_text()
    assert part["seen in, result"]


@pytest.mark.parametrize(("prefix", "last"), [("3.", 16), ("4.", 3)])
def test_no_equation_of_the_method_and_its_comparison_is_missing(prefix: str, last: int) -> None:
    names = [part["part of the thesis"] for part in PARTS]
    found = [re.match(rf"eq\. {prefix}(\d+)(?:-{prefix}(\d+))?", name) for name in names]
    named = {k for match in found if match for k in range(int(match[1]), int(match[2] or match[1]) + 1)}
    assert named == set(range(1, last + 1))
    assert {name for name in names if name.startswith("algorithm")} == {f"algorithm {k}" for k in range(1, 7)}
