"""`calib-ros replay`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.commands.calibration import error_against
from calib_ros.commands.settings import NOMINAL_BOX, require_classes
from calib_ros.commands.terminal import note, progress_bar
from calib_ros.config import Config, update
from calib_ros.datasets.source import Source
from calib_ros.datasets.with_motion import WithMotion
from calib_ros.errors import CalibrationError
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.initial_guess import NOMINAL, SEMANTIC
from calib_ros.result import INITIAL, Result
from calib_ros.sources import frame_positions, initial_extrinsic


def replay(source: Source, frames: str, initial: str, yaw_deg: float, config: Config) -> Iterator[dict[str, Any]]:
    """The result of every estimate of the online recalibrator, with its keyframes and drift; frames that cannot be used go to
    stderr."""
    positions = frame_positions(frames, len(source))
    T0 = initial_extrinsic(initial, source, yaw_deg)
    if initial == "nominal":
        wide = replace(config.search, rotation_deg=NOMINAL_BOX.reach[0], translation_m=NOMINAL_BOX.reach[1])
        config = replace(config, search=wide)
    start: Result | NDArray[np.float64] = T0
    if initial == SEMANTIC:
        require_classes(config)
        config = update(config, {"semantics": {"first_guess": True}})
        start = Result(T0, INITIAL, NOMINAL)
    recalibrator = Recalibrator(source.camera, start, config, source.camera_frame, source.lidar_frame)
    # The recalibrator looks at the cloud before; where frames are left out, that has to be read for it.
    if any(b != a + 1 for a, b in pairwise(positions)):
        source = WithMotion(source, config.motion, note)
    with progress_bar("replaying") as step:
        for k, i in enumerate(positions):
            frame = None
            try:
                frame = source[i]
                if recalibrator.ingest(frame) and recalibrator.looks:
                    for problem in recalibrator.look():
                        note(problem)
            except CalibrationError as error:
                note(f"frame {frame.name if frame is not None else f'at position {i}'}: {error}")
                continue
            step(k + 1, len(positions))
            if recalibrator.ready():
                extrinsic = recalibrator.estimate()
                result = extrinsic.result
                if source.reference is not None:
                    result = replace(result, reference_error=error_against(source.reference, result.T_camera_lidar))
                yield {
                    "frame": frame.name,
                    "frame_stamp": frame.stamp,
                    "keyframes": len(recalibrator.buffer),
                    "drift": extrinsic.drift,
                    **result.to_dict(),
                }
    if recalibrator.motion.missing:
        note(recalibrator.motion.missing)
