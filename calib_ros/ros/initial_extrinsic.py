"""The initial extrinsic: saved state, parameters, TF, nominal, in this order; and the state file of the last good one."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from calib_ros.camera import Camera
from calib_ros.errors import BadInputError
from calib_ros.online.events import ExtrinsicUpdated
from calib_ros.online.state import load_state, provenance_of, read_state, save_state
from calib_ros.registration.initial_guess import nominal, nominal_start
from calib_ros.result import CONVERGED, INITIAL, InitialSource, Result
from calib_ros.ros.parts import NodePart


class InitialExtrinsic(NodePart):
    """Chooses the initial extrinsic of a pipeline, and saves accepted ones."""

    def __init__(self, own: Any) -> None:
        super().__init__(own)
        self._reported = ""
        self._saved = 0  # accepted estimates when the extrinsic was saved
        self._stamp = 0  # of the newest data, ns

    def choose(self, camera: Camera, camera_frame: str, lidar_frame: str) -> Result | None:
        """The extrinsic to start from; None while TF may still come."""
        parameters = self._parameters
        path = parameters["state_file"]
        if path and os.path.exists(path):
            try:
                saved = load_state(path, camera, camera_frame, lidar_frame)
                return replace(saved, origin=InitialSource.SAVED_STATE)
            except BadInputError as error:
                if str(error) != self._reported:  # asked again with every pair while TF may still come
                    self._reported = str(error)
                    self._health.error(str(error), "state file read")
        given = parameters.initial()
        if given is not None:
            return given
        T, pending = self._own.tf.lookup(camera_frame, lidar_frame)
        if T is not None:
            return Result(T, INITIAL, "from TF", origin=InitialSource.TF)
        if pending:
            return None
        return nominal_start(parameters["nominal_yaw_deg"])

    def before_messages(self) -> Result:
        """The initial extrinsic before any message has named the sensors, as far as the parameters allow it; without TF."""
        parameters = self._parameters
        if os.path.exists(parameters["state_file"]):
            with suppress(BadInputError):  # reported when the sensors are known and the start is chosen
                saved = read_state(parameters["state_file"]).result
                names = (parameters["camera_frame"], saved.camera_frame), (parameters["lidar_frame"], saved.lidar_frame)
                if all(wanted in ("", found) for wanted, found in names):
                    return replace(saved, status=INITIAL, reason="from the saved state", origin=InitialSource.SAVED_STATE)
        return parameters.initial() or Result(nominal(parameters["nominal_yaw_deg"]), INITIAL)

    def check(self) -> None:
        """Start anew if TF has come for an extrinsic that started as nominal, and no estimate has been accepted since."""
        recalibrator = self._pipeline.recalibrator
        if recalibrator is None or recalibrator.current.accepted:
            return
        initial = recalibrator.tracker.initial
        if initial.origin is not InitialSource.NOMINAL:
            return
        T = self._own.tf.lookup(initial.camera_frame, initial.lidar_frame)[0]
        if T is not None and not np.allclose(T, initial.T_camera_lidar, atol=1e-6):
            self._node.get_logger().info("TF connects camera and LiDAR by now: starting anew from it")
            self._pipeline.restart()

    def add(self, event: Any) -> None:
        """Save a new extrinsic if it is an estimate that has been accepted."""
        if not isinstance(event, ExtrinsicUpdated):
            return
        extrinsic, self._stamp = event.extrinsic, event.stamp
        self._saved = min(self._saved, extrinsic.accepted)  # counted anew after a reset
        if extrinsic.result.status == CONVERGED and extrinsic.accepted > self._saved:
            self._saved = extrinsic.accepted
            self.save(extrinsic.result)

    def save(self, result: Result) -> tuple[bool, str]:
        """Write an accepted estimate to the state file; whether it was, and where or why not, for a person."""
        path, camera, recalibrator = self._parameters["state_file"], self._pipeline.camera, self._pipeline.recalibrator
        if not path or camera is None or recalibrator is None:
            return False, "nothing saved: set the parameter state_file to a path"
        accepted, keyframes = recalibrator.current.accepted, recalibrator.keyframes.seen
        try:
            newest = result.data_stamp or self._stamp
            save_state(path, result, camera, provenance_of(recalibrator.config, accepted, keyframes, newest))
        except BadInputError as error:
            self._health.error(str(error), "state file written")
            return False, str(error)
        return True, f"saved to {path}"
