"""The thesis's stage with other constants than its own."""

from __future__ import annotations

import dataclasses

from calib_ros.config import Config
from calib_ros_thesis.config import ThesisConfig, thesis_of


def with_constants(config: Config, **constants: object) -> Config:
    """`config` with these constants of its stage ``thesis``."""
    stage = thesis_of(config)
    changed = type("ThesisConfig", (type(stage),), constants)(**dataclasses.asdict(stage))
    return dataclasses.replace(config, others=tuple(changed if other is stage else other for other in config.others))


def thesis_with(**constants: object) -> ThesisConfig:
    """The stage by itself."""
    return thesis_of(with_constants(Config(), **constants))
