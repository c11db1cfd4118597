"""What the command line says of the extrinsic, and of the clocks, beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calib_ros.commands.axes import AXES, Three
from calib_ros.config import NO_LIMIT_DEG, NO_LIMIT_M, Config, update
from calib_ros.errors import BadInputError

_FREE = {axis: NO_LIMIT_DEG if axis[0] == "r" else NO_LIMIT_M for axis in AXES}


@dataclass(frozen=True)
class Knowledge:
    """Options of `calib-ros calibrate` and `replay`; None or empty = not said.

    rotation_only: the camera stays where it is in the LiDAR frame. fixed: names of AXES. bounds: axis and half width, deg or m.
    prior_deg, prior_m: standard deviations of the initial extrinsic. time_offset_s: see ``motion.time_offset_s``.
    """

    rotation_only: bool = False
    fixed: Sequence[str] = ()
    bounds: Sequence[tuple[str, float]] = ()
    prior_deg: Three | None = None
    prior_m: Three | None = None
    time_offset_s: float | None = None

    def limits(self) -> dict[str, float]:
        """Half width, deg or m, of every axis that is named. BadInputError if an axis is named twice, or beyond its range."""
        limits = dict.fromkeys(AXES[3:], (0.0, "--rotation-only")) if self.rotation_only else {}
        said = [(axis, 0.0, "--fix") for axis in self.fixed] + [(axis, half, "--bound") for axis, half in self.bounds]
        for axis, half, option in said:
            before, by = limits.get(axis, (half, option))
            if before != half:
                raise BadInputError(f"--bound {axis}={half:g} contradicts {_said(by, axis, before)}")
            if half > _FREE[axis]:
                raise BadInputError(f"--bound {axis}={half:g} is out of range [0, {_FREE[axis]:g}]")
            limits[axis] = (half, option)
        return {axis: half for axis, (half, _) in limits.items()}

    def applied(self, config: Config) -> Config:
        """The configuration with what is said here. BadInputError for what contradicts itself, or leaves nothing to estimate."""
        limits = self.limits()
        constraints = config.constraints
        half = dict(zip(AXES, (*constraints.limit_deg, *constraints.limit_m), strict=True)) | limits
        if not any(half.values()):
            raise BadInputError("all six axes are fixed: nothing is left to estimate")
        values: dict[str, object] = {
            "limit_deg": tuple(half[axis] for axis in AXES[:3]),
            "limit_m": tuple(half[axis] for axis in AXES[3:]),
        }
        for option, name, prior, axes in (
            ("--prior-deg", "sigma_deg", self.prior_deg, AXES[:3]),
            ("--prior-m", "sigma_m", self.prior_m, AXES[3:]),
        ):
            if prior is not None:
                self.check_fixed(option, prior, axes, "the standard deviation")
                values[name] = prior
        motion: dict[str, object] = {}
        if self.time_offset_s is not None:
            if config.motion.deskew == "off":
                raise BadInputError(
                    "--time-offset-ms has no effect with motion.deskew: off, which leaves all points where they are"
                )
            if not -0.5 <= self.time_offset_s <= 0.5:
                raise BadInputError(f"--time-offset-ms {1000 * self.time_offset_s:g} is out of range [-500, 500]")
            motion["time_offset_s"] = self.time_offset_s
        return update(config, {"constraints": values, "motion": motion})

    def check_search(self, search_deg: Three | None, search_m: Three | None) -> None:
        """BadInputError for a search along an axis that is fixed here."""
        for option, half, axes in (("--search-deg", search_deg, AXES[:3]), ("--search-m", search_m, AXES[3:])):
            if half is not None:
                self.check_fixed(option, half, axes, "the search")

    def check_fixed(self, option: str, values: Three, axes: Sequence[str], what: str) -> None:
        """BadInputError if a value that is not 0 belongs to an axis fixed here. One number for all axes means the free ones."""
        limits = self.limits()
        wrong = [axis for axis, value in zip(axes, values, strict=True) if value and limits.get(axis) == 0]
        if wrong and (len(wrong) == 3 or len(set(values)) > 1):
            verb = "is fixed" if len(wrong) == 1 else "are fixed"
            raise BadInputError(f"{option}: {', '.join(wrong)} {verb}, so {what} there must be 0")


def _said(option: str, axis: str, half: float) -> str:
    return {"--fix": f"--fix {axis}", "--bound": f"--bound {axis}={half:g}"}.get(option, option)
