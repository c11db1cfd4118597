"""Recorded frames changed as if their camera had moved, been late or covered; and a short recording that goes on and on."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.sources import Changed
from calib_ros.camera import Camera
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros_synthetic.rays import pixel_directions

Floats = NDArray[np.float64]
Image = NDArray[np.uint8]

DARK, NOISE = 7.0, 1.8  # grey levels of a covered image


def covered_image(like: Image, rng: np.random.Generator) -> Image:
    """A dark image of the same shape that shows nothing but noise."""
    level = DARK + NOISE * rng.standard_normal(like.shape, np.float32)
    return np.asarray(np.clip(np.rint(level), 0, 255), np.uint8)


def turned_image(image: Image, camera: Camera, R: Floats) -> Image:
    """What the camera would have seen, turned by R (3, 3) about its own centre: a direction d of before is now R d.

    Exact for any lens. What had been out of sight is filled with the nearest pixel at the border.
    """
    # Cubic, not linear: edges would become softer by half a pixel as soon as the camera moves.
    if camera.is_pinhole:
        size = (camera.width, camera.height)
        H = camera.K @ R @ np.linalg.inv(camera.K)
        return np.asarray(cv2.warpPerspective(image, H, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8)
    x, y, _ = pixel_directions(camera)
    directions = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3).astype(float)
    uv = camera.project(directions @ R)[0].reshape(*x.shape, 2).astype(np.float32)
    return np.asarray(cv2.remap(image, uv[..., 0], uv[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))


def shifted_cloud(frame: Frame, shift: Floats) -> Frame:
    """The frame with its points moved by `shift` (3,) m in the LiDAR's frame, as of a LiDAR that stands elsewhere on the car."""
    cloud = replace(frame.cloud, xyz=(frame.cloud.xyz + shift).astype(np.float32))
    twist = frame.twist
    if twist is not None:
        twist = np.r_[twist[:3], twist[3:] + np.cross(shift, twist[:3])]  # a turn carries the new place along
    return replace(frame, cloud=cloud, twist=twist)


def moved(source: Source, position: int, mount: Floats, mount_before: Floats, delay_s: float = 0.0) -> Frame:
    """The frame at `position` whose extrinsic is mount @ T, T being its own.

    The image is turned, the cloud is shifted: the change of the extrinsic's translation is put on the LiDAR, since a picture
    holds no depth. mount: (4, 4) at the cloud's time. delay_s: the image shows what was there so long before its stamp, by
    a camera mounted as in mount_before. A frame without reference stays as it is but for that.
    """
    frame = source[position]
    T = frame.reference
    if delay_s > 0:
        frame = _late(source, frame, position, delay_s)
    if T is None:
        return frame
    R = mount_before[:3, :3]
    if not np.allclose(R, np.eye(3), atol=1e-12):
        frame = replace(frame, image=turned_image(frame.image, frame.camera, R))
    # mount T p' = (R_mount, 0) T p for every point p.
    shift = -T[:3, :3].T @ mount[:3, :3].T @ mount[:3, 3]
    if np.abs(shift).max() > 0:
        frame = shifted_cloud(frame, shift)
    return replace(frame, reference=mount @ T)


def _late(source: Source, frame: Frame, position: int, delay_s: float) -> Frame:
    """With an earlier image, stamped delay_s too late: the one that then comes nearest to the cloud."""
    delay = round(delay_s * NANOSECONDS)

    def gap(other: Frame) -> int:
        return abs(other.stamp + delay - frame.moment_of_cloud)

    best = frame
    for before in range(position - 1, -1, -1):
        other = source[before]
        if gap(other) >= gap(best):
            break
        best = other
    return replace(frame, image=best.image, stamp=best.stamp + delay, cloud_stamp=frame.moment_of_cloud, camera=best.camera)


def reversed_time(frame: Frame, stamp: int) -> Frame:
    """The frame as in a film that runs backwards, with its cloud at `stamp` (ns): the car drives backwards, the head turns the
    other way round. Points straighten as they did before."""
    cloud = frame.cloud if frame.cloud.time is None else replace(frame.cloud, time=-frame.cloud.time)
    twist = None if frame.twist is None else -frame.twist
    return replace(frame, stamp=stamp - (frame.stamp - frame.moment_of_cloud), cloud_stamp=stamp, cloud=cloud, twist=twist)


class ThereAndBack(Changed):
    """A short recording played forwards and backwards in turn until `seconds` are full, with stamps that go on.

    times: (n,) s of every frame's cloud after the first one's. The source is read through once, for its stamps. BadInputError if
    they do not rise.
    """

    def __init__(self, source: Source, seconds: float) -> None:
        super().__init__(source)
        stamps = np.array([source[i].moment_of_cloud for i in range(len(source))], np.int64)
        n = len(stamps)
        gaps = np.diff(stamps) / NANOSECONDS
        if not (gaps > 0).all():
            raise BadInputError(f"{source.name}: its stamps do not rise from frame to frame, so that it cannot go on in time")
        order, times, forwards = [0], [0.0], [True]
        while n > 1 and times[-1] < seconds:
            ahead = (forwards[-1] and order[-1] < n - 1) or order[-1] == 0
            step = order[-1] if ahead else order[-1] - 1
            order.append(order[-1] + 1 if ahead else order[-1] - 1)
            times.append(times[-1] + float(gaps[step]))
            forwards.append(ahead)
        keep = max(int(np.searchsorted(times, seconds - 1e-6)), 1)  # sums of steps miss a round number by rounding
        self._order, self._forwards, self.times = order[:keep], forwards[:keep], np.array(times[:keep])
        self._start = int(stamps[0])

    def __len__(self) -> int:
        return len(self._order)

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`; its name says which time round it is. IndexError past either end."""
        frame = self.source[self._order[index]]
        stamp = self._start + round(float(self.times[index]) * NANOSECONDS)
        if self._forwards[index]:
            changed = replace(frame, stamp=stamp + frame.stamp - frame.moment_of_cloud, cloud_stamp=stamp)
        else:
            changed = reversed_time(frame, stamp)
        return replace(changed, name=f"{frame.name}@{self.times[index]:.1f}")
