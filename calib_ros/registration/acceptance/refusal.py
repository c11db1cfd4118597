"""Why an estimate is refused, as typed values, and the texts for people: reasons and notes of a Result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import ClassVar

from calib_ros.registration.covariance import Direction
from calib_ros.result import RefusalCode

# What a Result notes whether or not it is refused.
NO_INTENSITY = "the cloud has no intensity: reflectivity edges are off"
ONE_FRAME = "one frame only: a direction that it does not show may be wrong; use more scenes"


@dataclass(frozen=True)
class Refusal:
    """Why an optimum is not to be used. Kinds differ in their code and in the figures they carry; str() is the message."""

    code: ClassVar[RefusalCode]

    @property
    def figures(self) -> dict[str, float]:
        """Its numbers, by name."""
        values = {own.name: getattr(self, own.name) for own in fields(self)}
        return {name: float(value) for name, value in values.items() if isinstance(value, (int, float))}


@dataclass(frozen=True)
class WorseThanStart(Refusal):
    """The optimum scores less than the initial extrinsic."""

    code = RefusalCode.WORSE_THAN_START
    score: float
    initial_score: float

    def __str__(self) -> str:
        return f"no better extrinsic found: score {self.score:.3f} against {self.initial_score:.3f} at the start"


@dataclass(frozen=True)
class TooFarFromStart(Refusal):
    """The optimum lies farther from the initial extrinsic than the search was meant to reach; deg and m."""

    code = RefusalCode.TOO_FAR_FROM_START
    rotation_deg: float
    translation_m: float
    max_rotation_deg: float
    max_translation_m: float

    def __str__(self) -> str:
        return (
            f"the score still rises {self.rotation_deg:.1f} deg / {self.translation_m:.2f} m away from the start, at the limit "
            f"of {self.max_rotation_deg:g} deg / {self.max_translation_m:g} m per axis; widen the search"
        )


@dataclass(frozen=True)
class LowScore(Refusal):
    """The score is no better than that of the mean of the edge maps."""

    code = RefusalCode.LOW_SCORE
    score: float

    def __str__(self) -> str:
        return (
            f"the score is {self.score:.2f}: the image shows nothing where the LiDAR sees edges; "
            "check exposure, lens, topics and time stamps"
        )


@dataclass(frozen=True)
class NotSignificant(Refusal):
    """The optimum is no better than chance alignments are. inconsistent: the classes of points and pixels disagree there too."""

    code = RefusalCode.NOT_SIGNIFICANT
    z_score: float
    decoy_z: float
    p_value: float
    largest: float
    inconsistent: bool = False

    def __str__(self) -> str:
        classes = " and few labelled points meet pixels of their class there" if self.inconsistent else ""
        return (
            f"the optimum may be chance: its z-score is {self.z_score:.1f}, a mirrored image reaches {self.decoy_z:.1f} "
            f"(p = {self.p_value:.2g}, at most {self.largest:.2g} is accepted){classes}; use more scenes, widen the search, or "
            "check intrinsics, topics and time stamps"
        )


@dataclass(frozen=True)
class TooUncertain(Refusal):
    """The scenes do not determine the extrinsic to within the tolerance. directions: those they leave open."""

    code = RefusalCode.TOO_UNCERTAIN
    directions: tuple[Direction, ...]
    tolerance_deg: float
    tolerance_m: float

    def __str__(self) -> str:
        directions = ", ".join(map(str, self.directions[:2]))  # the least known ones
        return (
            f"not known to within {self.tolerance_deg:g} deg / {100 * self.tolerance_m:g} cm: {directions} (standard "
            "deviations); add frames of other scenes, or start from a known extrinsic and refine it"
        )


@dataclass(frozen=True)
class LeftOpen(Refusal):
    """The scenes leave open whether something that was given is so wrong that the extrinsic is off by more than the tolerance.

    what: its name with the unit. value: what the scenes show of it, with its standard deviation. probability: of being so wrong.
    """

    code = RefusalCode.TOO_UNCERTAIN
    what: str
    value: float
    sigma: float
    probability: float
    tolerance_deg: float
    tolerance_m: float

    def __str__(self) -> str:
        return (
            f"not known to within {self.tolerance_deg:g} deg / {100 * self.tolerance_m:g} cm: the scenes show a change of "
            f"{self.what} of {self.value:.2g} +- {self.sigma:.2g}, and leave open whether it is that wrong (probability "
            f"{self.probability:.0%}); add frames of other scenes, or check K and D in camera_info and the clocks"
        )


@dataclass(frozen=True)
class ObjectivesDisagree(Refusal):
    """The fast objective, started at the optimum of eq. 3.12, ends elsewhere; deg and m."""

    code = RefusalCode.OBJECTIVES_DISAGREE
    rotation_deg: float
    translation_m: float

    def __str__(self) -> str:
        return (
            f"the optimum of eq. 3.12 lies {self.rotation_deg:.1f} deg / {self.translation_m:.2f} m from that of the fast form, "
            "which begins there: use more scenes, start nearer, or take refine.objective: fast"
        )


@dataclass(frozen=True)
class WrongIntrinsics(Refusal):
    """Another focal length or principal point matches better. focal: share of the focal length; u, v: px of the recorded image;
    deviations: how far it is off, in standard deviations of the scenes and of what is known in advance together."""

    code = RefusalCode.WRONG_INTRINSICS
    focal: float
    u: float
    v: float
    deviations: float

    def __str__(self) -> str:
        if self.focal:
            what = f"with a focal length about {abs(self.focal):.1%} {'longer' if self.focal > 0 else 'shorter'}"
        elif self.u:
            what = f"with the principal point about {abs(self.u):.0f} px further to the {'right' if self.u > 0 else 'left'}"
        else:
            what = f"with the principal point about {abs(self.v):.0f} px further {'down' if self.v > 0 else 'up'}"
        return (
            f"wrong intrinsics: the scenes match better {what} ({self.deviations:.1f} standard deviations); check K and D "
            "in camera_info, the image size they are for, and image_is_rectified"
        )


@dataclass(frozen=True)
class WrongTimes(Refusal):
    """The scenes match better with the points measured at other times. seconds: what motion.time_offset_s lacks; deviations:
    how far that is from what is configured, in standard deviations."""

    code = RefusalCode.WRONG_TIMES
    seconds: float
    deviations: float

    def __str__(self) -> str:
        late = "images are stamped late" if self.seconds > 0 else "images are stamped early"
        return (
            f"wrong times: the scenes match clearly better with the clocks set {1000 * abs(self.seconds):.0f} ms apart "
            f"({self.deviations:.1f} standard deviations): {late}, or the scans the other way; synchronise the clocks, or add "
            f"{self.seconds:g} to motion.time_offset_s"
        )


def outliers_note(names: Sequence[str]) -> str:
    """Which frames were rejected as outliers."""
    return (
        f"left out, matching no better than chance where the others match: {', '.join(names)}; wrongly paired, a covered lens, "
        "or a scene that shows nothing"
    )


def unobservable_note(directions: Sequence[Direction]) -> str:
    """Which directions of the start were kept."""
    return f"not shown by the scenes, and kept from the start: {', '.join(map(str, directions))}"


def semantic_note(with_classes: int, frames: int, tried: int) -> str:
    """How a first guess from the classes came about."""
    return f"first guess from the classes of {with_classes} of {frames} frames; registered from {tried} of its hypotheses"


def joined(parts: Sequence[str]) -> str:
    """Reasons and notes in one line, without the empty ones."""
    return "; ".join(part for part in parts if part)
