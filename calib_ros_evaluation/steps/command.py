"""What `calib-ros steps` does, and the lines that it prints."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

import yaml

from calib_ros import __version__
from calib_ros.cli.inputs import configuration, initial_extrinsic, open_named_source
from calib_ros.cli.output import pose, progress_bar
from calib_ros.errors import BadInputError
from calib_ros_evaluation.steps.page import EXPECTED, SECTIONS, check_folder, make_steps, write_page


def run_steps(args: argparse.Namespace) -> str:
    """Write a page with every step of the method for one frame; lines for the user. args: of `calib-ros steps`.

    The extrinsic is the reference where there is one, else nominal, unless --initial says otherwise.
    """
    config = configuration(args.config, preset_name=args.preset)
    source, position = open_named_source(args), args.frame
    if not 0 <= position < len(source):
        raise BadInputError(f"--frame {position}: position is outside 0..{len(source) - 1} of this source")
    folder = Path(args.out)
    check_folder(folder)
    frame = source[position]
    reference = source.reference if frame.reference is None else frame.reference
    initial = args.initial or ("nominal" if reference is None else "reference")
    T = reference if initial == "reference" and reference is not None else initial_extrinsic(initial, source, args.yaw_deg)
    known = source.describe()
    facts = {
        "Source": known.get("source", f"{source.name}, {known.get('kind', '')}"),
        "Frame": f"{position} of 0..{len(source) - 1}, {frame.name}, {len(frame.cloud)} points",
        "Extrinsic": f"{initial}: {pose(T)}",
        "Command": _steps_command(args),
        "Version": f"calib-ros {__version__}",
    }
    settings = yaml.safe_dump(config.to_dict(), sort_keys=False)
    title = f"The method step by step: {source.name}, frame {position}"
    with progress_bar("drawing") as step:
        made = make_steps(frame, T, config)
        page = write_page(folder, title, facts, settings, SECTIONS, made, lambda done: step(min(done, EXPECTED), EXPECTED))
    return f"{page}\nopen it in a browser: {page.resolve().as_uri()}"


def _steps_command(args: argparse.Namespace) -> str:
    """The command for the page, without the output folder and defaults: the same input gives the same page."""
    command = ["calib-ros", "steps", args.source, "--frame", str(args.frame)]
    command += ["--camera", args.camera] if args.camera is not None else []
    for option in ("initial", "config", "image_topic", "points_topic", "camera_info_topic", "clock"):
        value = getattr(args, option)
        command += [f"--{option.replace('_', '-')}", value] if value else []
    command += ["--incomplete"] if args.incomplete else []
    command += [] if args.rectified is None else ["--rectified" if args.rectified else "--no-rectified"]
    return shlex.join(command + (["--yaw-deg", f"{args.yaw_deg:g}"] if args.yaw_deg else []))
