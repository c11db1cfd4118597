"""Findings about clocks, intrinsics and what may be mixed up: found, excluded, or not judged, and why."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from calib_ros.camera import Camera
from calib_ros.config import MotionConfig
from calib_ros.config.sensors import ESTIMATE
from calib_ros.intrinsics import CENTRE as CENTRE_NAMES
from calib_ros.intrinsics import RADIAL
from calib_ros.registration.acceptance.refusal import AS_RAW
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.judgement.lens import LensEstimate, LensFault
from calib_ros.result import RefusalCode, Result
from calib_ros_check.outcome import Cause, CauseFinding, CauseState, Tolerance
from calib_ros_check.sensors import CENTRE, LensChange, LensFit, scaled

MIXED_UP = (Cause.INVERSE_TRANSFORM, Cause.BODY_FRAME, Cause.CLOUD_FRAME, Cause.MIRRORED_IMAGE, Cause.ROTATED_IMAGE)
OF_CAMERAS = (Cause.FOCAL_LENGTH, Cause.PRINCIPAL_POINT, Cause.OTHER_CAMERA, Cause.NOT_RECTIFIED, Cause.ALREADY_RECTIFIED)
OTHER_FITS = "another cause fits better"
AS_GIVEN = "the extrinsic matches as it is given"
OFF = "the extrinsic is off"
SIGNIFICANT_SIGMAS = 3.0  # of an offset of the clocks: a right extrinsic must hardly ever fail by one
REPORTED_SIGMAS = 2.0  # of the interval in a message
ALREADY_RECTIFIED = "the image is rectified already, but its CameraInfo has a distortion, which is removed a second time"
UNRECTIFIED_FISHEYE = (
    "the image is that of a fisheye, but its CameraInfo has no distortion; take the rectified topic, or give the model "
    "'equidistant' with its coefficients"
)
KNOW_CLOCKS = (
    "drive at changing speeds and through turns, or, if it is known, state motion.time_offset_s with motion.time_offset: fixed"
)
FISHEYE_AS_RECTIFIED = f"the image is that of a fisheye, but is taken for rectified; {AS_RAW}"
_INTRINSICS = "check K and D in camera_info, the image size they are for, and whether the topic is rectified"


def clock_finding(
    features: Sequence[FrameFeatures], result: Result, seconds: float, tolerance: Tolerance, config: MotionConfig
) -> CauseFinding:
    """Are the clocks right? They are not where their offset moves points by more than the tolerance in any frame.

    seconds: offset that was found, as a change of motion.time_offset_s.
    """
    cause = Cause.TIME_OFFSET
    late = "images are stamped late, or scans early" if seconds > 0 else "images are stamped early, or scans late"
    advice = f"synchronise the clocks, or set motion.time_offset_s to {config.time_offset_s + seconds:.4g}"
    ms = f"{1000 * abs(seconds):.0f} ms"
    if result.refusal is RefusalCode.WRONG_TIMES:
        return CauseFinding(cause, CauseState.FOUND, f"the clocks are about {ms} apart: {late}; {advice}", {"seconds": seconds})
    if result.time_offset_s is None or result.time_offset_sigma_s is None:
        if config.time_offset != ESTIMATE:
            return CauseFinding(cause, CauseState.NOT_JUDGED, "the clocks are taken as stated (motion.time_offset: fixed)")
        why = "all frames move alike, or their motion is not known" if len(features) > 1 else "one frame does not tell"
        message = f"the offset of the clocks is not known: {why}; {KNOW_CLOCKS}"
        return CauseFinding(cause, CauseState.NOT_JUDGED, message)
    sigma = result.time_offset_sigma_s
    values = {"seconds": seconds, "sigma_s": sigma}
    twists = np.array([f.twist for f in features if f.twist is not None])
    turn = float(np.linalg.norm(twists[:, :3], axis=1).max()) * abs(seconds)
    shift = float(np.linalg.norm(twists[:, 3:], axis=1).max()) * abs(seconds)
    if abs(seconds) > SIGNIFICANT_SIGMAS * sigma and (np.rad2deg(turn) > tolerance.deg or shift > tolerance.m):
        moves = f"points are off by up to {np.rad2deg(turn):.1f} deg and {100 * shift:.0f} cm"
        message = f"the clocks are {ms} apart (+- {1000 * REPORTED_SIGMAS * sigma:.0f} ms), so that {moves}: {late}; {advice}"
        return CauseFinding(cause, CauseState.FOUND, message, values)
    message = f"the clocks agree: offset {1000 * seconds:+.1f} ms +- {1000 * REPORTED_SIGMAS * sigma:.1f} ms"
    return CauseFinding(cause, CauseState.EXCLUDED, message, values)


def findings(causes: Iterable[Cause], state: CauseState, message: str) -> tuple[CauseFinding, ...]:
    """The same about several causes."""
    return tuple(CauseFinding(cause, state, message) for cause in causes)


def lens_findings(
    lens: LensEstimate | None, fault: LensFault | None, why_not: str, camera: Camera, tolerance: Tolerance
) -> tuple[CauseFinding, ...]:
    """Do focal length, principal point and distortion fit? lens: None = not judged, and why_not. camera: as it is claimed."""
    if lens is None:
        return findings(of_cameras(camera), CauseState.NOT_JUDGED, why_not)
    if fault is None:
        return findings(of_cameras(camera), CauseState.EXCLUDED, "no other camera matches clearly better")
    refusal = fault.refusal(camera, tolerance.deg, tolerance.m)
    main = lens.unknowns[fault.k].name
    cause = Cause.PRINCIPAL_POINT if main in CENTRE_NAMES else Cause.FOCAL_LENGTH
    if main == RADIAL:
        cause = Cause.ALREADY_RECTIFIED if fault.removes_distortion else Cause.NOT_RECTIFIED
    names = {"focal": "focal", "aspect": "aspect", "u": "u_px", "v": "v_px"}
    values = {names[name]: value for name, value in refusal.figures.items() if name in names}
    values["barrel"] = -refusal.figures.get("radial", 0.0)
    return instead(CauseFinding(cause, CauseState.FOUND, str(refusal), values), of_cameras(camera))


def changed_findings(fit: LensFit, camera: Camera) -> tuple[CauseFinding, ...]:
    """That the camera is quite another. camera: as it is claimed."""
    best, found = fit.hypothesis, cause_of(fit, camera)
    values = {"focal": best.focal, "u_px": best.u * camera.width, "v_px": best.v * camera.width, "barrel": best.barrel}
    better = f"{fit.deviations:.1f} standard deviations better"
    advice = AS_RAW if found is Cause.NOT_RECTIFIED and camera.said_rectified else _INTRINSICS
    message = f"{_lens_words(best, found, camera)} ({better}); {advice}"
    return instead(CauseFinding(found, CauseState.FOUND, message, values), of_cameras(camera))


def instead(found: CauseFinding, causes: Iterable[Cause]) -> tuple[CauseFinding, ...]:
    """What was found, and that it excludes the others of these causes."""
    return (found, *findings((cause for cause in causes if cause is not found.cause), CauseState.EXCLUDED, OTHER_FITS))


def of_cameras(camera: Camera) -> tuple[Cause, ...]:
    """The causes that lie in a camera."""
    return tuple(cause for cause in possible_causes(camera) if cause in OF_CAMERAS)


def possible_causes(camera: Camera) -> tuple[Cause, ...]:
    """All causes that such a camera may have."""
    return tuple(cause for cause in Cause if cause is not Cause.ALREADY_RECTIFIED or distorts(camera))


def focal_finding(share: float) -> CauseFinding:
    """A focal length that is longer by a share."""
    message = f"wrong intrinsics: the scenes match clearly better with {_focal_words(share)}; {_INTRINSICS}"
    return CauseFinding(Cause.FOCAL_LENGTH, CauseState.FOUND, message, {"focal": share})


def centre_finding(lens: LensChange, camera: Camera, state: CauseState) -> CauseFinding:
    """A principal point that was found, or explains the frames as well as a rotation does. camera: as it is claimed."""
    words = " and ".join(_centre_words(lens, camera))
    message = f"wrong intrinsics: the scenes match clearly better with {words}; {_INTRINSICS}"
    if state is CauseState.POSSIBLE:
        message = f"{words} explains the frames as well as the rotation: they do not tell the two apart"
    values = {"u_px": lens.u * camera.width, "v_px": lens.v * camera.width}
    return CauseFinding(Cause.PRINCIPAL_POINT, state, message, values)


def distorts(camera: Camera) -> bool:
    """Whether CameraInfo says that the image is distorted."""
    return not (camera.is_pinhole or camera.is_sphere)


def cause_of(fit: LensFit, camera: Camera) -> Cause:
    """Which cause a change of the camera speaks for: that without which most is lost."""
    lens, most = fit.hypothesis, max(fit.parts, key=lambda name: fit.parts[name])
    if most == "barrel":
        # A picture that was rectified twice is drawn out at its corners, if its lens draws them in.
        return Cause.ALREADY_RECTIFIED if distorts(camera) and lens.barrel * barrel_of(camera) < 0 else Cause.NOT_RECTIFIED
    if lens.focal and (lens.u or lens.v):
        return Cause.OTHER_CAMERA
    return Cause.FOCAL_LENGTH if lens.focal else Cause.PRINCIPAL_POINT


def barrel_of(camera: Camera) -> float:
    """How far the lens moves a corner of the image towards its centre, as a share of the radius; see `LensChange`."""
    corner = np.linalg.solve(camera.K, [camera.width - 1.0, camera.height - 1.0, 1.0])
    uv = camera.project(0.9 * np.array([[corner[0], corner[1], 0.0]]) + [0, 0, 1.0])[0][0]
    ideal = 0.9 * (np.array([camera.width - 1.0, camera.height - 1.0]) - camera.K[:2, 2])
    return float(1 - np.linalg.norm(uv - camera.K[:2, 2]) / np.linalg.norm(ideal)) if np.isfinite(uv).all() else 1.0


def _lens_words(lens: LensChange, cause: Cause | None, camera: Camera) -> str:
    if cause is Cause.ALREADY_RECTIFIED:
        return ALREADY_RECTIFIED
    if cause is Cause.NOT_RECTIFIED:
        way = "towards" if lens.barrel > 0 else "away from"
        corners = f"corners lie {abs(lens.barrel):.0%} of the radius {way} the centre"
        if camera.said_rectified:
            return f"the image is taken for rectified, but is raw: {corners}"
        return (
            f"the image shows a lens distortion that its CameraInfo does not have: {corners}; take the rectified topic, or the "
            "CameraInfo of the camera as it is"
        )
    parts = [_focal_words(lens.focal)] * bool(lens.focal) + _centre_words(lens, camera)
    other = ""
    if cause is Cause.OTHER_CAMERA:
        of_size = _fits_size(lens, camera)
        other = f"; CameraInfo is {of_another_size(1 + lens.focal)}" if of_size else "; CameraInfo may be of another camera"
    return f"wrong intrinsics: the scenes match clearly better with {' and '.join(parts)}{other}"


def _focal_words(share: float) -> str:
    return f"a focal length {abs(share):.1%} {'longer' if share > 0 else 'shorter'}"


def _centre_words(lens: LensChange, camera: Camera) -> list[str]:
    moved = ((lens.u, "right", "left"), (lens.v, "down", "up"))
    return [
        f"a principal point {abs(share) * camera.width:.0f} px further {more if share > 0 else less}"
        for share, more, less in moved
        if round(share * camera.width)
    ]


def of_another_size(scale: float) -> str:
    """What is wrong with intrinsics of an image that is smaller by this factor, in words."""
    times = f"{scale:.2g} times smaller" if scale > 1 else f"{1 / scale:.2g} times larger"
    return f"of an image {times}: scale fx, fy, cx and cy by {scale:.3g}"


def _fits_size(lens: LensChange, camera: Camera) -> bool:
    """Whether a change of the camera is that of intrinsics for another size of the same image."""
    same = scaled(camera, 1 + lens.focal)
    return abs(lens.focal) > CENTRE[-1] and max(abs(lens.u - same.u), abs(lens.v - same.v)) <= CENTRE[-1]


def not_mixed_up(why: str) -> tuple[CauseFinding, ...]:
    """Findings where nothing was mixed up. why: AS_GIVEN, OFF or OTHER_FITS."""
    return findings(MIXED_UP, CauseState.EXCLUDED, why)


def complete(judged: Sequence[CauseFinding], camera: Camera) -> tuple[CauseFinding, ...]:
    """The findings, and that all other causes that such a camera may have were not judged."""
    known = {finding.cause for finding in judged}
    rest = (cause for cause in possible_causes(camera) if cause not in known)
    return (*judged, *findings(rest, CauseState.NOT_JUDGED, "to be judged when what was found is mended"))
