"""Configuration of the registration: pose constraints, score, global search, local refinement, first guess."""

from __future__ import annotations

from dataclasses import dataclass

from calib_ros import extensions
from calib_ros.config.options import Stage, option

NO_LIMIT_DEG, NO_LIMIT_M = 180.0, 100.0  # limits of this size are none


@dataclass(frozen=True)
class ConstraintsConfig(Stage):
    """What is known about the extrinsic in advance, per axis x, y, z of the camera's optical frame, around the initial one."""

    limit_deg: tuple[float, ...] = option(
        (NO_LIMIT_DEG,) * 3,
        "largest rotation away from the initial extrinsic about x, y, z, deg; 0 = fixed, 180 = free",
        low=0.0,
        high=NO_LIMIT_DEG,
        length=3,
    )
    limit_m: tuple[float, ...] = option(
        (NO_LIMIT_M,) * 3,
        "largest translation away from the initial extrinsic along x, y, z, m; 0 0 0 = rotation only, 100 = free",
        low=0.0,
        high=NO_LIMIT_M,
        length=3,
    )
    sigma_deg: tuple[float, ...] = option(
        (0.0,) * 3, "standard deviation of the initial rotation about x, y, z, deg; 0 = unknown", low=0.0, high=180.0, length=3
    )
    sigma_m: tuple[float, ...] = option(
        (0.0,) * 3, "standard deviation of the initial translation along x, y, z, m; 0 = unknown", low=0.0, high=100.0, length=3
    )


@dataclass(frozen=True)
class InitialConfig(Stage):
    """What the node starts from where nothing is known: no saved state, no parameters, no TF."""

    method: str = option(
        "nominal",
        "first guess of the extrinsic where none is given: nominal = looking along the LiDAR's +x axis; semantic = from "
        "the classes of online.min_keyframes keyframes; centroids = from their objects alone; motion = from 5 s of driving; "
        "auto = motion, then classes, then nominal",
        choices=("nominal", "semantic", "centroids", "motion", "auto"),
    )


@dataclass(frozen=True)
class ScoreConfig(Stage):
    """The fast edge registration score."""

    weight_reflectivity: float = option(
        0.6,
        "weight of steps of the reflectivity beside 1 of left/right range jumps; 0 = the intensity is not to be relied on",
        low=0.0,
        high=10.0,
    )


@dataclass(frozen=True)
class SearchConfig(Stage):
    """The global search: a box around the prior, even starts, successive halving. Rounds are small: most need one or two."""

    rotation_deg: float = option(3.0, "half width of the search box per rotation axis, deg; 0 = refine only", low=0.0, high=45.0)
    translation_m: float = option(0.3, "half width of the search box per translation axis, m; 0 = refine only", low=0.0, high=3.0)
    rounds: int = option(
        6,
        "largest number of rounds of starts; the search ends earlier when enough starts agree on an optimum beyond chance",
        low=1,
        high=1000,
    )
    starts: int = option(
        1024,
        "starts per round on each coarse level, in a box of 5 deg / 0.3 m; up to 16 times as many in larger ones",
        low=16,
        high=1048576,
    )
    seed: int = option(0, "seed of the starts and of the point subsets", low=0, high=2**31 - 1)
    threads: int = option(1, "threads of a search; the result is the same to the last bit", low=1, high=16)


@dataclass(frozen=True)
class RefineConfig(Stage):
    """The objective, the local refinement from the current extrinsic, and the checks of an estimate."""

    optimizer: str = option(
        "auto",
        "local optimiser; auto = levenberg_marquardt for the fast score, nelder_mead for the thesis's, which has no gradient",
        choices=("auto", "levenberg_marquardt", "nelder_mead", "barzilai_borwein"),
    )
    objective: str = option(
        "fast",
        "score to maximise: fast = the fast edge score, thesis = the thesis's eq. 3.12",
        choices=("fast", *extensions.names(extensions.OBJECTIVES)),
    )
    max_p_value: float = option(
        0.01, "largest probability that an optimum of chance scores as high; above, the estimate is refused", low=0.0, high=1.0
    )
    tolerance_deg: float = option(
        0.5,
        "accuracy of the rotation that a search must reach with 90 %, or its estimate is refused, deg; 180 = accept any",
        low=0.01,
        high=NO_LIMIT_DEG,
    )
    tolerance_m: float = option(
        0.1,
        "accuracy of the translation that a search must reach with 90 %, or its estimate is refused, m; 100 = accept any",
        low=0.001,
        high=NO_LIMIT_M,
    )
