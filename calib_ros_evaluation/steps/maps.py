"""From projected points to the LiDAR's edge map (thesis 3.4.3), how the maps are scored, and how the score separates a right
extrinsic from a wrong one (3.4.4)."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import TooFewFeaturesError
from calib_ros.registration.objective import FastScore
from calib_ros.registration.score.point_score import Score, project
from calib_ros_evaluation.curves import AXES, Curves, curves
from calib_ros_evaluation.methods.method import MeanScore
from calib_ros_evaluation.steps.cloud import REFLECTIVITY, depth_scale
from calib_ros_evaluation.steps.pictures import (
    GREYS,
    INFERNO,
    NAMES,
    PLASMA,
    VIRIDIS,
    WRONG_DEG,
    WRONG_M,
    Matrix,
    RegisteredFrame,
    Scale,
    Step,
    busiest,
    edge_picture,
    enlarged,
    loss_curves,
    tiles,
)
from calib_ros_thesis.config import thesis_of
from calib_ros_thesis.features import ThesisFeatures
from calib_ros_thesis.maps import (
    BLUR,
    DEPTH_STEP,
    DEPTH_UNITS,
    EMPTY,
    LARGE,
    MIDDLE,
    REFLECTIVITY_STEP,
    REFLECTIVITY_UNITS,
    SMALL,
    EdgeMaps,
    complete,
    completion_stages,
    far_level,
)
from calib_ros_thesis.score import MAX_DISCONTINUITY, RegistrationMaps, ThesisScore, registration_maps

Levels = NDArray[np.int16]
SECTION = "3.4.3"
step, wide_step = partial(Step, SECTION), partial(Step, SECTION, wide=True)
score_step = partial(Step, "3.4.4")
wide_score_step = partial(score_step, wide=True)
ROTATION_DEG, TRANSLATION_M = 2.0, 0.3  # half widths of the curves
EDGE_SHOWN = 0.1  # W D + E^L from here on is drawn over the image
STRONG = 0.25  # E^I that counts as an edge beneath, in captions
FAINT = 0.05  # of the brightest colour; what adds less to J is not drawn


def completion_steps(scene: RegisteredFrame) -> Iterator[Step]:
    """Sparse depth to the map before the last step, which gives dense depth."""
    sparse_depth, far = scene.maps.lidar.sparse_depth, far_level(thesis_of(scene.config))
    inversion = np.where(sparse_depth != EMPTY, np.int16(far + 1) - sparse_depth, np.int16(EMPTY))
    stages = {"inversion": inversion, **completion_stages(inversion)}
    seen = sparse_depth[sparse_depth != EMPTY]
    low, high = np.round((far + 1 - np.percentile(seen, [99, 1])) / DEPTH_UNITS) if len(seen) else (0, far / DEPTH_UNITS)
    inverted = Scale(f"{far / DEPTH_UNITS:g} m - depth, m", float(low), max(float(high), float(low) + 1), VIRIDIS)
    texts = {
        "inversion": "Depth is inverted, so that near points are large and win where the next steps take a maximum. Points are "
        "drawn larger.",
        "dilation": "Dilation by a diamond of 5 px: every point fills the pixels next to it.",
        "closing": f"Closing by {SMALL} px: gaps between the points of a surface fill up, its outline stays.",
        "middle holes": f"Empty pixels take the largest value within {MIDDLE} px; filled ones stay.",
        "large holes": f"The same within {LARGE} px. Look at the borders: objects grow into sky and ground by up "
        f"to {LARGE // 2} px, which is why edges count only where a point lies.",
    }
    for name, text in texts.items():
        levels = stages[name]
        shown = levels != EMPTY
        draw = inverted.dots if name == "inversion" else inverted.dense
        yield step(
            f"Completion: {name}",
            f"Figure 3.13. {text} {shown.mean():.1%} of the pixels are filled.",
            draw(levels / DEPTH_UNITS, shown),
        )
    h, w = sparse_depth.shape
    window = busiest(scene.maps.discontinuity, max(h // 3, 2), max(w // 8, 2))
    pictures = [
        inverted.palette[np.where(levels[window] != EMPTY, inverted.levels(levels[window] / DEPTH_UNITS), 0)]
        for levels in stages.values()
    ]
    yield wide_step(
        "Completion, magnified",
        "Figure 3.13 on the part of the picture with the strongest jumps, pixel by pixel: from single points to a surface. "
        "The last step but the inversion back is a median blur, which takes away what sticks out of a surface.",
        inverted.below(tiles(pictures, list(stages), 3, w)),
    )


def map_steps(scene: RegisteredFrame) -> Iterator[Step]:
    """Discontinuity, sparse maps, completion, dense maps, edges."""
    lidar, points, camera = scene.maps.lidar, scene.thesis.points, scene.frame.camera
    u, v, inside = project(points.xyz, scene.T, camera)
    depth = np.zeros((camera.height, camera.width), np.float32)
    depth[v, u] = points.depth[inside]  # far ones first
    yield step(
        "Scan on the image",
        "All points that pass the filters, by eq. 2.30 with the extrinsic of this page, coloured by depth. "
        f"{np.count_nonzero(lidar.occupied)} pixels "
        f"({lidar.occupied.mean():.1%}) hold a point; where several fall on one, the nearest counts.",
        depth_scale(points.depth[inside]).over(scene.gray, depth, depth > 0),
    )
    D = scene.maps.discontinuity
    jumps = scene.thesis.points.discontinuity
    yield step(
        "Depth discontinuity",
        "Figure 3.12: xi of eq. 3.10, how much farther than a point its neighbours in the ring lie; the bright points lie on "
        "the near side of a jump. The root of it is shown, for contrast, and points are drawn larger. "
        f"{(jumps > 0.5).mean():.1%} of the points jump by more than 0.5 m; {MAX_DISCONTINUITY:g} m count in full.",
        Scale("root of xi / full xi", 0, 1, GREYS).dots(np.sqrt(D), lidar.occupied),
    )
    yield from _sparse(scene)
    yield from completion_steps(scene)
    yield from _dense(scene)
    yield from _edges(scene)


def _depth_scale(lidar: EdgeMaps) -> Scale:
    return depth_scale(lidar.sparse_depth[lidar.sparse_depth != EMPTY] / np.float32(DEPTH_UNITS))


def _sparse(scene: RegisteredFrame) -> Iterator[Step]:
    lidar = scene.maps.lidar
    shown = lidar.sparse_depth != EMPTY
    yield step(
        "Sparse depth",
        f"The sparse projection map Psi of depth, without the ground: {shown.mean():.1%} of the pixels hold a value. Points are "
        "drawn larger than their pixel.",
        _depth_scale(lidar).dots(lidar.sparse_depth / DEPTH_UNITS, shown),
    )
    if scene.features.has_reflectivity:
        shown = lidar.sparse_reflectivity != EMPTY
        yield step(
            "Sparse reflectivity",
            f"Psi of reflectivity, ground and all: {shown.mean():.1%} of the pixels hold a value.",
            REFLECTIVITY.dots((lidar.sparse_reflectivity - 1) / REFLECTIVITY_UNITS, shown),
        )
    shown = lidar.sparse_object > 0
    yield step(
        "Sparse objects",
        f"Psi of the clusters: {len(np.unique(lidar.sparse_object[shown]))} objects on {shown.mean():.1%} of the pixels. "
        "Colours are names only.",
        NAMES[enlarged(lidar.sparse_object)],
    )


def _dense(scene: RegisteredFrame) -> Iterator[Step]:
    config, lidar = thesis_of(scene.config), scene.maps.lidar
    shown = lidar.dense_depth != EMPTY
    yield step(
        "Dense depth",
        f"Figure 3.15a: after a median blur of {BLUR} px and the inversion back, the dense map Phi of depth (eq. 3.11). "
        f"{shown.mean():.1%} of the pixels are filled.",
        _depth_scale(lidar).dense(lidar.dense_depth / DEPTH_UNITS, shown),
    )
    if scene.features.has_reflectivity:
        completed = complete(lidar.sparse_reflectivity)
        shown = completed != EMPTY
        yield step(
            "Dense reflectivity",
            f"Figure 3.15b: reflectivity by the same steps, without the inversion. {shown.mean():.1%} of the pixels are filled.",
            REFLECTIVITY.dense((completed - 1) / REFLECTIVITY_UNITS, shown),
        )
        kept = lidar.dense_reflectivity > 0
        yield step(
            "Low reflectivity removed",
            f"Borders between dull things are chance, so values up to {config.low_reflectivity:g} are set to 0; "
            f"{kept.sum() / max(int(shown.sum()), 1):.1%} of the filled pixels stay.",
            REFLECTIVITY.dense((lidar.dense_reflectivity - 1) / REFLECTIVITY_UNITS, kept),
        )
    yield step(
        "Objects closed",
        f"Figure 3.15c: the object map after a closing by {config.closing} px, which joins the points of an object and keeps its "
        f"size. {(lidar.dense_object > 0).mean():.1%} of the pixels belong to an object.",
        NAMES[lidar.dense_object],
    )


def _edges(scene: RegisteredFrame) -> Iterator[Step]:
    config, lidar = thesis_of(scene.config), scene.maps.lidar
    kinds = [("depth", "delta_d", f"a step of {DEPTH_STEP:g} m", lidar.depth_edges)]
    if scene.features.has_reflectivity:
        kinds.append(("reflectivity", "delta_r", f"a step of {REFLECTIVITY_STEP:g}", lidar.reflectivity_edges))
    kinds.append(("objects", "delta_o", "any change of the object", lidar.object_edges))
    for name, symbol, full, edges in kinds:
        yield step(
            f"Edges of {name}",
            f"{symbol}, figure 3.14: operator {config.operator} on the dense map; a full edge is {full}. "
            f"{(edges > 0.5).mean():.1%} of the pixels are stronger than 0.5.",
            edge_picture(edges),
        )
    E_L = lidar.lidar_edges
    yield step(
        "LiDAR edges",
        "E^L, figure 3.16: the mean of the edge maps, kept only where a point really fell (points drawn larger). "
        f"{np.count_nonzero(E_L)} pixels, {np.count_nonzero(E_L) / max(int(lidar.occupied.sum()), 1):.0%} of those with a point.",
        Scale("edge strength", 0, 1, GREYS).dots(E_L, lidar.occupied),
    )


def score_steps(scene: RegisteredFrame, samples: int) -> Iterator[Step]:
    """D, W, J at the right and at a wrong extrinsic, curves with `samples` values per axis."""
    config, maps = thesis_of(scene.config), scene.maps
    occupied = maps.lidar.occupied
    yield score_step(
        "Discontinuity image",
        f"D^L: the discontinuity of eq. 3.10 on the picture, 1 from {MAX_DISCONTINUITY:g} m on. The sum over the picture "
        f"is {maps.discontinuity.sum(dtype=np.float64):.0f}.",
        Scale("D", 0, 1, INFERNO).dots(maps.discontinuity, maps.discontinuity > FAINT),
    )
    yield score_step(
        "Weight image",
        f"W^L: the mean of reflectivity and inverse depth ({config.min_depth:g} m / depth), so that near and bright edges count "
        f"more. Mean {float(maps.weight[occupied].mean()) if occupied.any() else 0:.2f}.",
        Scale("W", 0, _round(maps.weight[occupied], 99), PLASMA).dots(maps.weight, occupied),
    )
    wrong = registration_maps(scene.thesis, scene.wrong, config)
    fast: Score | None = None
    with contextlib.suppress(TooFewFeaturesError):
        fast = FastScore([scene.features], scene.T, scene.config.score).at(-1)
    added = _matched(maps)
    high = _round(added[added > 0], 97)
    moved = f"moved {WRONG_DEG:g} deg and {100 * WRONG_M:g} cm to the side"
    yield from _met(scene, maps, fast, scene.T, high, "", "at the extrinsic of this page")
    yield from _met(scene, wrong, fast, scene.wrong, high, ", moved", f"at this extrinsic {moved}")
    rows = [("score", "at this page's extrinsic", "moved", "ratio")]
    pairs = {"J, eq. 3.12": [own.edge_registration_score() for own in (maps, wrong)]}
    pairs["J / LiDAR edges"] = [_normalized(own) for own in (maps, wrong)]
    if fast is not None:
        pairs["fast score"] = [fast.value(scene.T), fast.value(scene.wrong)]
    for name, (a, b) in pairs.items():
        rows.append((name, f"{a:.4g}", f"{b:.4g}", f"{a / b:.2f}" if b > 0 else "-"))
    yield wide_score_step(
        "Scores",
        f"The same frame at the extrinsic of this page and {moved}. The more a score falls, the better it separates a right "
        "extrinsic from a wrong one.",
        table=tuple(rows),
    )
    yield from _curve_steps(scene, fast, samples)


def _met(
    scene: RegisteredFrame, maps: RegistrationMaps, fast: Score | None, T: Matrix, high: float, suffix: str, where: str
) -> Iterator[Step]:
    """Where edges of both sensors meet at T."""
    scores = f"J = {maps.edge_registration_score():.1f}; divided by the LiDAR edges in the picture, {_normalized(maps):.3f}"
    scores += "." if fast is None else f"; fast score {fast.value(T):.3f}."
    added, edges = _matched(maps), np.asarray(255 * np.minimum(maps.image_edges / 0.5, 1), np.uint8)
    yield score_step(
        f"Score per pixel{suffix}",
        f"W D E^I + E^L E^I of eq. 3.12, {where}: what every pixel adds, over E^I in grey. The sum over the picture is {scores}",
        Scale("what a pixel adds to J", 0, high, INFERNO).over(edges, added, added >= FAINT * high),
    )
    drawn = _lidar_edges(maps) >= EDGE_SHOWN
    hits = float((maps.image_edges[drawn] > STRONG).mean()) if drawn.any() else 0.0
    yield score_step(
        f"Overlay{suffix}",
        f"LiDAR edges (W D + E^L from {EDGE_SHOWN:g} on) over the image, {where}: yellow where an image edge lies beneath, "
        f"purple where there is none. {hits:.0%} of them lie on an image edge stronger than {STRONG:g}. {scores}",
        Scale("image edge beneath", 0, 0.6, PLASMA).over(scene.gray, maps.image_edges, drawn),
    )


def _matched(maps: RegistrationMaps) -> NDArray[np.float32]:
    """What every pixel adds to J, eq. 3.12; (h, w)."""
    return np.asarray(_lidar_edges(maps) * maps.image_edges, np.float32)


def _round(values: NDArray[np.float32], percentile: float) -> float:
    """A round number that about so many per cent of the values stay below, to end a scale."""
    return max(float(f"{np.percentile(values, percentile):.1g}"), 0.05) if len(values) else 1.0


def _normalized(maps: RegistrationMaps) -> float:
    return maps.edge_registration_score() / max(maps.lidar_mass(), 1e-12)


def _lidar_edges(maps: RegistrationMaps) -> NDArray[np.float32]:
    return np.asarray(maps.weight * maps.discontinuity + maps.lidar.lidar_edges, np.float32)


def _curve_steps(scene: RegisteredFrame, fast: Score | None, samples: int) -> Iterator[Step]:
    found: dict[str, Curves] = {}
    try:
        score = ThesisScore([scene.thesis], scene.T, scene.config)
    except TooFewFeaturesError as error:
        yield score_step("Loss curves", f"No curves: {error}.")
        return
    normalized: list[float] = []

    def both(features: ThesisFeatures, T: Matrix) -> float:
        """J of eq. 3.12 at T (4, 4), at the last smoothing; the normalised one is noted: both come from the same maps."""
        pixels, _, edges = score.shown(T)[0]
        J = float(np.sum(edges * features.image_edges[-1].ravel()[pixels], dtype=np.float64))
        normalized.append(J / max(float(np.sum(edges, dtype=np.float64)), 1e-12))
        return J

    raw = curves(MeanScore(score.features, both), scene.T, ROTATION_DEG, TRANSLATION_M, samples)
    found["J, eq. 3.12"] = raw
    found["J / LiDAR edges"] = dataclasses.replace(raw, values=np.reshape(normalized, raw.values.shape))
    if fast is not None:
        found["fast score"] = curves(fast, scene.T, ROTATION_DEG, TRANSLATION_M, samples)
    missing = "" if fast is not None else " The scan shows too few edge points for the fast score."
    yield wide_score_step(
        "Loss curves",
        "Scores along each axis around the extrinsic of this page, the others at rest, as in figures 4.7 and 4.10; every "
        f"curve is scaled to 0..1 and its peak marked. Axes are the camera's: x right, y down, z ahead.{missing} A good score "
        "has one hill, which peaks at the true extrinsic.",
        loss_curves(found),
    )
    rows = [("peak at", *(f"{axis}, {'deg' if k < 3 else 'cm'}" for k, axis in enumerate(AXES)))]
    for name, curve in found.items():
        rows.append((name, *(f"{p:+.2f}" if k < 3 else f"{p:+.1f}" for k, p in enumerate(curve.peaks))))
    yield wide_score_step(
        "Peaks",
        f"Where each curve is highest, within {ROTATION_DEG:g} deg and {100 * TRANSLATION_M:g} cm. A single frame may show an "
        "axis badly: then its curve is flat and its peak far off.",
        table=tuple(rows),
    )
