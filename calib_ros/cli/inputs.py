"""From parsed options to the inputs of a command: source, frames, initial extrinsic, configuration, search box."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros import result
from calib_ros.cli.arguments import AXES, Three
from calib_ros.cli.output import note
from calib_ros.config import NO_LIMIT_DEG, NO_LIMIT_M, Config, load_stages, preset, update
from calib_ros.config.sensors import FARTHEST_OFFSET_S
from calib_ros.datasets import open_dataset
from calib_ros.datasets.open import is_bag
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.registration.initial_guess import BY_CLASSES, GUESSES, nominal
from calib_ros.registration.search.constraints import NOMINAL_BOX, SEMANTIC_BOX, Axes, SearchBox

_FREE = {axis: NO_LIMIT_DEG if axis[0] == "r" else NO_LIMIT_M for axis in AXES}


@dataclass(frozen=True)
class ConstraintOptions:
    """What the options of `calib-ros calibrate` and `replay` say about the extrinsic and the clocks; None or empty = nothing."""

    rotation_only: bool = False  # the camera's position in the LiDAR frame is fixed
    fixed: Sequence[str] = ()  # names of AXES
    bounds: Sequence[tuple[str, float]] = ()  # axis and half width, deg or m
    prior_deg: Three | None = None  # standard deviations of the initial extrinsic
    prior_m: Three | None = None
    time_offset: str | float | None = None  # see motion.time_offset; s if known

    def limits(self) -> dict[str, float]:
        """Half width, deg or m, of every named axis. BadInputError for contradictory values, or one out of range."""
        limits = dict.fromkeys(AXES[3:], (0.0, "--rotation-only")) if self.rotation_only else {}
        given = [(axis, 0.0, "--fix") for axis in self.fixed] + [(axis, half, "--bound") for axis, half in self.bounds]
        for axis, half, option in given:
            before, by = limits.get(axis, (half, option))
            if before != half:
                said = {"--fix": f"--fix {axis}", "--bound": f"--bound {axis}={before:g}"}.get(by, by)
                raise BadInputError(f"--bound {axis}={half:g} contradicts {said}")
            if half > _FREE[axis]:
                raise BadInputError(f"--bound {axis}={half:g} is out of range [0, {_FREE[axis]:g}]")
            limits[axis] = (half, option)
        return {axis: half for axis, (half, _) in limits.items()}

    def apply_to(self, config: Config) -> Config:
        """`config` with these options. BadInputError if they contradict each other, or leave nothing to estimate."""
        limits = self.limits()
        constraints = config.constraints
        half = dict(zip(AXES, (*constraints.limit_deg, *constraints.limit_m), strict=True)) | limits
        if not any(half.values()):
            raise BadInputError("all six axes are fixed: nothing is left to estimate")
        self.check_free("--prior", self.prior_deg, self.prior_m, "the standard deviation")
        values: dict[str, object] = {
            "limit_deg": tuple(half[axis] for axis in AXES[:3]),
            "limit_m": tuple(half[axis] for axis in AXES[3:]),
        }
        sigmas = {"sigma_deg": self.prior_deg, "sigma_m": self.prior_m}
        values |= {name: prior for name, prior in sigmas.items() if prior is not None}
        motion: dict[str, object] = {}
        if self.time_offset is not None and config.motion.deskew == "off":
            raise BadInputError("--time-offset has no effect with motion.deskew: off, which leaves all points where they are")
        if isinstance(self.time_offset, str):
            motion["time_offset"] = self.time_offset
        elif self.time_offset is not None:
            if not abs(self.time_offset) <= FARTHEST_OFFSET_S:
                within = f"[{-FARTHEST_OFFSET_S:g}, {FARTHEST_OFFSET_S:g}]"
                raise BadInputError(f"--time-offset {self.time_offset:g} is out of range {within} s; give seconds")
            motion |= {"time_offset": "fixed", "time_offset_s": self.time_offset}
        return update(config, {"constraints": values, "motion": motion})

    def check_free(self, option: str, deg: Three | None, m: Three | None, what: str) -> None:
        """BadInputError if an option has a value, by degrees and metres, that is not 0 and belongs to an axis fixed here. One
        number for all axes means the free ones. what: that the values are."""
        limits = self.limits()
        for unit, values, axes in (("deg", deg, AXES[:3]), ("m", m, AXES[3:])):
            wrong = [axis for axis, value in zip(axes, values or (), strict=False) if value and limits.get(axis) == 0]
            if wrong and (len(wrong) == 3 or len(set(values or ())) > 1):
                verb = "is fixed" if len(wrong) == 1 else "are fixed"
                raise BadInputError(f"{option}-{unit}: {', '.join(wrong)} {verb}, so {what} there must be 0")


def configuration(
    path: str | None,
    seed: int | None = None,
    objective: str | None = None,
    constraints: ConstraintOptions | None = None,
    threads: int | None = None,
    intrinsics: str | None = None,
    preset_name: str = "",
) -> Config:
    """The defaults, or a preset; with the values of a YAML file; with the given options."""
    stages = load_stages(path) if path else {}
    for stage, name, value in (
        ("search", "seed", seed),
        ("search", "threads", threads),
        ("refine", "objective", objective),
        ("camera", "intrinsics", intrinsics),
    ):
        if value is not None and isinstance(stages.get(stage) or {}, dict):
            stages[stage] = {**(stages.get(stage) or {}), name: value}
    config = update(preset(preset_name), stages)
    return constraints.apply_to(config) if constraints else config


def search_box(initial: str, config: Config, search_deg: Axes | None, search_m: Axes | None) -> SearchBox:
    """The search box: as given, else the default for this kind of initial extrinsic; clipped to the stage ``constraints``."""
    default = SearchBox(config.search.rotation_deg, config.search.translation_m)
    default = {"nominal": NOMINAL_BOX, **dict.fromkeys(GUESSES, SEMANTIC_BOX)}.get(initial, default)
    box = SearchBox(
        default.rotation_deg if search_deg is None else search_deg, default.translation_m if search_m is None else search_m
    )
    pairs = (box.rotation_deg, config.constraints.limit_deg), (box.translation_m, config.constraints.limit_m)
    rotation, translation = (tuple(np.minimum(half, limit).tolist()) for half, limit in pairs)
    return SearchBox(rotation, translation)


def require_classes(config: Config, initial: str) -> None:
    """BadInputError for a first guess from classes if the configuration gives none."""
    own = config.semantics
    if initial in BY_CLASSES and (own.segmentation == "none" or not own.image_classes or not own.cloud_classes):
        raise BadInputError(
            f"--initial {initial} needs classes of pixels and points: leave semantics.segmentation, image_classes and "
            "cloud_classes in --config at their defaults, or set the classes to an ONNX file, a folder, or 'source' for "
            "synthetic drives"
        )


def open_named_source(args: argparse.Namespace, config: Config | None = None) -> Source:
    """The source given on the command line. config: by which the images and clouds of a bag are paired, as the node does it."""
    options: dict[str, object] = {**bag_options(args)}
    if config is not None and is_bag(Path(args.source).expanduser()):
        options |= {"motion": config.motion, "tolerance_s": config.online.pair_tolerance_s}
        initial = getattr(args, "initial", "reference")
        if initial in ("nominal", *GUESSES):
            options["T_camera_lidar"] = nominal(args.yaw_deg)
        elif initial != "reference":
            options["T_camera_lidar"] = result.load(initial).T_camera_lidar
    source = open_dataset(args.source, camera=args.camera, **options)
    for remark in getattr(source, "remarks", ()):
        note(f"calib-ros: {remark}")
    return source


def bag_options(args: Any) -> dict[str, Any]:
    """What the command line says of a bag: its topics, clock, whether images are rectified and parts may be missing."""
    names = ("image_topic", "points_topic", "camera_info_topic", "clock", "incomplete")
    given = {name: getattr(args, name) for name in names if getattr(args, name)}
    return given if args.rectified is None else given | {"rectified": args.rectified}


def constraint_options(args: argparse.Namespace) -> ConstraintOptions:
    """The constraints given on the command line."""
    return ConstraintOptions(args.rotation_only, args.fix, args.bound, args.prior_deg, args.prior_m, args.time_offset)


def initial_of(args: argparse.Namespace, config: Config) -> str:
    """What ``--initial`` says, else the first guess of the preset, else nominal."""
    return args.initial or (config.initial.method if args.preset else "nominal")


def initial_extrinsic(text: str, source: Source, yaw_deg: float = 0.0) -> NDArray[np.float64]:
    """'nominal', 'reference', one of GUESSES or a result file -> T_camera_lidar (4, 4). BadInputError if it is not available."""
    if text in ("nominal", *GUESSES):
        return nominal(yaw_deg)
    if text == "reference":
        if source.reference is None:
            raise BadInputError(f"{source.name} has no reference extrinsic; use --initial nominal or a result file")
        return source.reference
    return result.load(text).T_camera_lidar
