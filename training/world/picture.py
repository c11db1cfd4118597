"""One picture of one random world, and its labels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros_synthetic.camera import SunView
from calib_ros_synthetic.rays import SKY as NOTHING
from calib_ros_synthetic.rays import Jobs, Rays, cast, unmet
from calib_ros_synthetic.solids import Solids, cell
from calib_ros_synthetic.surfaces import faces
from training.world.cameras import RandomCamera, camera_of, exposed
from training.world.grounds import GROUND, GroundPainter, Layout, cast_ground
from training.world.light import Light, light_of, shine, sky
from training.world.looks import Float32
from training.world.paint import Painter, Places, open_at, texture
from training.world.places import Place
from training.world.stage import CAR, CYCLIST, OTHER, PEDESTRIAN, POROUS, SKY, TREE, Cover, Stage

Ints = NDArray[np.int32]
Picture = tuple[NDArray[np.uint8], NDArray[np.uint8]]
TEXEL = 0.16  # m of the shadow map
SHADOWED = (60.0, 22.0, 6.0)  # m ahead, to either side and up that get shadows from it
BENEATH = 0.2  # m per texel of the map of what stands near the ground


@dataclass(frozen=True, eq=False)
class World:
    """A furnished world about the origin, which lies on the road below the camera. solids: relative to the lens."""

    stage: Stage
    layout: Layout
    ground: GroundPainter
    solids: Solids
    light: Light
    camera: RandomCamera


def world_of(seed: int, number: int, scale: float = 1.0) -> World:
    """The world of a number. scale: of the picture's size."""
    rng = np.random.default_rng([seed, number, 77])
    camera, stage = camera_of(rng, scale), Stage(rng)
    place = Place(stage, camera)
    ground = GroundPainter(stage, place.layout)
    solids = stage.solids().moved(np.array([0.0, 0.0, -camera.height]))
    return World(stage, place.layout, ground, solids, light_of(rng), camera)


def picture_of(seed: int, number: int, scale: float = 1.0) -> Picture:
    """BGR (H, W, 3) and CamVid's class numbers (H, W) of the picture with this number, always the same."""
    return render(world_of(seed, number, scale))


def render(world: World) -> Picture:
    """The picture of a world."""
    return render_with_depth(world)[:2]


def render_with_depth(world: World) -> tuple[NDArray[np.uint8], NDArray[np.uint8], Float32]:
    """The picture of a world, and where each of its rays ends (H, W), in lengths of its direction; infinite in the sky."""
    camera, rng = world.camera, world.stage.rng
    rays = camera.view.rays(camera.R)
    t, ids = unmet(rays.shape)
    cast_solids(rays, world.solids, camera.view.jobs(world.solids, camera.R), t, ids)
    kerbs = cast_ground(rays, world.layout, camera.height, t, ids)
    light, labels = _shaded(world, rays, t.ravel(), ids.ravel(), kerbs.ravel())
    image = np.ascontiguousarray(light.reshape(3, *ids.shape).transpose(1, 2, 0))
    labels = labels.reshape(ids.shape)
    image, labels = _smooth(image, ids), np.where(camera.view.seen, labels, OTHER).astype(np.uint8)
    levels = exposed(image, labels == SKY, rng)
    levels[~camera.view.seen] = 0
    return levels, labels, t


def cast_solids(rays: Rays, solids: Solids, jobs: Jobs, t: Float32, ids: Ints) -> None:
    """As the ray caster's own, with holes in porous solids."""

    def pierce(i: int, window: Rays, new: Float32, hit: NDArray[np.bool_]) -> None:
        if int(solids.surface[i]) in POROUS:
            rows, columns = np.nonzero(hit)
            points = [np.broadcast_to(p, hit.shape)[rows, columns] for p in window.at(np.where(hit, new, 0))]
            q = _local(solids, np.full(len(rows), i), np.stack(points).astype(np.float32))
            gap = open_at(int(solids.surface[i]), round(float(solids.style[i, 2])), q, solids.half[i].astype(np.float32))
            hit[rows[gap], columns[gap]] = False

    cast(rays, solids, jobs, t, ids, pierce)


def _local(solids: Solids, ids: NDArray[np.integer], xyz: Float32) -> Float32:
    """Points (3, n) in the axes of the solids ids (n,), in units of their half sizes."""
    yaw = solids.yaw[ids]
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = xyz - solids.centre[ids].T
    return np.asarray(np.stack([c * x + s * y, c * y - s * x, z]) / solids.half[ids].T, np.float32)


