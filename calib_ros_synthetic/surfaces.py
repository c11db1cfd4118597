"""Materials and colours at points of the synthetic street, the same for camera and LiDAR. Colours are BGR."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros_synthetic.materials import ALBEDO, CONTRAST, GLOSS, GRAIN, GROUNDS, OWN_COLOUR, Bytes, Part
from calib_ros_synthetic.rays import CURB, ROAD, Ints
from calib_ros_synthetic.solids import Float32, Floats, Kind, Solids, Surface, cell, noise2
from calib_ros_synthetic.street import Street

SUN = np.array([0.95, 1.10, 1.20], np.float32)
AMBIENT = np.array([0.52, 0.44, 0.40], np.float32)
ZENITH = np.array([0.72, 0.45, 0.26], np.float32)
HAZE = np.array([0.80, 0.74, 0.68], np.float32)
CLOUD = np.array([0.98, 0.97, 0.96], np.float32)
WOODS = np.array([0.16, 0.20, 0.15], np.float32)  # far trees on the horizon, too far for any LiDAR
HAZE_RANGE = 450.0  # m over which two thirds of the contrast are lost
HAZE_LAYER = 30.0  # m
FOCAL = 720.0  # px; the pixel size that textures fade for


@dataclass(frozen=True)
class Lighting:
    """Factors on the light of sun, surroundings and sky, and on the exposure; range of haze, m; power of the headlights."""

    sun: float = 1.0
    ambient: float = 1.0
    sky: float = 1.0
    haze: float = HAZE_RANGE
    headlights: float = 0.0
    exposure: float = 1.0


DAY = Lighting()
LAMPS = Lighting(sun=0.75, ambient=0.75, sky=0.25, haze=2000.0)  # indoors
BEAM = np.array([0.90, 1.0, 1.0], np.float32)  # colour of headlights
BEAM_WIDTH = 0.42  # rad to either side at which they have lost two thirds


@dataclass(frozen=True, eq=False)
class Spots:
    """n hits. normal: (3, n) unit vectors in world axes. u, v: (n,) metres along and up the surface. part: (n,) Part."""

    part: Bytes
    normal: Float32
    u: Float32
    v: Float32


def spots(street: Street | None, solids: Solids, ids: Ints, xyz: Float32, origin: Floats) -> Spots:
    """Materials of hits: ids (n,) as `cast` writes them, xyz (3, n) relative to origin (3,) in the world."""
    n = len(ids)
    out = Spots(np.zeros(n, np.uint8), np.zeros((3, n), np.float32), np.zeros(n, np.float32), np.zeros(n, np.float32))
    out.normal[2] = 1
    ground = np.flatnonzero(ids <= ROAD)
    if street is not None and len(ground):
        s, d = street.path.frenet(xyz[0, ground], xyz[1, ground], origin)
        out.u[ground], out.v[ground] = s, d
        out.part[ground] = GROUNDS[street.ground](street, ids[ground], s, d)
        curb = ground[ids[ground] == CURB]
        heading = street.path.station(out.u[curb])[2]
        towards_road = -np.sign(out.v[curb])
        out.normal[:, curb] = [-np.sin(heading) * towards_road, np.cos(heading) * towards_road, np.zeros(len(curb))]
    body = np.flatnonzero(ids >= 0)
    if len(body):
        _bodies(solids, ids[body], xyz[:, body], out, body)
    return out


def _of(values: Floats, ids: Ints) -> Float32:
    return np.asarray(values.astype(np.float32).take(ids))


def faces(solids: Solids, ids: Ints, q: Float32) -> tuple[Bytes, list[Float32], Float32, Float32]:
    """Axis of the face (n,), normal (three (n,), of any length), u and v (n,) m of places q (3, n), -1..1, on solids ids (n,).

    Axes and normals are the solids' own.
    """
    half = [_of(solids.half[:, k], ids) for k in range(3)]
    # The sides of a frustum lean; a box is a frustum that does not.
    slope = [_of(solids.taper[:, k] / 2, ids) for k in (0, 1)]
    side = [np.abs(q[k]) + slope[k] * (q[2] + 1) for k in (0, 1)]
    top = np.abs(q[2])
    across = (side[0] >= side[1]) & (side[0] >= top)
    along = ~across & (side[1] >= top)
    face = np.where(across, np.uint8(0), np.where(along, np.uint8(1), np.uint8(2)))
    normal = [
        np.where(across, np.sign(q[0]), 0),
        np.where(along, np.sign(q[1]), 0),
        np.where(across, slope[0], np.where(along, slope[1], np.sign(q[2]))),
    ]
    curved = np.flatnonzero(solids.kind.take(ids) >= Kind.ELLIPSOID)
    kind, bent = solids.kind[ids[curved]], q[:, curved]
    for shape, k in ((Kind.CYLINDER, 2), (Kind.WHEEL, 1)):
        m = kind == shape
        cap = m & (np.abs(bent[k]) > 0.999)
        for j in range(3):
            bent[j] = np.where(cap, np.sign(bent[k]) if j == k else 0, np.where(m & (j == k), 0, bent[j]))
    for k in range(3):
        normal[k][curved] = bent[k]
        normal[k] /= half[k]
    u = np.where(across, q[1] * half[1], q[0] * half[0])
    v = np.where(face == 2, q[1] * half[1], (q[2] + 1) * half[2])
    return face, normal, u, v


def _bodies(solids: Solids, ids: Ints, xyz: Float32, out: Spots, where: NDArray[np.intp]) -> None:
    c, s = _of(np.cos(solids.yaw), ids), _of(np.sin(solids.yaw), ids)
    x, y, z = (xyz[k] - _of(solids.centre[:, k], ids) for k in range(3))
    half = [_of(solids.half[:, k], ids) for k in range(3)]
    q = np.stack([(c * x + s * y) / half[0], (c * y - s * x) / half[1], z / half[2]])
    face, normal, u, v = faces(solids, ids, q)
    scale = 1 / np.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
    out.normal[0, where] = (c * normal[0] - s * normal[1]) * scale
    out.normal[1, where] = (s * normal[0] + c * normal[1]) * scale
    out.normal[2, where] = normal[2] * scale
    out.u[where], out.v[where] = u, v
    surface = solids.surface[ids]
    part = np.zeros(len(ids), np.uint8)
    for code in np.unique(surface).tolist():
        if code in PLAIN_PARTS:
            part[surface == code] = PLAIN_PARTS[code]
            continue
        m = np.flatnonzero(surface == code)
        at = Place(q[:, m], face[m], u[m], v[m], np.ascontiguousarray(solids.style[ids[m]].T))
        part[m] = PAINTERS[code](at)
    out.part[where] = part


@dataclass(frozen=True, eq=False)
class Place:
    """Where on its solid a hit is: q (3, n) in -1..1, face (n,) axis, u, v (n,) m, style (4, n)."""

    q: Float32
    face: Bytes
    u: Float32
    v: Float32
    style: Float32


def _facade(a: Place) -> Bytes:
    pitch, storey = 1.7 + 1.4 * a.style[0], np.float32(3.0)
    column, row = np.floor(a.u / pitch), np.floor(a.v / storey)
    x, y = np.abs(a.u - (column + 0.5) * pitch), a.v - row * storey
    wide, sill = pitch * (0.2 + 0.14 * a.style[1]), 0.75 + 0.3 * a.style[2]
    door = (row == 0) & (cell(column, 7, a.style[3] * 999) < 0.22)
    lintel = np.float32(2.4)
    sill = np.where(door, 0.1, sill)
    blind = cell(column, row, a.style[3] * 999) < 0.12
    hole = (x < wide) & (y > sill) & (y < lintel)
    pane = hole & (x < wide - 0.07) & (y > sill + 0.07) & (y < lintel - 0.07) & (x > 0.025)
    opening = np.where(door, Part.DOOR, np.where(pane, Part.WINDOW, Part.FRAME))
    band = (y < 0.12) & (row > 0) & (a.style[2] > 0.5)  # a string course between the storeys
    wall = np.where(band, Part.FRAME, Part.WALL)
    return np.where((a.face == 2) | blind | ~hole, wall, opening).astype(np.uint8)


def _body(a: Place) -> Bytes:
    x, y, z = a.q
    ends = a.face == 0
    lamp = ends & (np.abs(y) > 0.62) & (z > 0.15) & (z < 0.62)
    plate = ends & (np.abs(y) < 0.3) & (np.abs(z + 0.2) < 0.16)
    seam = (a.face == 1) & ((np.abs(x - 0.02) < 0.006) | (np.abs(x - 0.42) < 0.006) | (np.abs(x + 0.38) < 0.006))
    dark = (z < -0.72) | (ends & (x > 0) & (np.abs(z - 0.3) < 0.14) & (np.abs(y) < 0.5)) | seam
    return np.select([lamp, plate, dark], [Part.LAMP, Part.BOARD, Part.RUBBER], Part.PAINT).astype(np.uint8)


def _cabin(a: Place) -> Bytes:
    x, y, z = a.q
    pillar = (np.abs(np.abs(x) - 0.9 + 0.2 * (z + 1)) < 0.07) | (np.abs(x) < 0.05)
    glass = np.where(a.face == 1, ~pillar & (np.abs(x) < 0.85), np.abs(y) < 0.84) & (z > -0.75) & (z < 0.72)
    return np.where(glass & (a.face < 2), Part.GLASS, Part.PAINT).astype(np.uint8)


def _wheel(a: Place) -> Bytes:
    r = np.hypot(a.q[0], a.q[2])
    spokes = np.cos(5 * np.arctan2(a.q[0], a.q[2])) > -0.3
    return np.where((np.abs(a.q[1]) > 0.99) & (r < 0.68) & spokes, Part.RIM, Part.RUBBER).astype(np.uint8)


def _sign(a: Place) -> Bytes:
    x, y = np.abs(a.q[1]), np.abs(a.q[2])
    border = (x > 0.84) | (y > 0.84)
    symbol = np.where(a.style[0] < 0.5, (y < 0.2) & (x < 0.65), np.hypot(x, y) < 0.5)
    front = np.where(border | symbol, Part.SYMBOL, Part.BOARD)
    return np.where((a.face == 0) & (a.q[0] < 0), front, Part.METAL).astype(np.uint8)


def _poster(a: Place) -> Bytes:
    noise = noise2(a.u + 9 * a.style[0], a.v + 9 * a.style[1], 40)
    text = (cell(a.u * 6, a.v * 5, a.style[2] * 99) < 0.45) & (a.v % 0.6 < 0.3)
    return np.where((noise > 1.2) | text, Part.PRINT, Part.PLAIN).astype(np.uint8)


PLAIN_PARTS: dict[int, Part] = {
    Surface.PLAIN: Part.PLAIN, Surface.ROOF: Part.TILES, Surface.BARK: Part.BARK, Surface.LEAF: Part.LEAF,
    Surface.CLOTH: Part.CLOTH, Surface.METAL: Part.METAL, Surface.CEILING: Part.PLAIN,
}  # fmt: skip
PAINTERS: dict[int, Callable[[Place], Bytes]] = {
    Surface.FACADE: _facade, Surface.BODY: _body, Surface.CABIN: _cabin, Surface.TYRE: _wheel,
    Surface.SIGN: _sign, Surface.POSTER: _poster,
    Surface.SKIN: lambda a: np.where((a.q[2] > 0.35) | (a.q[0] < -0.3), Part.HAIR, Part.SKIN).astype(np.uint8),
    Surface.FENCE: lambda a: np.where((a.u % 0.16 < 0.03) & (a.q[2] < 0.8), Part.RUBBER, Part.SLAT).astype(np.uint8),
}  # fmt: skip


def display(linear: Float32) -> Float32:
    """Light 0..1 -> grey level 0..255 by a camera's gamma, here 2."""
    return np.asarray(np.sqrt(np.clip(linear, 0, 1)) * np.float32(255))


