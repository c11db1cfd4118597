"""Image points tracked from picture to picture, as directions in the camera's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.frame import Frame
from calib_ros.image.enhance import to_gray
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.motion_guess.lidar_motion import Run

Matrix = NDArray[np.float64]
Gray = NDArray[np.uint8]

# Pictures are compared whose cameras have moved enough that points at usual distances move by several degrees.
STEP_M, STEP_RAD = 1.0, np.deg2rad(4.0)
LONGEST_S = 1.0  # s between the two; points are lost on the way, and velocities change
POINTS = 400  # per picture; tracks of neighbouring points tell much the same
MIN_DISTANCE = 8  # px between them
QUALITY = 0.003  # of the best corner's; below it there is only noise, after equalisation
WINDOW, LEVELS = (21, 21), 4  # of the tracker (Lucas and Kanade 1981, Bouguet 2001): up to 10 px times 2^4 per picture
RETURN_PX = 1.0  # tracked there and back, points end where they began, or they are lost
CLIP, TILES = 3.0, (8, 8)  # of CLAHE, as the registration's own


@dataclass(frozen=True, eq=False)
class Tracks:
    """Points seen in two pictures each.

    pair: (n,) number of the pair of pictures. first, second: (n, 3) unit vectors to a point in the camera's frame at the pair's
    moments. start, end: (m,) s of the pairs. run: (m,) number of the run of consecutive frames. pixel: rad between neighbouring
    pixels.
    """

    pair: NDArray[np.intp]
    first: Matrix
    second: Matrix
    start: Matrix
    end: Matrix
    run: NDArray[np.intp]
    pixel: float

    def __len__(self) -> int:
        return len(self.pair)

    def subset(self, n: int, rng: np.random.Generator) -> Tracks:
        """About n of them, at random."""
        if len(self) <= n:
            return self
        keep = np.sort(rng.choice(len(self), n, replace=False))
        return Tracks(self.pair[keep], self.first[keep], self.second[keep], self.start, self.end, self.run, self.pixel)

    @cached_property
    def across(self) -> tuple[Matrix, Matrix]:
        """Two unit vectors (n, 3) each, at right angles to `second` and each other."""
        x = self.second
        other = np.where(np.abs(x[:, 1:2]) < 0.9, [[0.0, 1, 0]], [[1.0, 0, 0]])
        e = np.cross(other, x)
        e /= np.linalg.norm(e, axis=1, keepdims=True)
        return e, np.cross(x, e)


def tracked_points(frames: Sequence[Frame], runs: Sequence[Run], extract: FeatureExtractor) -> Tracks:
    """Tracks through all runs of the frames; none where nothing moves, or pictures show nothing that can be tracked."""
    camera, used = extract.camera, extract.used
    mask = None if used is None else used.astype(np.uint8) * 255
    firsts, seconds, numbers = [np.empty((0, 2))], [np.empty((0, 2))], [np.empty(0, np.intp)]
    moments: list[tuple[float, float, int]] = []
    for r, run in enumerate(runs):
        pairs = picture_pairs(run)
        grays: dict[int, Gray] = {}
        for a, b in pairs:
            for k in range(a, b + 1):
                if k not in grays:
                    grays[k] = tracking_image(frames[run.first + k], extract)
            for k in [k for k in grays if k < a]:
                del grays[k]
            start, end = track([grays[k] for k in range(a, b + 1)], mask)
            numbers.append(np.full(len(start), len(moments), np.intp))
            moments.append((run.images[a], run.images[b], r))
            firsts.append(start)
            seconds.append(end)
    table = np.array(moments, float).reshape(-1, 3)
    first, second = (bearings(camera, np.concatenate(uv)) for uv in (firsts, seconds))
    pixel = 1 / float(camera.K[0, 0])
    return Tracks(np.concatenate(numbers), first, second, table[:, 0], table[:, 1], table[:, 2].astype(np.intp), pixel)


def picture_pairs(run: Run) -> list[tuple[int, int]]:
    """Positions of pictures to compare: from each of a sequence, the first one after enough motion, or the last one in time."""
    pairs: list[tuple[int, int]] = []
    a = 0
    poses = run.pose(run.images)
    while a < len(run) - 1:
        b = a + 1
        while b < len(run) - 1 and run.images[b + 1] - run.images[a] <= LONGEST_S and not _moved(poses[a], poses[b]):
            b += 1
        if run.images[b] > run.images[a]:
            pairs.append((a, b))
        a += max((b - a + 1) // 2, 1)  # pairs overlap by half: all pictures count twice
    return pairs


def _moved(before: Matrix, after: Matrix) -> bool:
    R = before[:3, :3].T @ after[:3, :3]
    turn = np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))
    return bool(np.linalg.norm(after[:3, 3] - before[:3, 3]) >= STEP_M or turn >= STEP_RAD)


def tracking_image(frame: Frame, extract: FeatureExtractor) -> Gray:
    """Rectified grey image (h, w) of extract.camera, locally equalised so that shadows have corners, too."""
    gray = to_gray(extract.working_image(frame.image))
    return np.asarray(cv2.createCLAHE(CLIP, TILES).apply(gray), np.uint8)


def track(pictures: Sequence[Gray], mask: Gray | None = None) -> tuple[Matrix, Matrix]:
    """Pixels (n, 2) of corners in the first picture (h, w), and where they are in the last one, tracked through all.

    mask: (h, w) uint8, 0 where no corners are wanted. Corners by Shi and Tomasi 1994.
    """
    found = cv2.goodFeaturesToTrack(pictures[0], POINTS, QUALITY, MIN_DISTANCE, mask=mask)
    if found is None:
        return np.empty((0, 2)), np.empty((0, 2))
    start = found.reshape(-1, 1, 2).astype(np.float32)
    here = start
    for before, after in pairwise(pictures):
        there, arrived, _ = cv2.calcOpticalFlowPyrLK(before, after, here, None, winSize=WINDOW, maxLevel=LEVELS)
        back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, there, None, winSize=WINDOW, maxLevel=LEVELS)
        kept = (arrived.ravel() > 0) & (returned.ravel() > 0)
        kept &= np.linalg.norm((back - here)[:, 0], axis=1) < RETURN_PX
        height, width = after.shape
        u, v = there[:, 0].T
        kept &= (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
        if mask is not None:
            kept[kept] &= mask[np.rint(v[kept]).astype(int), np.rint(u[kept]).astype(int)] > 0
        start, here = start[kept], there[kept]
        if not len(here):
            break
    return start[:, 0].astype(float), here[:, 0].astype(float)


def bearings(camera: Camera, uv: Matrix) -> Matrix:
    """Unit vectors (n, 3) in the camera's frame of pixels (n, 2) of a pinhole or a cylinder."""
    x, y = ((uv - camera.K[:2, 2]) / [camera.K[0, 0], camera.K[1, 1]]).T
    rays = np.stack([np.sin(x), y, np.cos(x)] if camera.is_cylinder else [x, y, np.ones_like(x)], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
