"""What has converged goes back into the files of export.on_converged, and again whenever it has changed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from itertools import permutations
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from calib_ros.errors import BadInputError
from calib_ros.export import AUTOWARE, DESCRIPTIONS, Edges, content, has_changed, replace_file, with_edges, write_back
from calib_ros.io import check_output
from calib_ros.result import CONVERGED, Extrinsic, Result
from calib_ros.rig.description import RigDescription
from calib_ros.rig.live import Pair, joined_to
from calib_ros.rig.report import CAMCHAIN, RigReport
from calib_ros.ros.diagnostics import Health
from calib_ros.ros.parameters import Parameters

Known = TypeVar("Known", Result, RigReport)


class _Files(ABC, Generic[Known]):
    """Thread-safe; files are written on the executor's only thread. parameters: gives the current ones."""

    def __init__(self, parameters: Callable[[], Parameters], executor: Executor, health: Health) -> None:
        self._parameters, self._executor, self._health = parameters, executor, health
        self._written: dict[tuple[str, str], Known] = {}  # by file and joint

    def _put(self, known: Known) -> None:
        if self._parameters()["export.on_converged"]:
            self._executor.submit(self._write, known)

    def _write(self, known: Known) -> None:
        parameters = self._parameters()
        for path in parameters["export.on_converged"]:
            key = path, parameters["export.joint"]
            if key in self._written and not self._has_changed(known, self._written[key]):
                continue
            try:
                self._write_to(path, known)
                self._written[key] = known
            except BadInputError as error:
                self._health.error(f"export.on_converged: {error}", f"export.on_converged {path}")
            except Exception as error:
                self._health.unexpected(error)

    @abstractmethod
    def _has_changed(self, known: Known, before: Known) -> bool:
        """Whether it is to be written again."""

    @abstractmethod
    def _write_to(self, path: str, known: Known) -> None:
        """Raises BadInputError."""


class WriteBack(_Files[Result]):
    """Of a single pair. edges: of the tree of frames, see `calib_ros.export.write_back`."""

    def __init__(
        self, parameters: Callable[[], Parameters], edges: Callable[[Result], Edges], executor: Executor, health: Health
    ) -> None:
        super().__init__(parameters, executor, health)
        self._edges = edges

    def add(self, extrinsic: Extrinsic, stamp: int = 0) -> None:
        """The current extrinsic, whatever its status."""
        if extrinsic.usable and extrinsic.result.status == CONVERGED:
            self._put(extrinsic.result)

    def _has_changed(self, known: Result, before: Result) -> bool:
        return has_changed(known, before)

    def _write_to(self, path: str, known: Result) -> None:
        write_back(path, known, self._edges(known), self._parameters()["export.joint"])


class RigWriteBack(_Files[RigReport]):
    """Of a rig, as `calib-ros rig` writes it."""

    def add(self, report: RigReport) -> None:
        """A solution of which all sensors are usable."""
        self._put(report)

    def _has_changed(self, known: RigReport, before: RigReport) -> bool:
        return known.has_changed(before)

    def _write_to(self, path: str, known: RigReport) -> None:
        if Path(path).suffix.lower() == ".json":
            replace_file(path, known.dumps().encode(), content(path))
        elif remark := known.write(path):
            self._health.error(f"export.on_converged: {remark}", f"export.on_converged {path}")


def check_files(files: Sequence[str], description: RigDescription, pairs: Sequence[Pair]) -> None:
    """BadInputError for files of export.on_converged that no solution of a rig with these pairs can be written to."""
    if not files:
        return
    names = [sensor.name for sensor in description.sensors]
    if apart := [name for name in names if name not in joined_to(description.reference, pairs)]:
        raise BadInputError(
            f"export.on_converged waits for all sensors, and no pairs join {', '.join(apart)} to {description.reference}; add "
            "them to pairs of the rig, or leave the sensors out"
        )
    frames = [sensor.frame for sensor in description.sensors if sensor.frame]
    edges = dict.fromkeys(permutations(frames, 2), np.eye(4))
    for path in files:
        check_output(path, "export.on_converged:")
        has_edges = Path(path).suffix.lower() in (*DESCRIPTIONS, *AUTOWARE) and not Path(path).name.startswith(CAMCHAIN)
        if has_edges and len(frames) == len(names) and (there := content(path)) is not None:
            with_edges(there, path, edges)
