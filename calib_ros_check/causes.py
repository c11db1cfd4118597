"""Findings about clocks, intrinsics and what may be mixed up: found, excluded, or not judged, and why."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial

import numpy as np

from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.config import MotionConfig
from calib_ros.config.sensors import ESTIMATE
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.judgement.hypotheses import MIXED_UP, Hypothesis, distorts
from calib_ros.registration.judgement.lens import LensEstimate
from calib_ros.registration.judgement.refusal import Refusal, stamped
from calib_ros.result import Cause, RefusalCode, Result
from calib_ros_check.outcome import CauseFinding, CauseState, Tolerance

OF_CAMERAS = (Cause.FOCAL_LENGTH, Cause.PRINCIPAL_POINT, Cause.OTHER_CAMERA, Cause.NOT_RECTIFIED, Cause.ALREADY_RECTIFIED)
OTHER_FITS = "another cause fits better"
AS_GIVEN = "the extrinsic matches as it is given"
OFF = "turned or shifted, the extrinsic matches"
SIGNIFICANT_SIGMAS = 3.0  # of an offset of the clocks: a right extrinsic must hardly ever fail by one
REPORTED_SIGMAS = 2.0  # of the interval in a message
PARAMETER_PENALTY = 3.0  # log-likelihood that one more unknown costs: about as many values can be told apart
UNKNOWN_MOTION = "the vehicle's motion is unknown; use frames in which it stands, or give stamps and point times, or odometry"
KNOW_CLOCKS = "drive at changing speeds and through turns, or state motion.time_offset_s with motion.time_offset: fixed"


def clock_finding(
    features: Sequence[FrameFeatures], result: Result, seconds: float, tolerance: Tolerance, config: MotionConfig
) -> CauseFinding:
    """Are the clocks right? They are not where their offset moves points by more than the tolerance in any frame.

    seconds: offset that was found, as a change of motion.time_offset_s.
    """
    cause, finding = Cause.TIME_OFFSET, partial(CauseFinding, Cause.TIME_OFFSET)
    mended = f"{stamped(seconds)}; motion.time_offset_s would be {config.time_offset_s + seconds:.4g}"
    ms = f"{1000 * abs(seconds):.0f} ms"
    if result.refusal is RefusalCode.WRONG_TIMES:
        return finding(CauseState.FOUND, f"{cause}; by about {ms}: {mended}", {"seconds": seconds})
    if result.time_offset_s is None or result.time_offset_sigma_s is None:
        if config.time_offset != ESTIMATE:
            return finding(CauseState.NOT_JUDGED, "the clocks are taken as stated (motion.time_offset: fixed)")
        why = ("all frames move alike" if len(features) > 1 else "one frame does not tell") + f"; {KNOW_CLOCKS}"
        why = why if any(f.twist is not None for f in features) else UNKNOWN_MOTION
        return finding(CauseState.NOT_JUDGED, f"the offset of the clocks is not known: {why}")
    sigma = result.time_offset_sigma_s
    values = {"seconds": seconds, "sigma_s": sigma}
    twists = np.array([f.twist for f in features if f.twist is not None])
    turn = float(np.linalg.norm(twists[:, :3], axis=1).max()) * abs(seconds)
    shift = float(np.linalg.norm(twists[:, 3:], axis=1).max()) * abs(seconds)
    if abs(seconds) > SIGNIFICANT_SIGMAS * sigma and (np.rad2deg(turn) > tolerance.deg or shift > tolerance.m):
        moves = f"points are off by up to {np.rad2deg(turn):.1f} deg and {100 * shift:.0f} cm"
        interval = f"(+- {1000 * REPORTED_SIGMAS * sigma:.0f} ms)"
        return finding(CauseState.FOUND, f"{cause}; by {ms} {interval}, so that {moves}: {mended}", values)
    agree = f"the clocks agree: offset {1000 * seconds:+.1f} ms +- {1000 * REPORTED_SIGMAS * sigma:.1f} ms"
    return finding(CauseState.EXCLUDED, agree, values)


def findings(causes: Iterable[Cause], state: CauseState, message: str) -> tuple[CauseFinding, ...]:
    """The same about several causes."""
    return tuple(CauseFinding(cause, state, message) for cause in causes)


def lens_findings(lens: LensEstimate | None, fault: Refusal | None, why_not: str, camera: Camera) -> tuple[CauseFinding, ...]:
    """Do focal length, principal point and distortion fit? lens: None = not judged, and why_not. camera: as it is claimed."""
    if lens is None:
        return findings(of_cameras(camera), CauseState.NOT_JUDGED, why_not)
    if fault is None:
        return findings(of_cameras(camera), CauseState.EXCLUDED, "no other camera matches clearly better")
    return instead(_lens_finding(fault, CauseState.FOUND, str(fault)), of_cameras(camera))


def _lens_finding(fault: Refusal, state: CauseState, message: str) -> CauseFinding:
    names = {"focal": "focal", "aspect": "aspect", "u": "u_px", "v": "v_px"}
    values = {names[name]: value for name, value in fault.figures.items() if name in names}
    assert fault.cause is not None
    return CauseFinding(fault.cause, state, message, values | {"barrel": -fault.figures.get("radial", 0.0)})


def explained(hypothesis: Hypothesis, camera: Camera) -> tuple[CauseFinding, ...]:
    """That a hypothesis holds, and excludes the others. What was mixed up is mended before clocks and intrinsics are judged."""
    own = CauseFinding(hypothesis.cause, CauseState.FOUND, hypothesis.message)
    if hypothesis.of_lens:
        return (*instead(own, of_cameras(camera)), *findings(MIXED_UP, CauseState.EXCLUDED, OTHER_FITS))
    return instead(own, MIXED_UP)


def instead(found: CauseFinding, causes: Iterable[Cause]) -> tuple[CauseFinding, ...]:
    """What was found, and that it excludes the others of these causes."""
    return (found, *findings((cause for cause in causes if cause is not found.cause), CauseState.EXCLUDED, OTHER_FITS))


def of_cameras(camera: Camera) -> tuple[Cause, ...]:
    """The causes that lie in a camera."""
    return tuple(cause for cause in possible_causes(camera) if cause in OF_CAMERAS)


def possible_causes(camera: Camera) -> tuple[Cause, ...]:
    """All causes that such a camera may have."""
    return tuple(cause for cause in Cause if cause is not Cause.ALREADY_RECTIFIED or distorts(camera))


def lens_for_mount(lens: LensEstimate, T: Transform, tolerance: Tolerance, camera: Camera) -> CauseFinding | None:
    """A lens that takes the place of an error of the extrinsic T (4, 4), which the frames do not tell apart: off as lenses are,
    or by its principal point, however far. camera: as it is claimed."""
    change, T_instead = lens.expected
    if not tolerance.covers(T, T_instead) and lens.instead is not None:
        change, T_instead, loss = lens.instead
        if loss > PARAMETER_PENALTY:
            return None
    if not tolerance.covers(T, T_instead):
        return None
    effects = lens.moves * change / np.repeat([np.deg2rad(tolerance.deg), tolerance.m], 3)[:, None]
    other = lens.wrong(int(np.linalg.norm(effects, axis=0).argmax()), change, camera)
    return _lens_finding(other, CauseState.POSSIBLE, other.told)


def complete(judged: Sequence[CauseFinding], camera: Camera) -> tuple[CauseFinding, ...]:
    """The findings, and that all other causes that such a camera may have were not judged."""
    known = {finding.cause for finding in judged}
    rest = (cause for cause in possible_causes(camera) if cause not in known)
    return (*judged, *findings(rest, CauseState.NOT_JUDGED, "to be judged when what was found is mended"))
