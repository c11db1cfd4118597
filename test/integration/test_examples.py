"""The commands and the Python of README.md and docs/ run as they stand there; those that cannot run here say why and are checked
as far as possible; notebooks hold the blocks of their pages."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import documented_commands
import pytest
import sample_drives
import yaml
from paths import ROOT, module_at

from calib_ros import se3
from calib_ros.config import Config, update
from calib_ros.extensions import commands

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TOOL = module_at(ROOT / "tools/notebooks.py")
# What a block that is not run may say, what each of its commands then looks like, and how many such blocks there may be.
NOT_RUN = {
    "needs a ROS install": (
        r"ros2 |colcon |rosdep |export FAST\w+=\$\(ros2 |git clone |cd |ln -s |pip install |\. install/"
        r"|python3 -m venv |touch venv/|\. venv/|cp -r |bloom-generate |DEB_BUILD_OPTIONS=",
        13,
    ),
    "serves until Ctrl-C": (r"calib-ros view |pip install ", 3),
    "needs a data set": (r".*nuscenes|calib-ros certify /data/", 2),
    "needs a longer recording": (r"calib-ros calibrate \w+ --initial motion", 1),
    "takes minutes": (r"make (demo|test)$|calib-ros (rig|evaluate|check \S+ --rig|convert \S+rig=two_lidars)", 8),
}
PREPARED: dict[str, Callable[[Path], None]] = {
    "check": sample_drives.for_check,
    "fleet": sample_drives.for_fleet,
    "offline": sample_drives.for_offline,
    "tutorial_python": sample_drives.for_tutorial_python,
    "vehicle": sample_drives.for_vehicle,
}
ENVIRONMENT = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
pytestmark = pytest.mark.usefixtures("rendered_once")


def blocks(page: Path) -> list[Any]:
    """Prose and blocks of a page."""
    return TOOL.parts(page.read_text(encoding="utf-8"))


def runnable(page: Path) -> list[Any]:
    return [b for b in blocks(page) if not isinstance(b, str) and b.language in ("bash", "python") and "not run" not in b.markers]


def run(block: Any, page: Path, names: dict[str, Any]) -> str:
    """What a block prints, in the current folder. Python blocks of a page share their names."""
    if block.language == "python":
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile("\n" * (block.line - 1) + block.text, str(page), "exec"), names)
        return printed.getvalue()
    expected = int(block.markers.get("exit", 0))
    script = "" if expected else "set -e\n"
    done = subprocess.run(
        ["bash", "-c", script + block.text], env=ENVIRONMENT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert done.returncode == expected, f"{page.name}:{block.line} exits with {done.returncode}\n{block.text}{done.stdout}"
    return done.stdout


def masked(text: str) -> list[str]:
    """Lines with # for numbers, which differ between processors and libraries, and spaces as one."""
    return [" ".join(re.sub(r"-?\d+(\.\d+)?(e-?\d+)?", "#", line).split()) for line in text.splitlines() if line.strip()]


def assert_printed(shown: str, printed: str, where: str) -> None:
    """The lines of `shown` are among those printed, in that order; `...` stands for any end of a line, or lines."""
    rest = iter(masked(printed))
    for line in masked(shown):
        begun = line.removesuffix("...")
        there = any(p == line or (begun != line and p.startswith(begun)) for p in rest) if begun else True
        assert there, f"{where}: not printed, or not in this order:\n{line}\n\n{printed}"


