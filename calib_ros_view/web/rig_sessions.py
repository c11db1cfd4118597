"""The pages of the pairs of a recorded rig, made when they are opened first."""

from __future__ import annotations

import threading

from nicegui import run, ui

from calib_ros.errors import CalibrationError
from calib_ros_view.session.jobs import SessionJobs
from calib_ros_view.session.rig_session import RigSession
from calib_ros_view.session.rig_shown import Pair
from calib_ros_view.session.session import Session
from calib_ros_view.web import theme
from calib_ros_view.web.server import Pictures
from calib_ros_view.web.source_page import SourcePage

RIG = "/"  # address of the page of all sensors


class SessionPairs:
    """Opens the pairs of a rig, one at a time; all browsers see the same session of each."""

    def __init__(self, rig: RigSession, pictures: Pictures) -> None:
        self._rig, self._pictures = rig, pictures
        self._opened: dict[Pair, tuple[Session, SessionJobs]] = {}
        self._lock = threading.Lock()

    async def page(self, camera: str, lidar: str) -> None:
        """Build the page of a pair for a browser, or one with a line about why there is none."""
        try:
            opened = await run.io_bound(self._open, camera, lidar)
        except CalibrationError as error:
            failed(str(error))
            return
        if opened is not None:
            SourcePage(*opened, self._pictures, RIG).build()

    def _open(self, camera: str, lidar: str) -> tuple[Session, SessionJobs]:
        with self._lock:
            if (camera, lidar) not in self._opened:
                session = self._rig.session(camera, lidar)
                self._opened[camera, lidar] = session, SessionJobs(session)
            return self._opened[camera, lidar]

    def close(self) -> None:
        """End what runs."""
        for _, jobs in self._opened.values():
            jobs.close()


def failed(why: str) -> None:
    """A page that says why there is no other, and leads back to the rig."""
    theme.apply()
    with ui.header(elevated=False).classes("bar px-2"):
        ui.link("all sensors of the rig", RIG)
    ui.label(why).classes("p-4").props("role=alert")
