"""The rules of the house: linters, types, floors, and a configuration file that matches the code."""

from __future__ import annotations

import ast
import pkgutil
import re
import subprocess
import sys
from collections import defaultdict

import pytest
from paths import ROOT, module_at

from calib_ros import extensions

structure = module_at(ROOT / "tools/structure.py")
GROUPS = {value for name, value in vars(extensions).items() if name.isupper()}  # of entry points
ROS_MODULES = ("rclpy", "calib_ros_msgs", "sensor_msgs", "tf2_msgs")
ROS_ROOMS = ("calib_ros.ros", "calib_ros_check.node", "calib_ros_view.node", "calib_ros_synthetic.demo")


@pytest.fixture(scope="module")
def imports() -> list[tuple[str, str, str]]:
    """File, own module and imported module of every import of the product, but for type hints."""
    return [
        (str(path.relative_to(ROOT)), structure.module_of(path), module)
        for package in structure.PACKAGES
        for path in structure.package_files(package)
        for module in structure.imports_of(path, hints=False)
    ]


def test_the_core_imports_no_package_beside_it(imports) -> None:
    core = [(path, module) for path, own, module in imports if own.split(".")[0] == structure.CORE]
    assert [(path, module) for path, module in core if module.split(".")[0] in structure.BESIDE] == []


def test_no_count_of_the_repository_is_above_its_ceiling() -> None:
    """Lines, options, words, classes; and circles, of files or rooms that import each other, type hints included."""
    found = structure.counts()
    assert structure.above(found) == []
    more = {section: {name: count + 9999999 for name, count in own.items()} for section, own in found.items()}
    assert len(structure.above(more)) == sum(map(len, found.values())) == sum(map(len, structure.ceilings().values()))


def test_rclpy_and_messages_are_imported_where_ros_lives(imports) -> None:
    ros = [(path, own, module) for path, own, module in imports if module.split(".")[0] in ROS_MODULES]
    assert [(path, module) for path, own, module in ros if not own.startswith(ROS_ROOMS)] == []


def test_the_product_imports_neither_the_evaluation_nor_benchmarks(imports) -> None:
    assert [(path, module) for path, _, module in imports if module.split(".")[0] in structure.LABORATORY] == []


def test_class_names_are_unique() -> None:
    """One name means one thing: no two public classes at the top of the packages' modules share theirs."""
    found = defaultdict(list)
    for path in (path for package in (*structure.PACKAGES, "calib_ros_evaluation") for path in structure.package_files(package)):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert len(found) > 300
    assert {name: places for name, places in found.items() if len(places) > 1} == {}


def test_names_in_strings_are_those_of_the_code() -> None:
    """What studies and tests patch by a dotted name is there: no tool looks into strings."""
    wrong = []
    for path in (*structure.package_files("benchmarks"), *structure.package_files("test")):
        for name in set(re.findall(r'"(calib_ros(?:_[a-z]+)?(?:\.\w+)+)"', path.read_text(encoding="utf-8"))):
            if name.endswith((".yaml", ".rviz")) or name in GROUPS:
                continue
            try:
                pkgutil.resolve_name(name)
            except (ImportError, AttributeError) as error:
                wrong.append(f"{path.relative_to(ROOT)}: {name}: {error}")
    assert wrong == []


def run(*command: str) -> str:
    done = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True)
    return "" if done.returncode == 0 else done.stdout + done.stderr


def test_ruff() -> None:
    assert run("ruff", "check", "--quiet", ".") == ""
    assert run("ruff", "format", "--check", "--quiet", ".") == ""


@pytest.mark.slow
def test_mypy() -> None:
    assert run("mypy") == ""


def test_generated_files_are_those_of_the_code() -> None:
    done = subprocess.run([sys.executable, ROOT / "tools/write_config.py", "--check"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("name", "largest"), [("fastdds_profile.xml", 6_000_000), ("fastdds_profile_large.xml", 25_000_000)])
def test_large_message_profiles_are_well_formed(name: str, largest: int) -> None:
    import xml.etree.ElementTree as ET

    tree = ET.parse(ROOT / "config" / name)
    names = {element.tag.split("}")[1]: element.text for element in tree.iter()}
    assert int(names["segment_size"]) >= int(names["maxMessageSize"]) > 2 * largest
    assert int(names["receiveBufferSize"]) > 2 * largest
    assert names["useBuiltinTransports"] == "false"