def _shaded(world: World, rays: Rays, t: Float32, ids: Ints, kerbs: NDArray[np.bool_]) -> tuple[Float32, NDArray[np.uint8]]:
    """Light (3, n) and labels (n,) of what rays in the order of their grid met at t (n,)."""
    direction = np.stack([np.broadcast_to(d, rays.shape).ravel() for d in rays.direction])
    out, labels = np.empty((3, len(ids)), np.float32), np.empty(len(ids), np.uint8)
    free = np.flatnonzero(ids == NOTHING)
    out[:, free], labels[free] = sky(world.light, direction[:, free])
    some = np.flatnonzero(ids != NOTHING)
    xyz, what = direction[:, some] * t[some], ids[some]
    distance = np.sqrt((xyz * xyz).sum(axis=0))
    solids, camera, n = world.solids, world.camera, len(some)
    normal, near = np.zeros((3, n), np.float32), np.ones(n, np.float32)
    finish, shift, tint = np.zeros(n, np.int32), np.zeros(n, np.float32), np.ones(n, np.float32)
    u, v, leaf, label = np.zeros(n, np.float32), np.zeros(n, np.float32), np.zeros(n, bool), np.zeros(n, np.uint8)
    normal[2] = 1
    g = np.flatnonzero(what == GROUND)
    u[g] = xyz[0, g]
    finish[g], label[g], v[g] = world.ground.paint(xyz[0, g], xyz[1, g], kerbs[some][g])
    near[g] = _beneath(solids, camera.height, xyz[0, g], xyz[1, g])
    b = np.flatnonzero(what >= 0)
    if len(b):
        hit = what[b]
        q = _local(solids, hit, xyz[:, b])
        face, bent, u[b], v[b] = _geometry(solids, hit, q)
        c, s = np.cos(solids.yaw[hit]), np.sin(solids.yaw[hit])
        normal[:, b] = np.stack([c * bent[0] - s * bent[1], s * bent[0] + c * bent[1], bent[2]])
        finish[b] = Painter(world.stage, solids, world.light.night).finishes(Places(hit, q, face, u[b], v[b]))
        leaf[b] = solids.surface[hit] == Cover.LEAF
        inner = np.clip(np.sqrt((q * q).sum(axis=0)), 0, 1)  # leaves deep within a clump, and low, are dark
        tint[b] = solids.colour[hit, 0] * np.where(leaf[b], (0.25 + 0.75 * inner * inner) * (0.72 + 0.28 * q[2]), 1)
        shift[b], label[b] = solids.style[hit, 3], solids.label[hit]
        above = np.clip((xyz[2, b] + camera.height) / 1.2, 0, 1)
        near[b] = 0.6 + 0.4 * above
    mixed = leaf & (label == TREE)
    u[mixed] += 0.6 * xyz[2, mixed]
    table = world.stage.table()
    texel = distance / np.float32(camera.focal)
    tint[leaf] *= _single_leaves(xyz[:, leaf], texel[leaf])
    albedo = texture(table, finish, u, v, shift, texel) * tint
    lit = _lit(world, xyz, what, normal)
    out[:, some] = shine(
        world.light, albedo, normal, xyz / distance, distance, lit, near, table["gloss"][finish], table["emit"][finish], leaf,
        camera.R[:, 2].astype(np.float32),
    )  # fmt: skip
    labels[some] = label
    return out, labels


def _single_leaves(xyz: Float32, texel: Float32) -> Float32:
    """Brightness (n,) of leaves and of twigs full of them: grains of three sizes, each as long as a pixel is smaller."""
    out = np.ones(xyz.shape[1], np.float32)
    for size, share in ((0.07, 0.8), (0.2, 0.5), (0.6, 0.35)):
        grain = cell(xyz[0] / size + 0.4 * xyz[2], xyz[1] / size, xyz[2] / size + 0.3 * xyz[1]) - np.float32(0.5)
        out += share * grain * np.clip(2 * size / np.maximum(texel, 1e-4) - 0.5, 0, 1)
    return np.asarray(np.maximum(out, 0.15), np.float32)


