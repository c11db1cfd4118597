"""The extrinsic goes back into the files of export.on_converged once it has converged, and whenever it has changed."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor

from calib_ros.errors import BadInputError
from calib_ros.export import Edges, has_changed, write_back
from calib_ros.result import CONVERGED, Extrinsic, Result
from calib_ros.ros.diagnostics import Health
from calib_ros.ros.parameters import Parameters


class WriteBack:
    """Thread-safe; files are written on the executor's only thread.

    parameters: gives the current ones. edges: of the tree of frames, see `calib_ros.export.write_back`.
    """

    def __init__(
        self, parameters: Callable[[], Parameters], edges: Callable[[Result], Edges], executor: Executor, health: Health
    ) -> None:
        self._parameters, self._edges, self._executor, self._health = parameters, edges, executor, health
        self._written: dict[tuple[str, str], Result] = {}  # by file and joint

    def add(self, extrinsic: Extrinsic, stamp: int = 0) -> None:
        """The current extrinsic, whatever its status."""
        if extrinsic.usable and extrinsic.result.status == CONVERGED and self._parameters()["export.on_converged"]:
            self._executor.submit(self._write, extrinsic.result)

    def _write(self, result: Result) -> None:
        parameters = self._parameters()
        for path in parameters["export.on_converged"]:
            key = path, parameters["export.joint"]
            if key in self._written and not has_changed(result, self._written[key]):
                continue
            try:
                write_back(path, result, self._edges(result), parameters["export.joint"])
                self._written[key] = result
            except BadInputError as error:
                self._health.error(f"export.on_converged: {error}", f"export.on_converged {path}")
            except Exception as error:
                self._health.unexpected(error)
