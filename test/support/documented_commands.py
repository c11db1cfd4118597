"""Commands of the documentation, checked without running them: options, launch arguments, messages and parameters exist."""

from __future__ import annotations

import importlib
import re
import shlex
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import yaml
from calib_ros_msgs.msg import Extrinsic
from launch_files import declared
from paths import ROOT

from calib_ros.cli.arguments import parser
from calib_ros.config import Config
from calib_ros.extensions import commands
from calib_ros.ros.parameters import SETTINGS

# Commands that say nothing of this project.
FOREIGN = (
    r"cd [\w~/.]+", r"git clone <this repository> calib_ros", r"ln -s calib_ros/calib_ros_msgs \.", r"\. install/setup\.bash",
    r"rosdep install --from-paths src --ignore-src", r"colcon build", r"ros2 lifecycle set /calib_ros (configure|activate)",
    r"python3 -m venv --system-site-packages venv", r"touch venv/COLCON_IGNORE", r"\. venv/bin/activate",
    r"cp -r \. /tmp/calib_ros", r"bloom-generate rosdebian( --[\w-]+ \w+)+",
    r"DEB_BUILD_OPTIONS=nocheck dpkg-buildpackage -b -us -uc",
    r"ros2 bag record( /[\w/]+)+( -o \w+)?", r"ros2 topic echo /diagnostics( --once)?",
)  # fmt: skip


def lines(block: str) -> list[str]:
    """The commands of a bash block, without comments; `&&` joins two."""
    joined = block.replace("\\\n", " ")
    single = [re.sub(r"(^|\s)#.*$", "", line).strip() for line in joined.splitlines()]
    return [part.strip() for line in single for part in line.split(" && ") if part.strip()]


def fault(command: str) -> str:
    """What is wrong with a command; "" if nothing is known to be."""
    try:
        _check(command)
    except (AssertionError, AttributeError, ImportError, KeyError, OSError, ValueError, SystemExit) as error:
        return f"{command}: {error!r}"
    return ""


def _check(command: str) -> None:
    words = shlex.split(command)
    match words:
        case ["calib-ros" | ".venv/bin/calib-ros", *given]:
            parser(commands()).parse_args(given)
        case ["make", *given]:
            targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
            assert set(given) <= {*targets, "ROS=jazzy"}, targets
        case ["pip", "install", *what]:
            _check_pip(what)
        case ["ros2", "launch", "calib_ros", file, *arguments]:
            _check_launch(file, arguments)
        case ["ros2", "run", "calib_ros", program, *rest]:
            scripts = {point.name for point in entry_points(group="console_scripts")}
            assert program in scripts
            _check_parameters(rest)
        case ["ros2", "param", "set", "/calib_ros", name, _]:
            assert is_parameter(name)
        case ["ros2", "service", "call", name, kind, *request]:
            assert name.removeprefix("/calib_ros") in _offered("(?:create_service|serve)"), name
            _check_fields(_interface(kind).Request, yaml.safe_load(request[0]) if request else {})
        case ["ros2", "action", "send_goal", "--feedback", "/calib_ros/calibrate", kind]:
            assert _interface(kind).Goal
        case ["ros2", "topic", "echo", name, *options] if name.startswith("/calib_ros/"):
            assert name.removeprefix("/calib_ros") in _offered("create_publisher"), name
            assert options in ([], ["--once"]) or (
                options[0] == "--field" and options[1] in Extrinsic.get_fields_and_field_types()
            )
        case ["export", *_]:
            for file in re.findall(r"share/calib_ros/([\w/.]+)", command):
                assert (ROOT / file).exists(), file
        case _:
            assert any(re.fullmatch(pattern, command) for pattern in FOREIGN), "no check for this command"


def is_parameter(name: str) -> bool:
    stage, _, field = name.partition(".")
    return name in SETTINGS or field in Config().to_dict().get(stage, {})


def _check_pip(what: list[str]) -> None:
    extras = set(re.findall(r'^    "(\w+)": \[', (ROOT / "setup.py").read_text(), re.MULTILINE)) | {"all"}
    pinned = (ROOT / "requirements.txt").read_text() + (ROOT / "constraints.txt").read_text()
    for name in what:
        extra = re.fullmatch(r"(?:\.|calib_ros)\[(\w+)\]", name)
        library = re.split("[<>=]", name)[0]
        assert (extra[1] in extras) if extra else name == "." or re.search(rf"^{library}\b", pinned, re.MULTILINE), name


def _check_launch(file: str, arguments: list[str]) -> None:
    known = declared(file)
    for argument in arguments:
        name, assigned, _ = argument.partition(":=")
        assert assigned, argument
        assert name in known, f"{name} is not one of {sorted(known)}"


def _check_parameters(rest: list[str]) -> None:
    assert rest[:1] in ([], ["--ros-args"])
    for flag, assignment in zip(rest[1::2], rest[2::2], strict=True):
        assert flag in ("-p", "-r", "--params-file")
        assert flag != "-p" or is_parameter(assignment.partition(":=")[0]), assignment


def _interface(kind: str) -> Any:
    package, place, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.{place}"), name)


def _check_fields(message: Any, values: dict[str, Any]) -> None:
    fields = message.get_fields_and_field_types()
    for name, value in values.items():
        assert name in fields, f"{name} is not one of {sorted(fields)}"
        if isinstance(value, dict):
            package, _, kind = fields[name].partition("/")
            _check_fields(getattr(importlib.import_module(f"{package}.msg"), kind), value)


def _offered(call: str) -> set[str]:
    """Names below the node's, such as /check, that its sources make services or publishers of."""
    found: set[str] = set()
    for path in [*ROOT.glob("calib_ros/ros/*.py"), *ROOT.glob("calib_ros_*/node/*.py")]:
        found |= set(re.findall(rf'{call}\(\w+, "~(/[\w/]+)"', Path(path).read_text(encoding="utf-8")))
    return found
