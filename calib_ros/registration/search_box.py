"""Where to search."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ConfigError

Axes = float | tuple[float, float, float]


@dataclass(frozen=True)
class SearchBox:
    """Half widths of the search per axis, around the initial extrinsic, in the camera frame: one number, or one per axis x, y,
    z. Zero = not searched; all zero = refine only. rounds: at most; None = ``search.rounds``. ConfigError outside 0 to 45 deg
    and 0 to 3 m."""

    rotation_deg: Axes = 10.0
    translation_m: Axes = 0.5
    rounds: int | None = None

    def __post_init__(self) -> None:
        for name, value, high in (("rotation_deg", self.rotation_deg, 45.0), ("translation_m", self.translation_m, 3.0)):
            try:
                axes = _per_axis(value)
            except (TypeError, ValueError):
                axes = np.full(3, np.nan)
            if not ((axes >= 0) & (axes <= high)).all():  # NaN too
                raise ConfigError(f"SearchBox.{name} = {value!r} is out of range [0, {high:g}]; give a number, or three")

    @property
    def is_empty(self) -> bool:
        """True if there is nothing to search."""
        return not self.half_width().any()

    @property
    def reach(self) -> tuple[float, float]:
        """Largest half width in deg and in m."""
        return float(_per_axis(self.rotation_deg).max()), float(_per_axis(self.translation_m).max())

    def half_width(self) -> NDArray[np.float64]:
        """(6,) in rad and m."""
        return np.concatenate([np.deg2rad(_per_axis(self.rotation_deg)), _per_axis(self.translation_m)])


def _per_axis(value: Axes) -> NDArray[np.float64]:
    axes = np.asarray(value, float)
    return np.full(3, axes) if axes.ndim == 0 else axes.reshape(3)
