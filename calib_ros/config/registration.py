"""Configuration of the registration: pose constraints, score, global search, local refinement, first guess."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

from calib_ros import extensions
from calib_ros.config.options import Stage, option
from calib_ros.errors import ConfigError

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
        (0.0,) * 3,
        "standard deviation of the initial rotation about x, y, z, deg; 0 = unknown",
        low=0.0,
        high=180.0,
        length=3,
    )
    sigma_m: tuple[float, ...] = option(
        (0.0,) * 3,
        "standard deviation of the initial translation along x, y, z, m; 0 = unknown",
        low=0.0,
        high=100.0,
        length=3,
    )


@dataclass(frozen=True)
class InitialConfig(Stage):
    """What the node starts from where nothing is known: no saved state, no parameters, no TF."""

    method: str = option(
        "nominal",
        "first guess of the extrinsic where none is given: nominal = looking along the LiDAR's +x axis; semantic = from the "
        "classes of online.min_keyframes keyframes; motion = from 5 s of driving; auto = motion, then classes, then nominal; all "
        "but nominal for any yaw of the camera",
        choices=("nominal", "semantic", "motion", "auto"),
    )


@dataclass(frozen=True)
class GuessConfig(Stage):
    """The first guess from classes (thesis 3.5). The LiDAR's z axis points up within tilt_deg; its yaw is unknown."""

    tilt_deg: float = option(25.0, "largest angle between the camera's and the LiDAR's vertical, deg", low=1.0, high=60.0)
    distance_m: float = option(2.0, "largest distance between camera and LiDAR, m", low=0.1, high=10.0)
    candidates: int = option(5, "number of hypotheses kept, best first", low=1, high=64)


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
        "ring spacing above which upward edges are down-weighted by the square root of the ratio, deg",
        low=0.01,
        high=10.0,
    )
    weight_floor: int = option(
        150,
        "edge points per frame and type below which the weight of that type fades, so that a frame with few edges does not "
        "dominate",
        low=1,
        high=100000,
    )
    sigma: tuple[float, ...] = option(
        (16.0, 8.0, 4.0, 2.0, 1.2),
        "blur of the edge maps per level, coarse to fine, px at 1242 px image width; a coarser first level widens the basin, "
        "beyond 16 px it leads to wrong optima",
        low=0.3,
        high=64.0,
        length=5,
    )
    margin: float = option(
        0.28,
        "edge points are kept if they project within this share of the image width around the image at the prior",
        low=0.0,
        high=2.0,
    )
    min_points: int = option(
        200, "status insufficient if all frames together have fewer edge points than this", low=6, high=1000000
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not any(getattr(self, f.name) for f in fields(self) if f.name.startswith("weight_") and f.name != "weight_floor"):
            raise ConfigError("score.weight_side to score.weight_sky_top are all 0: nothing would be scored; leave one above 0")

    retired: ClassVar[tuple[str, ...]] = ("oriented", "local_contrast")


@dataclass(frozen=True)
class SearchConfig(Stage):
    """The global search: a box around the prior, Sobol starts, successive halving. Rounds are small: most need one or two."""

    rotation_deg: float = option(3.0, "half width of the search box per rotation axis, deg; 0 = refine only", low=0.0, high=45.0)
    translation_m: float = option(0.3, "half width of the search box per translation axis, m; 0 = refine only", low=0.0, high=3.0)
    rounds: int = option(
        6,
        "largest number of rounds of starts; the search ends earlier when enough starts agree on an optimum beyond chance",
        low=1,
        high=1000,
    )
    agreement: int = option(
        3, "number of independent starts that must reach the best optimum for the search to end", low=1, high=1000
    )
    starts: int = option(
        1024,
        "Sobol points scored per round on each coarse level, in a box of 5 deg / 0.3 m; up to 16 times as many in larger ones",
        low=16,
        high=1048576,
    )
    distinct: int = option(20, "number of distinct best points optimised on that level", low=1, high=4096)
    climbed: int = option(10, "number of them optimised on the next level", low=1, high=4096)
    refined: int = option(2, "optima of a round refined by Nelder-Mead", low=1, high=512)
    finalists: int = option(2, "optima compared on the finest level with all points", low=1, high=64)
    first_points: int = option(1500, "edge points used to score all starts", low=100, high=1000000)
    coarse_points: int = option(5000, "edge points used on the coarse levels", low=100, high=1000000)
    middle_points: int = option(15000, "edge points used by Nelder-Mead", low=100, high=1000000)
    simplex_evaluations: int = option(120, "score evaluations per Nelder-Mead run", low=20, high=10000)
    seed: int = option(0, "seed of the starts and of the point subsets", low=0, high=2**31 - 1)
    threads: int = option(
        1, "threads of a search; the result is the same to the last bit, and the CPU time that it takes no less", low=1, high=16
    )


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
    iterations: int = option(20, "Levenberg-Marquardt iterations per level", low=1, high=1000)
    max_rotation_deg: float = option(
        3.0,
        "a refinement turns no further than this from its start, per axis; one that ends there is refused, deg",
        low=0.01,
        high=90.0,
    )
    max_translation_m: float = option(
        0.5,
        "a refinement shifts no further than this from its start, per axis; one that ends there is refused, m",
        low=0.001,
        high=10.0,
    )
    max_p_value: float = option(
        0.01,
        "largest probability that an optimum of chance scores as high, by the mirrored image; above, the estimate is refused",
        low=0.0,
        high=1.0,
    )
    check_intrinsics: bool = option(
        True, "refuse the result of a search whose scenes match clearly better with another focal length or principal point"
    )
    tolerance_deg: float = option(
        0.5,
        "accuracy of the rotation that a search must reach with 90 %, deg; otherwise its estimate is refused and more scenes are "
        "needed; 180 = accept any",
        low=0.01,
        high=NO_LIMIT_DEG,
    )
    tolerance_m: float = option(
        0.1,
        "accuracy of the translation that a search must reach with 90 %, m; 100 = accept any",
        low=0.001,
        high=NO_LIMIT_M,
    )
    retired: ClassVar[tuple[str, ...]] = ("min_peak_ratio", "min_distinctness")
