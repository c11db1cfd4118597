"""The scan by itself, and its threshold filters (thesis 3.3, 3.3.1)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.evaluation.steps.panorama import Panorama
from calib_ros.evaluation.steps.pictures import HIDDEN, PLASMA, VIRIDIS, Scale
from calib_ros.evaluation.steps.step import Scene, Step
from calib_ros.frame import PointCloud
from calib_ros.lidar import filters
from calib_ros.lidar.attributes import NO_OBJECT, ground_plane, ground_points, object_labels, within_reach, within_thresholds
from calib_ros.lidar.ground import Plane
from calib_ros.lidar.scan import range_image

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float32]
SECTION = "3.3"
TELLING = 0.05  # a configured filter that removes a smaller share of the points is shown with another threshold
REFLECTIVITY = Scale("reflectivity, share of full scale", 0, 1, PLASMA)


def depth_scale(depth: Floats) -> Scale:
    """Colours of depth, bright = near; the nearest and farthest hundredth of the depths (n,) share the scale's ends."""
    low, high = np.percentile(depth, [1, 99]) if len(depth) else (1, 2)
    low = max(float(f"{low:.2g}"), 0.1)
    return Scale("depth (eq. 3.8), m", low, max(float(f"{high:.2g}"), 2 * low), VIRIDIS, log=True, falling=True)


@dataclass(frozen=True, eq=False)
class Cloud:
    """All returns of a scan (n,) in the order of its panorama, and what the thesis finds of them."""

    points: PointCloud
    panorama: Panorama
    depth: Floats
    reflectivity: Floats | None
    passed: Mask
    plane: Plane | None
    ground: Mask
    label: NDArray[np.uint8]

    @staticmethod
    def of(scene: Scene) -> Cloud:
        """The same steps as attributes(), which keeps only the points that are left in the end."""
        config = scene.config.thesis
        # Every return has its cell: nothing is cut off, no hole is filled.
        scan = range_image(scene.frame.cloud, dataclasses.replace(scene.config.lidar, min_range=0.0, hole_jump=0.0))
        xyz, d = scan.cloud.xyz, filters.depth(scan.cloud.xyz)
        reach, passed = within_reach(xyz, config), within_thresholds(xyz, scan.reflectivity, config)
        plane = ground_plane(xyz[reach], config)
        ground, label = np.zeros(len(xyz), bool), np.full(len(xyz), NO_OBJECT, np.uint8)
        ground[reach] = ground_points(xyz[reach], plane, config)
        ground &= passed
        label[passed] = object_labels(xyz[passed], d[passed], ground[passed], config)
        panorama = Panorama.of(scan, scene.T, scene.frame.camera)
        return Cloud(scan.cloud, panorama, d, scan.reflectivity, passed, plane, ground, label)


def cloud_steps(scene: Scene, cloud: Cloud) -> Iterator[Step]:
    """Raw scan and threshold filters."""
    n = len(cloud.points)
    scale = depth_scale(cloud.depth)
    yield Step(
        SECTION,
        "Scan by depth",
        f"Figure 3.7a: all {n} returns of the scan as a panorama; a row is a ring of the LiDAR, a column a direction. The white "
        "lines are the borders of the camera's picture. Bright is near.",
        cloud.panorama.draw(scale.palette[scale.levels(cloud.depth)], scale),
        wide=True,
    )
    if cloud.reflectivity is None:
        yield Step(
            SECTION,
            "Scan by reflectivity",
            "Figure 3.7b is missing: this source tells no intensity, or the same for all points. "
            "What needs it is left out, or zero, below.",
        )
    else:
        yield Step(
            SECTION,
            "Scan by reflectivity",
            "Figure 3.7b: how much of the beam comes back. Look for signs, number plates and lane markings, which depth does not "
            f"show. The median is {np.median(cloud.reflectivity):.2f}; 5 % of the points lie above "
            f"{np.percentile(cloud.reflectivity, 95):.2f}.",
            cloud.panorama.draw(PLASMA[REFLECTIVITY.levels(cloud.reflectivity)], REFLECTIVITY),
            wide=True,
        )
    yield from _filters(scene, cloud)


