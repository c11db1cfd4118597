"""Every constant of calib_ros, one frozen dataclass per stage.

This is the one place of all defaults: the YAML file and the ROS parameters mirror these names (``stage.field``).
A field says its unit, its meaning and, where it was chosen by measurement, on what.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from calib_ros.errors import BadInputError, ConfigError
from calib_ros.options import Stage, option


@dataclass(frozen=True)
class ImageConfig(Stage):
    """Image preparation and edge maps (thesis 3.2, 3.4.1)."""

    equalization: str = option(
        "clahe",
        "histogram equalisation: none, global (eq. 3.4), adaptive (local, no clip limit) or clahe (local, clip limit)",
        choices=("none", "global", "adaptive", "clahe"),
    )
    equalize_color: bool = option(False, "equalise the three colours one by one before the picture turns grey (figure 3.5)")
    clahe_clip: float = option(2.0, "clip limit of CLAHE", low=0.1, high=40.0)
    clahe_tiles: int = option(8, "tiles per axis of adaptive equalisation and CLAHE", low=1, high=64)
    filter: str = option(
        "bilateral",
        "noise filter: bilateral (eq. 3.5), gaussian (eq. 3.6, 3.7) or none",
        choices=("bilateral", "gaussian", "none"),
    )
    gaussian_sigma: float = option(1.0, "sigma of the Gaussian noise filter, px", low=0.1, high=20.0)
    bilateral_diameter: int = option(5, "bilateral filter neighbourhood, px", low=1, high=25)
    bilateral_color: float = option(40.0, "bilateral filter sigma of brightness, grey levels", low=1.0, high=255.0)
    bilateral_space: float = option(5.0, "bilateral filter sigma of distance, px", low=0.5, high=50.0)
    max_width: int = option(
        1280, "wider images are shrunk to this for the registration, px: finer pixels do not lower the error", low=160, high=8192
    )
    gradient_percentile: float = option(97.0, "gradient magnitude that counts as a full edge, percentile", low=50.0, high=100.0)


@dataclass(frozen=True)
class LidarConfig(Stage):
    """Edge points of a scan, found in its own range image. Thresholds: KITTI 64 rings, two drives."""

    min_range: float = option(1.0, "points nearer than this (the vehicle itself) are dropped, m", low=0.0, high=20.0)
    max_range: float = option(60.0, "edges beyond this are dropped, m", low=5.0, high=300.0)
    jump_min: float = option(0.3, "least range jump of an edge, m", low=0.02, high=5.0)
    side_jump_ratio: float = option(0.02, "least left/right range jump per range", low=0.0, high=0.5)
    top_jump_ratio: float = option(0.05, "least upward range jump per range", low=0.0, high=0.5)
    jump_saturation: float = option(3.0, "range jump of full strength, m; strength is its square root", low=0.1, high=50.0)
    reflectivity_step: float = option(0.12, "least reflectivity step of an edge, share of full scale", low=0.01, high=1.0)
    reflectivity_max_range: float = option(40.0, "reflectivity edges beyond this are dropped, m", low=2.0, high=300.0)
    reflectivity_max_jump: float = option(
        0.2, "range step above which a reflectivity step is a range edge, m", low=0.01, high=2.0
    )
    outward_shift: float = option(
        0.5, "edge points move outward by this share of the angular step: the last hit lies inside the object", low=0.0, high=1.0
    )
    gap_steps: int = option(6, "empty columns that make an edge against the sky", low=1, high=50)
    hole_jump: float = option(0.5, "single lost returns are filled if their neighbours differ less, m", low=0.0, high=5.0)


@dataclass(frozen=True)
class ScoreConfig(Stage):
    """The fast edge registration score: weights and resolution levels."""

    weight_side: float = option(1.0, "weight of left/right range jumps", low=0.0, high=10.0)
    weight_top: float = option(0.6, "weight of upward range jumps", low=0.0, high=10.0)
    weight_reflectivity: float = option(0.6, "weight of reflectivity steps", low=0.0, high=10.0)
    weight_sky_side: float = option(0.5, "weight of sideways edges against the sky", low=0.0, high=10.0)
    weight_sky_top: float = option(0.3, "weight of upward edges against the sky", low=0.0, high=10.0)
    ring_spacing_deg: float = option(
        0.4,
        "upward edges of scanners with wider rings weigh less, by the root of the ratio, deg (half for 16 rings: "
        "errors fall by a third on two KITTI sets)",
        low=0.01,
        high=10.0,
    )
    weight_floor: int = option(
        150,
        "edge points per frame and type below which its weight fades, so that a poor frame does not shout",
        low=1,
        high=100000,
    )
    sigma: tuple[float, ...] = option(
        (8.0, 4.0, 2.0, 1.2),
        "blur of the edge maps per level, coarse to fine, px at 1242 px image width",
        low=0.3,
        high=64.0,
        length=4,
    )
    margin: float = option(
        0.28,
        "edge points are kept if they project within this share of the image width around it at the prior",
        low=0.0,
        high=2.0,
    )
    min_points: int = option(200, "fewer edge points in all frames together give status insufficient", low=6, high=1000000)


@dataclass(frozen=True)
class ThesisConfig(Stage):
    """The thesis's own objective, eq. 3.12 (refine.objective: thesis). Chosen on 11 KITTI scenes of two recordings."""

    operator: str = option("mix", "edge operator of images and dense maps, algorithm 5", choices=("sobel", "canny", "mix"))
    canny_low: float = option(0.3, "Canny: weaker edges are dropped, share of a full edge", low=0.0, high=1.0)
    canny_high: float = option(0.6, "Canny: stronger edges always stay, share of a full edge", low=0.0, high=1.0)
    smoothing: tuple[float, ...] = option(
        (4.0, 1.5),
        "Gaussian smoothing of the image's edge map (figure 3.10), px at 720 px focal length; optimised one after the other",
        low=0.0,
        high=64.0,
    )
    semantic_share: float = option(
        0.5, "share of semantic edges where they are blended with gradient edges, before the smoothing", low=0.0, high=1.0
    )
    min_depth: float = option(2.0, "points nearer than this (eq. 3.8) are filtered out, m", low=0.1, high=50.0)
    max_depth: float = option(60.0, "points farther than this (eq. 3.8) are filtered out, m", low=5.0, high=300.0)
    min_height: float = option(-5.0, "points lower than this below the LiDAR are filtered out, m", low=-100.0, high=100.0)
    max_height: float = option(20.0, "points higher than this above the LiDAR are filtered out, m", low=-100.0, high=100.0)
    min_reflectivity: float = option(0.0, "points that reflect less are filtered out, share of full scale", low=0.0, high=1.0)
    max_reflectivity: float = option(1.0, "points that reflect more are filtered out, share of full scale", low=0.0, high=1.0)
    azimuth_deg: float = option(
        0.0, "middle of the azimuths kept, counter-clockwise from the LiDAR's +x, deg", low=-180.0, high=180.0
    )
    azimuth_half_width_deg: float = option(180.0, "half width of the azimuths kept, deg; 180 = all", low=1.0, high=180.0)
    ground_distance: float = option(0.2, "points nearer than this to the ground plane are ground, m", low=0.01, high=2.0)
    ground_tilt_deg: float = option(15.0, "planes tilted more than this are no ground, deg", low=0.0, high=90.0)
    ground_share: float = option(0.05, "a plane with a smaller share of the points is no ground", low=0.0, high=1.0)
    ground_iterations: int = option(128, "planes tried by RANSAC (algorithm 1)", low=1, high=10000)
    cluster_eps: float = option(0.7, "DBSCAN (algorithm 2): radius of the neighbourhood, m", low=0.01, high=10.0)
    cluster_min_points: int = option(10, "DBSCAN: points in the neighbourhood that make it dense", low=1, high=10000)
    cluster_max_depth: float = option(40.0, "DBSCAN: points farther than this are no objects, m", low=1.0, high=300.0)
    cluster_voxel: float = option(
        0.15,
        "DBSCAN: points of a cube of this size count as one of their number, m; 0 = all by themselves, which is 5 to 11 times "
        "slower and finds the same objects (adjusted Rand index from 0.998 on three KITTI scans)",
        low=0.0,
        high=2.0,
    )
    depth_step: float = option(3.0, "step of the dense depth map that is a full edge, m", low=0.05, high=50.0)
    reflectivity_step: float = option(0.2, "step of the dense reflectivity map that is a full edge", low=0.01, high=1.0)
    low_reflectivity: float = option(0.3, "lower values of the dense reflectivity map are set to 0", low=0.0, high=1.0)
    closing: int = option(9, "size of the object map's closing, px", low=1, high=63)
    max_discontinuity: float = option(3.0, "depth discontinuity (eq. 3.10) that counts in full, m", low=0.05, high=50.0)
    normalize: bool = option(
        True,
        "divide J of eq. 3.12 by the LiDAR edges in the picture; as a plain sum it also grows with their number, "
        "and its peak lies decimetres off along t_y and t_z",
    )
    dense_edges: str = option(
        "every_evaluation",
        "edges of the dense maps: found anew at every evaluation as in eq. 3.12 (with 20 keyframes an estimate "
        "takes minutes), or once per level and attached to the points (a second; for a node)",
        choices=("every_evaluation", "once_per_level"),
    )
    evaluations: int = option(240, "evaluations of J per level", low=20, high=100000)
    first_step_deg: float = option(
        1.6,
        "size of the first simplex, and longest step of the ascent, deg and as many times 17 cm; half of it on each next level "
        "(several scenes end nearer with 1.6 than with 0.8, single ones wander less with 0.4)",
        low=0.01,
        high=20.0,
    )


