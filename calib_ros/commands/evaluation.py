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

from calib_ros import __version__, result
from calib_ros.commands.terminal import note, progress_bar
from calib_ros.config import Config
from calib_ros.datasets.several import sources_in
from calib_ros.errors import BadInputError
from calib_ros.evaluation.compare import as_text, compare
from calib_ros.evaluation.evaluate import Request, evaluate
from calib_ros.evaluation.experiments.plan import EXPERIMENTS, FULL, QUICK, Plan
from calib_ros.evaluation.experiments.setup import Scene, Setup, labels
from calib_ros.evaluation.methods.registry import NAMES
from calib_ros.evaluation.report.summary import summary
from calib_ros.evaluation.trials.table import read_trials


@dataclass(frozen=True)
class Asked:
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


def run_evaluation(asked: Asked) -> str:
    """Evaluate methods on sources; returns lines for the user."""
    workers = (os.cpu_count() or 1) if asked.workers is None else asked.workers
    request = Request(
        asked.setup(),
        Path(asked.out),
        asked.plan(),
        asked.frames,
        asked.methods or NAMES,
        asked.experiments or EXPERIMENTS,
        workers,
        asked.scheduler or "",
        asked.fresh,
    )
    libraries = f"numpy {np.__version__}, scipy {scipy.__version__}, OpenCV {cv2.__version__}"
    facts = {
        "Command": asked.command.encode("utf-8", "replace").decode(),
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
