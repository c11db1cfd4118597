"""From projected points to the LiDAR's edge map (thesis 3.4.3)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from calib_ros.evaluation.steps.cloud import REFLECTIVITY, depth_scale
from calib_ros.evaluation.steps.completion import completion_steps
from calib_ros.evaluation.steps.pictures import GREYS, NAMES, Scale, edge_picture, enlarged, over
from calib_ros.evaluation.steps.step import Scene, Step
from calib_ros.lidar import density
from calib_ros.lidar.edge_maps import DEPTH_UNITS, REFLECTIVITY_UNITS, EdgeMaps
from calib_ros.registration.projection import project

Levels = NDArray[np.int16]
Mask = NDArray[np.bool_]
SECTION = "3.4.3"


def map_steps(scene: Scene) -> Iterator[Step]:
    """Discontinuity, sparse maps, completion, dense maps, edges."""
    config, lidar = scene.config.thesis, scene.maps.lidar
    size = lidar.occupied.size
    yield Step(
        SECTION,
        "Scan on the image",
        "All points that pass the filters, by eq. 2.30 with the extrinsic of this page, coloured by depth. "
        f"{np.count_nonzero(lidar.occupied)} pixels "
        f"({lidar.occupied.mean():.1%}) hold a point; where several fall on one, the nearest counts.",
        _points(scene),
    )
    D = scene.maps.discontinuity
    jumps = scene.features.points.discontinuity
    yield Step(
        SECTION,
        "Depth discontinuity",
        "Figure 3.12: xi of eq. 3.10, how much farther than a point its neighbours in the ring lie; the bright points lie on "
        "the near side of a jump. The root of it is shown, for contrast, and points are drawn larger. "
        f"{(jumps > 0.5).mean():.1%} of the points jump by more than 0.5 m; {config.max_discontinuity:g} m count in full.",
        Scale("root of xi / full xi", 0, 1, GREYS).dots(np.sqrt(D), lidar.occupied),
    )
    yield from _sparse(scene)
    yield from completion_steps(scene)
    yield from _dense(scene, size)
    yield from _edges(scene)


def _points(scene: Scene) -> NDArray[np.uint8]:
    """The image with its points coloured by depth, far ones beneath."""
    points, camera = scene.features.points, scene.frame.camera
    u, v, inside = project(points.xyz, scene.T, camera)
    scale = depth_scale(points.depth[inside])
    levels = np.zeros((camera.height, camera.width), np.uint8)
    levels[v, u] = scale.levels(points.depth[inside])
    return scale.below(over(scene.gray, enlarged(levels), scale.palette))


def _depth_scale(lidar: EdgeMaps) -> Scale:
    return depth_scale(lidar.sparse_depth[lidar.sparse_depth != density.EMPTY] / np.float32(DEPTH_UNITS))


def _sparse(scene: Scene) -> Iterator[Step]:
    lidar = scene.maps.lidar
    shown = lidar.sparse_depth != density.EMPTY
    yield Step(
        SECTION,
        "Sparse depth",
        f"The sparse projection map Psi of depth, without the ground: {shown.mean():.1%} of the pixels hold a value. Points are "
        "drawn larger than their pixel.",
        _depth_scale(lidar).dots(lidar.sparse_depth / DEPTH_UNITS, shown),
    )
    if scene.features.has_reflectivity:
        shown = lidar.sparse_reflectivity != density.EMPTY
        yield Step(
            SECTION,
            "Sparse reflectivity",
            f"Psi of reflectivity, ground and all: {shown.mean():.1%} of the pixels hold a value.",
            REFLECTIVITY.dots((lidar.sparse_reflectivity - 1) / REFLECTIVITY_UNITS, shown),
        )
    shown = lidar.sparse_object > 0
    yield Step(
        SECTION,
        "Sparse objects",
        f"Psi of the clusters: {len(np.unique(lidar.sparse_object[shown]))} objects on {shown.mean():.1%} of the pixels. "
        "Colours are names only.",
        NAMES[enlarged(lidar.sparse_object)],
    )


def _dense(scene: Scene, size: int) -> Iterator[Step]:
    config, lidar = scene.config.thesis, scene.maps.lidar
    shown = lidar.dense_depth != density.EMPTY
    yield Step(
        SECTION,
        "Dense depth",
        f"Figure 3.15a: after a median blur of {density.BLUR} px and the inversion back, the dense map Phi of depth (eq. 3.11). "
        f"{shown.mean():.1%} of the pixels are filled.",
        _depth_scale(lidar).dense(lidar.dense_depth / DEPTH_UNITS, shown),
    )
    if scene.features.has_reflectivity:
        completed = density.complete(lidar.sparse_reflectivity)
        shown = completed != density.EMPTY
        yield Step(
            SECTION,
            "Dense reflectivity",
            f"Figure 3.15b: reflectivity by the same steps, without the inversion. {shown.mean():.1%} of the pixels are filled.",
            REFLECTIVITY.dense((completed - 1) / REFLECTIVITY_UNITS, shown),
        )
        kept = lidar.dense_reflectivity > 0
        yield Step(
            SECTION,
            "Low reflectivity removed",
            f"Borders between dull things are chance, so values up to {config.low_reflectivity:g} are set to 0; "
            f"{kept.sum() / max(int(shown.sum()), 1):.1%} of the filled pixels stay.",
            REFLECTIVITY.dense((lidar.dense_reflectivity - 1) / REFLECTIVITY_UNITS, kept),
        )
    yield Step(
        SECTION,
        "Objects closed",
        f"Figure 3.15c: the object map after a closing by {config.closing} px, which joins the points of an object and keeps its "
        f"size. {np.count_nonzero(lidar.dense_object) / size:.1%} of the pixels belong to an object.",
        NAMES[lidar.dense_object],
    )


def _edges(scene: Scene) -> Iterator[Step]:
    config, lidar = scene.config.thesis, scene.maps.lidar
    kinds = [("depth", "delta_d", f"a step of {config.depth_step:g} m", lidar.depth_edges)]
    if scene.features.has_reflectivity:
        kinds.append(("reflectivity", "delta_r", f"a step of {config.reflectivity_step:g}", lidar.reflectivity_edges))
    kinds.append(("objects", "delta_o", "any change of the object", lidar.object_edges))
    for name, symbol, full, edges in kinds:
        yield Step(
            SECTION,
            f"Edges of {name}",
            f"{symbol}, figure 3.14: operator {config.operator} on the dense map; a full edge is {full}. "
            f"{(edges > 0.5).mean():.1%} of the pixels are stronger than 0.5.",
            edge_picture(edges),
        )
    E_L = lidar.lidar_edges
    yield Step(
        SECTION,
        "LiDAR edges",
        "E^L, figure 3.16: the mean of the edge maps, kept only where a point really fell (points drawn larger). "
        f"{np.count_nonzero(E_L)} pixels, {np.count_nonzero(E_L) / max(int(lidar.occupied.sum()), 1):.0%} of those with a point.",
        Scale("edge strength", 0, 1, GREYS).dots(E_L, lidar.occupied),
    )