def _geometry(solids: Solids, ids: Ints, q: Float32) -> tuple[NDArray[np.uint8], Float32, Float32, Float32]:
    """Axis of the face (n,), normal (3, n) in the solid's axes, and u, v (n,) m of places q (3, n) on solids ids (n,).

    Vehicles' normals are bent outwards as if their sheets were curved: flat ones mirror one colour only.
    """
    face, parts, u, v = faces(solids, ids, q)
    normal = np.stack(parts)
    normal /= np.sqrt((normal * normal).sum(axis=0)) + 1e-9
    bend = np.isin(solids.surface[ids], [Cover.BODY, Cover.CABIN]) * np.float32(0.3)
    normal += bend * q
    normal /= np.sqrt((normal * normal).sum(axis=0)) + 1e-9
    return face, normal, u, v


def _beneath(solids: Solids, height: float, x: Float32, y: Float32) -> Float32:
    """Share (n,) of the ambient light at points of the ground: less beneath vehicles and at the foot of what stands there."""
    size, reach = int(2 * 50 / BENEATH), 50.0
    grid = np.zeros((size, size), np.float32)
    low = solids.centre[:, 2] - solids.half[:, 2] + height < 0.7
    close = (np.abs(solids.centre[:, :2]) < reach).all(axis=1) & low
    close &= np.isin(solids.label, [CAR, PEDESTRIAN, CYCLIST, OTHER, TREE])
    if close.any():
        foot = solids.corners()[close][:, [0, 1, 3, 2], :2]
        for corners in np.rint((foot + reach) / BENEATH).astype(np.int32):
            cv2.fillConvexPoly(grid, np.ascontiguousarray(corners), 1.0)
    grid = cv2.GaussianBlur(grid, (0, 0), 0.3 / BENEATH)
    i, j = (np.clip((a + np.float32(reach)) / BENEATH, 0, size - 1).astype(np.int32) for a in (y, x))
    return np.asarray(1 - 0.85 * grid[i, j], np.float32)


def _lit(world: World, xyz: Float32, ids: Ints, normal: Float32) -> Float32:
    """Share (n,) of the sun seen from points (3, n): a map of depths as the sun sees them, four texels averaged."""
    light, camera = world.light, world.camera
    out = np.ones(len(ids), np.float32)
    if float(light.direct.max()) < 0.1:
        return out
    ahead, wide, high = SHADOWED
    low = -4.0 if camera.focal > 150 else -15.0
    forward = np.array([np.cos(camera.yaw), np.sin(camera.yaw)])
    view = SunView(light.sun, forward, (low, ahead), wide, (-camera.height, high), TEXEL)
    depth, owner = unmet(view.shape)
    cast_solids(view.rays(), world.solids, view.jobs(world.solids), depth, owner)
    facing = np.flatnonzero((normal * light.sun.astype(np.float32)[:, None]).sum(axis=0) > 0)
    at = view.axes.astype(np.float32) @ xyz[:, facing]
    column, row = ((at[k] - np.float32(view.low[k])) / TEXEL for k in (0, 1))
    distance = at[2] - np.float32(view.low[2]) - np.float32(0.06)
    inside = (column >= 0) & (column < view.shape[1] - 1) & (row >= 0) & (row < view.shape[0] - 1)
    facing, column, row, distance = facing[inside], column[inside], row[inside], distance[inside]
    r, c = row.astype(np.int32), column.astype(np.int32)
    a, b = column - c, row - r
    shade = np.zeros(len(facing), np.float32)
    for dr, dc, weight in ((0, 0, (1 - b) * (1 - a)), (0, 1, (1 - b) * a), (1, 0, b * (1 - a)), (1, 1, b * a)):
        shade += weight * ((depth[r + dr, c + dc] < distance) & (owner[r + dr, c + dc] != ids[facing]))
    out[facing] -= shade
    return out


def _smooth(image: Float32, ids: Ints) -> Float32:
    """Softens the steps at outlines, where neighbours belong to different solids: cheaper than more rays."""
    differs = np.zeros(ids.shape, bool)
    differs[:, 1:] |= ids[:, 1:] != ids[:, :-1]
    differs[1:] |= ids[1:] != ids[:-1]
    top = np.float32(2.5) * np.median(image) + np.float32(1.5)
    soft = cv2.GaussianBlur(np.minimum(image, top), (0, 0), 0.7)
    return np.where(differs[..., None], soft, image)
