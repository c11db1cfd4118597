"""What the completion network learns from: pictures of random worlds, what a scanner beside the camera measures, exact depth.

FOLDER/image, sparse and dense hold NUMBER.png: grey levels, and depths in 1/256 m as 16 bit, 0 = nothing measured, or sky.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from calib_ros_synthetic.rays import ORIGIN, Rays, unmet
from calib_ros_synthetic.scanners import MODELS, SpinningScanner
from calib_ros_synthetic.wide import WideView
from training.world.grounds import GROUND
from training.world.picture import World, cast_solids, render_with_depth, world_of

Float32 = NDArray[np.float32]
Floats = NDArray[np.float64]
UNITS = 256.0  # levels per metre, as of KITTI's depth maps
FARTHEST = 80.0  # m; beyond it nothing is measured, and nothing has to be completed
KINDS = ("image", "sparse", "dense")
# HDL-64E most often, as KITTI's; of scanners with 16 rings there is little to complete.
SCANNERS = ("hdl64e", "hdl64e", "hdl64e", "pandar64", "os1_64", "os1_128", "vls128", "vlp32c", "hdl32e")
SCALES = (0.8, 1.7)  # of the pictures' sizes: up to those of usual cameras
LOST_SOLIDS, LOST_POINTS = 0.06, 0.15  # shares: dark cars and panes, of which much is lost; and at most of all points


class Scene(NamedTuple):
    """image: (H, W) uint8. sparse, dense: (H, W) float32, distance from the scanner's axis (eq. 3.8), m; 0 = unknown."""

    image: NDArray[np.uint8]
    sparse: Float32
    dense: Float32


def scene_of(seed: int, number: int) -> Scene | None:
    """The scene of a number, always the same; None for worlds that are seen through a fisheye."""
    rng = np.random.default_rng([seed, number, 31])
    world = world_of(seed, number, float(rng.uniform(*SCALES)))
    camera = world.camera
    if isinstance(camera.view, WideView):
        return None
    image, _, t = render_with_depth(world)
    # Behind, beside and above the lens, as scanners on roofs are.
    turn = Rotation.from_euler("zyx", [camera.yaw, *np.deg2rad(rng.normal(0, 1, 2))]).as_matrix()
    offset = turn @ [rng.uniform(-0.8, 0.2), rng.uniform(-0.4, 0.4), rng.uniform(-0.1, 0.7)]
    met = np.isfinite(t)
    rays = camera.view.rays(camera.R)
    places = np.stack([np.broadcast_to(d, t.shape)[met] * t[met] for d in rays.direction], axis=-1)
    dense = np.zeros(t.shape, np.float32)
    dense[met] = _from_axis(places, offset, turn)
    dense[dense > FARTHEST] = 0
    gray = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    return Scene(gray, _sparse(world, offset, turn, rng), dense)


def _from_axis(places: Floats, offset: Floats, turn: Floats) -> Float32:
    """Distances (n,) of places (n, 3), relative to the lens, from the axis of a scanner at offset (3,), turned (3, 3)."""
    own = (places - offset) @ turn
    return np.hypot(own[:, 0], own[:, 1]).astype(np.float32)


