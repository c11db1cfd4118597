"""`calib-ros evaluate`."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import scipy
import yaml

from calib_ros import __version__, result
from calib_ros.cli.choices import initial_extrinsic
from calib_ros.cli.text import note, pose, progress_bar
from calib_ros.config import Config
from calib_ros.datasets.open import sources_in
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros_evaluation.compare import as_text, compare
from calib_ros_evaluation.evaluate import Request, evaluate
from calib_ros_evaluation.experiments.plan import EXPERIMENTS, FULL, QUICK, Plan
from calib_ros_evaluation.experiments.setup import Scene, Setup, labels
from calib_ros_evaluation.experiments.tables import read_trials
from calib_ros_evaluation.methods.registry import NAMES
from calib_ros_evaluation.report.tables import summary
from calib_ros_evaluation.steps.page import EXPECTED, SECTIONS, check_folder, write_page
from calib_ros_evaluation.steps.page import steps as make_steps


@dataclass(frozen=True)
class EvaluationOptions:
    """Options of the command line; None = as the plan has it. topics: of bags. reference: a result file. command: as it stands in
    the report."""

    source: Sequence[str]
    config: Config
    out: str
    command: str
    camera: int = 2
    topics: tuple[tuple[str, str], ...] = ()
    frames: str = "all"
    quick: bool = False
    methods: tuple[str, ...] | None = None
    experiments: tuple[str, ...] | None = None
    start_deg: float | None = None
    start_m: float | None = None
    repeats: int | None = None
    seed: int | None = None
    reference: str | None = None
    workers: int | None = None
    scheduler: str | None = None
    fresh: bool = False

    def setup(self) -> Setup:
        """Sources under their names. BadInputError where there are none."""
        paths = [path for text in self.source for path in sources_in(text)]
        # Workers may start elsewhere; and what is given twice is one source.
        paths = list(dict.fromkeys(str(Path(path).resolve()) if Path(path).exists() else path for path in paths))
        reference: tuple[tuple[float, ...], ...] = ()
        if self.reference is not None:
            reference = tuple(map(tuple, result.load(self.reference).T_camera_lidar.tolist()))
        scenes = (
            Scene(label, path, self.camera, self.topics, reference) for label, path in zip(labels(paths), paths, strict=True)
        )
        return Setup(tuple(scenes), self.config)

    def plan(self) -> Plan:
        """BadInputError for what cannot be."""
        plan = QUICK if self.quick else FULL
        deg = plan.start[0] if self.start_deg is None else self.start_deg
        m = plan.start[1] if self.start_m is None else self.start_m
        if not (0 < deg <= 45 and 0 < m <= 3):  # NaN, too
            raise BadInputError(f"--start-deg {deg:g} --start-m {m:g}: give more than 0, at most 45 deg and 3 m")
        repeats = plan.repeats if self.repeats is None else self.repeats
        if not 1 <= repeats <= 1000:
            raise BadInputError(f"--repeats {repeats}: give 1 to 1000")
        seed = plan.seed if self.seed is None else self.seed
        if seed < 0:
            raise BadInputError(f"--seed {seed}: give 0 or more")
        return replace(plan, start=(deg, m), repeats=repeats, seed=seed)


def run_evaluation(options: EvaluationOptions) -> str:
    """Evaluate methods on sources; returns lines for the user."""
    workers = (os.cpu_count() or 1) if options.workers is None else options.workers
    request = Request(
        options.setup(),
        Path(options.out),
        options.plan(),
        options.frames,
        options.methods or NAMES,
        options.experiments or EXPERIMENTS,
        workers,
        options.scheduler or "",
        options.fresh,
    )
    libraries = f"numpy {np.__version__}, scipy {scipy.__version__}, OpenCV {cv2.__version__}"
    facts = {
        "Command": options.command.encode("utf-8", "replace").decode(),
        "Version": f"calib-ros {__version__}; Python {platform.python_version()}, {libraries}",
        "Machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
    }
    with progress_bar("evaluating") as step:
        # The survey takes seconds, all else minutes.
        done = evaluate(request, facts, lambda stage, n, total: step(n if stage == "trials" else 0.0, max(total, 1)))
    for line in done.notes:
        note(line)
    page = done.files[0].resolve()
    table = summary(done.results)
    lines = [table.text(), ""] if table.rows else []
    return "\n".join([*lines, str(page), f"open it in a browser: {page.as_uri()}"])


def compared(first: str, second: str) -> str:
    """Two tables of trials, pair by pair; lines for the user."""
    return as_text(compare(read_trials(Path(first)), read_trials(Path(second))), first, second)


# `calib-ros steps`.
def steps(source: Source, position: int, initial: str | None, yaw_deg: float, config: Config, out: str, command: str) -> str:
    """A page with every step of the method for one frame; returns lines for the user.

    initial: None = the reference where there is one, else nominal. command: as it stands on the page.
    """
    if not 0 <= position < len(source):
        raise BadInputError(f"--frame {position}: position is outside 0..{len(source) - 1} of this source")
    folder = Path(out)
    check_folder(folder)
    frame = source[position]
    reference = source.reference if frame.reference is None else frame.reference
    initial = initial or ("nominal" if reference is None else "reference")
    T = reference if initial == "reference" and reference is not None else initial_extrinsic(initial, source, yaw_deg)
    known = source.describe()
    facts = {
        "Source": known.get("source", f"{source.name}, {known.get('kind', '')}"),
        "Frame": f"{position} of 0..{len(source) - 1}, {frame.name}, {len(frame.cloud)} points",
        "Extrinsic": f"{initial}: {pose(T)}",
        "Command": command,
        "Version": f"calib-ros {__version__}",
    }
    settings = yaml.safe_dump(config.to_dict(), sort_keys=False)
    title = f"The method step by step: {source.name}, frame {position}"
    with progress_bar("drawing") as step:
        made = make_steps(frame, T, config)
        page = write_page(folder, title, facts, settings, SECTIONS, made, lambda done: step(min(done, EXPECTED), EXPECTED))
    return f"{page}\nopen it in a browser: {page.resolve().as_uri()}"
