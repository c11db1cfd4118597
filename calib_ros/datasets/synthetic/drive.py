"""A drive through a ray-cast street with a known extrinsic: the embedded data of the demo and of the tests.

Everything follows from the parameters and the number of the frame, not from the order of access.
The world stands still and the sun does not move; only the vehicle does. The image and the scan see the same surfaces: the
image through a lens, with shadows, textures and reflections that no LiDAR sees; the scan with range noise, lost returns
and, while the vehicle moves, with the distortion of the motion.
"""

from __future__ import annotations

import inspect
from collections import OrderedDict
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.datasets.synthetic.camera import Scene, render
from calib_ros.datasets.synthetic.lidar import MODELS, PERIOD, Scanner, scan
from calib_ros.datasets.synthetic.rays import CameraView
from calib_ros.datasets.synthetic.solids import Floats
from calib_ros.datasets.synthetic.street import BLOCK, VIEW_AHEAD, Ride, Street
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.frame import SemanticClass as Label

START = 1_600_000_000 * NANOSECONDS  # stamp of the first frame; 0 would mean "no stamp" to many tools
CRUISE = 5.0  # m/s
CACHED_FRAMES = 4
LONGEST = 10.0  # m; objects this far behind do not reach ahead of the camera
CAMERA_IN_LIDAR = (0.29, 0.05, -0.11)  # m; position of the lens
FOCAL = 0.58  # focal length as a share of the image width, as KITTI's

# Parameter -> type, lowest and highest value.
LIMITS: dict[str, tuple[type[int] | type[float], float, float]] = {
    "seed": (int, 0, 2**31 - 1),
    "frames": (int, 1, 100_000),
    "rings": (int, 0, 128),
    "width": (int, 64, 8192),
    "height": (int, 48, 8192),
    "speed": (float, 0.0, 40.0),
    "stride": (int, 1, 1000),
    "noise": (float, 0.0, 10.0),
    "tilt_deg": (float, 0.0, 20.0),
}


@dataclass(frozen=True, eq=False)
class Labels:
    """SemanticClass of the points (n,) uint8 and of the pixels (H, W) uint8 of a frame."""

    points: NDArray[np.uint8]
    image: NDArray[np.uint8]


def _checked(name: str, value: Any) -> Any:
    kind, low, high = LIMITS[name]
    allowed = "one of " + ", ".join(map(str, sorted(MODELS))) if name == "rings" else f"from {low:g} to {high:g}"
    try:
        number = float(value)
        good = low <= number <= high and (kind is float or number == int(number)) and not isinstance(value, bool)
    except (TypeError, ValueError, OverflowError):
        good = False
    if not good or (name == "rings" and int(number) not in MODELS):
        what = "a whole number" if kind is int else "a number"
        raise BadInputError(f"synthetic drive: {name}={value} is not allowed; it must be {what} {allowed}")
    return kind(number)