def sky(direction: Float32, seed: int, lighting: Lighting) -> Float32:
    """Light (3, n) from the directions (3, n) of any length: gradient, clouds, and woods at the horizon."""
    x, y, z = direction / np.sqrt((direction * direction).sum(axis=0))
    up = np.clip(z, 0, 1)
    blend = np.sqrt(up)
    out = HAZE[:, None] + (ZENITH - HAZE)[:, None] * blend
    height = 1 / (up + np.float32(0.08))
    cover = np.clip(0.45 * noise2(x * height + seed, y * height, 40) + 0.1, 0, 1) * np.minimum(1, 6 * up)
    out += (CLOUD[:, None] - out) * cover
    low = np.flatnonzero(z < 0.09)
    around = np.arctan2(y[low], x[low])
    wood = z[low] < 0.035 + 0.016 * noise2(around, np.full_like(around, seed * 0.37), 60)
    out[:, low[wood]] = (WOODS * 0.55 + HAZE * 0.25)[:, None]
    if lighting.haze < HAZE_RANGE:  # a layer of haze below the sky: the lower, the longer the way through it
        clear = np.exp(np.float32(-HAZE_LAYER / lighting.haze) / np.clip(z, 0.01, 1))
        out = out * clear + (HAZE * np.float32(0.8))[:, None] * (1 - clear)
    return np.asarray(out * np.float32(lighting.sky), np.float32)


