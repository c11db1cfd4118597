"""What an evaluation works on, as plain data that travels to other processes and machines."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import calib_ros
from calib_ros.config import Config
from calib_ros.datasets import Source, open_source

Matrix = NDArray[np.float64]
SHOWING = (
    "ros/",
    "commands/",
    "cli.py",
    "demo.py",
    "overlay",
    "report.py",
    "exports.py",
    "evaluation/report/",
    "evaluation/steps/",
)


@dataclass(frozen=True)
class Scene:
    """A source. label: its name among all. path: as open_source takes it. options: of open_source. reference: rows of a
    T_camera_lidar (4, 4) that counts instead of the source's own; empty = the source's."""

    label: str
    path: str
    camera: int = 2
    options: tuple[tuple[str, str], ...] = ()
    reference: tuple[tuple[float, ...], ...] = ()

    def open(self) -> Source:
        """The source. BadInputError if it cannot be opened."""
        return open_source(self.path, camera=self.camera, **dict(self.options))


@dataclass(frozen=True)
class Setup:
    """The same for all jobs of an evaluation."""

    scenes: tuple[Scene, ...]
    config: Config

    def scene(self, label: str) -> Scene:
        """The scene of a label; KeyError if there is none."""
        return {scene.label: scene for scene in self.scenes}[label]

    @property
    def fingerprint(self) -> str:
        """Of the configuration; differs where results may."""
        text = json.dumps(self.config.to_dict(), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def code_fingerprint() -> str:
    """Of the program that answers come from: two states of it must not share a folder, though their version be the same. What
    only shows answers, or runs elsewhere, does not count."""
    package, found = Path(calib_ros.__file__).parent, hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        name = path.relative_to(package).as_posix()
        if not name.startswith(SHOWING):
            found.update(name.encode() + b"\0" + path.read_bytes())
    return found.hexdigest()[:16]


def labels(paths: Sequence[str]) -> list[str]:
    """A short name for each source, no two alike."""
    out: list[str] = []
    for path in paths:
        path = path.encode("utf-8", "replace").decode()  # names of other encodings cannot be written
        parts = [part for part in Path(path).parts if part not in ("/", "..", ".")] or [path]
        label = parts[-1]
        # "00" and "training" are names of places in a dataset, not of drives.
        if len(parts) > 1 and (len(label) < 4 or label in ("training", "testing")):
            label = f"{parts[-2]}/{label}"
        names = (label, *(f"{label} ({n})" for n in range(2, len(out) + 3)))
        out.append(next(name for name in names if name not in out))
    return out