@pytest.mark.parametrize(
    "page", [pytest.param(p, id=p.stem, marks=[] if p.stem == "api" else pytest.mark.slow) for p in PAGES if runnable(p)]
)
def test_the_examples_of_a_page_run_in_their_order(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    PREPARED.get(page.stem, lambda folder: None)(tmp_path)
    names: dict[str, Any] = {"__name__": page.stem}
    printed, before = "", ""
    for part in blocks(page):
        if isinstance(part, str):
            before = printed if not part.strip() else ""  # a text block directly below is what was printed
        elif part in runnable(page):
            printed = run(part, page, names)
        elif part.language == "text" and before:
            assert_printed(part.text, before, f"{page.name}:{part.line}")
    if page.stem == "README":
        assert names["result"].status == "converged"
        deg, m = se3.error(names["source"].reference, names["result"].T_camera_lidar)
        assert deg < 0.2
        assert m < 0.05


def test_blocks_that_are_not_run_say_why_and_are_few() -> None:
    counts: Counter[str] = Counter()
    for page in PAGES:
        for block in blocks(page):
            if isinstance(block, str) or "not run" not in block.markers:
                continue
            where, reason = f"{page.name}:{block.line}", block.markers["not run"]
            assert block.language == "bash", f"{where}: Python can run anywhere"
            assert reason in NOT_RUN, where
            for command in documented_commands.lines(block.text):
                assert re.match(NOT_RUN[reason][0], command), f"{where}: this could run: {command}"
            counts[reason] += 1
    assert {reason: counts[reason] for reason in NOT_RUN if counts[reason] > NOT_RUN[reason][1]} == {}


def test_commands_that_are_not_run_name_what_exists() -> None:
    """And `ros2` commands within the text."""
    faults = []
    for page in PAGES:
        for block in blocks(page):
            if isinstance(block, str):
                found = re.findall(r"`(ros2 [^`]*\bcalib_ros\b[^`]*)`", block)
            else:
                found = documented_commands.lines(block.text) if "not run" in block.markers else []
            faults += [f"{page.name}: {fault}" for command in found if (fault := documented_commands.fault(command))]
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize(
    "command",
    [
        "calib-ros calibrate drive --seach-deg 3", "ros2 launch calib_ros calib.launch.py imagetopic:=/image", "make tests",
        "ros2 service call /calib_ros/chek calib_ros_msgs/srv/Check", "ros2 service call /calib_ros/check std_srvs/srv/Check",
        'ros2 service call /calib_ros/check calib_ros_msgs/srv/Check "{tolerance: 1}"', "ros2 topic echo /calib_ros/extrinsics",
        "ros2 topic echo /calib_ros/extrinsic --field advise",
        "ros2 param set /calib_ros online.modes manual", "ros2 run calib_ros calib_node --ros-args -p rig:=rig.yaml",
        "pip install '.[browser]'", "rm -rf /", "export X=$(ros2 pkg prefix calib_ros)/share/calib_ros/config/profile.xml",
    ],
)  # fmt: skip
def test_a_command_that_names_what_does_not_exist_is_found(command: str) -> None:
    assert documented_commands.fault(command)


def test_every_block_with_commands_says_its_language() -> None:
    program = re.compile(rf"(calib-ros ({'|'.join(['info', 'calibrate', *commands()])})|ros2|make|pip|python3?) ")
    for page in PAGES:
        for block in blocks(page):
            if not isinstance(block, str) and block.language not in ("bash", "python"):
                assert block.language in ("", "text", "yaml", "xml", "math"), f"{page.name}:{block.line}"
                assert block.markers == {}, f"{page.name}:{block.line}"
                shown = block.text.replace("ros2 run tf2_ros static_transform_publisher", "")  # which calibrate prints
                assert not any(program.match(line) for line in shown.splitlines()), f"{page.name}:{block.line}"


def test_configurations_in_the_text_are_read() -> None:
    """YAML blocks of stages, or of parameters by their full names."""
    stages = set(Config().to_dict())
    found = 0
    for page in PAGES:
        for block in blocks(page):
            values = yaml.safe_load(block.text) if not isinstance(block, str) and block.language == "yaml" else {}
            own = {name: value for name, value in values.items() if name in stages}
            update(Config(), own)
            dotted = [name for name in values if "." in name]
            assert all(documented_commands.is_parameter(name) for name in dotted), page.name
            found += bool(own or dotted)
    assert found >= 4


@pytest.mark.parametrize("name", TOOL.TUTORIALS)
def test_a_notebook_holds_the_blocks_of_its_page(name: str) -> None:
    page = ROOT / "docs" / f"{name}.md"
    written = (ROOT / "docs" / f"{name}.ipynb").read_text(encoding="utf-8")
    assert written == TOOL.notebook(page.read_text(encoding="utf-8")), "run python tools/notebooks.py"
    code = ["".join(cell["source"]) for cell in json.loads(written)["cells"] if cell["cell_type"] == "code"]
    assert [re.sub(r"^%%bash.*\n", "", text) for text in code] == [block.text.strip() for block in runnable(page)]
    assert any(text.startswith("%%bash") for text in code) == any(block.language == "bash" for block in runnable(page))
