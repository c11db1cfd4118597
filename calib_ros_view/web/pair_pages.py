"""The pages of the pairs of a rig, recorded or running, made when they are opened first."""

from __future__ import annotations

import threading
from collections.abc import Callable

from nicegui import run, ui

from calib_ros.errors import CalibrationError
from calib_ros_view.session.rig_shown import Pair
from calib_ros_view.web import theme

RIG = "/"  # address of the page of all sensors
Opened = tuple[Callable[[], None], Callable[[], None]]  # builds the page for a browser; ends what runs for it


class PairPages:
    """Opens pairs, one at a time; all browsers see the same of each. opening: makes the page of a camera with a LiDAR;
    CalibrationError where there is none."""

    def __init__(self, opening: Callable[[str, str], Opened]) -> None:
        self._opening = opening
        self._opened: dict[Pair, Opened] = {}
        self._lock = threading.Lock()

    async def page(self, camera: str, lidar: str) -> None:
        """Build the page of a pair for a browser, or one with a line about why there is none."""
        try:
            opened = await run.io_bound(self._open, camera, lidar)
        except CalibrationError as error:
            theme.apply()
            with ui.header(elevated=False).classes("bar px-2"):
                ui.link("all sensors of the rig", RIG)
            ui.label(str(error)).classes("p-4").props("role=alert")
            return
        if opened is not None:
            opened[0]()

    def _open(self, camera: str, lidar: str) -> Opened:
        with self._lock:
            if (camera, lidar) not in self._opened:
                self._opened[camera, lidar] = self._opening(camera, lidar)
            return self._opened[camera, lidar]

    def close(self) -> None:
        """End what runs."""
        for _, end in self._opened.values():
            end()
