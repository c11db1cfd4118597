"""The scan by itself: panoramas, threshold filters, ground and clusters (thesis 3.3)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.lidar.range_image import range_image
from calib_ros.overlay import BAR, put, text_width
from calib_ros.registration.score.point_score import project
from calib_ros_evaluation.steps.pictures import (
    HIDDEN,
    NAMES,
    PLASMA,
    VIRIDIS,
    Image,
    RegisteredFrame,
    Scale,
    Step,
    enlarged,
    over,
)
from calib_ros_semantics.class_pictures import BACKGROUND, from_above, sizes
from calib_ros_thesis.cloud import (
    GROUND_SHARE,
    NO_OBJECT,
    by_angle,
    by_height,
    by_range,
    by_reflectivity,
    depth,
    ground_plane,
    ground_points,
    object_labels,
    within_reach,
    within_thresholds,
)
from calib_ros_thesis.config import thesis_of

Mask = NDArray[np.bool_]
Floats = NDArray[np.float32]
SECTION = "3.3"
step, wide_step = partial(Step, SECTION), partial(Step, SECTION, wide=True)
TELLING = 0.05  # a configured filter that removes a smaller share of the points is shown with another threshold
REFLECTIVITY = Scale("reflectivity, share of full scale", 0, 1, PLASMA)
HEIGHT = 320  # px that all rings together are at least high
GROUND = (40, 120, 200)  # BGR, orange
GROUND_LEVEL, OTHER_LEVEL = 1, 2
GROUND_PALETTE = np.zeros((256, 3), np.uint8)
GROUND_PALETTE[[GROUND_LEVEL, OTHER_LEVEL]] = GROUND, (200, 170, 60)


def depth_scale(depth: Floats) -> Scale:
    """Colours of depth, bright = near; the nearest and farthest hundredth of the depths (n,) share the scale's ends."""
    low, high = np.percentile(depth, [1, 99]) if len(depth) else (1, 2)
    low = max(float(f"{low:.2g}"), 0.1)
    return Scale("depth (eq. 3.8), m", low, max(float(f"{high:.2g}"), 2 * low), VIRIDIS, log=True, falling=True)


