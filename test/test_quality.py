"""The rules of the house: linters, types, floors, and a configuration file that matches the code."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "calib_ros"
# Top floor first; a room imports only from floors below, or from its own.
FLOORS = [
    ["ros", "cli", "__main__", "demo", "commands"],
    ["evaluation"],
    ["online"],
    ["overlay", "overlay_bars", "report", "sources", "exports"],
    ["registration"],
    ["semantics"],
    ["lidar", "image", "datasets"],
    ["messages", "result", "frame", "camera", "se3", "config", "files", "classes"],
    ["plain_yaml"],
    ["errors", "__init__"],
]


def floor_of(room: str) -> int:
    for number, rooms in enumerate(FLOORS):
        if room in rooms:
            return number
    raise AssertionError(f"{room} stands on no floor; add it to FLOORS")


def imports_of(path: Path) -> list[tuple[str, bool]]:
    """(module, whether only for type checking) of every import."""
    found: list[tuple[str, bool]] = []

    def walk(node: ast.AST, typing_only: bool) -> None:
        for child in ast.iter_child_nodes(node):
            guarded = typing_only or (isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test))
            if isinstance(child, ast.Import):
                found.extend((alias.name, guarded) for alias in child.names)
            elif isinstance(child, ast.ImportFrom) and child.module:
                names = (
                    [f"{child.module}.{alias.name}" for alias in child.names] if child.module == "calib_ros" else [child.module]
                )
                found.extend((name, guarded) for name in names)
            else:
                walk(child, guarded)

    walk(ast.parse(path.read_text()), False)
    return found


MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.name != "__init__.py" or path.parent != PACKAGE)


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_a_room_imports_only_from_below(path: Path) -> None:
    room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    for module, typing_only in imports_of(path):
        parts = module.split(".")
        if parts[0] in ("rclpy", "calib_ros_msgs", "sensor_msgs", "tf2_msgs"):
            assert room == "ros", f"{path.name} imports {module}: rclpy and messages live in calib_ros/ros only"
        if parts[0] == "calib_ros" and len(parts) > 1 and not parts[1].startswith("__") and not typing_only:
            assert floor_of(parts[1]) >= floor_of(room), f"{path.name} imports {module} from a floor above"


def run(*command: str) -> str:
    done = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True)
    return "" if done.returncode == 0 else done.stdout + done.stderr


def test_ruff() -> None:
    assert run("ruff", "check", "--quiet", ".") == ""
    assert run("ruff", "format", "--check", "--quiet", ".") == ""


def test_mypy() -> None:
    assert run("mypy") == ""


def test_the_parameter_file_is_that_of_the_code() -> None:
    done = subprocess.run([sys.executable, ROOT / "tools/write_config.py", "--check"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_parameter_file_says_the_defaults() -> None:
    from calib_ros.config import Config

    assert Config.from_yaml(ROOT / "config/calib_ros.yaml") == Config()


def test_large_message_profile_is_well_formed() -> None:
    import xml.etree.ElementTree as ET

    tree = ET.parse(ROOT / "config/fastdds_profile.xml")
    names = {element.tag.split("}")[1]: element.text for element in tree.iter()}
    assert int(names["segment_size"]) >= int(names["maxMessageSize"]) > 6_000_000
    assert names["useBuiltinTransports"] == "false"
