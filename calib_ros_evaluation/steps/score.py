"""How the maps are scored, and how the score separates a right extrinsic from a wrong one (thesis 3.4.4)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import TooFewFeaturesError
from calib_ros.registration.score.fast_score import FastScore
from calib_ros.registration.score.point_score import Score
from calib_ros_evaluation.curves import AXES, Curves, curves
from calib_ros_evaluation.steps.pictures import (
    INFERNO,
    PLASMA,
    WRONG_DEG,
    WRONG_M,
    Image,
    Matrix,
    RegisteredFrame,
    Scale,
    Step,
    enlarged,
    loss_curves,
    over,
)
from calib_ros_thesis.config import thesis_of
from calib_ros_thesis.score import MAX_DISCONTINUITY, RegistrationMaps, ThesisScore, registration_maps

SECTION = "3.4.4"
step = partial(Step, SECTION)
ROTATION_DEG, TRANSLATION_M = 2.0, 0.3  # half widths of the curves
EDGE_SHOWN = 0.1  # W D + E^L from here on is drawn over the image
STRONG = 0.25  # E^I that counts as an edge beneath, in captions
FAINT = 0.05  # of the brightest colour; what adds less to J is not drawn


@dataclass(frozen=True, eq=False)
class Both:
    """J of eq. 3.12 as a score, which notes the normalised one on the way: both come from the same maps."""

    score: ThesisScore
    normalized: list[float] = field(default_factory=list)

    def value(self, T: Matrix) -> float:
        """J at T (4, 4), at the last smoothing."""
        pixels, _, edges = self.score.shown(T)[0]
        J = float(np.sum(edges * self.score.features[0].image_edges[-1].ravel()[pixels], dtype=np.float64))
        self.normalized.append(J / max(float(np.sum(edges, dtype=np.float64)), 1e-12))
        return J


def score_steps(scene: RegisteredFrame, samples: int) -> Iterator[Step]:
    """D, W, J at the right and at a wrong extrinsic, curves with `samples` values per axis."""
    config, maps = thesis_of(scene.config), scene.maps
    occupied = maps.lidar.occupied
    yield step(
        "Discontinuity image",
        f"D^L: the discontinuity of eq. 3.10 on the picture, 1 from {MAX_DISCONTINUITY:g} m on. The sum over the picture "
        f"is {maps.discontinuity.sum(dtype=np.float64):.0f}.",
        Scale("D", 0, 1, INFERNO).dots(maps.discontinuity, maps.discontinuity > FAINT),
    )
    yield step(
        "Weight image",
        f"W^L: the mean of reflectivity and inverse depth ({config.min_depth:g} m / depth), so that near and bright edges count "
        f"more. Mean {float(maps.weight[occupied].mean()) if occupied.any() else 0:.2f}.",
        Scale("W", 0, _round(maps.weight[occupied], 99), PLASMA).dots(maps.weight, occupied),
    )
    wrong = registration_maps(scene.thesis, scene.wrong, config)
    fast = _fast(scene)
    added = _matched(maps)
    high = _round(added[added > 0], 97)
    moved = f"moved {WRONG_DEG:g} deg and {100 * WRONG_M:g} cm to the side"
    yield from _met(scene, maps, fast, scene.T, high, "", "at the extrinsic of this page")
    yield from _met(scene, wrong, fast, scene.wrong, high, ", moved", f"at this extrinsic {moved}")
    yield _score_table(maps, wrong, fast, scene)
    yield from _curve_steps(scene, fast, samples)


def _met(
    scene: RegisteredFrame, maps: RegistrationMaps, fast: Score | None, T: Matrix, high: float, suffix: str, where: str
) -> Iterator[Step]:
    """Where edges of both sensors meet at T."""
    scores = f"J = {maps.edge_registration_score():.1f}; divided by the LiDAR edges in the picture, {_normalized(maps):.3f}"
    scores += "." if fast is None else f"; fast score {fast.value(T):.3f}."
    yield step(
        f"Score per pixel{suffix}",
        f"W D E^I + E^L E^I of eq. 3.12, {where}: what every pixel adds, over E^I in grey. The sum over the picture is {scores}",
        _heat(maps, high),
    )
    drawn = _lidar_edges(maps) >= EDGE_SHOWN
    hits = float((maps.image_edges[drawn] > STRONG).mean()) if drawn.any() else 0.0
    yield step(
        f"Overlay{suffix}",
        f"LiDAR edges (W D + E^L from {EDGE_SHOWN:g} on) over the image, {where}: yellow where an image edge lies beneath, "
        f"purple where there is none. {hits:.0%} of them lie on an image edge stronger than {STRONG:g}. {scores}",
        _overlay(scene.gray, maps),
    )


def _matched(maps: RegistrationMaps) -> NDArray[np.float32]:
    """What every pixel adds to J, eq. 3.12; (h, w)."""
    return np.asarray(_lidar_edges(maps) * maps.image_edges, np.float32)


def _round(values: NDArray[np.float32], percentile: float) -> float:
    """A round number that about so many per cent of the values stay below, to end a scale."""
    return max(float(f"{np.percentile(values, percentile):.1g}"), 0.05) if len(values) else 1.0


def _heat(maps: RegistrationMaps, high: float) -> Image:
    """What every pixel adds to J, over the image's edges."""
    scale, added = Scale("what a pixel adds to J", 0, high, INFERNO), _matched(maps)
    edges = np.asarray(255 * np.minimum(maps.image_edges / 0.5, 1), np.uint8)
    return scale.below(over(edges, enlarged(np.where(added >= FAINT * high, scale.levels(added), 0)), INFERNO))


