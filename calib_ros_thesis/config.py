"""Configuration of the thesis's own objective."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from calib_ros.config import Config
from calib_ros.config.options import Stage, option
from calib_ros.errors import ConfigError

THESIS_ORDER = (
    ("min_depth", "max_depth"),
    ("min_height", "max_height"),
    ("min_reflectivity", "max_reflectivity"),
)  # of each pair the first must be less
MAX_SMOOTHINGS = 8  # each keeps a map per frame


@dataclass(frozen=True)
class ThesisConfig(Stage):
    """The thesis's own objective, eq. 3.12 (refine.objective: thesis)."""

    operator: str = option("mix", "edge operator of images and dense maps, algorithm 5", choices=("sobel", "canny", "mix"))
    # Canny's thresholds, shares of a full edge, which is that of each picture itself.
    canny_low: ClassVar[float] = 0.3
    canny_high: ClassVar[float] = 0.6
    smoothing: tuple[float, ...] = option(
        (4.0, 1.5),
        "Gaussian smoothing of the image's edge map (figure 3.10), px at 720 px focal length; one optimisation "
        "per level, in this order",
        low=0.0,
        high=64.0,
    )
    semantic_share: float = option(
        0.5, "share of semantic edges when blended with gradient edges, before smoothing", low=0.0, high=1.0
    )
    min_depth: float = option(2.0, "points closer than this are removed (eq. 3.8), m", low=0.1, high=50.0)
    max_depth: float = option(60.0, "points farther than this are removed (eq. 3.8), m", low=5.0, high=300.0)
    min_height: float = option(-5.0, "points below this height relative to the LiDAR are removed, m", low=-100.0, high=100.0)
    max_height: float = option(20.0, "points above this height relative to the LiDAR are removed, m", low=-100.0, high=100.0)
    min_reflectivity: float = option(0.0, "points of lower reflectivity are removed, share of full scale", low=0.0, high=1.0)
    max_reflectivity: float = option(1.0, "points of higher reflectivity are removed, share of full scale", low=0.0, high=1.0)
    azimuth_deg: float = option(
        0.0, "centre of the azimuth range kept, counter-clockwise from the LiDAR's +x, deg", low=-180.0, high=180.0
    )
    azimuth_half_width_deg: float = option(180.0, "half width of the azimuth range kept, deg; 180 = all", low=1.0, high=180.0)
    # Algorithm 1, RANSAC: points this close to the plane are ground, m, and planes that are tried.
    ground_distance: ClassVar[float] = 0.2
    ground_iterations: ClassVar[int] = 128
    # Algorithm 2, DBSCAN: radius of a neighbourhood, m, points that make it dense, depth, m, beyond which they are too sparse.
    cluster_eps: ClassVar[float] = 0.7
    cluster_min_points: ClassVar[int] = 10
    cluster_max_depth: ClassVar[float] = 40.0
    closing: ClassVar[int] = 9  # of the object map, px: joins the points of an object
    low_reflectivity: float = option(
        0.3, "lower values of the dense reflectivity map are set to 0, share of full scale", low=0.0, high=1.0
    )
    normalize: bool = option(
        True, "divide J of eq. 3.12 by the number of LiDAR edges in the image, since a plain sum grows with it"
    )
    dense_edges: str = option(
        "every_evaluation",
        "when the edges of the dense maps are detected: every_evaluation = as in eq. 3.12, once_per_level = once, and "
        "attached to the points, which is quick enough for a node",
        choices=("every_evaluation", "once_per_level"),
    )
    evaluations: int = option(240, "evaluations of J per level", low=20, high=100000)

    def check_with(self, config: Config) -> None:
        """See Stage."""
        for low, high in THESIS_ORDER:
            first, second = getattr(self, low), getattr(self, high)
            if not first < second:
                raise ConfigError(f"thesis.{low} = {first:g} must be less than thesis.{high} = {second:g}")
        if not 1 <= len(self.smoothing) <= MAX_SMOOTHINGS:
            raise ConfigError(
                f"thesis.smoothing has {len(self.smoothing)} levels; give 1 to {MAX_SMOOTHINGS}, each is an optimisation of its "
                "own; 0 = no smoothing"
            )
        if config.refine.objective != "thesis":
            return
        if config.image.projection == "sphere":
            raise ConfigError("image.projection = sphere does not go with refine.objective = thesis, which needs a pinhole")
        if self.dense_edges == "every_evaluation" and config.refine.optimizer == "levenberg_marquardt":
            raise ConfigError(
                "refine.optimizer = levenberg_marquardt needs a gradient, which eq. 3.12 does not have; use nelder_mead or "
                "barzilai_borwein, or thesis.dense_edges: once_per_level"
            )


def thesis_of(config: Config) -> ThesisConfig:
    """The stage ``thesis`` of a configuration."""
    return config.stage(ThesisConfig)
