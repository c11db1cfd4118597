"""Is it the mount that moved, or the camera's clock? A late image shifts everything by the vehicle's own motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import TooFewFeaturesError
from calib_ros.lidar.deskew import moved
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.fast_score import FastScore
from calib_ros.registration.features import Features
from calib_ros.registration.frame_features import FrameFeatures
from calib_ros.registration.thesis_features import ThesisFeatures

Matrix = NDArray[np.float64]
OFFSETS = np.round(np.arange(-0.2, 0.2001, 0.01), 2)  # s; beyond, nobody would pair the two
LEAST_S = 0.02  # a smaller offset is none: cameras are triggered to some milliseconds
FASTER = np.array([np.deg2rad(2.0)] * 3 + [1.0] * 3)  # rad/s, m/s; a slower vehicle does not tell
EXPLAINS = 0.9  # of the score that a moved mount reaches with six parameters, by the offset alone


@dataclass(frozen=True)
class Lateness:
    """How late the images are against the scans, s (negative: early), and the score with that, and without.

    offset_s: motion.time_offset_s that was allowed for already, s.
    """

    seconds: float
    score: float
    without: float
    offset_s: float = 0.0


def lateness(calibrator: Calibrator, keyframes: Sequence[Features], T: Matrix) -> Lateness | None:
    """The time offset with which the keyframes fit T (4, 4) best. None if the vehicle moves in none, or its motion is unknown.

    Keyframes at rest take part: they fit at any offset, and a vehicle that stops behind a late camera has not been knocked.
    At time tau after the image's moment a point that stands still is at exp(twist tau)^-1 of where it was, for all points alike.
    """
    own = [f.fast if isinstance(f, ThesisFeatures) else f for f in keyframes]
    twists = [f.twist for f in own if f.twist is not None]
    if len(twists) < len(own) or not (np.abs(twists) >= FASTER).any():
        return None
    try:
        config, atlas = calibrator.config, calibrator.match(own, T).score.atlas  # the images stay as they are
        scores = [FastScore([_shifted(f, float(s)) for f in own], T, config.score, atlas=atlas).at(-1).value(T) for s in OFFSETS]
    except TooFewFeaturesError:
        return None
    best = int(np.argmax(scores))
    return Lateness(float(OFFSETS[best]), scores[best], scores[int(np.argmin(np.abs(OFFSETS)))], config.motion.time_offset_s)


def explained(found: Lateness | None, score: float) -> str:
    """In words, if the offset fits the keyframes as well as a moved mount would, which reaches `score`; else empty."""
    if found is None or abs(found.seconds) < LEAST_S or found.score < EXPLAINS * score:
        return ""
    late = "late" if found.seconds > 0 else "early"
    return (
        f"the images are {1000 * abs(found.seconds):.0f} ms {late} against the scans (that alone explains the difference): "
        f"synchronise the clocks, or set motion.time_offset_s to {found.offset_s + found.seconds:.3g}"
    )


def _shifted(frame: FrameFeatures, seconds: float) -> FrameFeatures:
    assert frame.twist is not None
    xyz = moved(frame.points.xyz, frame.twist, np.full(len(frame.points), seconds)).astype(np.float32)
    return replace(frame, points=replace(frame.points, xyz=xyz))
