"""The command line: commands, options, and the types of their values. Imports nothing that takes time."""

from __future__ import annotations

import argparse
import math
from argparse import ArgumentTypeError
from collections.abc import Mapping
from typing import Any

from calib_ros.extensions import OBJECTIVES, PRESETS, Command, names

AXES = ("rx", "ry", "rz", "tx", "ty", "tz")  # turning about, and shifting along, x, y, z of the camera's optical frame
Three = tuple[float, float, float]


def per_axis(text: str) -> Three:
    """'5' or '5,5,1' -> three numbers that are not negative."""
    values = [_number(part, text) for part in text.split(",")]
    if len(values) not in (1, 3):
        raise ArgumentTypeError(f"'{text}' holds {len(values)} numbers; give one, or three for x,y,z")
    x, y, z = values if len(values) == 3 else values * 3
    return x, y, z


def axis_values(text: str) -> list[tuple[str, float]]:
    """'ty=0.1,rx=2' -> names and numbers that are not negative."""
    out = []
    for part in text.split(","):
        name, equals, value = part.partition("=")
        if not equals:
            raise ArgumentTypeError(f"'{text}' is not understood; write AXIS=VALUE like ry=2 (deg) or tz=0.1 (m)")
        out.append((_axis(name, text), _number(value, text)))
    return out


def milliseconds(text: str) -> float:
    """'-4' -> seconds."""
    return _finite(text, text) / 1000


def time_offset(text: str) -> str | float:
    """'estimate', 'fixed', or seconds."""
    if text in ("estimate", "fixed"):
        return text
    try:
        return _finite(text, text)
    except ArgumentTypeError as error:
        raise ArgumentTypeError(f"{error}; give estimate, fixed or seconds") from None


def _axis(name: str, text: str) -> str:
    name = name.strip()
    if name not in AXES:
        where = "" if name == text else f" in '{text}'"
        raise ArgumentTypeError(f"'{name}'{where} is no axis; there are {', '.join(AXES)}")
    return name


def _number(part: str, text: str) -> float:
    value = _finite(part, text)
    if value < 0:
        raise ArgumentTypeError(f"{part.strip()} must not be negative")
    return value


def _finite(part: str, text: str) -> float:
    try:
        value = float(part)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        where = "" if part == text else f" in '{text}'"
        raise ArgumentTypeError(f"'{part.strip()}'{where} is no number")
    return value


BAD_INPUT = 2
# As in calib_ros.export, which would have --help wait for OpenCV.
SOURCE = "KITTI, nuScenes[#SCENE] or plain folder, ROS 2 bag, or synthetic[:seed=3,frames=16,rings=32,...]"
FORMATS = ("tf", "urdf", "autoware", "kitti", "kitti-raw", "json", "yaml")


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> Any:
        """One line instead of the whole usage."""
        self.exit(BAD_INPUT, f"{self.prog}: {message}; see {self.prog} --help\n")


