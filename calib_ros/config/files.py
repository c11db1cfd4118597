"""Configuration files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from calib_ros import io
from calib_ros.errors import BadInputError


def load_stages(path: str | Path) -> dict[str, Any]:
    """The stages of a YAML file as nested {stage: {field: value}}; in it, flat ROS names (``search.seed``) or nested ones.

    BadInputError if it cannot be read or holds something else.
    """
    text = io.read_text(path, "configuration", "a file like config/calib_ros.yaml")
    try:
        data = io.load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: a date that is none
        wrong = io.what_is_wrong(error)
        raise BadInputError(f"{path} is not valid YAML{wrong}; correct it or start from config/calib_ros.yaml") from None
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise BadInputError(f"{path} must hold stages with names and values, as config/calib_ros.yaml does")
    ros = next((v for v in data.values() if isinstance(v, dict) and "ros__parameters" in v), None)
    if ros is None:
        return data
    parameters = ros["ros__parameters"] or {}  # nothing: everything in the file is commented out
    if not isinstance(parameters, dict):
        raise BadInputError(f"{path}: ros__parameters must hold names and values, as in config/calib_ros.yaml")
    stages: dict[str, Any] = {}
    for key, value in parameters.items():
        stage, dot, name = str(key).partition(".")
        if dot:  # the node's own settings have no dot; an unknown stage is refused by update()
            stages.setdefault(stage, {})[name] = value
        elif isinstance(value, dict):
            stages.setdefault(stage, {}).update(value)
    return stages