@dataclass(frozen=True)
class SearchConfig(Stage):
    """The global search: a box around the prior, Sobol starts, successive halving (measured on 245 KITTI frames)."""

    rotation_deg: float = option(3.0, "half width of the box per rotation axis, deg; 0 = refine only", low=0.0, high=45.0)
    translation_m: float = option(0.3, "half width of the box per translation axis, m; 0 = refine only", low=0.0, high=3.0)
    starts: int = option(4096, "Sobol points scored on the coarsest level", low=16, high=1048576)
    distinct: int = option(60, "starts that go on to Levenberg-Marquardt", low=1, high=4096)
    refined: int = option(8, "optima that go on to Nelder-Mead", low=1, high=512)
    finalists: int = option(3, "optima compared on the fine level with all points", low=1, high=64)
    coarse_points: int = option(5000, "edge points used on the coarse levels", low=100, high=1000000)
    middle_points: int = option(15000, "edge points used by Nelder-Mead", low=100, high=1000000)
    simplex_evaluations: int = option(120, "score evaluations of one Nelder-Mead run", low=20, high=10000)
    seed: int = option(0, "seed of starts and of point subsets", low=0, high=2**31 - 1)


@dataclass(frozen=True)
class RefineConfig(Stage):
    """The local refinement from a current extrinsic."""

    optimizer: str = option(
        "auto",
        "local optimiser; auto = levenberg_marquardt for the fast score, nelder_mead for the thesis's, which has no slope",
        choices=("auto", "levenberg_marquardt", "nelder_mead", "barzilai_borwein"),
    )
    objective: str = option("fast", "score to maximise: the fast form, or the thesis's eq. 3.12", choices=("fast", "thesis"))
    iterations: int = option(20, "Levenberg-Marquardt iterations per level", low=1, high=1000)
    max_rotation_deg: float = option(
        3.0, "a refinement that moves further than this from its start is refused, deg", low=0.01, high=90.0
    )
    max_translation_m: float = option(
        0.5, "a refinement that moves further than this from its start is refused, m", low=0.001, high=10.0
    )
    min_distinctness: float = option(
        1.8,
        "an estimate must score this many times better than 99 % of the extrinsics around it, else it is refused as chance "
        "(true calibrations 2.0-4.0, chance 1.1-2.0; KITTI and synthetic, 3 and more frames)",
        low=0.0,
        high=100.0,
    )