class Cloud:
    """All returns of a scan (n,) in the order of its panorama, and what the thesis finds of them.

    index: (rows, columns) into the returns or -1, highest ring first, left of the vehicle left. borders: azimuths of the left and
    right border of the camera's picture, rad. colors: (n, 3) by depth, on `scale`.
    """

    def __init__(self, scene: RegisteredFrame) -> None:
        # The same steps as attributes(), which keeps only the points that are left in the end.
        config, camera = thesis_of(scene.config), scene.frame.camera
        scan = range_image(scene.frame.cloud, dataclasses.replace(scene.config.lidar, min_range=0.0))  # nothing is cut off
        self.xyz = xyz = scan.cloud.xyz
        self.index, self.reflectivity = np.ascontiguousarray(scan.index[:, ::-1]), scan.reflectivity
        self.depth = depth(xyz)
        reach, self.passed = within_reach(xyz, config), within_thresholds(xyz, scan.reflectivity, config)
        self.plane = ground_plane(xyz[reach], config)
        self.ground, self.label = np.zeros(len(xyz), bool), np.full(len(xyz), NO_OBJECT, np.uint8)
        self.ground[reach] = ground_points(xyz[reach], self.plane, config)
        self.ground &= self.passed
        some = self.passed
        self.label[some] = object_labels(xyz[some], self.depth[some], self.ground[some], config)
        rays = np.array([[0, camera.K[1, 2], 1], [camera.width - 1, camera.K[1, 2], 1]]) @ np.linalg.inv(camera.K).T
        ahead = rays @ scene.T[:3, :3]
        self.borders = np.arctan2(ahead[:, 1], ahead[:, 0])
        self.scale = depth_scale(self.depth)
        self.colors = self.scale.palette[self.scale.levels(self.depth)]

    def draw(self, colors: Image, scale: Scale | None = None) -> Image:
        """Colours (n, 3) of the points -> panorama with azimuths above, the camera's borders, and the scale below."""
        rows, columns = self.index.shape
        cells = np.where((self.index >= 0)[..., None], colors[np.maximum(self.index, 0)], np.uint8(BACKGROUND))
        picture = np.repeat(cells, max(round(HEIGHT / rows), 1), axis=0)
        font, line, margin = sizes(columns)
        for x in np.rint((np.pi - self.borders) / (2 * np.pi) * (columns - 1)).astype(int).tolist():
            cv2.line(picture, (x, 0), (x, picture.shape[0]), (255, 255, 255), max(columns // 900, 1))
        top = np.full((line + margin, columns, 3), BAR, np.uint8)
        for degrees, name in ((180, "behind"), (90, "left 90 deg"), (0, "ahead"), (-90, "right 90 deg"), (-180, "behind")):
            width = text_width(name, font)
            x = round((180 - degrees) / 360 * columns) - width // 2
            put(top, name, (int(np.clip(x, margin, columns - width - margin)), line - margin // 2), font)
        picture = np.vstack([top, picture])
        return picture if scale is None else scale.below(picture)


def cloud_steps(scene: RegisteredFrame, cloud: Cloud) -> Iterator[Step]:
    """Raw scan, threshold filters, the ground found and removed, then clusters of what is left."""
    yield wide_step(
        "Scan by depth",
        f"Figure 3.7a: all {len(cloud.xyz)} returns of the scan as a panorama; a row is a ring of the LiDAR, a column a "
        "direction. The white lines are the borders of the camera's picture. Bright is near.",
        cloud.draw(cloud.colors, cloud.scale),
    )
    if cloud.reflectivity is None:
        yield step(
            "Scan by reflectivity",
            "Figure 3.7b is missing: this source has no intensity, or the same for all points. "
            "What needs it is left out, or zero, below.",
        )
    else:
        yield wide_step(
            "Scan by reflectivity",
            "Figure 3.7b: how much of the beam comes back. Look for signs, number plates and lane markings, which depth does not "
            f"show. The median is {np.median(cloud.reflectivity):.2f}; 5 % of the points lie above "
            f"{np.percentile(cloud.reflectivity, 95):.2f}.",
            cloud.draw(PLASMA[REFLECTIVITY.levels(cloud.reflectivity)], REFLECTIVITY),
        )
    yield from _filters(scene, cloud)
    yield from _ground(scene, cloud)
    yield from _clusters(scene, cloud)


def _filters(scene: RegisteredFrame, cloud: Cloud) -> Iterator[Step]:
    rows: list[tuple[str, ...]] = [("filter", "kept in this run", "removed", "kept in the picture", "removed")]
    for name, text, own, own_mask, other, other_mask in _choices(scene, cloud):
        removed = 1 - float(own_mask.mean())
        shown, mask = (own, own_mask) if removed >= TELLING else (other, other_mask)
        rows.append((name, own, f"{removed:.1%}", shown, f"{1 - mask.mean():.1%}"))
        why = (
            "the limits of this run" if shown == own else f"chosen for the picture, since this run ({own}) removes {removed:.1%}"
        )
        yield wide_step(
            f"Filter by {name}",
            f"Figure 3.8. {text} Coloured: kept, {shown} ({why}). Grey: the {np.count_nonzero(~mask)} points removed, "
            f"{1 - mask.mean():.1%} of all.",
            cloud.draw(np.where(mask[:, None], cloud.colors, np.uint8(HIDDEN[0])), cloud.scale),
        )
    yield wide_step(
        "Threshold filters together",
        f"Of {len(cloud.xyz)} points, {np.count_nonzero(cloud.passed)} pass all filters of this run and go on.",
        table=tuple(rows),
    )


def _choices(scene: RegisteredFrame, cloud: Cloud) -> Iterator[tuple[str, str, str, Mask, str, Mask]]:
    """Filter, what it is for, the limits of this run and which points pass, limits that show its effect, and which pass those."""
    config, xyz = thesis_of(scene.config), cloud.xyz
    floor = float(np.percentile(xyz[:, 2], 10)) if cloud.plane is None else cloud.plane.offset / float(cloud.plane.normal[2])
    low = round(floor + 0.3, 1)
    yield (
        "height",
        "A floor under the heights takes away ground and kerbs.",
        f"{config.min_height:g} to {config.max_height:g} m",
        by_height(xyz, config.min_height, config.max_height),
        f"{low:g} to {config.max_height:g} m from the LiDAR",
        by_height(xyz, low, config.max_height),
    )
    if cloud.reflectivity is not None:
        bright = max(round(float(np.percentile(cloud.reflectivity, 95)), 2), 0.01)
        yield (
            "reflectivity",
            "Only what reflects well stays: signs, plates, markings, some poles.",
            f"{config.min_reflectivity:g} to 1",
            by_reflectivity(cloud.reflectivity, config.min_reflectivity),
            f"{bright:g} to 1",
            by_reflectivity(cloud.reflectivity, bright),
        )
    left, right = cloud.borders
    width = float(np.angle(np.exp(1j * (left - right))))
    middle, half = (float(np.rad2deg(a)) for a in (np.angle(np.exp(1j * (right + width / 2))), abs(width) / 2))
    yield (
        "angle",
        "Directions that the camera does not see are of no use.",
        f"{config.azimuth_half_width_deg:g} deg around {config.azimuth_deg:g} deg",
        by_angle(xyz, config.azimuth_deg, config.azimuth_half_width_deg),
        f"{half:.0f} deg around {round(middle)} deg, the camera's field",
        by_angle(xyz, middle, half),
    )
    yield (
        "range",
        "What is very near (the vehicle itself) or very far has no clear edges in the image.",
        f"{config.min_depth:g} to {config.max_depth:g} m",
        by_range(xyz, config.min_depth, config.max_depth),
        "5 to 30 m",
        by_range(xyz, 5, 30),
    )


def _ground(scene: RegisteredFrame, cloud: Cloud) -> Iterator[Step]:
    config = thesis_of(scene.config)
    colors = cloud.colors.copy()
    colors[~cloud.passed] = HIDDEN
    if cloud.plane is None:
        text = f"no plane holds {GROUND_SHARE:.0%} of the points, so nothing counts as ground."
    else:
        normal, tilt = cloud.plane.normal, np.rad2deg(np.arccos(np.clip(cloud.plane.normal[2], -1, 1)))
        text = (
            f"the plane lies {abs(cloud.plane.offset) / normal[2]:.2f} m below the LiDAR and is tilted by {tilt:.1f} deg; "
            f"{np.count_nonzero(cloud.ground)} points ({cloud.ground.mean():.0%}) lie nearer to it than "
            f"{config.ground_distance:g} m, or below."
        )
    marked = colors.copy()
    marked[cloud.ground] = GROUND
    yield wide_step(
        "Ground found",
        f"RANSAC, algorithm 1, {config.ground_iterations} planes tried: {text} Ground is orange.",
        cloud.draw(marked, cloud.scale),
    )
    colors[cloud.ground] = HIDDEN
    yield wide_step(
        "Ground removed",
        "Figure 3.9a: the depth map without the ground (grey). Objects now stand by themselves. Depth edges and clusters are "
        "taken from these points; reflectivity edges from all, since lane markings lie on the ground.",
        cloud.draw(colors, cloud.scale),
    )
    order = np.argsort(cloud.xyz[:, 2], kind="stable")
    yield step(
        "Ground from above",
        "The ground from above, ahead is up: ground in orange, all else by depth. Look for kerbs and slopes that are taken for "
        "ground, or are not.",
        from_above(cloud.xyz[order], marked[order]),
    )
    levels = np.where(cloud.ground, GROUND_LEVEL, OTHER_LEVEL)
    yield step(
        "Ground on the image",
        "The same on the image, projected with the extrinsic of this page (eq. 2.30): ground in orange, all else in blue.",
        over(scene.gray, enlarged(_on_image(scene, cloud, np.where(cloud.passed, levels, 0))), GROUND_PALETTE),
    )


def _clusters(scene: RegisteredFrame, cloud: Cloud) -> Iterator[Step]:
    config = thesis_of(scene.config)
    colors = NAMES[cloud.label]
    colors[cloud.label == NO_OBJECT] = HIDDEN
    sizes = np.sort(np.bincount(cloud.label)[1:])[::-1]
    sizes = sizes[sizes > 0]
    largest = f"The largest has {sizes[0]} points, the smallest {sizes[-1]}. " if len(sizes) else ""
    yield wide_step(
        "Clusters",
        f"Figure 3.9b: DBSCAN, algorithm 2, finds {len(sizes)} objects among the points above ground within "
        f"{config.cluster_max_depth:g} m (radius {config.cluster_eps:g} m, {config.cluster_min_points} points). {largest}"
        "Grey points belong to none. Colours are names only.",
        cloud.draw(colors),
    )
    order = np.argsort(cloud.label > 0, kind="stable")
    yield step(
        "Clusters from above",
        "The same from above. Look for objects that have grown together and for walls that fall apart: their borders become "
        "edges.",
        from_above(cloud.xyz[order], colors[order]),
    )
    labels = _on_image(scene, cloud, cloud.label)
    seen = len(np.unique(labels[labels > 0]))
    yield step(
        "Clusters on the image",
        f"{seen} of the objects are in the camera's picture, projected with the extrinsic of this page (eq. 2.30).",
        over(scene.gray, enlarged(labels), NAMES),
    )


def _on_image(scene: RegisteredFrame, cloud: Cloud, levels: NDArray[np.generic]) -> Image:
    """Levels (n,) of the points on the pixels (h, w) they fall on; 0 elsewhere. The nearest point counts."""
    camera, far_first = scene.frame.camera, np.argsort(-cloud.depth, kind="stable")
    u, v, inside = project(cloud.xyz[far_first], scene.T, camera)
    picture = np.zeros((camera.height, camera.width), np.uint8)
    picture[v, u] = levels[far_first][inside]
    return picture
