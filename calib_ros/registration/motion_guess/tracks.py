"""The LiDAR's trajectory, by odometry or its scans, and image points tracked along it as directions in the camera's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix
from calib_ros.config import MotionConfig
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.image.enhance import to_gray
from calib_ros.lidar.deskew import has_times
from calib_ros.lidar.ego_motion import MAX_GAP_S, estimate_motion
from calib_ros.registration.features import FeatureExtractor

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
class Run:
    """Consecutive frames between whose scans the motion is known.

    first: position of the first frame. times: (n,) s of the scans, from the first scan of all. images: (n,) s of the images on
    the same clock. poses: (n, 4, 4) of the LiDAR at the scans in its frame at the first of the run. twists: (n - 1, 6) mean
    velocity from each scan to the next, rad/s and m/s in the LiDAR's frame.
    """

    first: int
    times: Matrix
    images: Matrix
    poses: Matrix
    twists: Matrix

    @classmethod
    def of(cls, first: int, times: Matrix, images: Matrix, twists: Matrix) -> Run:
        """A run by its velocities."""
        poses = [np.eye(4)]
        for twist, gap in zip(twists, np.diff(times), strict=True):
            poses.append(poses[-1] @ se3.exp(twist * gap))
        return cls(first, times, images, np.array(poses), twists)

    def __len__(self) -> int:
        return len(self.times)

    def pose(self, seconds: ArrayLike) -> Matrix:
        """Poses (k, 4, 4) at moments (k,) s; before the first and after the last scan at the velocity there."""
        seconds = np.asarray(seconds, float)
        k = np.clip(np.searchsorted(self.times, seconds, side="right") - 1, 0, len(self.twists) - 1)
        return np.asarray(self.poses[k] @ se3.exp_many(self.twists[k] * (seconds - self.times[k])[:, None]))

    def relative(self, first: ArrayLike, second: ArrayLike) -> Matrix:
        """Transforms (k, 4, 4) of points from the LiDAR's frame at the moments `first` (k,) s to that at `second`."""
        return np.asarray(np.linalg.inv(self.pose(second)) @ self.pose(first))


def lidar_runs(frames: Sequence[Frame], config: MotionConfig) -> tuple[list[Run], list[str]]:
    """The runs of consecutive frames, in the order of their stamps, whose motion is known, and why it is not elsewhere.

    Frames that carry a twist on both sides of a gap are believed. Raises MissingDependencyError where scans have to be aligned
    and small_gicp is missing.
    """
    reasons: list[str] = []
    runs: list[Run] = []
    if not frames:
        return runs, reasons
    origin = frames[0].moment_of_cloud
    twists: list[Matrix] = []
    first = 0
    for k in range(1, len(frames) + 1):
        twist, reason = (
            _between(frames[k - 1], frames[k], config, twists[-1] if twists else None) if k < len(frames) else (None, "")
        )
        if twist is not None:
            twists.append(twist)
            continue
        if reason:
            reasons.append(reason)
        if twists:
            times = np.array([(f.moment_of_cloud - origin) / NANOSECONDS for f in frames[first:k]])
            images = np.array([(f.stamp - origin) / NANOSECONDS - config.time_offset_s for f in frames[first:k]])
            runs.append(Run.of(first, times, images, np.array(twists)))
        twists, first = [], k
    return runs, reasons


def _between(before: Frame, frame: Frame, config: MotionConfig, start: Matrix | None) -> tuple[Matrix | None, str]:
    """Mean velocity (6,) from one frame's scan to the next one's, or None and why it is unknown."""
    gap_s = (frame.moment_of_cloud - before.moment_of_cloud) / NANOSECONDS
    if not 0 < gap_s <= MAX_GAP_S:
        return None, f"frames {before.name} and {frame.name} are {gap_s:.3g} s apart, more than {MAX_GAP_S:g} s"
    if before.twist is not None and frame.twist is not None:
        return (before.twist + frame.twist) / 2, ""
    if before.compensated or not has_times(before.cloud) or config.deskew == "off":
        # All points count as measured at the stamp. Of compensated scans that is so; others without times are both distorted
        # alike, which leaves the motion between them nearly as it is, while a wrong guess of the times would not.
        config = replace(config, spin="none") if config.from_scans != "always" or before.compensated else config
        before, frame = (replace(f, cloud=replace(f.cloud, time=None)) for f in (before, frame))
    motion = estimate_motion(before.cloud, frame.cloud, gap_s, config, start)
    return motion.twist, motion.reason


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
    equalise = cv2.createCLAHE(CLIP, TILES)  # shadows have corners, too
    for r, run in enumerate(runs):
        pairs = picture_pairs(run)
        grays: dict[int, Gray] = {}
        for a, b in pairs:
            for k in range(a, b + 1):
                if k not in grays:
                    gray = to_gray(extract.working_image(frames[run.first + k].image))
                    grays[k] = np.asarray(equalise.apply(gray), np.uint8)
            for k in [k for k in grays if k < a]:
                del grays[k]
            start, end = track([grays[k] for k in range(a, b + 1)], mask)
            numbers.append(np.full(len(start), len(moments), np.intp))
            moments.append((run.images[a], run.images[b], r))
            firsts.append(start)
            seconds.append(end)
    table = np.array(moments, float).reshape(-1, 3)
    first, second = (camera.unproject(np.concatenate(uv)) for uv in (firsts, seconds))
    pixel = 1 / float(camera.K[0, 0])
    return Tracks(np.concatenate(numbers), first, second, table[:, 0], table[:, 1], table[:, 2].astype(np.intp), pixel)


def picture_pairs(run: Run) -> list[tuple[int, int]]:
    """Positions of pictures to compare: from each of a sequence, the first one after enough motion, or the last one in time."""
    pairs: list[tuple[int, int]] = []
    a, poses = 0, run.pose(run.images)

    def moved(before: Matrix, after: Matrix) -> bool:
        turn = np.arccos(np.clip((np.trace(before[:3, :3].T @ after[:3, :3]) - 1) / 2, -1, 1))
        return bool(np.linalg.norm(after[:3, 3] - before[:3, 3]) >= STEP_M or turn >= STEP_RAD)

    while a < len(run) - 1:
        b = a + 1
        while b < len(run) - 1 and run.images[b + 1] - run.images[a] <= LONGEST_S and not moved(poses[a], poses[b]):
            b += 1
        if run.images[b] > run.images[a]:
            pairs.append((a, b))
        a += max((b - a + 1) // 2, 1)  # pairs overlap by half: all pictures count twice
    return pairs


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