def _fast(scene: RegisteredFrame) -> Score | None:
    """The fast score of this frame; None if the scan shows too few edge points for it."""
    try:
        return FastScore([scene.features], scene.T, scene.config.score).at(-1)
    except TooFewFeaturesError:
        return None


def _normalized(maps: RegistrationMaps) -> float:
    return maps.edge_registration_score() / max(maps.lidar_mass(), 1e-12)


def _lidar_edges(maps: RegistrationMaps) -> NDArray[np.float32]:
    return np.asarray(maps.weight * maps.discontinuity + maps.lidar.lidar_edges, np.float32)


def _overlay(image: Image, maps: RegistrationMaps) -> Image:
    scale = Scale("image edge beneath", 0, 0.6, PLASMA)
    dots = np.where(_lidar_edges(maps) >= EDGE_SHOWN, scale.levels(maps.image_edges), 0)
    return scale.below(over(image, enlarged(dots), PLASMA))


def _score_table(right: RegistrationMaps, wrong: RegistrationMaps, fast: Score | None, scene: RegisteredFrame) -> Step:
    J = [maps.edge_registration_score() for maps in (right, wrong)]
    rows = [("score", "at this page's extrinsic", "moved", "ratio")]
    pairs = {"J, eq. 3.12": J, "J / LiDAR edges": [_normalized(right), _normalized(wrong)]}
    if fast is not None:
        pairs["fast score"] = [fast.value(scene.T), fast.value(scene.wrong)]
    for name, (a, b) in pairs.items():
        rows.append((name, f"{a:.4g}", f"{b:.4g}", f"{a / b:.2f}" if b > 0 else "-"))
    return step(
        "Scores",
        f"The same frame at the extrinsic of this page and moved {WRONG_DEG:g} deg and {100 * WRONG_M:g} cm to the side. The "
        "more a score falls, the better it separates a right extrinsic from a wrong one.",
        table=tuple(rows),
        wide=True,
    )


def _curve_steps(scene: RegisteredFrame, fast: Score | None, samples: int) -> Iterator[Step]:
    found: dict[str, Curves] = {}
    try:
        both = Both(ThesisScore([scene.thesis], scene.T, scene.config))
    except TooFewFeaturesError as error:
        yield step("Loss curves", f"No curves: {error}.")
        return
    raw = curves(both, scene.T, ROTATION_DEG, TRANSLATION_M, samples)
    found["J, eq. 3.12"] = raw
    found["J / LiDAR edges"] = dataclasses.replace(raw, values=np.reshape(both.normalized, raw.values.shape))
    if fast is not None:
        found["fast score"] = curves(fast, scene.T, ROTATION_DEG, TRANSLATION_M, samples)
    missing = "" if fast is not None else " The scan shows too few edge points for the fast score."
    yield step(
        "Loss curves",
        "Scores along each axis around the extrinsic of this page, the others at rest, as in figures 4.7 and 4.10; every "
        f"curve is scaled to 0..1 and its peak marked. Axes are the camera's: x right, y down, z ahead.{missing} A good score "
        "has one hill, which peaks at the true extrinsic.",
        loss_curves(found),
        wide=True,
    )
    rows = [("peak at", *(f"{axis}, {'deg' if k < 3 else 'cm'}" for k, axis in enumerate(AXES)))]
    for name, curve in found.items():
        rows.append((name, *(f"{p:+.2f}" if k < 3 else f"{p:+.1f}" for k, p in enumerate(curve.peaks))))
    yield step(
        "Peaks",
        f"Where each curve is highest, within {ROTATION_DEG:g} deg and {100 * TRANSLATION_M:g} cm. A single frame may show an "
        "axis badly: then its curve is flat and its peak far off.",
        table=tuple(rows),
        wide=True,
    )