@dataclass(frozen=True)
class OnlineConfig(Stage):
    """What happens over time: pairing, keyframes, estimates."""

    pair_tolerance_s: float = option(
        0.05, "image and cloud stamps farther apart than this are not paired, s", low=0.0001, high=1.0
    )
    pair_queue: int = option(8, "images and clouds kept while they wait for a partner", low=1, high=100)
    similarity_threshold: float = option(
        0.92,
        "an image less similar than this to the last keyframe's is a keyframe "
        "(the thesis's 0.7 keeps 3 of 154 frames of a drive)",
        low=0.0,
        high=1.0,
    )
    keyframe_interval_s: float = option(
        1.0, "after this time without a keyframe one is taken if the picture changed at all, s", low=0.05, high=3600.0
    )
    static_similarity: float = option(
        0.995, "images more similar than this show the same scene and are never a new keyframe", low=0.5, high=1.0
    )
    buffer_size: int = option(20, "keyframes in the ring buffer", low=1, high=200)
    min_keyframes: int = option(5, "keyframes before the first estimate", low=1, high=200)
    auto_calibrate: bool = option(True, "estimate at new keyframes; false = only when the service asks")


THESIS_ORDER = (
    ("canny_low", "canny_high"),
    ("min_depth", "max_depth"),
    ("min_height", "max_height"),
    ("min_reflectivity", "max_reflectivity"),
    ("min_depth", "cluster_max_depth"),
)  # of each pair the first must be less
MAX_SMOOTHINGS = 8  # each keeps a map per frame


