"""Configuration of the thesis's own objective."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from calib_ros.config import Config
from calib_ros.config.options import Stage, option
from calib_ros.errors import ConfigError


@dataclass(frozen=True)
class ThesisConfig(Stage):
    """The thesis's own objective, eq. 3.12 (refine.objective: thesis)."""

    operator: str = option("mix", "edge operator of images and dense maps, algorithm 5", choices=("sobel", "canny", "mix"))
    # Canny's thresholds, shares of a full edge, which is that of each picture itself.
    canny_low: ClassVar[float] = 0.3
    canny_high: ClassVar[float] = 0.6
    # Gaussian smoothing of the image's edge map (figure 3.10), px at 720 px focal length, with an optimisation at each: the first
    # finds the optimum, the last locates it.
    smoothing: ClassVar[tuple[float, ...]] = (4.0, 1.5)
    semantic_share: ClassVar[float] = 0.5  # of masks, blended with gradient edges before smoothing: neither is better
    # The filters of 3.3.1, eq. 3.8. Depth, m: nearer is the vehicle, farther are too few points for an edge. Height above the
    # LiDAR, m; reflectivity, share of full scale; azimuth, deg: what no camera sees drops out anyway, so nearly all pass.
    min_depth: ClassVar[float] = 2.0
    max_depth: ClassVar[float] = 60.0
    min_height: ClassVar[float] = -5.0
    max_height: ClassVar[float] = 20.0
    min_reflectivity: ClassVar[float] = 0.0
    max_reflectivity: ClassVar[float] = 1.0
    azimuth_deg: ClassVar[float] = 0.0
    azimuth_half_width_deg: ClassVar[float] = 180.0
    # Algorithm 1, RANSAC: points this close to the plane are ground, m, and planes that are tried.
    ground_distance: ClassVar[float] = 0.2
    ground_iterations: ClassVar[int] = 128
    # Algorithm 2, DBSCAN: radius of a neighbourhood, m, points that make it dense, depth, m, beyond which they are too sparse.
    cluster_eps: ClassVar[float] = 0.7
    cluster_min_points: ClassVar[int] = 10
    cluster_max_depth: ClassVar[float] = 40.0
    closing: ClassVar[int] = 9  # of the object map, px: joins the points of an object
    low_reflectivity: ClassVar[float] = 0.3  # share of full scale: borders between dull things are chance
    normalize: bool = option(
        True, "divide J of eq. 3.12 by the number of LiDAR edges in the image, since a plain sum grows with it"
    )
    dense_edges: str = option(
        "every_evaluation",
        "when the edges of the dense maps are detected: every_evaluation = as in eq. 3.12, once_per_level = once, and "
        "attached to the points, which is quick enough for a node",
        choices=("every_evaluation", "once_per_level"),
    )
    evaluations: ClassVar[int] = 240  # of J per level: a simplex that is no smaller by then stands on a ridge

    def check_with(self, config: Config) -> None:
        """See Stage."""
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
