"""What `calib-ros evaluate` does, and the lines that it prints."""

from __future__ import annotations

import argparse
import os
import platform
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import scipy

from calib_ros import __version__, result
from calib_ros.cli.inputs import bag_options, configuration
from calib_ros.cli.output import note, progress_bar
from calib_ros.datasets.kitti import drives_in
from calib_ros.datasets.open import is_single
from calib_ros.errors import BadInputError
from calib_ros_evaluation.compare import as_text, compare
from calib_ros_evaluation.evaluate import Experiments, Study, evaluate
from calib_ros_evaluation.experiments.plan import EXPERIMENTS, FULL, QUICK
from calib_ros_evaluation.experiments.setup import Setup, SourceSpec, labels
from calib_ros_evaluation.methods.own import NAMES
from calib_ros_evaluation.protocols.definitions import COUNTS, DETECTION_COUNTS, MISCALIBRATION, PROTOCOLS, TRIALS
from calib_ros_evaluation.protocols.definitions import NAMES as PROTOCOL_NAMES
from calib_ros_evaluation.protocols.trials import Calibrations, Detection, read_perturbations
from calib_ros_evaluation.results import read_trials


def run_evaluation(args: argparse.Namespace) -> str:
    """Evaluate on sources, or compare two evaluations; lines for the user. args: of `calib-ros evaluate`."""
    if args.compare:
        return as_text(compare(*(read_trials(Path(path)) for path in args.compare)), *args.compare)
    study = study_of(args)
    workers = (os.cpu_count() or 1) if args.workers is None else int(args.workers)
    if workers < 1:
        raise BadInputError(f"--workers {workers}: give at least 1")
    paths = [path for text in args.source for path in sources_in(text)]
    # Absolute, since workers may start elsewhere; a source that is given twice is one.
    paths = list(dict.fromkeys(str(Path(path).resolve()) if Path(path).exists() else path for path in paths))
    reference = () if args.reference is None else tuple(map(tuple, result.load(args.reference).T_camera_lidar.tolist()))
    chosen = tuple(bag_options(args).items())
    scenes = (SourceSpec(label, path, args.camera, chosen, reference) for label, path in zip(labels(paths), paths, strict=True))
    setup = Setup(tuple(scenes), configuration(args.config, preset_name=args.preset))
    with progress_bar("evaluating") as step:

        def progress(stage: str, done: int, total: int) -> None:
            """Reading the sources takes seconds, all else minutes."""
            step(done if stage == "trials" else 0.0, max(total, 1))

        libraries = f"numpy {np.__version__}, scipy {scipy.__version__}, OpenCV {cv2.__version__}"
        facts = {
            "Command": shlex.join(["calib-ros", *args.given]).encode("utf-8", "replace").decode(),
            "Version": f"calib-ros {__version__}; Python {platform.python_version()}, {libraries}",
            "Machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        }
        of_run = {"frames": args.frames, "workers": workers, "scheduler": args.scheduler or "", "fresh": args.fresh}
        said, files, notes = evaluate(setup, study, Path(args.out), facts, progress, **of_run)
    for line in notes:
        note(line)
    page = files[0].resolve()
    return "\n".join([*said, str(page), f"open it in a browser: {page.as_uri()}"])


def study_of(args: argparse.Namespace) -> Study:
    """The experiments, or a published protocol. BadInputError for options that do not belong to it, or out of range."""
    name, trials = args.protocol, TRIALS if args.trials is None else args.trials
    of_protocols = ("frames_per_trial", "trials", "table")
    of_experiments = ("quick", "methods", "experiments", "start_deg", "start_m", "repeats")
    for option in of_protocols if name is None else of_experiments:
        if getattr(args, option) not in (None, False):
            text = f"--{option.replace('_', '-')}"
            if name is None:
                raise BadInputError(f"{text} belongs to --protocol; give --protocol NAME, or leave it out")
            raise BadInputError(f"--protocol {name} says what is done; leave out {text}")
    if args.seed is not None and args.seed < 0:
        raise BadInputError(f"--seed {args.seed}: give 0 or more")
    if name is None:
        methods, experiments = args.methods or NAMES, args.experiments or EXPERIMENTS
        _check_names("method", methods, NAMES)
        _check_names("experiment", experiments, EXPERIMENTS)
        plan = QUICK if args.quick else FULL
        deg, m = (own if new is None else new for own, new in zip(plan.start, (args.start_deg, args.start_m), strict=True))
        if not (0 < deg <= 45 and 0 < m <= 3):  # NaN, too
            raise BadInputError(f"--start-deg {deg:g} --start-m {m:g}: give more than 0, at most 45 deg and 3 m")
        repeats = plan.repeats if args.repeats is None else args.repeats
        if not 1 <= repeats <= 1000:
            raise BadInputError(f"--repeats {repeats}: give 1 to 1000")
        seed = plan.seed if args.seed is None else args.seed
        return Experiments(replace(plan, start=(deg, m), repeats=repeats, seed=seed), methods, experiments)
    _check_names("protocol", [name], PROTOCOL_NAMES)
    if not 1 <= trials <= 100_000:
        raise BadInputError(f"--trials {trials}: give 1 to 100000")
    if name != MISCALIBRATION:
        if args.table is not None:
            raise BadInputError(f"--table belongs to --protocol {MISCALIBRATION}; leave it out for {name}")
        return Calibrations(PROTOCOLS[name], args.frames_per_trial or COUNTS, trials, args.seed or 0)
    if args.trials is not None or args.seed is not None:
        raise BadInputError(f"--protocol {MISCALIBRATION} checks every row of the table; leave out --trials and --seed")
    if args.table is None:
        raise BadInputError(f"--protocol {MISCALIBRATION} needs the published perturbations: give their CSV file by --table FILE")
    return Detection(read_perturbations(Path(args.table)), args.frames_per_trial or DETECTION_COUNTS)


def _check_names(kind: str, given: Sequence[str], known: Sequence[str]) -> None:
    for name in given:
        if name not in known:
            raise BadInputError(f"there is no {kind} '{name}'; choose among {', '.join(known)}")


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
