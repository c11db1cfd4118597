"""Painters: which finish the places on solids have, what porous solids let through, and the colours of finishes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros_synthetic.solids import Solids, cell, noise2
from training.world.looks import Float32, Pattern
from training.world.stage import Cover, Stage

Ints = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Places:
    """n places on solids. ids: (n,). q: (3, n), -1..1 of the half sizes. face: (n,) axis. u, v: (n,) m along and up it."""

    ids: Ints
    q: Float32
    face: NDArray[np.uint8]
    u: Float32
    v: Float32

    def pick(self, some: NDArray[np.intp]) -> Places:
        """Some of them."""
        return Places(self.ids[some], self.q[:, some], self.face[some], self.u[some], self.v[some])


class Painter:
    """Paints the solids of one stage."""

    def __init__(self, stage: Stage, solids: Solids, night: bool) -> None:
        self._named = stage.finish
        self._facades, self._bodies = stage.facades, stage.bodies
        self._own = np.rint(solids.style[:, 1]).astype(np.int32)
        self._variant = np.rint(solids.style[:, 2]).astype(np.int32)
        self._phase = solids.style[:, 3]
        self._half = solids.half.astype(np.float32)
        self._cover = solids.surface
        self._night = night

    def finishes(self, at: Places) -> Ints:
        """Finishes (n,) of places."""
        out = self._own[at.ids]
        cover = self._cover[at.ids]
        painters = {
            Cover.FACADE: self._facade, Cover.BODY: self._body, Cover.CABIN: self._cabin, Cover.COACH: self._coach,
            Cover.WHEEL: self._wheel, Cover.SHAPE: self._plate, Cover.HEAD: self._head, Cover.LIGHTS: self._lights,
        }  # fmt: skip
        for code, paint in painters.items():
            some = np.flatnonzero(cover == code)
            if len(some):
                out[some] = paint(at.pick(some), out[some])
        return out

    def _styles(self, rows: list[dict[str, float]], at: Places) -> dict[str, Float32]:
        """What the styles of places say, (n,) by name."""
        return {name: np.array([row[name] for row in rows], np.float32)[self._variant[at.ids]] for name in rows[0]}

    def _facade(self, at: Places, wall: Ints) -> Ints:
        s = self._styles(self._facades, at)
        phase, half = self._phase[at.ids], self._half[at.ids]
        reach = np.where(at.face == 0, half[:, 1], half[:, 0])
        pitch = 2 * reach / np.maximum(np.floor(2 * reach / s["pitch"]), 1)  # whole windows between the corners
        column, row = np.floor((at.u + reach) / pitch), np.floor(at.v / s["storey"])
        x, y = np.abs(at.u + reach - (column + 0.5) * pitch), at.v - row * s["storey"]
        ground = row == 0
        shop = ground & (s["shop"] > 0)
        door = ground & (cell(column, 7, phase * 999) < s["doors"]) & ~shop
        wide = np.where(s["ribbon"] > 0, pitch / 2 - 0.04, pitch * s["wide"])
        wide = np.where(shop, pitch * 0.44, np.where(door, np.minimum(wide, 0.7), wide))
        sill = np.where(shop, 0.45, np.where(door, 0.08, s["sill"]))
        lintel = s["lintel"]
        within = (y > sill) & (y < lintel) & (at.v < 2 * half[:, 2] - 0.2) & (at.face < 2)
        hole = (x < wide) & within & ~((cell(column, row, phase * 999) < s["blind"]) & ~shop)
        frame = np.where(shop, 0.06, s["frame"])
        pane = hole & (x < wide - frame) & (y > sill + frame) & (y < lintel - frame)
        across = np.abs((x / wide * (s["bars_x"] + 1) / 2 + np.where(s["bars_x"] % 2 > 0, 0.0, 0.5)) % 1.0 - 0.5) * wide * 2
        up = np.abs(((y - sill) / (lintel - sill) * (s["bars_y"] + 1) + 0.5) % 1.0 - 0.5) * (lintel - sill)
        pane &= ~((across > wide - 0.035) & (s["bars_x"] > 0)) & ~((up < 0.03) & (s["bars_y"] > 0))
        lower = cell(column * 3 + 1, row, phase * 999)  # how far a curtain or a blind is down
        down = (lintel - sill) * np.abs(2 * lower / np.maximum(s["curtain"], 0.01) - 1)
        curtain = pane & (lower < s["curtain"]) & (y > sill + down)
        lit = pane & (cell(column + 5, row * 3, phase * 999) < s["lit"]) & self._night
        shutter = (s["shutter"] > 0) & ~ground & (x > wide) & (x < wide + s["shutter"]) & within
        band = (y < s["band"]) & (row > 0) & (at.face < 2)
        glass, trim, wood = (s[name].astype(np.int32) for name in ("glass", "trim", "door"))
        out = np.where(band, trim, wall)
        out = np.where(shutter, wood, out)
        out = np.where(hole, np.where(door, wood, trim), out)
        out = np.where(pane & ~door, glass, out)
        out = np.where(curtain & ~door, self._named["curtain"], out)
        return np.where(lit & ~door, self._named["lit"], out)

    def _body(self, at: Places, paint: Ints) -> Ints:
        s = self._styles(self._bodies, at)
        (x, y, z), name, front = at.q, self._named, at.q[0] > 0
        ends, sides = at.face == 0, at.face == 1
        lamp = ends & (np.abs(y) > s["lamp in"]) & (z > s["lamp low"]) & (z < s["lamp high"]) & (np.abs(y) < 0.95)
        plate = ends & (np.abs(y) < 0.28) & (np.abs(z + 0.15) < 0.14)
        grille = ends & front & (np.abs(y) < s["lamp in"]) & (np.abs(z - s["lamp low"]) < s["grille"] * 0.5)
        arch = np.zeros(len(x), bool)
        for axle in ("rear axle", "front axle"):
            arch |= sides & (np.square((x - s[axle]) / s["arch x"]) + np.square((z + 1.25) / (1.25 * s["arch z"])) < 1)
        seam = sides & ((np.abs(x - 0.02) < 0.005) | (np.abs(x - 0.42) < 0.005) | (np.abs(x + 0.36) < 0.005))
        handle = sides & (np.abs(z - 0.72) < 0.06) & ((np.abs(x + 0.05) < 0.025) | (np.abs(x + 0.42) < 0.025))
        out = np.where((z < s["sill"]) | seam | arch | grille, name["dark"], paint)
        out = np.where(handle, name["chrome"], out)
        out = np.where(lamp, np.where(front, name["lamp"], name["tail"]), out)
        return np.where(plate, name["plate"], out)

    def _cabin(self, at: Places, paint: Ints) -> Ints:
        s = self._styles(self._bodies, at)
        x, y, z = at.q
        w = s["pillar"]
        pillar = (np.abs(np.abs(x) - 0.9 + 0.16 * (z + 1)) < w) | (np.abs(x - 0.05) < 0.7 * w)
        glass = np.where(at.face == 1, ~pillar & (np.abs(x) < 0.9), np.abs(y) < 0.86) & (z > -0.82) & (z < 0.78) & (at.face < 2)
        return np.where(glass, self._named["car glass"], paint)

    def _coach(self, at: Places, paint: Ints) -> Ints:
        z, width = at.q[2], 1.5 + 0.5 * self._phase[at.ids]
        pillar = (at.u % width) < 0.1
        side = (at.face == 1) & ~pillar & (np.abs(at.q[0]) < 0.97)
        end = (at.face == 0) & (np.abs(at.q[1]) < 0.88)
        glass = (side & (z > -0.1) & (z < 0.62)) | (end & (z > -0.25) & (z < 0.7))
        door = (at.face == 1) & (np.abs(np.abs(at.q[0]) - 0.8) < 0.06) & (z < 0.6) & ~pillar
        lamp = (at.face == 0) & (np.abs(at.q[1]) > 0.7) & (np.abs(z + 0.75) < 0.1)
        out = np.where(glass | door, self._named["car glass"], paint)
        return np.where(lamp, self._named["lamp"], out)

    def _wheel(self, at: Places, tyre: Ints) -> Ints:
        r, spokes = np.hypot(at.q[0], at.q[2]), np.cos(self._variant[at.ids] * np.arctan2(at.q[0], at.q[2])) > -0.3
        rim = (np.abs(at.q[1]) > 0.98) & (r < 0.7) & (spokes | (r < 0.2) | (r > 0.62))
        return np.where(rim, self._named["rim"], tyre)

    def _plate(self, at: Places, face: Ints) -> Ints:
        back = (at.face == 0) & (at.q[0] > 0) & (self._phase[at.ids] < 0.6)
        border = _inside(at.q[1] * 1.22, at.q[2] * 1.22, self._variant[at.ids])
        rim = np.where(self._phase[at.ids] < 0.5, self._named["red"], self._named["white"])
        return np.where(back, self._named["metal"], np.where(border, face, rim))

    def _head(self, at: Places, skin: Ints) -> Ints:
        return np.where((at.q[2] > 0.3) | (at.q[0] < -0.25), self._named["hair"], skin)

    def _lights(self, at: Places, case: Ints) -> Ints:
        which = np.floor((at.q[2] + 1) * 1.5)
        disc = (at.face == 0) & (at.q[0] < 0) & (np.hypot(at.q[1] * 0.16, ((at.q[2] + 1) * 1.5 - which - 0.5) * 0.3) < 0.11)
        on = which == self._variant[at.ids] % 3
        colour = np.where(which > 1, self._named["red light"], self._named["green light"])
        return np.where(disc, np.where(on, colour, self._named["dark"]), case)


def _inside(y: Float32, z: Float32, shape: Ints) -> NDArray[np.bool_]:
    """Whether y, z (n,) in -1..1 belong to plates of these shapes (n,)."""
    cases = [
        np.maximum(np.abs(y), np.abs(z)) < 1,
        np.hypot(y, z) < 1,
        (np.abs(y) < (1 - z) / 2) & (z > -1),
        (np.abs(y) < (1 + z) / 2) & (z < 1),
        (np.maximum(np.abs(y), np.abs(z)) < 1) & (np.abs(y) + np.abs(z) < 1.41),
        np.abs(y) + np.abs(z) < 1,
    ]
    return np.asarray(np.choose(np.clip(shape, 0, 5), cases), bool)


def open_at(cover: int, variant: int, q: Float32, half: Float32) -> NDArray[np.bool_]:
    """Whether a porous solid has a hole at q (3, n)."""
    if cover == Cover.SHAPE:
        return ~_inside(q[1], q[2], np.full(q.shape[1], variant, np.int32))
    if cover == Cover.SPOKES:
        r = np.hypot(q[0], q[2])
        return np.asarray((r < 0.88) & (np.cos(11 * np.arctan2(q[0], q[2])) < 0.93) & (r > 0.12))
    u, z = q[0] * half[0], (q[2] + 1) * half[2]
    frame = (np.abs(q[2]) > 0.93) | (np.abs(q[2] + 0.75) < 0.05)
    if variant == 0:  # pickets
        return np.asarray((u % 0.16 > 0.09) & ~((np.abs(q[2] - 0.5) < 0.08) | (np.abs(q[2] + 0.5) < 0.08)))
    if variant == 1:  # upright bars
        return np.asarray((u % 0.12 > 0.025) & ~frame)
    if variant == 2:  # mesh
        return np.asarray((u % 0.1 > 0.012) & (z % 0.1 > 0.012) & ~frame)
    if variant == 3:  # rails along
        return np.asarray((z % 0.4 > 0.08) & (u % 2.0 > 0.08))
    return np.asarray(z % 0.2 > 0.13)  # boards along


def texture(table: dict[str, Float32], finish: Ints, u: Float32, v: Float32, shift: Float32, texel: Float32) -> Float32:
    """Albedo (3, n) of finishes (n,) at u, v (n,) m. shift: (n,) moves the noise, so that no two solids show the same.

    texel: (n,) m that a pixel covers there; finer patterns fade to their mean.
    """
    f = {name: values[finish] for name, values in table.items() if name not in ("a", "b", "size", "gloss", "emit")}
    mix, tone = np.zeros(len(u), np.float32), np.ones(len(u), np.float32)
    size, pattern = table["size"][finish], f["pattern"]
    for kind in np.unique(pattern).tolist():
        if kind == Pattern.NONE:
            continue
        some = np.flatnonzero(pattern == kind)
        mix[some], tone[some] = _pattern(int(kind), u[some], v[some], size[some], f["joint"][some], shift[some])
        tone[some] = 1 + f["spread"][some] * (tone[some] - 0.5) * 2
        if kind == Pattern.BLOTCH:
            continue
        cells = np.minimum(size[some, 0], size[some, 1]) / np.maximum(texel[some], 1e-4)
        fade = np.clip(cells / 2 - 0.5, 0, 1)
        mean = np.where(kind == Pattern.PRINT, 0.3, 2 * f["joint"][some] / np.maximum(size[some].min(axis=1), 0.05))
        mix[some] = mean + (mix[some] - mean) * fade
        tone[some] = 1 + (tone[some] - 1) * fade
    grains = f["grain"] * texel
    fine = noise2(u * f["grain"] + shift * 91, v * f["grain"], 1) / (1 + grains * grains)
    broad = noise2(u + shift * 7, v, 2.5)
    tone *= np.clip(1 + f["fine"] * fine + f["broad"] * broad, 0.2, 2.2)
    a, b = table["a"][finish].T, table["b"][finish].T
    return np.asarray((a + (b - a) * mix) * tone, np.float32)


def _pattern(kind: int, u: Float32, v: Float32, size: Float32, joint: Float32, shift: Float32) -> tuple[Float32, Float32]:
    """Share of the second colour and a random number, each (n,), of a pattern."""
    if kind == Pattern.BLOTCH:
        noise = noise2(u / size[:, 0] + shift * 31, v / size[:, 0], 1.5)
        return np.clip(noise * 2 - 0.6, 0, 1).astype(np.float32), np.full(len(u), 0.5, np.float32)
    row = np.floor(v / size[:, 1])
    along = u / size[:, 0] + (0.5 * (row % 2) if kind == Pattern.BRICK else 0.0)
    column = np.floor(along)
    if kind == Pattern.PRINT:
        noise = noise2(u / size[:, 0] + shift * 17, v / size[:, 1], 3)
        line = (np.floor(v / size[:, 1] / 3 + shift * 5) % 2) > 0
        share = np.where(line, cell(along * 3, row, shift * 999) < 0.45, noise > 0.7)
        return share.astype(np.float32), cell(column, row, shift * 999)
    gap_u, gap_v = (along - column) * size[:, 0] < joint, (v - row * size[:, 1]) < joint
    if kind in (Pattern.ROWS, Pattern.COLUMNS):
        share, which = (gap_v, row) if kind == Pattern.ROWS else (gap_u, column)
        return share.astype(np.float32), cell(which, shift * 999)
    return (gap_u | gap_v).astype(np.float32), cell(column, row, shift * 999)