class SyntheticDrive:
    """Frames of a drive, with the exact extrinsic as reference.

    Parameters
    ----------
    seed : of the street. frames : their number.
    rings : 16, 32, 64 or 128 of a spinning LiDAR; 0 for a scanner without rings, which scans a never-repeating rosette ahead.
    width, height : px, unless `camera` gives the intrinsics.
    speed : m/s; at 0 the vehicle stops for every frame, where it would be at CRUISE speed.
    stride : scans of the LiDAR (0.1 s) from one frame to the next.
    noise : factor on all sensor noise; 0 = none.
    T_camera_lidar : extrinsic (4, 4); by default a camera below and in front of the LiDAR, rotated from straight ahead by
        tilt_deg degrees about an axis that depends on the seed.
    empty : stations (from, to), m from the start of the drive, between which there are no objects beside the road.

    Raises BadInputError for values out of range.
    """

    camera_frame = "camera"
    lidar_frame = "velodyne"

    def __init__(
        self,
        seed: int = 0,
        frames: int = 20,
        rings: int = 64,
        *,
        width: int = 1242,
        height: int = 375,
        camera: Camera | None = None,
        speed: float = CRUISE,
        stride: int = 10,
        noise: float = 1.0,
        tilt_deg: float = 2.0,
        T_camera_lidar: ArrayLike | None = None,
        empty: tuple[float, float] | None = None,
    ) -> None:
        given = {"seed": seed, "frames": frames, "rings": rings, "width": width, "height": height, "speed": speed}
        given |= {"stride": stride, "noise": noise, "tilt_deg": tilt_deg}
        self._parameters = {name: _checked(name, value) for name, value in given.items()}
        p = self._parameters
        self.seed: int = p["seed"]
        self.rings: int = p["rings"]
        self.stride: int = p["stride"]
        self.speed: float = p["speed"]
        self.noise: float = p["noise"]
        self._frames: int = p["frames"]
        self.camera = camera or _default_camera(p["width"], p["height"])
        if T_camera_lidar is None:
            self.reference: Floats = _default_extrinsic(self.seed, p["tilt_deg"])
        else:
            self.reference = se3.as_transform(T_camera_lidar, "T_camera_lidar")
        if empty is not None and not -np.inf < empty[0] < empty[1] < np.inf:
            raise BadInputError(f"synthetic drive: empty={empty} is not allowed; give the stations in m where it begins and ends")
        self._travel = PERIOD * self.stride * (self.speed or CRUISE)  # m from one frame to the next
        self._street = Street(self.seed, self._travel * self._frames, empty)
        self._ride = Ride(self._street.path, self.seed, self._street.lane)
        self._scanner = Scanner(self.rings)
        self._view: CameraView | None = None
        self._made: OrderedDict[int, tuple[Frame, Labels]] = OrderedDict()

    @classmethod
    def from_text(cls, text: str) -> SyntheticDrive:
        """`synthetic` or `synthetic:seed=3,frames=16,rings=32`: any of the numeric parameters by name."""
        kind, _, rest = text.strip().partition(":")
        if kind != "synthetic":
            raise BadInputError(f"'{text}' is no synthetic drive; write 'synthetic' or 'synthetic:seed=3,frames=16'")
        parameters: dict[str, Any] = {}
        for item in filter(None, (part.strip() for part in rest.split(","))):
            key, equals, value = (part.strip() for part in item.partition("="))
            if key not in LIMITS or not equals:
                raise BadInputError(f"synthetic drive: '{item}' is not understood; write key=value with {', '.join(LIMITS)}")
            parameters[key] = _checked(key, value)
        return cls(**parameters)

    @property
    def name(self) -> str:
        """The source text of the drive, without parameters that exist only in Python (camera, T_camera_lidar, empty)."""
        defaults = inspect.signature(SyntheticDrive).parameters
        changed = [f"{k}={v}" for k, v in self._parameters.items() if k == "seed" or v != defaults[k].default]
        return "synthetic:" + ",".join(changed)

    def __len__(self) -> int:
        return self._frames

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`, counted from the end if negative. IndexError past either end."""
        made, _ = self._make(self._position(index))
        # The cache must not change when a caller modifies its frame.
        return replace(deepcopy(made), camera=made.camera)

    def labels(self, index: int) -> Labels:
        """Classes of the points of a frame and of the centres of its pixels."""
        labels = self._make(self._position(index))[1]
        return Labels(labels.points.copy(), labels.image.copy())

    def moved(self, index: int, T_camera_lidar: Floats, age_s: float = 0.0) -> Frame:
        """Frame `index` with the camera mounted at T_camera_lidar (4, 4), which is the frame's reference.

        age_s: the image shows the street as seen that long before its stamp.
        """
        return self._render(self._position(index), T_camera_lidar, age_s)[0]

    def emptied(self, start_s: float, end_s: float) -> SyntheticDrive:
        """The same drive, with only the road visible ahead from start_s to end_s after the first frame."""
        speed = self._travel / (PERIOD * self.stride)
        empty = (start_s * speed - LONGEST, end_s * speed + VIEW_AHEAD + BLOCK)
        drive = SyntheticDrive(**self._parameters, camera=self.camera, empty=empty)
        drive.reference = self.reference
        return drive

    def pose(self, index: int) -> Floats:
        """T_world_lidar (4, 4) at the frame's stamp; z is up, the road lies at z = 0."""
        return self._ride.pose(self._position(index) * self._travel)

    def twist(self, index: int) -> Floats:
        """The LiDAR's velocity (rx, ry, rz, tx, ty, tz) in rad/s and m/s in its own frame at the frame's stamp.

        It is constant during a scan: at `time` the scanner stands at pose(index) @ se3.exp(twist * time).
        """
        return self._ride.twist(self._position(index) * self._travel, self.speed)

    def describe(self) -> dict[str, str]:
        """Facts for people."""
        c, t = self.camera, self.reference[:3, 3]
        tilt = se3.rotation_error_deg(_nominal(), self.reference)
        return {
            "source": f"{self.name}, a ray-cast street with exact ground truth",
            "frames": f"{len(self)}, every {self.stride * PERIOD:g} s, {self._travel:g} m apart",
            "camera": f"{c.width}x{c.height}, fx {c.K[0, 0]:.1f} px, {c.model if len(c.D) else 'no distortion'}",
            "LiDAR": self._scanner.describe(),
            "motion": f"{self.speed:g} m/s" if self.speed else "stops for every frame",
            "noise": f"{self.noise:g} x the default",
            "reference": f"{tilt:.2f} deg from looking straight ahead, translation {t[0]:.3f} {t[1]:.3f} {t[2]:.3f} m",
        }

    def _position(self, index: int) -> int:
        if not -self._frames <= index < self._frames:
            raise IndexError(f"frame {index} of a synthetic drive with {self._frames} frames")
        return index % self._frames

    def _make(self, index: int) -> tuple[Frame, Labels]:
        made = self._made.pop(index, None)
        if made is None:
            made = self._render(index, self.reference)
        self._made[index] = made
        while len(self._made) > CACHED_FRAMES:
            self._made.popitem(last=False)
        return made

    def _render(self, index: int, T_camera_lidar: Floats, age_s: float = 0.0) -> tuple[Frame, Labels]:
        self._view = view = self._view or CameraView(self.camera)
        T_world_lidar, twist = self.pose(index), self.twist(index)
        station = index * self._travel
        T_world_camera = self._ride.pose(station - self.speed * age_s) @ se3.inverse(T_camera_lidar)
        solids = self._street.around(station)
        # Everything is cast relative to the sensor: far from the world's origin float32 would be too coarse.
        cloud, hit = scan(
            self._street, solids.moved(-T_world_lidar[:3, 3]), replace(self._scanner, number=index * self.stride),
            T_world_lidar, twist, self.noise, np.random.default_rng([self.seed, 5, index]),
        )  # fmt: skip
        lens = T_world_camera[:3, 3]
        scene = Scene(self._street, solids.moved(-lens), lens, T_world_camera[:3, :3])
        image, seen = render(scene, view, self.noise, np.random.default_rng([self.seed, 6, index]))
        stamp = START + index * round(self.stride * PERIOD * NANOSECONDS)
        # Ids below 0 index this table from its end: curb, pavement and road, then the sky.
        table = np.r_[solids.label, [Label.GROUND] * 3, Label.SKY].astype(np.uint8)
        labels = Labels(table[hit], table[seen])
        frame = Frame(
            *(image, replace(cloud, label=labels.points), self.camera, stamp, stamp, T_camera_lidar, f"{index:06d}", twist),
            classes=labels.image,
        )
        return frame, labels


def _nominal() -> Floats:
    return np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def _default_camera(width: int, height: int) -> Camera:
    f = FOCAL * width
    return Camera(np.array([[f, 0, 0.491 * width], [0, f, 0.461 * height], [0, 0, 1]]), width, height)


def _default_extrinsic(seed: int, tilt_deg: float) -> Floats:
    axis = np.random.default_rng([seed, 7]).standard_normal(3)
    T = se3.perturb(_nominal(), tilt_deg * axis / np.linalg.norm(axis), np.zeros(3))
    T[:3, 3] = -T[:3, :3] @ CAMERA_IN_LIDAR
    return T
