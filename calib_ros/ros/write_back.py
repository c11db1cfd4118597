"""What has converged goes back into the files of export.on_converged, and again whenever it has changed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from itertools import permutations
from pathlib import Path

import numpy as np

from calib_ros.errors import BadInputError
from calib_ros.export import AUTOWARE, CAMCHAIN, DESCRIPTIONS, Edges, content, has_changed, with_edges, write_back
from calib_ros.io import check_output
from calib_ros.result import CONVERGED, Extrinsic, Result
from calib_ros.rig.description import RigDescription
from calib_ros.rig.live import Pair, joined_to
from calib_ros.rig.report import RigReport
from calib_ros.ros.diagnostics import Health
from calib_ros.ros.parameters import Parameters


class WriteBack:
    """Thread-safe; files are written on the executor's only thread. parameters: gives the current ones. edges: of a single pair,
    those of the tree of frames, see `calib_ros.export.write_back`."""

    def __init__(
        self,
        parameters: Callable[[], Parameters],
        executor: Executor,
        health: Health,
        edges: Callable[[Result], Edges] = lambda _: {},
    ) -> None:
        self._parameters, self._executor, self._health, self._edges = parameters, executor, health, edges
        self._written: dict[tuple[str, str], Result | RigReport] = {}  # by file and joint

    def add(self, extrinsic: Extrinsic, stamp: int = 0) -> None:
        """The current extrinsic of a single pair, whatever its status."""
        if extrinsic.usable and extrinsic.result.status == CONVERGED:
            self.put(extrinsic.result)

    def put(self, known: Result | RigReport) -> None:
        """What has converged: of a pair, or of a rig a solution of which all sensors are usable."""
        if self._parameters()["export.on_converged"]:
            self._executor.submit(self._write, known)

    def _write(self, known: Result | RigReport) -> None:
        parameters = self._parameters()
        for path in parameters["export.on_converged"]:
            told, joint = f"export.on_converged {path}", parameters["export.joint"]
            before = self._written.get((path, joint))
            if isinstance(known, Result):
                same = isinstance(before, Result) and not has_changed(known, before)
            else:
                same = isinstance(before, RigReport) and not known.has_changed(before)
            if same:
                continue
            try:
                if isinstance(known, Result):
                    write_back(path, known, self._edges(known), joint)
                elif remark := known.write(path):
                    self._health.error(f"export.on_converged: {remark}", told)
                self._written[path, joint] = known
            except BadInputError as error:
                self._health.error(f"export.on_converged: {error}", told)
            except Exception as error:
                self._health.unexpected(error)


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
