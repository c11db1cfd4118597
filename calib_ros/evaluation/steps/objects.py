"""Ground and objects of a scan (thesis 3.3.2, 3.3.3)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from calib_ros.evaluation.steps.cloud import SECTION, Cloud, depth_scale
from calib_ros.evaluation.steps.panorama import from_above
from calib_ros.evaluation.steps.pictures import HIDDEN, NAMES, enlarged, over
from calib_ros.evaluation.steps.step import Image, Scene, Step
from calib_ros.lidar.attributes import NO_OBJECT
from calib_ros.registration.projection import project

GROUND = (40, 120, 200)  # BGR, orange
GROUND_LEVEL, OTHER_LEVEL = 1, 2
GROUND_PALETTE = np.zeros((256, 3), np.uint8)
GROUND_PALETTE[[GROUND_LEVEL, OTHER_LEVEL]] = GROUND, (200, 170, 60)


def object_steps(scene: Scene, cloud: Cloud) -> Iterator[Step]:
    """The ground found and removed, then clusters of what is left."""
    yield from _ground(scene, cloud)
    yield from _clusters(scene, cloud)


def _ground(scene: Scene, cloud: Cloud) -> Iterator[Step]:
    config = scene.config.thesis
    scale = depth_scale(cloud.depth)
    colors = scale.palette[scale.levels(cloud.depth)]
    colors[~cloud.passed] = HIDDEN
    if cloud.plane is None:
        text = f"no plane holds {config.ground_share:.0%} of the points, so nothing counts as ground."
    else:
        normal, tilt = cloud.plane.normal, np.rad2deg(np.arccos(np.clip(cloud.plane.normal[2], -1, 1)))
        text = (
            f"the plane lies {abs(cloud.plane.offset) / normal[2]:.2f} m below the LiDAR and is tilted by {tilt:.1f} deg; "
            f"{np.count_nonzero(cloud.ground)} points ({cloud.ground.mean():.0%}) lie nearer to it than "
            f"{config.ground_distance:g} m, or below."
        )
    marked = colors.copy()
    marked[cloud.ground] = GROUND
    yield Step(
        SECTION,
        "Ground found",
        f"RANSAC, algorithm 1, {config.ground_iterations} planes tried: {text} Ground is orange.",
        cloud.panorama.draw(marked, scale),
        wide=True,
    )
    colors[cloud.ground] = HIDDEN
    yield Step(
        SECTION,
        "Ground removed",
        "Figure 3.9a: the depth map without the ground (grey). Objects now stand by themselves. Depth edges and clusters are "
        "taken from these points; reflectivity edges from all, since lane markings lie on the ground.",
        cloud.panorama.draw(colors, scale),
        wide=True,
    )
    order = np.argsort(cloud.points.xyz[:, 2], kind="stable")
    yield Step(
        SECTION,
        "Ground from above",
        "The ground from above, ahead is up: ground in orange, all else by depth. Look for kerbs and slopes that are taken for "
        "ground, or are not.",
        from_above(cloud.points.xyz[order], marked[order]),
    )
    levels = np.where(cloud.ground, GROUND_LEVEL, OTHER_LEVEL)
    yield Step(
        SECTION,
        "Ground on the image",
        "The same on the image, projected with the extrinsic of this page (eq. 2.30): ground in orange, all else in blue.",
        over(scene.gray, enlarged(_on_image(scene, cloud, np.where(cloud.passed, levels, 0))), GROUND_PALETTE),
    )


def _clusters(scene: Scene, cloud: Cloud) -> Iterator[Step]:
    config = scene.config.thesis
    colors = NAMES[cloud.label]
    colors[cloud.label == NO_OBJECT] = HIDDEN
    sizes = np.sort(np.bincount(cloud.label)[1:])[::-1]
    sizes = sizes[sizes > 0]
    largest = f"The largest has {sizes[0]} points, the smallest {sizes[-1]}. " if len(sizes) else ""
    yield Step(
        SECTION,
        "Clusters",
        f"Figure 3.9b: DBSCAN, algorithm 2, finds {len(sizes)} objects among the points above ground within "
        f"{config.cluster_max_depth:g} m (radius {config.cluster_eps:g} m, {config.cluster_min_points} points). {largest}"
        "Grey points belong to none. Colours are names only.",
        cloud.panorama.draw(colors),
        wide=True,
    )
    order = np.argsort(cloud.label > 0, kind="stable")
    yield Step(
        SECTION,
        "Clusters from above",
        "The same from above. Look for objects that have grown together and for walls that fall apart: their borders become "
        "edges.",
        from_above(cloud.points.xyz[order], colors[order]),
    )
    labels = _on_image(scene, cloud, cloud.label)
    seen = len(np.unique(labels[labels > 0]))
    yield Step(
        SECTION,
        "Clusters on the image",
        f"{seen} of the objects are in the camera's picture, projected with the extrinsic of this page (eq. 2.30).",
        over(scene.gray, enlarged(labels), NAMES),
    )


def _on_image(scene: Scene, cloud: Cloud, levels: NDArray[np.generic]) -> Image:
    """Levels (n,) of the points on the pixels (h, w) they fall on; 0 elsewhere. The nearest point counts."""
    camera, far_first = scene.frame.camera, np.argsort(-cloud.depth, kind="stable")
    u, v, inside = project(cloud.points.xyz[far_first], scene.T, camera)
    picture = np.zeros((camera.height, camera.width), np.uint8)
    picture[v, u] = levels[far_first][inside]
    return picture
