"""Configuration: one frozen dataclass per stage of the method, whose fields the YAML file and the ROS parameters name as
``stage.field``."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import yaml

from calib_ros import extensions, io
from calib_ros.config.online import MonitorConfig as MonitorConfig
from calib_ros.config.online import OnlineConfig as OnlineConfig
from calib_ros.config.online import TrackerConfig as TrackerConfig
from calib_ros.config.options import Stage
from calib_ros.config.registration import NO_LIMIT_DEG as NO_LIMIT_DEG
from calib_ros.config.registration import NO_LIMIT_M as NO_LIMIT_M
from calib_ros.config.registration import ConstraintsConfig as ConstraintsConfig
from calib_ros.config.registration import InitialConfig as InitialConfig
from calib_ros.config.registration import RefineConfig as RefineConfig
from calib_ros.config.registration import ScoreConfig as ScoreConfig
from calib_ros.config.registration import SearchConfig as SearchConfig
from calib_ros.config.removed import FORMER_STAGES, REMOVED, notices
from calib_ros.config.semantics import SemanticsConfig as SemanticsConfig
from calib_ros.config.sensors import CameraConfig as CameraConfig
from calib_ros.config.sensors import ImageConfig as ImageConfig
from calib_ros.config.sensors import LidarConfig as LidarConfig
from calib_ros.config.sensors import MotionConfig as MotionConfig
from calib_ros.errors import BadInputError, ConfigError

AnyStage = TypeVar("AnyStage", bound=Stage)


@cache
def _other_stages() -> dict[str, type[Stage]]:
    return {name: extensions.load(extensions.STAGES, name) for name in extensions.names(extensions.STAGES)}


@dataclass(frozen=True)
class Config:
    """All parameters, one immutable stage each. Change them with `from_dict`, `from_yaml` or `dataclasses.replace`. Listed with
    units, defaults and ranges in docs/figures/parameters.csv.

    Raises
    ------
    ConfigError : values that are in range but contradict each other, as ``online.min_keyframes`` above ``online.buffer_size``.
    """

    camera: CameraConfig = field(default_factory=CameraConfig)
    image: ImageConfig = field(default_factory=ImageConfig)
    lidar: LidarConfig = field(default_factory=LidarConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    score: ScoreConfig = field(default_factory=ScoreConfig)
    semantics: SemanticsConfig = field(default_factory=SemanticsConfig)
    constraints: ConstraintsConfig = field(default_factory=ConstraintsConfig)
    initial: InitialConfig = field(default_factory=InitialConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    online: OnlineConfig = field(default_factory=OnlineConfig)
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    monitor: MonitorConfig = field(default_factory=MonitorConfig)
    # Stages of packages beside the core that are installed: read them by `stage`, change them by `update`.
    others: tuple[Stage, ...] = field(default_factory=lambda: tuple(kind() for kind in _other_stages().values()))

    def __post_init__(self) -> None:
        """ConfigError for values that are in range, but contradict each other."""
        online = self.online
        if online.min_keyframes > online.buffer_size:
            raise ConfigError(
                f"online.min_keyframes = {online.min_keyframes} is more than online.buffer_size = {online.buffer_size}: "
                "no estimate would ever be made"
            )
        if self.semantics.segment_anything_decoder and not self.semantics.segment_anything:
            raise ConfigError(
                "semantics.segment_anything_decoder is set without semantics.segment_anything, its encoder; set both, or neither"
            )
        for stage in (self.image, self.lidar, *self.others):
            stage.check_with(self)

    def stage(self, kind: type[AnyStage]) -> AnyStage:
        """The stage of a package beside the core; its defaults where the package has not joined it."""
        own = next((other for other in self.others if isinstance(other, kind)), None)
        return kind() if own is None else own  # made only where it is missing: every field is checked then

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Config:
        """The defaults with the values of a nested ``{stage: {field: value}}`` replaced. ConfigError for an unknown name, or a
        value of the wrong type or out of range."""
        return update(Config(), values)

    @staticmethod
    def from_yaml(path: str | Path) -> Config:
        """The defaults with the values of a YAML file, nested or as a ROS parameter file (``/**: ros__parameters:``), of which
        settings of the node are ignored. Raises as `load_stages` and `from_dict`."""
        return Config.from_dict(load_stages(path))

    def to_dict(self) -> dict[str, Any]:
        """All parameters as a nested ``{stage: {field: value}}``."""
        return {name: dataclasses.asdict(_get(self, name)) for name in stages()}


NODE_GROUPS = ("capture", "export")  # settings of the node alone begin like a stage with these
OWN_STAGES: dict[str, type[Stage]] = {name: kind for name, kind in get_type_hints(Config).items() if name != "others"}


def stages() -> dict[str, type[Any]]:
    """All stages by name, those of packages beside the core last."""
    return {**OWN_STAGES, **_other_stages()}


def _get(config: Config, name: str) -> Any:
    return getattr(config, name) if name in OWN_STAGES else config.stage(_other_stages()[name])


def preset(name: str) -> Config:
    """The configuration that an installed package calls by this name, as the thesis's own; the defaults for an empty name.
    ConfigError names those there are."""
    config, known = Config(), extensions.names(extensions.PRESETS)
    if name and name not in known:
        raise ConfigError(f"there is no preset {name!r}; there are {', '.join(known) or 'none: no package that brings one'}")
    for path in extensions.load(extensions.PRESETS, name) if name else ():
        config = update(config, load_stages(path))
    return config


def update(config: Config, values: dict[str, Any]) -> Config:
    """`config` with the named values replaced. Options that there were in former versions are left out, with a FutureWarning.
    ConfigError names what is unknown or out of range."""
    known, changed = stages(), {}
    for name, stage_values in values.items():
        if name not in known and name not in FORMER_STAGES:
            raise ConfigError(f"unknown configuration stage '{name}'; there are {', '.join(known)}")
        if stage_values is None:  # all its lines are commented out
            continue
        if not isinstance(stage_values, dict):
            raise ConfigError(f"configuration stage '{name}' must hold names and values, got {stage_values!r}")
        for notice in notices(f"{name}.{key}" for key in stage_values):
            warnings.warn(notice, FutureWarning, stacklevel=3)
        stage_values = {key: value for key, value in stage_values.items() if f"{name}.{key}" not in REMOVED}
        fields = {f.name for f in dataclasses.fields(known[name])} if name in known else set()
        for key in stage_values:
            if key not in fields:
                raise ConfigError(f"unknown parameter '{name}.{key}'; there are {', '.join(sorted(fields))}")
        if name in known:
            changed[name] = dataclasses.replace(_get(config, name), **stage_values)
    own = {name: stage for name, stage in changed.items() if name in OWN_STAGES}
    new = {type(stage): stage for name, stage in changed.items() if name not in OWN_STAGES}
    others = tuple({**{type(stage): stage for stage in config.others}, **new}.values())
    return dataclasses.replace(config, **own, others=others)


def load_stages(path: str | Path) -> dict[str, Any]:
    """The stages of a YAML file as nested {stage: {field: value}}; in it, flat ROS names (``search.seed``) or nested ones.
    BadInputError if it cannot be read or holds something else."""
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
        if stage in NODE_GROUPS:
            continue
        if dot:  # an unknown stage is refused by update()
            stages.setdefault(stage, {})[name] = value
        elif isinstance(value, dict):  # other settings of the node are no groups
            stages.setdefault(stage, {}).update(value)
    return stages
