"""What `calib-ros evaluate` and `calib-ros steps` do, and the lines that they print."""

from __future__ import annotations

import argparse
import os
import platform
import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import scipy
import yaml

from calib_ros import __version__, result
from calib_ros.cli.inputs import bag_options, configuration, initial_extrinsic, open_named_source
from calib_ros.cli.output import note, pose, progress_bar
from calib_ros.datasets.kitti import drives_in
from calib_ros.datasets.open import is_single
from calib_ros.errors import BadInputError
from calib_ros_evaluation.compare import as_text, compare
from calib_ros_evaluation.csv_files import read_trials
from calib_ros_evaluation.evaluate import Evaluation, EvaluationOptions, evaluate
from calib_ros_evaluation.experiments.plan import EXPERIMENTS, FULL, QUICK, Plan
from calib_ros_evaluation.experiments.setup import Setup, SourceSpec, labels
from calib_ros_evaluation.methods.registry import NAMES
from calib_ros_evaluation.protocols.definitions import COUNTS, DETECTION_COUNTS, MISCALIBRATION, TRIALS, check_name
from calib_ros_evaluation.protocols.evaluate import Evaluated, ProtocolOptions, evaluate_protocol
from calib_ros_evaluation.report.tables import summary
from calib_ros_evaluation.steps.page import EXPECTED, SECTIONS, check_folder, make_steps, write_page


def run_evaluation(args: argparse.Namespace) -> str:
    """Evaluate methods on sources; lines for the user. args: of `calib-ros evaluate`."""
    for name in ("frames_per_trial", "trials", "table"):
        if getattr(args, name) is not None:
            raise BadInputError(f"--{name.replace('_', '-')} belongs to --protocol; give --protocol NAME, or leave it out")
    options = EvaluationOptions(
        *_common(args), plan=plan_of(args), methods=args.methods or NAMES, experiments=args.experiments or EXPERIMENTS
    )
    with progress_bar("evaluating") as step:
        done = evaluate(options, _facts(args), partial(_progress, step))
    table = summary(done.results)
    return _said([table.text(), ""] if table.rows else [], done)


def _common(args: argparse.Namespace) -> tuple[Setup, Path, str, int, str, bool]:
    """Of RunOptions, in their order."""
    workers = (os.cpu_count() or 1) if args.workers is None else int(args.workers)
    return setup_of(args), Path(args.out), args.frames, workers, args.scheduler or "", args.fresh


def _progress(step: Callable[[float, float], None], stage: str, done: int, total: int) -> None:
    """Reading the sources takes seconds, all else minutes."""
    step(done if stage == "trials" else 0.0, max(total, 1))


def _said(lines: Sequence[str], done: Evaluation | Evaluated) -> str:
    for line in done.notes:
        note(line)
    page = done.files[0].resolve()
    return "\n".join([*lines, str(page), f"open it in a browser: {page.as_uri()}"])


def run_protocol(args: argparse.Namespace) -> str:
    """Run a published protocol on sources; lines for the user. args: of `calib-ros evaluate`."""
    check_name(args.protocol)
    for name in ("quick", "methods", "experiments", "start_deg", "start_m", "repeats"):
        if getattr(args, name):
            raise BadInputError(f"--protocol {args.protocol} says what is done; leave out --{name.replace('_', '-')}")
    if args.protocol == MISCALIBRATION and (args.trials is not None or args.seed is not None):
        raise BadInputError(f"--protocol {MISCALIBRATION} checks every row of the table; leave out --trials and --seed")
    options = ProtocolOptions(
        *_common(args),
        name=args.protocol,
        counts=args.frames_per_trial or (DETECTION_COUNTS if args.protocol == MISCALIBRATION else COUNTS),
        trials=TRIALS if args.trials is None else args.trials,
        seed=0 if args.seed is None else args.seed,
        table=None if args.table is None else Path(args.table),
    )
    with progress_bar("evaluating") as step:
        done = evaluate_protocol(options, _facts(args), partial(_progress, step))
    return _said([line for one in done.section.tables for line in (one.title, one.text(), "")], done)


def _facts(args: argparse.Namespace) -> dict[str, str]:
    """For the head of a report."""
    libraries = f"numpy {np.__version__}, scipy {scipy.__version__}, OpenCV {cv2.__version__}"
    return {
        "Command": shlex.join(["calib-ros", *args.given]).encode("utf-8", "replace").decode(),
        "Version": f"calib-ros {__version__}; Python {platform.python_version()}, {libraries}",
        "Machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
    }


def setup_of(args: argparse.Namespace) -> Setup:
    """Sources under their names, and the configuration. BadInputError where there are none."""
    paths = [path for text in args.source for path in sources_in(text)]
    # Absolute, since workers may start elsewhere; a source that is given twice is one.
    paths = list(dict.fromkeys(str(Path(path).resolve()) if Path(path).exists() else path for path in paths))
    reference: tuple[tuple[float, ...], ...] = ()
    if args.reference is not None:
        reference = tuple(map(tuple, result.load(args.reference).T_camera_lidar.tolist()))
    chosen = tuple(bag_options(args).items())
    scenes = (SourceSpec(label, path, args.camera, chosen, reference) for label, path in zip(labels(paths), paths, strict=True))
    return Setup(tuple(scenes), configuration(args.config, preset_name=args.preset))


def sources_in(text: str) -> list[str]:
    """What `open_dataset` opens at a path: itself (also a synthetic drive), or the KITTI drives, bags or plain folders below.

    Raises BadInputError if there are none.
    """
    path = Path(text).expanduser()
    if not path.is_dir() or is_single(path):
        return [text]  # open_dataset reports what is wrong with it
    found = drives_in(path) or [child for child in sorted(path.iterdir()) if is_single(child)]
    if not found:
        raise BadInputError(f"{text} holds no KITTI drives, ROS 2 bags or plain folders; give their folders one by one")
    return [str(one) for one in found]


def plan_of(args: argparse.Namespace) -> Plan:
    """The full or the quick plan with what the options change. BadInputError for a value out of range."""
    plan = QUICK if args.quick else FULL
    deg = plan.start[0] if args.start_deg is None else args.start_deg
    m = plan.start[1] if args.start_m is None else args.start_m
    if not (0 < deg <= 45 and 0 < m <= 3):  # NaN, too
        raise BadInputError(f"--start-deg {deg:g} --start-m {m:g}: give more than 0, at most 45 deg and 3 m")
    repeats = plan.repeats if args.repeats is None else args.repeats
    if not 1 <= repeats <= 1000:
        raise BadInputError(f"--repeats {repeats}: give 1 to 1000")
    seed = plan.seed if args.seed is None else args.seed
    if seed < 0:
        raise BadInputError(f"--seed {seed}: give 0 or more")
    return replace(plan, start=(deg, m), repeats=repeats, seed=seed)


def compare_tables(first: str, second: str) -> str:
    """Compare two tables of trials pair by pair; lines for the user."""
    return as_text(compare(read_trials(Path(first)), read_trials(Path(second))), first, second)


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