@dataclass(frozen=True)
class Config:
    """All stages."""

    image: ImageConfig = field(default_factory=ImageConfig)
    lidar: LidarConfig = field(default_factory=LidarConfig)
    score: ScoreConfig = field(default_factory=ScoreConfig)
    thesis: ThesisConfig = field(default_factory=ThesisConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    online: OnlineConfig = field(default_factory=OnlineConfig)

    def __post_init__(self) -> None:
        """ConfigError for values that are in range, but contradict each other."""
        online = self.online
        if online.min_keyframes > online.buffer_size:
            raise ConfigError(
                f"online.min_keyframes = {online.min_keyframes} is more than online.buffer_size = {online.buffer_size}: "
                "no estimate would ever be made"
            )
        if any(fine > coarse for coarse, fine in pairwise(self.score.sigma)):
            raise ConfigError(f"score.sigma = {list(self.score.sigma)} must run from coarse to fine")
        self._check_thesis()

    def _check_thesis(self) -> None:
        thesis = self.thesis
        for low, high in THESIS_ORDER:
            if not getattr(thesis, low) < getattr(thesis, high):
                raise ConfigError(
                    f"thesis.{low} = {getattr(thesis, low):g} must be less than thesis.{high} = {getattr(thesis, high):g}"
                )
        if not thesis.smoothing:
            raise ConfigError("thesis.smoothing must hold at least one level; 0 = no smoothing")
        if len(thesis.smoothing) > MAX_SMOOTHINGS:
            raise ConfigError(
                f"thesis.smoothing has {len(thesis.smoothing)} levels; give at most {MAX_SMOOTHINGS}, "
                "each is an optimisation of its own"
            )
        exact = self.refine.objective == "thesis" and thesis.dense_edges == "every_evaluation"
        if exact and self.refine.optimizer == "levenberg_marquardt":
            raise ConfigError(
                "refine.optimizer = levenberg_marquardt needs a slope, which eq. 3.12 has not; use nelder_mead or "
                "barzilai_borwein, or thesis.dense_edges: once_per_level"
            )

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Config:
        """Nested {stage: {field: value}}; what is not named keeps its default. ConfigError for anything unknown."""
        return update(Config(), values)

    @staticmethod
    def from_yaml(path: str | Path) -> Config:
        """The same from a YAML file; a ROS parameter file (``/**: ros__parameters:``) is understood too, its node settings
        left aside. BadInputError if the file cannot be read, ConfigError if a value is wrong."""
        return Config.from_dict(load_stages(path))

    def to_dict(self) -> dict[str, Any]:
        """Nested plain dict of everything."""
        return dataclasses.asdict(self)


STAGES: dict[str, type[Any]] = {
    "image": ImageConfig,
    "lidar": LidarConfig,
    "score": ScoreConfig,
    "thesis": ThesisConfig,
    "search": SearchConfig,
    "refine": RefineConfig,
    "online": OnlineConfig,
}


def update(config: Config, values: dict[str, Any]) -> Config:
    """`config` with the named values replaced. ConfigError names what is unknown or out of range."""
    stages: dict[str, Any] = {}
    for name, stage_values in values.items():
        if name not in STAGES:
            raise ConfigError(f"unknown configuration stage '{name}'; there are {', '.join(STAGES)}")
        if stage_values is None:  # everything below it is commented out
            continue
        if not isinstance(stage_values, dict):
            raise ConfigError(f"configuration stage '{name}' must hold names and values, got {stage_values!r}")
        known = {f.name for f in dataclasses.fields(STAGES[name])}
        for key in stage_values:
            if key not in known:
                raise ConfigError(f"unknown parameter '{name}.{key}'; there are {', '.join(sorted(known))}")
        stages[name] = dataclasses.replace(getattr(config, name), **stage_values)
    return dataclasses.replace(config, **stages)


def load_stages(path: str | Path) -> dict[str, Any]:
    """The stages of a YAML file, flat ROS names (``search.seed``) or nested."""
    try:
        text = Path(path).read_text(encoding="utf-8")
        data = yaml.safe_load(text)
    except OSError as error:
        raise BadInputError(f"cannot read configuration {path}: {error.strerror}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # ValueError: not UTF-8, or a date that is none
        where = getattr(error, "problem_mark", None)
        line = f" in line {where.line + 1}" if where is not None else ""
        raise BadInputError(f"{path} is not valid YAML{line}; correct it or start from config/calib_ros.yaml") from None
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
