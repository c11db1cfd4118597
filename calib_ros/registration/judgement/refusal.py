"""Why an estimate is refused, and the texts for people: reasons and notes of a Result."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from calib_ros.camera import Camera
from calib_ros.intrinsics import ASPECT, CENTRE, FOCAL, RADIAL
from calib_ros.registration.covariance import Direction
from calib_ros.result import Cause, RefusalCode

# What a Result notes whether or not it is refused.
LEFT_OUT = (
    "left out, matching no better than chance where the others match: {}; wrongly paired, a covered lens, or a scene that shows "
    "nothing"
)
KEPT = "not shown by the scenes, and kept from the start: {}"
NO_INTENSITY = "the cloud has no intensity: reflectivity edges are off"
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
    """Why an optimum is not to be used. figures: its numbers, by name. cause: what is wrong, if that is known. str() is the
    message."""

    code: RefusalCode
    text: str
    figures: Mapping[str, float]
    cause: Cause | None = None

    def __str__(self) -> str:
        return self.text


def _refusal(code: RefusalCode, text: str, cause: Cause | None = None, /, **figures: float) -> Refusal:
    return Refusal(code, text, {name: float(value) for name, value in figures.items()}, cause)


def worse_than_start(score: float, initial_score: float) -> Refusal:
    """The optimum scores less than the initial extrinsic."""
    text = f"no better extrinsic found: score {score:.3f} against {initial_score:.3f} at the start"
    if score >= initial_score:  # but for the prior
        text += " is too little for its distance from the start (constraints.sigma_deg, constraints.sigma_m)"
    return _refusal(RefusalCode.WORSE_THAN_START, text, score=score, initial_score=initial_score)


def too_far_from_start(rotation_deg: float, translation_m: float, max_rotation_deg: float, max_translation_m: float) -> Refusal:
    """The optimum lies farther from the initial extrinsic than the search was meant to reach."""
    text = (
        f"the score still rises {rotation_deg:.1f} deg / {translation_m:.2f} m away from the start, at the limit "
        f"of {max_rotation_deg:g} deg / {max_translation_m:g} m per axis; widen the search"
    )
    limits = {"max_rotation_deg": max_rotation_deg, "max_translation_m": max_translation_m}
    return _refusal(RefusalCode.TOO_FAR_FROM_START, text, rotation_deg=rotation_deg, translation_m=translation_m, **limits)


def low_score(score: float) -> Refusal:
    """The score is no better than that of the mean of the edge maps; NaN where there is none."""
    figure = f" (score {score:.2g})" if math.isfinite(score) else ""
    text = (
        f"the image shows nothing where the LiDAR sees edges{figure}; check exposure, lens, topics and time stamps, or widen the "
        "search if the start may be farther off"
    )
    return _refusal(RefusalCode.LOW_SCORE, text, score=score)


def not_significant(z_score: float, decoy_z: float, p_value: float, largest: float, inconsistent: bool) -> Refusal:
    """The optimum is no better than chance alignments are. inconsistent: the classes of points and pixels disagree there too."""
    classes = " and few labelled points meet pixels of their class there" if inconsistent else ""
    text = (
        f"the optimum may be chance: its z-score is {z_score:.1f}, a mirrored image reaches {decoy_z:.1f} "
        f"(p = {p_value:.2g}, at most {largest:.2g} is accepted){classes}; use more scenes, widen the search, or "
        "check intrinsics, topics and time stamps"
    )
    figures = {"z_score": z_score, "decoy_z": decoy_z, "p_value": p_value, "largest": largest, "inconsistent": inconsistent}
    return _refusal(RefusalCode.NOT_SIGNIFICANT, text, **figures)


def too_uncertain(directions: Sequence[Direction], tolerance_deg: float, tolerance_m: float) -> Refusal:
    """The scenes do not determine the extrinsic to within the tolerance. directions: those they leave open."""
    text = (
        f"not known to within {tolerance_deg:g} deg / {100 * tolerance_m:g} cm: {', '.join(map(str, directions[:2]))} (standard "
        "deviations); add frames of other scenes, widen the search if the start may be farther off, or refine a known extrinsic"
    )
    return _refusal(RefusalCode.TOO_UNCERTAIN, text, tolerance_deg=tolerance_deg, tolerance_m=tolerance_m)


def left_open(what: str, value: float, sigma: float, probability: float, tolerance_deg: float, tolerance_m: float) -> Refusal:
    """The scenes leave open whether something that was given is so wrong that the extrinsic is off by more than the tolerance.

    what: its name with the unit. value: what the scenes show of it, with its standard deviation, infinite where they show
    nothing. probability: of being so wrong.
    """
    shown = f"show a change of {what} of {value:.2g} +- {sigma:.2g}" if math.isfinite(sigma) else f"do not show {what}"
    text = (
        f"not known to within {tolerance_deg:g} deg / {100 * tolerance_m:g} cm: the scenes {shown}, and leave open whether it is "
        f"that wrong (probability {probability:.0%}); add frames of other scenes, or check K and D in camera_info and the clocks"
    )
    figures = {"value": value, "sigma": sigma, "probability": probability}
    return _refusal(RefusalCode.TOO_UNCERTAIN, text, **figures, tolerance_deg=tolerance_deg, tolerance_m=tolerance_m)


def objectives_disagree(rotation_deg: float, translation_m: float) -> Refusal:
    """The fast objective, started at the optimum of eq. 3.12, ends elsewhere."""
    text = (
        f"the optimum of eq. 3.12 lies {rotation_deg:.1f} deg / {translation_m:.2f} m from that of the fast form, "
        "which begins there: use more scenes, start nearer, or take refine.objective: fast"
    )
    return _refusal(RefusalCode.OBJECTIVES_DISAGREE, text, rotation_deg=rotation_deg, translation_m=translation_m)


def wrong_intrinsics(main: str, values: Mapping[str, float], camera: Camera, removed: bool, deviations: float) -> Refusal:
    """Another lens matches better. main: which of the values, by their names, matters most: shares of the focal length, the
    aspect, the image width and the corner's radius. camera: as it is stated; removed: hardly any of its distortion is seen.
    deviations: how far `main` is off, in standard deviations of the scenes and of what is known in advance together."""
    value, width = values[main], camera.width
    cure = "check K and D in camera_info, the image size they are for, and image_is_rectified (--rectified)"
    cause, plus = Cause.PRINCIPAL_POINT if main in CENTRE else Cause.FOCAL_LENGTH, value > 0
    if main in (FOCAL, ASPECT):
        of, than = ("a focal length", "") if main == FOCAL else ("fy", " against fx")
        what = f"with {of} about {abs(value):.1%} {'longer' if plus else 'shorter'}{than}"
    elif main in CENTRE:
        where = ("to the right" if plus else "to the left") if main == CENTRE[0] else ("down" if plus else "up")
        what = f"with the principal point about {abs(width * value):.3g} px further {where}"
    elif removed:
        what = "without the lens distortion of camera_info, as if the images were rectified already"
        cure, cause = "set image_is_rectified (--rectified), or check D", Cause.ALREADY_RECTIFIED
    else:
        missing = "that camera_info does not state" if camera.is_pinhole else "other than camera_info states"
        cure, cause = AS_RAW if camera.said_rectified else cure, Cause.NOT_RECTIFIED
        what = f"with a lens distortion {missing}, which moves the corners of the image by {value:+.1%} of their radius"
    text = f"wrong intrinsics: the scenes match better {what} ({deviations:.1f} standard deviations); {cure}"
    units = {FOCAL: ("focal", 1), ASPECT: ("aspect", 1), CENTRE[0]: ("u", width), CENTRE[1]: ("v", width), RADIAL: ("radial", 1)}
    figures = {units[name][0]: units[name][1] * value for name, value in values.items()}
    return _refusal(RefusalCode.WRONG_INTRINSICS, text, cause, **figures, deviations=deviations)


def wrong_times(seconds: float, deviations: float) -> Refusal:
    """The scenes match better with the points measured at other times. seconds: what motion.time_offset_s lacks; deviations:
    how far that is from what is configured, in standard deviations."""
    late = "images are stamped late" if seconds > 0 else "images are stamped early"
    apart = f"with the clocks set {1000 * abs(seconds):.0f} ms apart"
    match = f"the best match is one {apart}, which the scenes do not confirm"
    if deviations >= 1:
        match = f"the scenes match clearly better {apart} ({deviations:.1f} standard deviations)"
    text = (
        f"wrong times: {match}: {late}, or the scans the other way; synchronise the clocks, or add {seconds:.3g} to "
        "motion.time_offset_s"
    )
    return _refusal(RefusalCode.WRONG_TIMES, text, Cause.TIME_OFFSET, seconds=seconds, deviations=deviations)


def odd_intrinsics(camera: Camera) -> list[str]:
    """What is unusual of stated intrinsics, whether or not anything is refused."""
    (fx, _, cx), (_, fy, cy) = camera.K[:2].tolist()
    out = [f"fx and fy differ by {abs(fy / fx - 1):.0%}"] if abs(fy / fx - 1) > USUAL_ASPECT else []
    shares = cx / camera.width, cy / camera.height
    if not all(MIDDLE <= share <= 1 - MIDDLE for share in shares):
        out.append(f"the principal point lies at {shares[0]:.0%} of the image's width and {shares[1]:.0%} of its height")
    return [f"{' and '.join(out)}: check that K in camera_info is of this image"] if out else []


def joined(parts: Sequence[str]) -> str:
    """Reasons and notes in one line, without the empty ones."""
    return "; ".join(part for part in parts if part)