def light(
    solids: Solids, ids: Ints, xyz: Float32, here: Spots, lit: Float32, sun: Floats, lighting: Lighting, forward: Floats | None
) -> Float32:
    """Light (3, n) that reaches the lens from hits at xyz (3, n) relative to the lens. lit: (n,) share of the sun seen.

    forward: (3,) where the headlights shine.
    """
    part, normal = here.part, here.normal
    own = OWN_COLOUR.take(part) & (ids >= 0)
    # One table: the solids' own colours, then those of the materials.
    row = np.where(own, ids, part + np.int32(len(solids)))
    distance = np.sqrt(xyz[0] * xyz[0] + xyz[1] * xyz[1] + xyz[2] * xyz[2])

    grain = GRAIN.take(part)
    texels = grain * distance * np.float32(1 / FOCAL)  # per pixel; finer than that, only the mean is left
    offset = np.float32(0.618) * ids
    fine = noise2(here.u * grain + offset * 91, here.v * grain, 1)
    broad = noise2(here.u + offset * 7, here.v, 2.5)
    texture = 1 + CONTRAST.take(part) * fine / (1 + texels * texels) + np.float32(0.06) * broad
    texture = np.clip(texture, 0.25, 2.2)

    sx, sy, sz = (np.float32(v) for v in sun)
    direct = np.maximum(normal[0] * sx + normal[1] * sy + normal[2] * sz, 0) * lit
    leaf = np.flatnonzero(part == Part.LEAF)
    direct[leaf] = 0.35 * lit[leaf] + 0.55 * direct[leaf]  # leaves point everywhere and let light through
    ambient = np.float32(0.62) + np.float32(0.38) * normal[2]
    body = ids >= 0
    ambient *= np.where(body, np.float32(0.7) + np.float32(0.3) * np.clip(here.v / 1.5, 0, 1), 1)
    lamps = _headlights(xyz, normal, distance, part, lighting, forward)
    out = np.empty_like(xyz)
    for k in range(3):
        albedo = np.concatenate([solids.colour[:, k], ALBEDO[:, k]]).take(row)
        out[k] = albedo * texture * (SUN[k] * lighting.sun * direct + AMBIENT[k] * lighting.ambient * ambient + lamps * BEAM[k])

    shiny = np.flatnonzero((GLOSS > 0).take(part))
    if len(shiny):
        ray, n = xyz[:, shiny] / distance[shiny], normal[:, shiny]
        cosine = (ray * n).sum(axis=0)
        mirror = ray - 2 * cosine * n
        fresnel = GLOSS[part[shiny]] + np.float32(0.7) * (1 - np.abs(cosine)) ** 5
        up = np.clip(4 * mirror[2] + 0.2 + 0.25 * broad[shiny], 0.08, 1)  # below the roofs the street is mirrored
        out[:, shiny] += fresnel * up * lighting.sky * (0.5 * HAZE + 0.5 * ZENITH)[:, None]
        glint = np.maximum(mirror[0] * sx + mirror[1] * sy + mirror[2] * sz, 0) ** 60 * lit[shiny] * lighting.sun
        out[:, shiny] += np.minimum(fresnel * 4, 1) * glint
    clear = np.exp(distance * np.float32(-1 / lighting.haze))
    out *= clear
    out += (HAZE * np.float32(0.8 * lighting.sky))[:, None] * (1 - clear)
    return out


def _headlights(
    xyz: Float32, normal: Float32, distance: Float32, part: Bytes, lighting: Lighting, forward: Floats | None
) -> Float32 | float:
    """Light (n,) of the own headlights, which shine from about the lens; signs and number plates return it."""
    if lighting.headlights == 0 or forward is None:
        return 0.0
    f = forward.astype(np.float32)
    ray = xyz / distance
    ahead = np.clip(f[0] * ray[0] + f[1] * ray[1] + f[2] * ray[2], -1, 1)
    facing = np.abs((ray * normal).sum(axis=0))
    beam = np.exp(-np.square(np.arccos(ahead) / np.float32(BEAM_WIDTH)))
    power = np.float32(lighting.headlights) * beam * facing / (25.0 + np.square(distance))
    return np.asarray(power * np.where((part == Part.BOARD) | (part == Part.SYMBOL), 12.0, 1.0), np.float32)
