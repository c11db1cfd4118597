"""Why an estimate is refused: the figures after the words of `calib_ros.result.Trouble`, and notes of a Result."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from calib_ros.camera import Camera
from calib_ros.intrinsics import ASPECT, CENTRE, FOCAL, RADIAL
from calib_ros.result import Cause, RefusalCode

# What a Result notes whether or not it is refused.
LEFT_OUT = (
    "left out, matching no better than chance where the others match: {}; wrongly paired, a covered lens, or a scene that shows "
    "nothing"
)
KEPT = "not shown by the scenes, and kept from the start: {}"
NO_INTENSITY = "the cloud has no intensity: reflectivity edges are off"
BUT_FOR_PRIOR = "which is too little for its distance from the start (constraints.sigma_deg, constraints.sigma_m)"
ONE_FRAME = "one frame only: a direction that it does not show may be wrong; use more scenes"
AS_RAW = "give --no-rectified, or image_is_rectified: false to the node"
# And where intrinsics may be at fault, of a Camera.said_rectified.
MAYBE_RAW = f"the images are taken for rectified, but camera_info has a distortion: if straight lines are bent in them, {AS_RAW}"
SIGNIFICANCE = 1e-3  # largest probability of a false refusal
GROSSLY = 0.01  # share of what is given that is plainly wrong, as the intrinsics of another image size are
OPEN_PROBABILITY = 0.1  # of being plainly wrong: a search must reach its tolerance with 90 %
USUAL_ASPECT, MIDDLE = 0.05, 0.25  # shares: fy and fx differ by less, and the principal point lies farther from every border
SUSPECT_INTRINSICS = (RefusalCode.WRONG_INTRINSICS, RefusalCode.NOT_SIGNIFICANT, RefusalCode.LOW_SCORE)


@dataclass(frozen=True)
class Refusal:
    """Why an optimum is not to be used. told: its figures, for people. figures: the same by name. cause: what is wrong, if that
    is known. str() is the message."""

    code: RefusalCode
    told: str
    figures: Mapping[str, float]
    cause: Cause | None = None

    def __str__(self) -> str:
        return joined([str(self.cause or self.code), self.told])


# The figures of a refusal, by their names.
TOLD = {
    RefusalCode.WORSE_THAN_START: "score {score:.3f} against {initial_score:.3f} at the start",
    RefusalCode.TOO_FAR_FROM_START: "the score still rises {rotation_deg:.1f} deg / {translation_m:.2f} m away from the start, "
    "at the limit of {max_rotation_deg:g} deg / {max_translation_m:g} m per axis",
    RefusalCode.LOW_SCORE: "widen the search if the start may be farther off",
    RefusalCode.NOT_SIGNIFICANT: "z-score {z_score:.1f}, {decoy_z:.1f} in a mirrored image (p = {p_value:.2g}, at most "
    "{largest:.2g} is accepted)",
    RefusalCode.TOO_UNCERTAIN: "not known to within {tolerance_deg:g} deg / {tolerance_m:g} m",
    RefusalCode.OBJECTIVES_DISAGREE: "the optimum of eq. 3.12 lies {rotation_deg:.1f} deg / {translation_m:.2f} m from that of "
    "the fast form",
}


def refused(code: RefusalCode, told: str = "", cause: Cause | None = None, /, **figures: float) -> Refusal:
    """A refusal. told: for people, beside what TOLD says of the figures."""
    given = {name: float(value) for name, value in figures.items()}
    return Refusal(code, joined([TOLD.get(code, "").format(**given), told]), given, cause)


def left_open(what: str, value: float, sigma: float, probability: float, tolerance_deg: float, tolerance_m: float) -> Refusal:
    """The scenes leave open whether something that was given is so wrong that the extrinsic is off by more than the tolerance.

    what: its name with the unit. value: what the scenes show of it, with its standard deviation, infinite where they show
    nothing. probability: of being so wrong.
    """
    shown = f"show a change of {what} of {value:.2g} +- {sigma:.2g}" if math.isfinite(sigma) else f"do not show {what}"
    told = f"the scenes {shown}, and leave open whether it is that wrong (probability {probability:.0%})"
    figures = {"value": value, "sigma": sigma, "probability": probability}
    figures |= {"tolerance_deg": tolerance_deg, "tolerance_m": tolerance_m}
    return refused(RefusalCode.TOO_UNCERTAIN, f"{told}; or check K and D in camera_info, and the clocks", **figures)


def wrong_intrinsics(main: str, values: Mapping[str, float], camera: Camera, removed: bool, deviations: float) -> Refusal:
    """Another lens matches better. main: which of the values, by their names, matters most: shares of the focal length, the
    aspect, the image width and the corner's radius. camera: as it is stated; removed: hardly any of its distortion is seen.
    deviations: how far `main` is off, in standard deviations of the scenes and of what is known in advance together."""
    value, width = values[main], camera.width
    size = f"about {abs(value):.1%} {'longer' if value > 0 else 'shorter'}"
    moved = f"the principal point about {abs(width * value):.3g} px further"
    missing = "that camera_info does not state" if camera.is_pinhole else "other than camera_info states"
    cause, what = {
        FOCAL: (Cause.FOCAL_LENGTH, f"a focal length {size}"),
        ASPECT: (Cause.FOCAL_LENGTH, f"fy {size} against fx"),
        CENTRE[0]: (Cause.PRINCIPAL_POINT, f"{moved} to the {'right' if value > 0 else 'left'}"),
        CENTRE[1]: (Cause.PRINCIPAL_POINT, f"{moved} {'down' if value > 0 else 'up'}"),
        RADIAL: (Cause.NOT_RECTIFIED, f"a lens distortion {missing}, which moves the corners by {value:+.1%} of their radius"),
    }[main]
    if main == RADIAL and removed:
        cause, what = Cause.ALREADY_RECTIFIED, "none of the distortion of camera_info, as if the images were rectified already"
    told = f"the scenes match better with {what} ({deviations:.1f} standard deviations)"
    told = joined([told, AS_RAW if cause is Cause.NOT_RECTIFIED and camera.said_rectified else ""])
    units = {FOCAL: ("focal", 1), ASPECT: ("aspect", 1), CENTRE[0]: ("u", width), CENTRE[1]: ("v", width), RADIAL: ("radial", 1)}
    figures = {units[name][0]: units[name][1] * value for name, value in values.items()}
    return refused(RefusalCode.WRONG_INTRINSICS, told, cause, **figures, deviations=deviations)


def wrong_times(seconds: float, deviations: float) -> Refusal:
    """The scenes match better with the points measured at other times. seconds: what motion.time_offset_s lacks; deviations:
    how far that is from what is configured, in standard deviations."""
    apart = f"{1000 * abs(seconds):.0f} ms apart"
    match = f"the best match is with the clocks {apart}, which the scenes do not confirm"
    if deviations >= 1:
        match = f"the scenes match clearly better with the clocks {apart} ({deviations:.1f} standard deviations)"
    told = f"{match}: {stamped(seconds)}; add {seconds:.3g} to motion.time_offset_s"
    return refused(RefusalCode.WRONG_TIMES, told, Cause.TIME_OFFSET, seconds=seconds, deviations=deviations)


def stamped(seconds: float) -> str:
    """What an offset of the clocks means, as motion.time_offset_s."""
    return "images are stamped late, or scans early" if seconds > 0 else "images are stamped early, or scans late"


def odd_intrinsics(camera: Camera) -> list[str]:
    """What is unusual of stated intrinsics, whether or not anything is refused."""
    (fx, _, cx), (_, fy, cy) = camera.K[:2].tolist()
    out = [f"fx and fy differ by {abs(fy / fx - 1):.0%}"] if abs(fy / fx - 1) > USUAL_ASPECT else []
    shares = cx / camera.width, cy / camera.height
    if not all(MIDDLE <= share <= 1 - MIDDLE for share in shares):
        out.append(f"the principal point lies at {shares[0]:.0%} of the image's width and {shares[1]:.0%} of its height")
    return [f"{' and '.join(out)}: check that K in camera_info is of this image"] if out else []


def joined(parts: Sequence[str]) -> str:
    """Reasons and notes in one line, without the empty ones; see `lines_of`."""
    return "; ".join(part for part in parts if part)


def lines_of(reason: str) -> list[str]:
    """A reason in lines, for terminal and pages."""
    return [part for part in reason.split("; ") if part]
