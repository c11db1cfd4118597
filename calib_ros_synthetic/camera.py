"""Renders the camera image of the synthetic street, with sub-pixel exact silhouettes and shadows, and what makes a picture bad:
light, haze, rain drops, motion blur, a rolling shutter, compression."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros_synthetic import surfaces
from calib_ros_synthetic.ego import OwnLayer
from calib_ros_synthetic.materials import Part
from calib_ros_synthetic.rays import (
    OWN,
    SAMPLES,
    SKY,
    CameraView,
    Ints,
    Jobs,
    Rays,
    RowMotion,
    cast,
    cast_ground,
    changes,
    intersect,
    nearest_first,
    unmet,
)
from calib_ros_synthetic.solids import Float32, Floats, Solids, Surface
from calib_ros_synthetic.street import Street
from calib_ros_synthetic.surfaces import DAY, LAMPS, Lighting, spots

AHEAD, SIDE, TEXEL = 55.0, 13.0, 0.07  # m that the map reaches ahead and to either side; m per texel
Ids = NDArray[np.int32]
BLUR = 0.5  # px, standard deviation of the lens and the sensor
READ_NOISE = 1.8  # grey levels
SHADED = 1 << 16  # rays at a time: larger arrays do not fit the cache
FAR, FLOW_STEP = 1000.0, 1e-3  # m, the distance of the sky; s over which the flow of the picture is taken

Picture = NDArray[np.float32]
BLUR_TAPS = 9  # samples along the way that a pixel's surface moves during the exposure
LONGEST_BLUR = 60.0  # px


@dataclass(frozen=True)
class Conditions:
    """What a picture is taken under.

    lighting: of the scene; indoors, the lamps' light is scaled by it. noise: factor on the noise of the image sensor.
    visibility: m at which haze leaves 1/e of a LiDAR's light. exposure: s, for motion blur. readout: s from the first row to the
    last. drops: on the lens. jpeg: quality, 1 to 100; 0 = not compressed.
    """

    lighting: Lighting = field(default_factory=lambda: DAY)
    noise: float = 1.0
    visibility: float = np.inf
    exposure: float = 0.0
    readout: float = 0.0
    drops: int = 0
    jpeg: int = 0

    def lit(self, indoors: bool) -> Lighting:
        """The lighting of a scene under these conditions."""
        if not indoors:
            return self.lighting
        a, b = self.lighting, LAMPS
        return replace(a, sun=a.sun * b.sun, ambient=a.ambient * b.ambient, sky=a.sky * b.sky, haze=min(a.haze, b.haze))


NIGHT = Lighting(sun=0.02, ambient=0.035, sky=0.01, headlights=60.0, haze=900.0, exposure=2.2)
HAZY = Lighting(sun=0.25, ambient=1.0, sky=1.0, haze=55.0)

CONDITIONS: dict[str, Conditions] = {
    "clear": Conditions(),
    "night": Conditions(lighting=NIGHT, noise=5.0, exposure=0.012),  # headlights, hardly any contrast beyond them
    "haze": Conditions(lighting=HAZY, noise=1.5, visibility=160.0),  # two thirds of the contrast are lost at 55 m
    "rain": Conditions(lighting=Lighting(sun=0.1, ambient=0.9, sky=0.8, haze=160.0), noise=2.0, visibility=300.0, drops=40),
    "blur": Conditions(noise=1.5, exposure=0.020),  # a long exposure from a moving vehicle
    "rolling": Conditions(readout=0.030),  # a CMOS sensor read row by row in 30 ms
    "jpeg": Conditions(noise=1.5, jpeg=25),  # blocks of 8 x 8
}
CLEAR = CONDITIONS["clear"]


@dataclass(frozen=True, eq=False)
class Scene:
    """What the camera looks at. solids: relative to the lens. origin: of the lens in the world (3,). R: world from camera.

    R_vehicle: world from vehicle; needed with own and with headlights. own: what the camera sees of its vehicle. motion: of a
    rolling shutter. twist: of the camera in its own frame, for blur.
    """

    street: Street
    solids: Solids
    origin: Floats
    R: Floats
    lighting: Lighting = DAY
    own: OwnLayer | None = None
    R_vehicle: Floats | None = None
    motion: RowMotion | None = None
    twist: Floats | None = None


def render(
    scene: Scene, view: CameraView, noise: float, rng: np.random.Generator, spoilt: Conditions = CLEAR
) -> tuple[NDArray[np.uint8], Ids]:
    """-> image (H, W, 3) BGR, and what each pixel's centre sees (H, W) as `cast` writes it.

    spoilt: what happens to the picture; its lighting, readout and noise are the scene's and the caller's.
    """
    rays = view.rays(scene.R, scene.motion)
    t, ids = unmet(rays.shape)
    if scene.own is not None:  # nothing is seen through the own vehicle
        whole = scene.own.pixels[scene.own.cover == 1]
        t.ravel()[whole], ids.ravel()[whole] = 0, OWN
    cast(rays, scene.solids, view.jobs(scene.solids, scene.R, scene.motion), t, ids)
    cast_ground(rays, scene.street, scene.origin, t, ids)
    shadows = Shadows(scene.solids, scene.street.sun, scene.R[:, 2], float(scene.origin[2]))
    colour, part = _shade(scene, shadows, rays, t.ravel(), ids.ravel())
    # Clumps of one crown grow through each other; only the crown's outline is a silhouette.
    part = part.reshape(ids.shape)
    key = np.where(part == Part.LEAF, SKY - 100, ids * 64 + part)
    edge = np.flatnonzero(changes(key))
    colour[:, edge] = _antialias(scene, shadows, view, ids, edge)
    if scene.own is not None:
        _cover(scene, scene.own, colour, ids)
    image = np.ascontiguousarray(colour.reshape(3, *ids.shape).transpose(1, 2, 0))
    if spoilt.exposure and scene.twist is not None:
        image = _motion_blurred(image, _flow(view, t, ids, scene.twist), spoilt.exposure)
    image[~view.seen] = 0
    image = cv2.GaussianBlur(image, (0, 0), BLUR)
    if spoilt.drops:
        image = _with_drops(image, spoilt.drops, np.random.default_rng([scene.street.seed, 10]))
    if noise > 0:
        image += np.float32(READ_NOISE * noise) * rng.standard_normal(image.shape, np.float32)
    levels = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    if spoilt.jpeg:
        data = cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, spoilt.jpeg])[1]
        levels = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
    return levels, np.where(view.seen, ids, SKY)


def _flow(view: CameraView, t: Float32, ids: Ids, twist: Floats) -> Float32:
    """How fast what each pixel sees moves over the picture, (H, W, 2) px/s; the own vehicle stands still."""
    far = np.minimum(t, np.float32(FAR))
    x, y, z = view.x * far, view.y * far, view.z * far
    (wx, wy, wz), (vx, vy, vz) = (
        a * np.float32(FLOW_STEP / 2) for a in (twist[:3].astype(np.float32), twist[3:].astype(np.float32))
    )
    # A fixed point moves by -(v + w x p) in the camera's frame.
    dx, dy, dz = -(vx + wy * z - wz * y), -(vy + wz * x - wx * z), -(vz + wx * y - wy * x)
    flow = (view.pixels((x + dx, y + dy, z + dz)) - view.pixels((x - dx, y - dy, z - dz))) / np.float32(FLOW_STEP)
    flow[ids == OWN] = 0
    return np.asarray(flow, np.float32)


def _cover(scene: Scene, own: OwnLayer, colour: Float32, ids: Ids) -> None:
    """Lays the own vehicle over the grey levels (3, n) and writes OWN to ids (H, W), in place."""
    R = np.eye(3) if scene.R_vehicle is None else scene.R_vehicle
    over = own.colour(R.T @ scene.street.sun, scene.lighting, float(scene.origin[2]))
    colour[:, own.pixels] += own.cover * (over - colour[:, own.pixels])
    ids.ravel()[own.pixels[own.cover > 0.5]] = OWN


def _shade(scene: Scene, shadows: Shadows, rays: Rays, t: Float32, ids: Ids) -> tuple[Float32, NDArray[np.uint8]]:
    """Grey levels (3, n) and materials (n,) of n rays in the order of their grid, with distances t (n,) and ids (n,)."""
    directions = np.stack([d.ravel() for d in rays.direction])
    colour = np.empty((3, len(ids)), np.float32)
    part = np.zeros(len(ids), np.uint8)
    free = np.flatnonzero(ids == SKY)
    colour[:, free] = surfaces.sky(directions[:, free], scene.street.seed, scene.lighting)
    origin = None if scene.motion is None else [np.broadcast_to(o, rays.shape).ravel() for o in rays.origin]
    sun = scene.street.sun.tolist()
    forward = None if scene.R_vehicle is None else scene.R_vehicle[:, 0]
    solid = np.flatnonzero((ids != SKY) & (ids != OWN))
    for first in range(0, len(solid), SHADED):
        hit = solid[first : first + SHADED]
        xyz, what = directions[:, hit] * t[hit], ids[hit]
        if origin is not None:
            xyz += np.stack([o[hit] for o in origin])
        here = spots(scene.street, scene.solids, what, xyz, scene.origin)
        facing = here.normal[0] * sun[0] + here.normal[1] * sun[1] + here.normal[2] * sun[2] > 0
        lit = shadows.lit(xyz, what, facing)
        colour[:, hit] = surfaces.light(scene.solids, what, xyz, here, lit, scene.street.sun, scene.lighting, forward)
        part[hit] = here.part
    colour[:, ids == OWN] = 0
    return surfaces.display(colour * np.float32(scene.lighting.exposure)), part


def _antialias(scene: Scene, shadows: Shadows, view: CameraView, ids: Ids, edge: NDArray[np.intp]) -> Float32:
    """Mean grey level (3, n) of the sub-pixel rays of the pixels with flat indices edge (n,).

    Only solids that a pixel or one of its eight neighbours sees are tried. Levels are averaged after the gamma: averaged
    light would push every border a tenth of a pixel towards its dark side.
    """
    rows, columns = np.divmod(edge, ids.shape[1])
    rays = view.between(edge, SAMPLES, scene.R, scene.motion)
    t, found = unmet(rays.shape)
    padded = np.pad(ids, 1, mode="edge")
    around: list[Ids] = []
    pixels, candidates = [], []
    for j in range(3):
        for i in range(3):
            seen = padded[rows + j, columns + i]
            new = seen >= 0
            for earlier in around:
                new &= seen != earlier
            around.append(seen)
            pixels.append(np.flatnonzero(new))
            candidates.append(seen[pixels[-1]])
    pixel, candidate = np.concatenate(pixels), np.concatenate(candidates)
    order = np.argsort(candidate, kind="stable")
    pixel, candidate = pixel[order], candidate[order]
    for group in np.split(np.arange(len(pixel)), np.flatnonzero(np.diff(candidate)) + 1):
        if len(group):
            which, i = pixel[group], int(candidate[group[0]])
            some = rays.window(np.s_[:], which)
            new_t, old_t, old = intersect(scene.solids, i, some), t[:, which], found[:, which]
            hit = new_t < old_t
            t[:, which], found[:, which] = np.where(hit, new_t, old_t), np.where(hit, np.int32(i), old)
    cast_ground(rays, scene.street, scene.origin, t, found)
    colour, _ = _shade(scene, shadows, rays, t.ravel(), found.ravel())
    return np.asarray(colour.reshape(3, *rays.shape).mean(axis=1))


def _motion_blurred(image: Picture, flow: Picture, exposure: float) -> Picture:
    """Image (H, W, 3) averaged along the way that each pixel's surface takes. flow: (H, W, 2) px/s. exposure: s.

    The way is centred on the moment of the picture, so that no edge is displaced.
    """
    way = flow * np.float32(exposure)
    length = np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-6)
    way *= np.minimum(1, np.float32(LONGEST_BLUR) / length)
    if float(np.abs(way).max()) < 0.3:
        return image
    v, u = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    out = np.zeros_like(image)
    for k in np.linspace(-0.5, 0.5, BLUR_TAPS, dtype=np.float32):
        out += cv2.remap(image, u + k * way[..., 0], v + k * way[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out / BLUR_TAPS, np.float32)


def _with_drops(image: Picture, count: int, rng: np.random.Generator) -> Picture:
    """Image (H, W, 3) through rain drops: each shows the scene upside down, small and out of focus. rng: places the drops."""
    height, width = image.shape[:2]
    v, u = np.mgrid[:height, :width].astype(np.float32)
    weight = np.zeros((height, width), np.float32)
    for _ in range(count):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        radius = width * rng.uniform(0.006, 0.026)
        tall = rng.uniform(1.0, 1.5)
        r0, r1 = max(int(y - 1.5 * radius * tall), 0), min(int(y + 1.5 * radius * tall) + 2, height)
        c0, c1 = max(int(x - 1.5 * radius), 0), min(int(x + 1.5 * radius) + 2, width)
        if r1 <= r0 or c1 <= c0:
            continue
        rows, columns = np.mgrid[r0:r1, c0:c1].astype(np.float32)
        dx, dy = columns - np.float32(x), (rows - np.float32(y)) / np.float32(tall)
        inside = np.clip((radius - np.hypot(dx, dy)) / (0.25 * radius), 0, 1)
        u[r0:r1, c0:c1] += inside * (-5.0 * dx)
        v[r0:r1, c0:c1] += inside * (-5.0 * dy)
        weight[r0:r1, c0:c1] = np.maximum(weight[r0:r1, c0:c1], inside)
    blurred = cv2.GaussianBlur(image, (0, 0), width / 320)
    seen = cv2.remap(blurred, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return np.asarray(image + weight[..., None] * (seen - image), np.float32)


class Shadows:
    """Looks up which places the sun reaches: parallel rays from it on a grid of texels that covers a box."""

    def __init__(self, solids: Solids, sun: Floats, forward: Floats, height: float) -> None:
        """solids: relative to the lens. sun, forward: towards the sun and along the view (3,). height: of the lens, m."""
        forward = forward[:2] / (np.linalg.norm(forward[:2]) + 1e-9)
        left = np.array([-forward[1], forward[0]])
        receivers = np.array(
            [[*(a * forward + b * left), z] for a in (0.0, AHEAD) for b in (-SIDE, SIDE) for z in (-height, 5.0)]
        )
        e1 = np.cross([0.0, 0.0, 1.0], sun)
        e1 /= np.linalg.norm(e1)
        self._axes = np.stack([e1, np.cross(sun, e1), -sun])  # columns, rows, distance from the sun
        flat = receivers @ self._axes.T
        self._low = flat.min(axis=0)
        self._low[2] -= 60.0  # far enough towards the sun to start outside everything that throws shadows
        shape = tuple(int(n) for n in np.ceil((flat.max(axis=0) - self._low)[1::-1] / TEXEL) + 1)
        rows, columns = (self._low[k] + np.arange(shape[1 - k]) * TEXEL for k in (1, 0))
        (e1, e2, down), start = self._axes, self._low[2]
        origin = tuple((e1[k] * columns[None] + e2[k] * rows[:, None] + down[k] * start).astype(np.float32) for k in range(3))
        self._depth, self._ids = unmet(shape)
        rays = Rays(origin, tuple(np.full((1, 1), v, np.float32) for v in down))  # type: ignore[arg-type]
        cast(rays, solids, self._jobs(solids, shape), self._depth, self._ids)
        d = self._depth
        d = np.minimum(d, np.roll(d, -1, axis=1))
        self._first = np.minimum(d, np.roll(d, -1, axis=0))  # of the four texels around a place

    def _jobs(self, solids: Solids, shape: tuple[int, ...]) -> Jobs:
        """Windows for `cast`."""
        flat = solids.corners() @ self._axes.T
        low, high = flat.min(axis=1), flat.max(axis=1)
        spans = []
        for k in (1, 0):
            spans += [np.ceil((low[:, k] - self._low[k]) / TEXEL), np.floor((high[:, k] - self._low[k]) / TEXEL) + 1]
        clipped = np.clip(np.array(spans), 0, np.repeat(shape, 2)[:, None]).astype(np.int32)
        keep = (clipped[1] > clipped[0]) & (clipped[3] > clipped[2]) & (low[:, 2] > self._low[2])
        keep &= solids.surface != Surface.CEILING
        jobs = np.concatenate([np.arange(len(solids), dtype=np.int32)[None], clipped])[:, keep].T
        return nearest_first(np.ascontiguousarray(jobs), low[keep, 2] - self._low[2])

    def lit(self, xyz: Float32, ids: Ints, faces_sun: NDArray[np.bool_]) -> Float32:
        """Share (n,) of the sun that reaches points xyz (3, n) on the things ids (n,); 1 outside the map.

        Only places that face the sun (n,) are looked up. A solid does not shade itself here: its normals tell that,
        without the speckles of a depth map.
        """
        axes, low, scale = self._axes.tolist(), self._low.tolist(), 1 / TEXEL
        height, width = self._depth.shape
        some = np.flatnonzero(faces_sun)
        x, y, z = (xyz[k].take(some) for k in range(3))
        columns, rows = (((axes[k][0] * x + axes[k][1] * y + axes[k][2] * z) - low[k]) * scale for k in (0, 1))
        depth = (axes[2][0] * x + axes[2][1] * y + axes[2][2] * z) - (low[2] + 0.03)
        inside = (columns >= 0) & (columns < width - 1) & (rows >= 0) & (rows < height - 1)
        texel = np.where(inside, rows, 0).astype(np.int32) * width + np.where(inside, columns, 0).astype(np.int32)
        hidden = np.flatnonzero(inside & (self._first.ravel().take(texel) < depth))
        columns, rows, depth, texel = columns[hidden], rows[hidden], depth[hidden], texel[hidden]
        some = some[hidden]
        a, b, own = columns % 1, rows % 1, ids[some]
        shade = np.zeros(len(some), np.float32)
        for step, weight in ((0, (1 - b) * (1 - a)), (1, (1 - b) * a), (width, b * (1 - a)), (width + 1, b * a)):
            at = texel + step
            shade += weight * ((self._depth.ravel().take(at) < depth) & (self._ids.ravel().take(at) != own))
        out = np.ones(len(ids), np.float32)
        out[some] -= shade
        return out