def parser(extensions: Mapping[str, Command] | None = None) -> argparse.ArgumentParser:
    """All commands with their options; the name of the chosen one is `command`. extensions: commands of other
    packages by name."""
    whole = _Parser(prog="calib-ros", description="Targetless camera-LiDAR extrinsic calibration, once or while driving.")
    whole.add_argument("--version", action="store_true", help="print the version and exit")
    commands = whole.add_subparsers(dest="command", metavar="COMMAND", parser_class=_Parser)

    def add(name: str, text: str, source: bool = True) -> argparse.ArgumentParser:
        command = commands.add_parser(name, help=text, description=text)
        if source:
            add_source(command)
        return command

    add("info", "show frames, topics, camera and reference extrinsic of a source")

    command = add("calibrate", "estimate the extrinsic from the frames of a source")
    _frames_and_start(command)
    for option, unit in (("--search-deg", "deg"), ("--search-m", "m")):
        command.add_argument(
            option, type=per_axis, metavar="S[,S,S]", help=f"half width, {unit}, from nominal 10, 0.5, else 3, 0.3; 0 = refine"
        )
    _constraints(command)
    command.add_argument(
        "--objective", choices=["fast", *names(OBJECTIVES)], help="score (default fast); thesis = eq. 3.12, see --preset"
    )
    command.add_argument(
        "--intrinsics",
        choices=["given", "refine"],
        help="given (default), or refine: correct focal length, principal point and distortion together with the extrinsic",
    )
    command.add_argument("--camera-info", metavar="YAML", help="write the refined intrinsics as camera_calibration does")
    command.add_argument("--overlay", metavar="PNG", help="write a before/after image of the middle frame")
    command.add_argument("--json", metavar="FILE", help="write the result as JSON (YAML if FILE ends so); - = standard output")
    command.add_argument("--seed", type=int, help="seed of the search")
    command.add_argument("--threads", type=int, help="threads of the search (default 1); the result is the same")

    command = add("rig", "estimate the extrinsics of several cameras and LiDARs together", source=False)
    command.add_argument("source", help=SOURCE)
    command.add_argument(
        "--rig", metavar="YAML", help="its sensors and where they are believed to be (default: all, as the recording states them)"
    )
    command.add_argument("--write-rig", metavar="YAML", help="write what was assumed without --rig, to be edited")
    command.add_argument("--frames", default="all", help="of every pair: all, 0,4,8 or 0:100:5")
    command.add_argument("--config", metavar="YAML", help="configuration; see config/calib_ros.yaml")
    command.add_argument("--json", metavar="FILE", help="write the result as JSON; - = standard output")
    command.add_argument("--report", metavar="HTML", help="write a page")
    command.add_argument("--before", metavar="JSON", help="a former result of this rig: say which sensor has moved since")
    command.add_argument(
        "--out",
        action="append",
        default=[],
        metavar="FILE",
        help="write for other tools: .urdf or .xacro (joints change in place), .yaml (Autoware), camchain*.yaml (Kalibr)",
    )
    command.add_argument("--seed", type=int, help="seed of the search")

    command = add("convert", "write a source as a ROS 2 bag")
    command.add_argument("bag", help="folder to create")
    command.add_argument("--frames", default="all", help="all, 0,4,8 or 0:100:5")
    command.add_argument("--storage", default="mcap", choices=["mcap", "sqlite3"])

    command = add("replay", "run the online recalibrator over a source, without ROS; prints a JSON line per estimate")
    _frames_and_start(command)
    _constraints(command)
    command.add_argument("--gif", metavar="FILE", help="a moving picture of it, for people, of at most 2 MB")

    command = add("export", "convert a result or state file for other tools: TF, URDF, KITTI, Autoware", source=False)
    command.add_argument("file", help="JSON or YAML result, or the node's state file")
    command.add_argument("--format", default="tf", choices=FORMATS, help="default tf, a static_transform_publisher command")
    command.add_argument("--parent", default="camera", choices=["camera", "lidar"], help="lidar = inverted (default camera)")
    command.add_argument(
        "--camera-frame", metavar="NAME", help="name of the camera's optical frame; default: the one in the file"
    )
    command.add_argument("--lidar-frame", metavar="NAME", help="name of the LiDAR frame; default: the one in the file")
    command.add_argument(
        "--out", metavar="FILE", help="output file (default: standard output); of an existing .urdf or .xacro the joint changes"
    )

    command = add("play", "publish a bag over ROS", source=False)
    command.add_argument("bag")
    command.add_argument("--rate", type=float, default=1.0, help="playback rate (default 1)")
    command.add_argument("--loop", action="store_true", help="start over at the end")
    command.add_argument("--clock", action="store_true", help="publish /clock for use_sim_time")
    command.add_argument("--wait", type=float, default=10.0, help="seconds to wait for subscribers (default 10)")
    command.add_argument(
        "--follow",
        default="",
        metavar="NODE",
        help="play no faster than this node takes images and scans in, for example /calib_ros",
    )
    for name, extension in (extensions or {}).items():
        extension.add_arguments(add(name, extension.help, source=False))
    return whole