def _filters(scene: Scene, cloud: Cloud) -> Iterator[Step]:
    xyz, scale = cloud.points.xyz, depth_scale(cloud.depth)
    colors = scale.palette[scale.levels(cloud.depth)]
    rows: list[tuple[str, ...]] = [("filter", "kept in this run", "removed", "kept in the picture", "removed")]
    for name, text, own, own_mask, other, other_mask in _choices(scene, cloud):
        removed = 1 - float(own_mask.mean())
        shown, mask = (own, own_mask) if removed >= TELLING else (other, other_mask)
        rows.append((name, own, f"{removed:.1%}", shown, f"{1 - mask.mean():.1%}"))
        why = (
            "the limits of this run" if shown == own else f"chosen for the picture, since this run ({own}) removes {removed:.1%}"
        )
        yield Step(
            SECTION,
            f"Filter by {name}",
            f"Figure 3.8. {text} Coloured: kept, {shown} ({why}). Grey: the {np.count_nonzero(~mask)} points removed, "
            f"{1 - mask.mean():.1%} of all.",
            cloud.panorama.draw(np.where(mask[:, None], colors, np.uint8(HIDDEN[0])), scale),
            wide=True,
        )
    yield Step(
        SECTION,
        "Threshold filters together",
        f"Of {len(xyz)} points, {np.count_nonzero(cloud.passed)} pass all filters of this run and go on.",
        table=tuple(rows),
        wide=True,
    )


def _choices(scene: Scene, cloud: Cloud) -> Iterator[tuple[str, str, str, Mask, str, Mask]]:
    """Filter, what it is for, the limits of this run and who passes, telling limits and who passes those."""
    config, xyz = scene.config.thesis, cloud.points.xyz
    floor = float(np.percentile(xyz[:, 2], 10)) if cloud.plane is None else cloud.plane.offset / float(cloud.plane.normal[2])
    low = round(floor + 0.3, 1)
    yield (
        "height",
        "A floor under the heights takes away ground and kerbs.",
        f"{config.min_height:g} to {config.max_height:g} m",
        filters.by_height(xyz, config.min_height, config.max_height),
        f"{low:g} to {config.max_height:g} m from the LiDAR",
        filters.by_height(xyz, low, config.max_height),
    )
    if cloud.reflectivity is not None:
        bright = max(round(float(np.percentile(cloud.reflectivity, 95)), 2), 0.01)
        yield (
            "reflectivity",
            "Only what reflects well stays: signs, plates, markings, some poles.",
            f"{config.min_reflectivity:g} to 1",
            filters.by_reflectivity(cloud.reflectivity, config.min_reflectivity),
            f"{bright:g} to 1",
            filters.by_reflectivity(cloud.reflectivity, bright),
        )
    middle, half = _camera_azimuths(scene)
    yield (
        "angle",
        "Directions that the camera does not see are of no use.",
        f"{config.azimuth_half_width_deg:g} deg around {config.azimuth_deg:g} deg",
        filters.by_angle(xyz, config.azimuth_deg, config.azimuth_half_width_deg),
        f"{half:.0f} deg around {round(middle)} deg, the camera's field",
        filters.by_angle(xyz, middle, half),
    )
    yield (
        "range",
        "What is very near (the vehicle itself) or very far has no clear edges in the image.",
        f"{config.min_depth:g} to {config.max_depth:g} m",
        filters.by_range(xyz, config.min_depth, config.max_depth),
        "5 to 30 m",
        filters.by_range(xyz, 5, 30),
    )


def _camera_azimuths(scene: Scene) -> tuple[float, float]:
    """Middle and half width of the camera's horizontal field, in the LiDAR's azimuth, deg."""
    camera, R = scene.frame.camera, scene.T[:3, :3]
    rays = np.array([[0, camera.K[1, 2], 1], [camera.width - 1, camera.K[1, 2], 1]]) @ np.linalg.inv(camera.K).T @ R
    left, right = np.arctan2(rays[:, 1], rays[:, 0])
    width = float(np.angle(np.exp(1j * (left - right))))
    middle = float(np.angle(np.exp(1j * (right + width / 2))))
    return float(np.rad2deg(middle)), float(np.rad2deg(abs(width) / 2))
