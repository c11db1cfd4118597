"""The constants of the stages, but for the thesis's own objective."""

from __future__ import annotations

from dataclasses import dataclass, fields

from calib_ros.config.options import Stage, option
from calib_ros.errors import ConfigError


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

    layout: str = option(
        "auto",
        "how the scan is laid out: rings (spinning scanners), projection (solid-state ones and such as never repeat their "
        "pattern), or auto = told by the points",
        choices=("auto", "rings", "projection"),
    )
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
    top_spread: float = option(
        1.0,
        "upward edges are spread over this share of the step to the next ring, about their shifted place: one height for a whole "
        "outline pulls the estimate by its error (16 rings of one KITTI drive: median error from 0.17 to 0.14 deg)",
        low=0.0,
        high=1.0,
    )
    gap_steps: int = option(6, "empty columns that make an edge against the sky", low=1, high=50)
    hole_jump: float = option(0.5, "single lost returns are filled if their neighbours differ less, m", low=0.0, high=5.0)


@dataclass(frozen=True)
class ScoreConfig(Stage):
    """The fast edge registration score: weights and resolution levels."""

    oriented: bool = option(
        True,
        "sideways edges of the scan are scored on vertical lines of the image only, upward ones on horizontal lines; "
        "false = all on edges of any direction, to compare",
    )
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
        (16.0, 8.0, 4.0, 2.0, 1.2),
        "blur of the edge maps per level, coarse to fine, px at 1242 px image width (a first level of 16 px: from 5 deg / 0.3 m "
        "45 % of the starts reach the truth, from 8 px 11 %; 24 px leads astray)",
        low=0.3,
        high=64.0,
        length=5,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not any(getattr(self, f.name) for f in fields(self) if f.name.startswith("weight_") and f.name != "weight_floor"):
            raise ConfigError("score.weight_side to score.weight_sky_top are all 0: nothing would be scored; leave one above 0")

    margin: float = option(
        0.28,
        "edge points are kept if they project within this share of the image width around it at the prior",
        low=0.0,
        high=2.0,
    )
    min_points: int = option(200, "fewer edge points in all frames together give status insufficient", low=6, high=1000000)


@dataclass(frozen=True)
class SearchConfig(Stage):
    """The global search: a box around the prior, Sobol starts, successive halving (measured on 245 KITTI frames)."""

    rotation_deg: float = option(3.0, "half width of the box per rotation axis, deg; 0 = refine only", low=0.0, high=45.0)
    translation_m: float = option(0.3, "half width of the box per translation axis, m; 0 = refine only", low=0.0, high=3.0)
    rounds: int = option(
        8, "rounds of starts at most; the search ends earlier when enough starts agree on the best optimum", low=1, high=1000
    )
    agreement: int = option(3, "independent starts that must have found the best optimum to end the search", low=1, high=1000)
    starts: int = option(2048, "Sobol points scored in a round on each of the three coarse levels", low=16, high=1048576)
    distinct: int = option(80, "of these, the best that differ, which climb that level", low=1, high=4096)
    climbed: int = option(30, "of these, the ones that climb on", low=1, high=4096)
    refined: int = option(16, "optima of a round that go on to Nelder-Mead", low=1, high=512)
    finalists: int = option(8, "optima compared on the finest level with all points", low=1, high=64)
    first_points: int = option(1500, "edge points used to score all starts", low=100, high=1000000)
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
    min_peak_ratio: float = option(
        1.8,
        "an estimate must score this many times better than 99 % of the extrinsics around it, else it is refused as chance "
        "(true calibrations 2.0-4.0, chance 1.1-2.0; KITTI and synthetic, 3 and more frames)",
        low=0.0,
        high=100.0,
        formerly="min_distinctness",
    )