def add_source(command: argparse.ArgumentParser, default: str | None = None) -> None:
    if default is None:
        command.add_argument("source", help=SOURCE)
    else:
        command.add_argument("source", nargs="?", default=default, help=f"{SOURCE} (default {default})")
    add_camera_and_topics(command)


def add_camera_and_topics(command: argparse.ArgumentParser) -> None:
    command.add_argument("--camera", help="KITTI: 0-3 (default 2); nuScenes, folder: name or number (CAM_FRONT, the first)")
    for topic in ("image", "points", "camera-info"):
        command.add_argument(f"--{topic}-topic", help="topic of a bag that holds several of the kind")
    command.add_argument(
        "--rectified",
        action=argparse.BooleanOptionalAction,
        help="the images are rectified: P, or K, is their camera, without distortion; by default of a bag if its topic says so",
    )
    command.add_argument("--incomplete", action="store_true", help="use what is left of a bag of which parts are missing")
    command.add_argument(
        "--clock",
        choices=("auto", "header", "recording"),
        help="by which images and clouds of a bag pair: the stamps of their headers, the times of recording, or the stamps with "
        "differences between the clocks that the recording shows taken out (auto, the default)",
    )


def _frames_and_start(command: argparse.ArgumentParser) -> None:
    command.add_argument("--frames", default="all", help="all, 0,4,8 or 0:100:5 (positions as info lists them)")
    command.add_argument(
        "--initial",
        help="nominal, reference, a result file, or a first guess: semantic = from the classes in the scenes, centroids = from "
        "objects alone, motion = from frames that follow each other, auto = by what is available (default nominal, or the "
        "preset's)",
    )
    add_yaw_and_config(command)


def add_yaw_and_config(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--yaw-deg", type=float, default=0.0, help="yaw of the nominal camera to the left of the LiDAR's +x axis; 180 = backward"
    )
    command.add_argument("--config", metavar="YAML", help="configuration; see config/calib_ros.yaml")
    add_preset(command)


def add_preset(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--preset", choices=names(PRESETS), default="", help="thesis = the thesis's own system; other options hold before it"
    )


def _constraints(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group(
        "constraints on the extrinsic",
        "Axes are rx, ry, rz (deg) and tx, ty, tz (m) of the camera: x right, y down, z forward, relative to the initial "
        "extrinsic.",
    )
    group.add_argument(
        "--rotation-only", action="store_true", help="keep the camera's position in the LiDAR frame; estimate only its rotation"
    )
    names_of = lambda text: [_axis(part, text) for part in text.split(",")]  # noqa: E731
    group.add_argument("--fix", type=names_of, action="extend", default=[], metavar="AXES", help="fix these axes, as in rx,tz")
    group.add_argument(
        "--bound",
        type=axis_values,
        action="extend",
        default=[],
        metavar="AXIS=VALUE[,...]",
        help="limit these axes, for example ry=2,tz=0.1",
    )
    for option, unit in (("--prior-deg", "deg"), ("--prior-m", "m")):
        group.add_argument(
            option, type=per_axis, metavar="S[,S,S]", help=f"standard deviation of the initial extrinsic, {unit}; 0 = unknown"
        )
    group.add_argument(
        "--time-offset",
        type=time_offset,
        metavar="WHAT",
        help="clocks of camera and LiDAR: estimate (default), fixed (motion.time_offset_s), or seconds, added to the times of "
        "the points: positive = measured later, or the image exposed earlier, than stamped",
    )
    # As it was called before there was something to estimate.
    group.add_argument("--time-offset-ms", dest="time_offset", type=milliseconds, help=argparse.SUPPRESS)