def _sparse(world: World, offset: Floats, turn: Floats, rng: np.random.Generator) -> Float32:
    """A scan in the picture (H, W), with noise and losses; of the points in one pixel the nearest is kept."""
    scanner = SpinningScanner(MODELS[SCANNERS[int(rng.integers(len(SCANNERS)))]])
    beams, _ = scanner.beams()
    direction = [sum(np.float32(turn[k, j]) * beams[j] for j in range(3)) for k in range(3)]
    rays, solids, pose = Rays(ORIGIN, tuple(direction)), world.solids.moved(-offset), np.eye(4)  # type: ignore[arg-type]
    pose[:3, :3] = turn
    t, ids = unmet(rays.shape)
    cast_solids(rays, solids, scanner.jobs(solids, beams, pose, 0.0, 0.0), t, ids)
    _cast_ground(rays, world, offset, t, ids)
    lost = np.where(rng.random(len(solids)) < LOST_SOLIDS, rng.uniform(0.3, 1, len(solids)), 0)
    lost = np.r_[lost, 0, 0][ids]  # the last two are the ground and the sky
    hit = np.isfinite(t) & (rng.random(t.shape) > np.maximum(lost, rng.uniform(0, LOST_POINTS)))
    distance = t[hit] + scanner.model.noise * rng.standard_normal(int(hit.sum()))
    places = np.stack([d[hit] * distance for d in direction], axis=-1) + offset
    depth, own = _from_axis(places, offset, turn), places @ world.camera.R
    shown = np.flatnonzero((own[:, 2] > 0.5) & (depth > 1) & (depth < FARTHEST))
    shown = shown[np.argsort(-depth[shown], kind="stable")]
    K, out = world.camera.view.K, np.zeros(world.camera.view.x.shape, np.float32)
    u, v = np.rint(own[shown, :2] / own[shown, 2:] * K[[0, 1], [0, 1]] + K[:2, 2]).astype(int).T
    inside = (u >= 0) & (u < out.shape[1]) & (v >= 0) & (v < out.shape[0])
    out[v[inside], u[inside]] = depth[shown][inside]
    return out


def _cast_ground(rays: Rays, world: World, offset: Floats, t: Float32, ids: NDArray[np.int32]) -> None:
    """As `cast_solids`, for the ground below a scanner at offset (3,) from the lens; kerbs are met at their top's height."""
    down = -rays.direction[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = (np.float32(world.camera.height + offset[2] - h) / down for h in (0.0, world.layout.kerb))
    near = (down > 1e-3) & (high < t)
    x, y = (np.float32(offset[k]) + high[near] * rays.direction[k][near] for k in (0, 1))
    new = np.where(world.layout.is_road(x, y), low[near], high[near])
    closer = new < t[near]
    rows, columns = (index[closer] for index in np.nonzero(near))
    t[rows, columns], ids[rows, columns] = new[closer], GROUND


def write(folder: Path, seed: int, number: int) -> bool:
    """Renders a scene, unless its files exist -> whether it did. A stop in between leaves no half-written file."""
    targets = [folder / kind / f"{number:06}.png" for kind in KINDS]
    if all(target.exists() for target in targets):
        return False
    scene = scene_of(seed, number)
    if scene is None:
        return False
    for target, data in zip(targets, scene, strict=True):
        new = target.with_suffix(".new.png")
        values = data if data.dtype == np.uint8 else np.rint(data * UNITS).astype(np.uint16)
        if not cv2.imwrite(str(new), values):
            raise OSError(f"{new} cannot be written")
        os.replace(new, target)
    return True


def render(folder: Path, seed: int, numbers: Iterable[int], processes: int) -> None:
    """Renders the scenes of these numbers that are missing. ValueError if the folder holds those of another seed."""
    for kind in KINDS:
        (folder / kind).mkdir(parents=True, exist_ok=True)
    note, mine = folder / "seed.txt", f"seed {seed}\n"
    if note.exists() and note.read_text() != mine:
        raise ValueError(f"{folder} holds scenes of {note.read_text().strip()}; use that, or another --data")
    note.write_text(mine)
    todo = list(numbers)
    with ProcessPoolExecutor(processes, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        for _ in tqdm(pool.map(partial(write, folder, seed), todo, chunksize=4), total=len(todo), unit="scene"):
            pass


def read(folder: Path, number: int) -> Scene:
    """A rendered scene. FileNotFoundError if it is not there."""
    parts = [cv2.imread(str(folder / kind / f"{number:06}.png"), cv2.IMREAD_UNCHANGED) for kind in KINDS]
    if any(part is None for part in parts):
        raise FileNotFoundError(f"{folder} has no whole scene {number}; render it again")
    image, sparse, dense = parts
    return Scene(image, *((depth / np.float32(UNITS)).astype(np.float32) for depth in (sparse, dense)))


def numbers_in(folder: Path) -> list[int]:
    """Numbers of the rendered scenes, sorted. FileNotFoundError if there are none."""
    found = sorted(int(path.stem) for path in (folder / KINDS[-1]).glob("*[0-9].png"))
    if not found:
        raise FileNotFoundError(f"{folder} holds no rendered scenes; render some")
    return found
