"""The configuration and the search box that a command works with."""

from __future__ import annotations

import numpy as np

from calib_ros.commands.axes import Three
from calib_ros.commands.knowledge import Knowledge
from calib_ros.config import Config, load_stages
from calib_ros.errors import BadInputError
from calib_ros.registration.first_guess.choose import BOX
from calib_ros.registration.initial_guess import SEMANTIC
from calib_ros.registration.search_box import Axes, SearchBox

NOMINAL_BOX = SearchBox(10.0, 0.5)  # a camera mounted by eye is within this of nominal


def configuration(
    path: str | None, seed: int | None = None, objective: str | None = None, known: Knowledge | None = None
) -> Config:
    """The configuration of a YAML file, or the defaults; with another seed of the search, or objective, and what is known
    beforehand, if given."""
    stages = load_stages(path) if path else {}
    for stage, name, value in (("search", "seed", seed), ("refine", "objective", objective)):
        if value is not None and isinstance(stages.get(stage) or {}, dict):
            stages[stage] = {**(stages.get(stage) or {}), name: value}
    config = Config.from_dict(stages)
    return known.applied(config) if known else config


def search_box(initial: str, config: Config, search_deg: Axes | None, search_m: Axes | None) -> SearchBox:
    """Where to search: as asked for, else as fits where the initial extrinsic comes from; never beyond the limits of the
    stage ``constraints``."""
    default = SearchBox(config.search.rotation_deg, config.search.translation_m)
    default = {"nominal": NOMINAL_BOX, SEMANTIC: BOX}.get(initial, default)
    asked = SearchBox(
        default.rotation_deg if search_deg is None else search_deg, default.translation_m if search_m is None else search_m
    )
    return SearchBox(
        _within(asked.rotation_deg, config.constraints.limit_deg), _within(asked.translation_m, config.constraints.limit_m)
    )


def require_classes(config: Config) -> None:
    """BadInputError if a first guess from the classes of the scenes is asked for, but nothing would tell them."""
    own = config.semantics
    if own.segmentation == "none" or not own.image_classes or not own.cloud_classes:
        raise BadInputError(
            "--initial semantic needs classes of pixels and points: leave semantics.segmentation, image_classes and "
            "cloud_classes in --config at their defaults, or set the classes to an ONNX file, a folder, or 'source' for "
            "synthetic drives"
        )


def _within(half: Axes, limit: tuple[float, ...]) -> Three:
    x, y, z = np.minimum(half, limit).tolist()
    return x, y, z
