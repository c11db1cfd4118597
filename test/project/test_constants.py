"""Every number that judges an estimate stands in a table, with what it was derived from."""

from __future__ import annotations

import ast
import csv
from pathlib import Path

from paths import ROOT

JUDGES = (
    *(f"calib_ros/registration/{name}.py" for name in ("judgement/*", "covariance", "search/optimizers")),
    *(
        "calib_ros/registration/score/chance.py",
        "calib_ros/registration/estimate.py",
        "calib_ros_check/*.py",
        "benchmarks/compare.py",
    ),
    *(f"calib_ros/online/{name}.py" for name in ("evidence", "monitor", "glance", "tracker", "pose_filter", "clocks")),
)
SYSTEMATIC_ERROR = ("calib_ros/registration/objective.py", "SYSTEMATIC_ERROR")  # whose other constants judge nothing
OF_PAGES = {"report", "page", "cli", "commands"}
TABLE = ROOT / "docs" / "figures" / "constants.csv"


def is_number(value: ast.expr) -> bool:
    constants = [node.value for node in ast.walk(value) if isinstance(node, ast.Constant)]
    return any(isinstance(c, (int, float)) for c in constants) and not any(isinstance(c, str) for c in constants)


def numbers(path: Path) -> dict[str, str]:
    """Public constants of a module that are numbers -> as written."""
    found = {}
    for node in ast.parse(path.read_text()).body:
        if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None or not is_number(node.value):
            continue
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        pairs = [(target, node.value)]
        if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            pairs = list(zip(target.elts, node.value.elts, strict=True))
        found |= {name.id: ast.unparse(value) for name, value in pairs if isinstance(name, ast.Name)}
    return {name: value for name, value in found.items() if name.isupper() and not name.startswith("_")}


def test_every_constant_of_judgement_is_listed_as_it_is() -> None:
    paths = {path for pattern in JUDGES for path in ROOT.glob(pattern) if path.stem not in OF_PAGES}
    there = {(str(path.relative_to(ROOT)), *item) for path in paths for item in numbers(path).items()}
    there.add((*SYSTEMATIC_ERROR, numbers(ROOT / SYSTEMATIC_ERROR[0])[SYSTEMATIC_ERROR[1]]))
    with TABLE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {(row["module"], row["constant"], row["value"]) for row in rows} == there
    assert len(rows) == len(there) > 100
    assert all(row["basis"] for row in rows)
