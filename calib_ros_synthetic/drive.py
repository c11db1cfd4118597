"""A drive of one pair, as a source of its own."""

from __future__ import annotations

from typing import Any

from calib_ros_synthetic.parameters import parsed
from calib_ros_synthetic.rig import RigPair, SyntheticRig


class SyntheticDrive(RigPair):
    """Frames of a drive, with the exact extrinsic as reference. Parameters are those of SyntheticRig."""

    def __init__(
        self, seed: int = 0, frames: int = 20, rings: int | None = None, *, rig: str | None = None, **options: Any
    ) -> None:
        given: dict[str, Any] = {"rings": rings} if rings is not None else {}
        of = SyntheticRig(rig, seed=seed, frames=frames, **given, **options)
        super().__init__(of, of.cameras[0], of.lidars[0])

    @classmethod
    def from_text(cls, text: str) -> SyntheticDrive:
        """`synthetic`, `synthetic:seed=3,frames=16,rings=32` or `synthetic:rig=os1_128_windshield,scene=park`: any parameters
        that are numbers or names."""
        return cls(**parsed(text))
