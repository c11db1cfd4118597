"""The rules of the house: linters, types, floors, and a configuration file that matches the code."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from paths import ROOT

PACKAGE, EVALUATION = ROOT / "calib_ros", ROOT / "calib_ros_evaluation"
# Top floor first; a room imports only from floors below, or from its own.
FLOORS = [
    ["__init__", "__main__"],
    ["cli"],
    ["web"],
    ["ros"],
    ["view"],
    ["online", "check"],
    ["class_pictures"],
    ["overlay", "export"],
    ["thesis"],
    ["registration"],
    ["semantics"],
    ["image", "datasets"],
    ["lidar"],
    ["messages", "jobs"],
    ["result", "frame", "camera", "config", "stamps"],
    ["se3", "io", "page", "runtime"],
    ["errors"],
]
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}


def imports_of(path: Path) -> list[str]:
    """Modules that are imported, but for those imported for type checking only."""
    found: list[str] = []

    def walk(node: ast.AST) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test):
                continue
            if isinstance(child, ast.Import):
                found.extend(alias.name for alias in child.names)
            elif isinstance(child, ast.ImportFrom) and child.module:
                names = [f"{child.module}.{alias.name}" for alias in child.names]
                found.extend(names if child.module == "calib_ros" else [child.module])
            else:
                walk(child)

    walk(ast.parse(path.read_text()))
    return found


def test_rooms_import_only_from_floors_below() -> None:
    wrong = []
    for path in PACKAGE.rglob("*.py"):
        room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        for module in imports_of(path):
            top, _, rest = module.partition(".")
            other = rest.split(".")[0]
            if top in ("rclpy", "calib_ros_msgs", "sensor_msgs", "tf2_msgs") and room != "ros":
                wrong.append(f"{path.relative_to(ROOT)} imports {module}: rclpy and messages live in calib_ros/ros only")
            if top == "calib_ros" and rest and not other.startswith("__") and FLOOR[other] < FLOOR[room]:
                wrong.append(f"{path.relative_to(ROOT)} imports {module} from a floor above")
    assert not wrong, "\n".join(wrong)


def test_the_product_imports_neither_the_evaluation_nor_benchmarks() -> None:
    laboratory = ("calib_ros_evaluation", "benchmarks", "training", "tools")
    wrong = [
        f"{path.relative_to(ROOT)} imports {module}"
        for path in PACKAGE.rglob("*.py")
        for module in imports_of(path)
        if module.split(".")[0] in laboratory
    ]
    assert not wrong, "\n".join(wrong)


def run(*command: str) -> str:
    done = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True)
    return "" if done.returncode == 0 else done.stdout + done.stderr


def test_ruff() -> None:
    assert run("ruff", "check", "--quiet", ".") == ""
    assert run("ruff", "format", "--check", "--quiet", ".") == ""


@pytest.mark.slow
def test_mypy() -> None:
    assert run("mypy") == ""


def test_the_parameter_file_is_that_of_the_code() -> None:
    done = subprocess.run([sys.executable, ROOT / "tools/write_config.py", "--check"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_parameter_file_says_the_defaults() -> None:
    from calib_ros.config import Config

    assert Config.from_yaml(ROOT / "config/calib_ros.yaml") == Config()


@pytest.mark.parametrize(("name", "largest"), [("fastdds_profile.xml", 6_000_000), ("fastdds_profile_large.xml", 25_000_000)])
def test_large_message_profiles_are_well_formed(name: str, largest: int) -> None:
    import xml.etree.ElementTree as ET

    tree = ET.parse(ROOT / "config" / name)
    names = {element.tag.split("}")[1]: element.text for element in tree.iter()}
    assert int(names["segment_size"]) >= int(names["maxMessageSize"]) > 2 * largest
    assert names["useBuiltinTransports"] == "false"
