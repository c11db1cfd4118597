"""What a check finds: verdicts, the size of the error along every axis, and causes other than the mount."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from datetime import datetime, timezone
from enum import Enum
from typing import Any

from calib_ros import se3
from calib_ros.arrays import Covariance, Transform
from calib_ros.errors import BadInputError
from calib_ros.io import AsJson
from calib_ros.result import VERSION, Cause


class CheckVerdict(Enum):
    """Whether an extrinsic is right to within a tolerance."""

    PASS = "pass"
    FAIL = "fail"
    INCONCLUSIVE = "inconclusive"  # the scenes do not tell


class CauseState(Enum):
    """What is known of a cause."""

    FOUND = "found"
    POSSIBLE = "possible"  # it explains the frames as well as an error of the extrinsic does
    EXCLUDED = "excluded"
    NOT_JUDGED = "not_judged"  # the scenes do not tell


@dataclass(frozen=True)
class Tolerance:
    """The error up to which an extrinsic is right: of its rotation, deg, and of its translation, m (eq. 2.19).
    Raises BadInputError for values that are not positive."""

    deg: float = 0.5
    m: float = 0.1

    def __post_init__(self) -> None:
        for part, value, most, unit in (("rotation", self.deg, 90.0, "deg"), ("translation", self.m, 10.0, "m")):
            if not 0 < value <= most:
                raise BadInputError(f"the tolerance of the {part}, {value:g} {unit}, is out of range (0, {most:g}] {unit}")

    def __str__(self) -> str:
        return f"{self.deg:g} deg / {100 * self.m:g} cm"

    def covers(self, T: Transform, T_other: Transform) -> bool:
        """Whether two extrinsics (4, 4) are the same to within the tolerance."""
        return se3.rotation_error_deg(T, T_other) <= self.deg and se3.translation_error_m(T, T_other) <= self.m


@dataclass(frozen=True)
class Deviation:
    """An error of the extrinsic, along an axis or in all.

    error: its median; low and high: where it lies with 95 %, and where the estimate alone has it; deg, or m. NaN where nothing is
    known. words: for people.
    """

    name: str
    verdict: CheckVerdict
    error: float = math.nan
    low: float = math.nan
    high: float = math.nan
    words: str = ""

    @property
    def is_known(self) -> bool:
        """Whether the scenes tell it."""
        return math.isfinite(self.error)

    @property
    def is_off(self) -> bool:
        """Whether the scenes tell on which side an axis is off."""
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class CauseFinding:
    """What is known of a cause other than the mount. values: what was found, by name and unit, as ``seconds`` or ``focal``.
    message: for people."""

    cause: Cause
    state: CauseState
    message: str
    values: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class CheckResult(AsJson):
    """Whether an extrinsic is right to within a tolerance.

    verdict: in all; fail where the extrinsic is off by more, or another cause was found. reason: one line for people, what was
    found, and what to do. T_checked, T_estimated: T_camera_lidar (4, 4) that was checked, and that the scenes show with any other
    cause mended; None where they show none. covariance: (6, 6) of a left perturbation (rx, ry, rz, tx, ty, tz) of the latter, rad
    and m, with the camera as it is stated; covariance_with_intrinsics: with what these leave open. shared_covariance: the part
    of both that other recordings of the same sensors have in common, as what the clocks leave open. p_within: probability that
    the extrinsic is within the tolerance; NaN where nothing is known. rotation, translation: in all, deg and m. axes: rx, ry, rz
    (deg) and tx, ty, tz (m), the rotation vector of R_checked R_true^T and t_checked - t_true, in the camera's axes (x right, y
    down, z forward). causes: all other causes that were considered.
    time_offset_s, time_offset_sigma_s: of the clocks, as motion.time_offset_s; None where the frames do not show it. z_score,
    p_value: of the match that the estimate rests on, see `Evidence`; NaN without one. frames_used: that the estimate rests on, of
    frame_names. notes: what else there is to know, for people. elapsed_s, cpu_s: time of the check. data_stamp: of the newest
    frame, ns, by the sensors' clock; 0 if unknown.
    """

    verdict: CheckVerdict
    reason: str
    tolerance: Tolerance
    T_checked: Transform
    T_estimated: Transform | None
    covariance: Covariance | None
    p_within: float
    rotation: Deviation
    translation: Deviation
    axes: tuple[Deviation, ...]
    causes: tuple[CauseFinding, ...] = ()
    covariance_with_intrinsics: Covariance | None = None
    shared_covariance: Covariance | None = None
    time_offset_s: float | None = None
    time_offset_sigma_s: float | None = None
    z_score: float = math.nan
    p_value: float = math.nan
    frames_used: int = 0
    frame_names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    camera_frame: str = "camera"
    lidar_frame: str = "lidar"
    elapsed_s: float = 0.0
    cpu_s: float = 0.0
    data_stamp: int = 0
    stamp: str = field(default_factory=lambda: datetime.now(timezone.utc).isoformat(timespec="milliseconds"))

    @property
    def cause(self) -> Cause | None:
        """The cause that was found, if it is not the mount."""
        return next((finding.cause for finding in self.causes if finding.state is CauseState.FOUND), None)

    def to_dict(self) -> dict[str, Any]:
        """The format of ``calib-ros check --json``, docs/check.md: plain values, None for what is not known."""
        values = {field.name: plain(getattr(self, field.name)) for field in fields(self)}
        values["frames"] = values.pop("frame_names")
        rounded = {name: round(values[name], 3) for name in ("elapsed_s", "cpu_s")}
        first = {"verdict": self.verdict.value, "reason": self.reason, "cause": plain(self.cause)}
        return first | values | rounded | {"version": VERSION}


def plain(value: Any) -> Any:
    """As JSON has it: numbers and arrays of numpy, enumerations and dataclasses too; None for a number that is not finite."""
    if isinstance(value, Enum):
        return value.value
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return {field.name: plain(getattr(value, field.name)) for field in fields(value)} if is_dataclass(value) else value
