"""What has converged goes back into the files of export.on_converged, and again whenever it has changed."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.errors import BadInputError
from calib_ros.export import AUTOWARE, CAMCHAIN, DESCRIPTIONS, content, has_changed, with_edges, write_back
from calib_ros.io import check_output
from calib_ros.online.events import ExtrinsicUpdated
from calib_ros.result import CONVERGED, Result
from calib_ros.rig.description import RigDescription
from calib_ros.rig.graph import joined_to
from calib_ros.rig.report import RigReport
from calib_ros.ros.parts import NodePart


class WriteBack(NodePart):
    """Thread-safe; files are written one after the other. Of a single pair edges are those of the tree of frames, see
    `calib_ros.export.write_back`."""

    def __init__(self, own: Any) -> None:
        super().__init__(own)
        self._known: Result | RigReport | None = None
        self._settings = self._wanted()
        self._written: dict[tuple[str, str], Result | RigReport] = {}  # by file and joint

    def _wanted(self) -> tuple[tuple[str, ...], str]:
        return self._parameters["export.on_converged"], self._parameters["export.joint"]

    def add(self, event: Any) -> None:
        """A new extrinsic of a single pair, whatever its status."""
        if isinstance(event, ExtrinsicUpdated):
            result = event.extrinsic.result
            self.put(result if event.extrinsic.usable and result.status == CONVERGED else None)

    def put(self, known: Result | RigReport | None) -> None:
        """What has converged: of a pair, or of a rig a solution of which all sensors are usable."""
        self._known = known
        if known is not None and self._wanted()[0]:
            self._own.files.submit(self._write, known)

    def check(self) -> None:
        """Other files want what is known."""
        if (wanted := self._wanted()) != self._settings:
            self._settings = wanted
            self.put(self._known)

    def _write(self, known: Result | RigReport) -> None:
        files, joint = self._wanted()
        for path in files:
            told = f"export.on_converged {path}"
            before = self._written.get((path, joint))
            if isinstance(known, Result):
                same = isinstance(before, Result) and not has_changed(known, before)
            else:
                same = isinstance(before, RigReport) and not known.has_changed(before)
            if same:
                continue
            try:
                if isinstance(known, Result):
                    write_back(path, known, self._own.tf.edges(known), joint)
                elif remark := known.write(path):
                    self._health.error(f"export.on_converged: {remark}", told)
                self._written[path, joint] = known
            except BadInputError as error:
                self._health.error(f"export.on_converged: {error}", told)
            except Exception as error:
                self._health.unexpected(error)


def check_files(files: Sequence[str], description: RigDescription) -> None:
    """BadInputError for files of export.on_converged that no solution of a rig can be written to."""
    if not files:
        return
    names, pairs = [sensor.name for sensor in description.sensors], [*description.camera_pairs, *description.lidar_pairs]
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
