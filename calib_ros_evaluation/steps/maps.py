"""From projected points to the LiDAR's edge map (thesis 3.4.3)."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from calib_ros.registration.score.point_score import project
from calib_ros_evaluation.steps.cloud import REFLECTIVITY, depth_scale
from calib_ros_evaluation.steps.pictures import (
    GREYS,
    NAMES,
    VIRIDIS,
    Image,
    RegisteredFrame,
    Scale,
    Step,
    busiest,
    edge_picture,
    enlarged,
    tiles,
)
from calib_ros_thesis.config import thesis_of
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
from calib_ros_thesis.score import MAX_DISCONTINUITY

Levels = NDArray[np.int16]
SECTION = "3.4.3"
step, wide_step = partial(Step, SECTION), partial(Step, SECTION, wide=True)


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
    yield wide_step(
        "Completion, magnified",
        "Figure 3.13 on the part of the picture with the strongest jumps, pixel by pixel: from single points to a surface. "
        "The last step but the inversion back is a median blur, which takes away what sticks out of a surface.",
        _magnified(stages, scene.maps.discontinuity, inverted),
    )


def _magnified(stages: dict[str, Levels], interest: NDArray[np.float32], scale: Scale) -> Image:
    h, w = interest.shape
    window = busiest(interest, max(h // 3, 2), max(w // 8, 2))
    pictures = [
        scale.palette[np.where(levels[window] != EMPTY, scale.levels(levels[window] / DEPTH_UNITS), 0)]
        for levels in stages.values()
    ]
    return scale.below(tiles(pictures, list(stages), 3, w))


def map_steps(scene: RegisteredFrame) -> Iterator[Step]:
    """Discontinuity, sparse maps, completion, dense maps, edges."""
    lidar = scene.maps.lidar
    size = lidar.occupied.size
    yield step(
        "Scan on the image",
        "All points that pass the filters, by eq. 2.30 with the extrinsic of this page, coloured by depth. "
        f"{np.count_nonzero(lidar.occupied)} pixels "
        f"({lidar.occupied.mean():.1%}) hold a point; where several fall on one, the nearest counts.",
        _points(scene),
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
    yield from _dense(scene, size)
    yield from _edges(scene)


def _points(scene: RegisteredFrame) -> NDArray[np.uint8]:
    """The image with its points coloured by depth, far ones beneath."""
    points, camera = scene.thesis.points, scene.frame.camera
    u, v, inside = project(points.xyz, scene.T, camera)
    scale = depth_scale(points.depth[inside])
    depth = np.zeros((camera.height, camera.width), np.float32)
    depth[v, u] = points.depth[inside]
    return scale.over(scene.gray, depth, depth > 0)


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


def _dense(scene: RegisteredFrame, size: int) -> Iterator[Step]:
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
        f"size. {np.count_nonzero(lidar.dense_object) / size:.1%} of the pixels belong to an object.",
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
