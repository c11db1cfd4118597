"""A drive through a ray-cast street or another scene with a known extrinsic: the embedded data of the demo and of the tests.

Everything follows from the parameters and the number of the frame, not from the order of access. Only the vehicle moves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from inspect import signature
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.datasets.recent import Recent
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros_synthetic.conditions import CONDITIONS
from calib_ros_synthetic.ego import OwnLayer
from calib_ros_synthetic.installation import Installation
from calib_ros_synthetic.rays import CameraView
from calib_ros_synthetic.ride import RIDES, SPINS, STAMP_AT, STEADY, WEAVING, Ride
from calib_ros_synthetic.rigs import RIGS, Fields
from calib_ros_synthetic.scanners import PERIOD, PLAIN, SpinningScanner, in_frame, plain_scanner
from calib_ros_synthetic.scenes import SCENES
from calib_ros_synthetic.solids import Floats, Solids
from calib_ros_synthetic.trip import Ids, Trip, labels_of, named

START = 1_600_000_000 * NANOSECONDS  # stamp of the first frame; 0 would mean "no stamp" to many tools
CACHED_FRAMES = 4
CAMERA_IN_LIDAR = (0.29, 0.05, -0.11)  # m; position of the lens
FOCAL = 0.58  # focal length as a share of the image width, as KITTI's

# Parameter -> type, lowest and highest value.
Limits = Mapping[str, tuple[type[int] | type[float], float, float]]
LIMITS: Limits = {
    "seed": (int, 0, 2**31 - 1),
    "frames": (int, 1, 100_000),
    "rings": (int, 0, 128),
    "width": (int, 64, 8192),
    "height": (int, 48, 8192),
    "speed": (float, 0.0, 40.0),
    "stride": (int, 1, 1000),
    "noise": (float, 0.0, 10.0),
    "tilt_deg": (float, 0.0, 20.0),
    "image_late_ms": (float, -500.0, 500.0),
    "jitter_ms": (float, 0.0, 100.0),
}
NAMED = ("rig", "scene", "condition", "fields", "ride", "stamp_at", "spin")  # parameters whose value is a name


def checked(name: str, value: Any, limits: Limits = LIMITS) -> Any:
    """A parameter as a number of its type. BadInputError for what is none, or out of range."""
    kind, low, high = limits[name]
    allowed = "one of " + ", ".join(map(str, sorted(PLAIN))) if name == "rings" else f"from {low:g} to {high:g}"
    try:
        number = float(value)
        good = low <= number <= high and (kind is float or number == int(number)) and not isinstance(value, bool)
    except (TypeError, ValueError, OverflowError):
        good = False
    if not good or (name == "rings" and int(number) not in PLAIN):
        what = "a whole number" if kind is int else "a number"
        raise BadInputError(f"synthetic drive: {name}={value} is not allowed; it must be {what} {allowed}")
    return kind(number)


def parsed(text: str, limits: Limits = LIMITS, names: Sequence[str] = NAMED) -> dict[str, Any]:
    """The parameters in the text of a source. limits: of those that are numbers. names: of those whose value is a name."""
    kind, _, rest = text.strip().partition(":")
    if kind != "synthetic":
        raise BadInputError(f"'{text}' is no synthetic drive; write 'synthetic' or 'synthetic:seed=3,frames=16'")
    parameters: dict[str, Any] = {}
    for item in filter(None, (part.strip() for part in rest.split(","))):
        key, equals, value = (part.strip() for part in item.partition("="))
        if (key not in limits and key not in names) or not equals:
            known = ", ".join((*limits, *names))
            raise BadInputError(f"synthetic drive: '{item}' is not understood; write key=value with {known}")
        parameters[key] = value if key in names else checked(key, value, limits)
    return parameters


class SyntheticDrive:
    """Frames of a drive, with the exact extrinsic as reference.

    Parameters
    ----------
    seed : of the scene. frames : their number.
    rings : 16, 32, 64 (default) or 128 of a spinning LiDAR; 0 for a scanner without rings, which scans a never-repeating rosette
        ahead. A rig has its own scanner.
    width, height : px, by default 1242x375 or the rig's, of which one alone keeps the shape; not used with `camera`.
    speed : m/s; at 0 the vehicle stops for every frame, where it would be at its usual speed. By default what is usual in the
        scene (5 m/s in the street), as far as the rig's vehicle can go.
    stride : tenths of a second from one frame to the next; at 10 Hz, scans.
    noise : factor on all sensor noise; 0 = none.
    T_camera_lidar : extrinsic (4, 4); by default a camera below and in front of the LiDAR, or where the rig has it, rotated by
        tilt_deg degrees about an axis that depends on the seed.
    rig : a name in rigs.RIGS. scene : a name in scenes.SCENES. condition : a name in conditions.CONDITIONS, by default the rig's.
    fields : all, xyzir, xyzi or xyz: what the clouds hold, by default what the rig's driver gives.
    ride : steady, or weaving: the vehicle swerves, brakes and accelerates.
    image_late_ms : images are stamped that much late; jitter_ms : standard deviation of their stamps.
    stamp_at : start, middle or end, the part of the scan that its stamp refers to; middle is where the scanner faces ahead.
    spin : clockwise or counterclockwise, seen from above.

    Raises BadInputError for values out of range and for unknown names.
    """

    camera_frame = "camera"

    def __init__(
        self,
        seed: int = 0,
        frames: int = 20,
        rings: int | None = None,
        *,
        width: int | None = None,
        height: int | None = None,
        camera: Camera | None = None,
        speed: float | None = None,
        stride: int = 10,
        noise: float = 1.0,
        tilt_deg: float = 2.0,
        T_camera_lidar: ArrayLike | None = None,
        rig: str | None = None,
        scene: str = "street",
        condition: str | None = None,
        fields: str | None = None,
        ride: str = STEADY,
        image_late_ms: float = 0.0,
        jitter_ms: float = 0.0,
        stamp_at: str = "middle",
        spin: str = "clockwise",
    ) -> None:
        values = locals()
        given = {name: values[name] for name in (*LIMITS, *NAMED)}
        world = named("scene", scene, SCENES)
        model = None if rig is None else named("rig", rig, RIGS)
        cruise = world.cruise if model is None else min(world.cruise, model.top_speed)
        if model is not None and rings is not None:
            raise BadInputError(
                f"synthetic drive: rings={rings} does not go with rig={rig}, which has its own scanner; leave it out"
            )
        self._defaults = {name: p.default for name, p in signature(SyntheticDrive).parameters.items() if name in given}
        self._defaults |= {"speed": cruise} | ({"rings": 64, "width": 1242, "height": 375} if model is None else {})
        p: dict[str, Any] = {name: self._defaults[name] if value is None else value for name, value in given.items()}
        p |= {name: checked(name, given[name]) for name in LIMITS if given[name] is not None}
        for name, known in (("ride", RIDES), ("stamp_at", STAMP_AT), ("spin", SPINS)):
            named(name, p[name], dict.fromkeys(known))
        self._parameters = p
        self.seed: int = p["seed"]
        self.rings: int | None = p["rings"]
        self.stride: int = p["stride"]
        self.speed: float = p["speed"]
        self.noise: float = p["noise"]
        self._frames: int = p["frames"]
        usual = Fields.ALL if model is None else model.fields
        self._fields = usual if fields is None else named("fields", fields, {f.value: f for f in Fields})
        weather = named("condition", condition or ("clear" if model is None else model.condition), CONDITIONS)
        self._installed = None if model is None else Installation(model, self.seed, p["tilt_deg"], p["width"], p["height"])
        if self._installed is None:
            self.lidar_frame = "velodyne"
            self.camera = camera or _default_camera(p["width"], p["height"])
            self.reference: Floats = _default_extrinsic(self.seed, p["tilt_deg"])
            self._scanner: SpinningScanner = plain_scanner(self.rings or 0)
        else:
            self.lidar_frame = self._installed.frame
            self.camera = camera or self._installed.camera
            self.reference = self._installed.reference
            self._scanner = self._installed.scanner
        if T_camera_lidar is not None:
            self.reference = se3.as_transform(T_camera_lidar, "T_camera_lidar")
        way = Ride(self.seed, self.speed or cruise, ride == WEAVING)
        street = world(self.seed, way.station(self._seconds(self._frames)))
        self._trip = Trip(street, way, weather, self.noise, self.speed > 0, spin)
        self._view: CameraView | None = None
        self._own: OwnLayer | None = None
        self._made = Recent(CACHED_FRAMES)

    @classmethod
    def from_text(cls, text: str) -> SyntheticDrive:
        """`synthetic`, `synthetic:seed=3,frames=16,rings=32` or `synthetic:rig=os1_128_windshield,scene=park`: any parameters
        that are numbers or names."""
        return cls(**parsed(text))

    @property
    def name(self) -> str:
        """The source text of the drive, without parameters that exist only in Python (camera, T_camera_lidar)."""
        changed = [f"{k}={v}" for k, v in self._parameters.items() if k == "seed" or v != self._defaults[k]]
        return "synthetic:" + ",".join(changed)

    def __len__(self) -> int:
        return self._frames

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`, counted from the end if negative. IndexError past either end."""
        position = self._position(index)
        made = self._made(position, lambda: self._render(position, self.reference))
        # The cache must not change when a caller modifies its frame.
        return replace(deepcopy(made), camera=made.camera)

    def moved(self, index: int, T_camera_lidar: Floats, age_s: float = 0.0) -> Frame:
        """Frame `index` with the camera mounted at T_camera_lidar (4, 4), which is the frame's reference.

        age_s: the image shows the street as seen that long before its stamp.
        """
        return self._render(self._position(index), T_camera_lidar, age_s)

    def pose(self, index: int) -> Floats:
        """T_world_lidar (4, 4) at the frame's stamp, of the frame that clouds are given in; z is up, the road lies at z = 0."""
        ride = self._trip.pose(self._seconds(self._position(index)))
        return ride if self._installed is None else self._installed.pose(ride, self._installed.T_base_frame)

    def twist(self, index: int) -> Floats:
        """The velocity (rx, ry, rz, tx, ty, tz) in rad/s and m/s of the frame that clouds are given in, at the frame's stamp.

        It is constant during a scan: at `time` the scanner stands at pose(index) @ se3.exp(twist * time).
        """
        ride = self._trip.twist(self._seconds(self._position(index)))
        return ride if self._installed is None else self._installed.twist(ride, self._installed.T_base_frame)

    def describe(self) -> dict[str, str]:
        """Facts for people."""
        c, t = self.camera, self.reference[:3, 3]
        tilt = se3.rotation_error_deg(_nominal(), self.reference)
        rig, scene = self._parameters["rig"], self._parameters["scene"]
        length = self._trip.station(self._seconds(len(self)))
        facts = {
            "source": f"{self.name}, a ray-cast {scene.replace('_', ' ')} with exact ground truth",
            "frames": f"{len(self)}, every {self.stride * PERIOD:g} s, {length / len(self):.3g} m apart",
            "camera": f"{c.width}x{c.height}, fx {c.K[0, 0]:.1f} px, {c.model if len(c.D) else 'no distortion'}",
            "LiDAR": self._scanner.describe(),
            "motion": f"{self.speed:g} m/s, {self._parameters['ride']}" if self.speed else "stops for every frame",
            "noise": f"{self.noise:g} x the default",
            "reference": f"{tilt:.2f} deg from looking straight ahead, translation {t[0]:.3f} {t[1]:.3f} {t[2]:.3f} m",
        }
        return facts if rig is None else facts | {"rig": f"{rig}: {RIGS[rig].why}"}

    def _seconds(self, index: int) -> float:
        return index * self.stride * PERIOD

    def _position(self, index: int) -> int:
        if not -self._frames <= index < self._frames:
            raise IndexError(f"frame {index} of a synthetic drive with {self._frames} frames")
        return index % self._frames

    def _render(self, index: int, T_camera_lidar: Floats, age_s: float = 0.0) -> Frame:
        if self._view is None:
            self._view = CameraView(self.camera) if self._installed is None else self._installed.view(self.camera)
        view = self._view
        seconds, installed, trip = self._seconds(index), self._installed, self._trip
        ride, ride_twist = trip.pose(seconds), trip.twist(seconds)
        T_world_lidar, twist, own = ride, ride_twist, None
        if installed is not None:
            mount, own = installed.T_base_lidar, installed.own_returns
            T_world_lidar, twist = installed.pose(ride, mount), installed.twist(ride_twist, mount)
        solids = trip.street.around(trip.station(seconds))
        rng = np.random.default_rng([self.seed, 5, index])
        cloud, hit = trip.scan(solids, self._scanner, index * self.stride, T_world_lidar, twist, own, rng)
        image, seen = self._picture(index, solids, T_camera_lidar, age_s, view)
        cloud_stamp = START + index * round(self.stride * PERIOD * NANOSECONDS)
        stamp = cloud_stamp
        if installed is not None:
            stamp += round(installed.image_delay * NANOSECONDS)
            rng = np.random.default_rng([self.seed, 9, index])
            cloud, kept = installed.delivered(cloud, twist, self._fields, rng)
            hit, twist = hit[kept], installed.twist(ride_twist, installed.T_base_frame)
        shift = STAMP_AT[self._parameters["stamp_at"]] * (PERIOD if installed is None else 1 / installed.rig.rate)
        if shift and cloud.time is not None:  # the points' times count from the stamp
            cloud = replace(cloud, time=(cloud.time - shift).astype(np.float32))
        late, jitter = self._parameters["image_late_ms"] / 1000, self._parameters["jitter_ms"] / 1000
        if jitter:
            late += jitter * np.random.default_rng([self.seed, 11, index]).standard_normal()
        stamp, cloud_stamp = stamp + round(late * NANOSECONDS), cloud_stamp + round(shift * NANOSECONDS)
        cloud = replace(cloud, label=labels_of(solids, hit))
        return Frame(
            *(image, cloud, self.camera, stamp, cloud_stamp, T_camera_lidar, f"{index:06d}", twist),
            compensated=installed is not None and installed.rig.compensated,
            classes=labels_of(solids, seen),
        )

    def _picture(
        self, index: int, solids: Solids, T_camera_lidar: Floats, age_s: float, view: CameraView
    ) -> tuple[NDArray[np.uint8], Ids]:
        """The image of a frame and what each pixel sees; solids: in the world."""
        installed = self._installed
        T_world_frame = self._trip.pose(self._seconds(index) - (age_s if self.speed else 0.0))
        R_vehicle, own = None, None
        if installed is not None:
            R_vehicle = T_world_frame[:3, :3]
            T_world_frame = installed.pose(T_world_frame, installed.T_base_frame)
            later = self.twist(index) * installed.image_delay
            if later.any():
                T_world_frame = T_world_frame @ se3.exp(later)
            if T_camera_lidar is self.reference:
                own = self._own = self._own or installed.own_layer(view, T_camera_lidar)
            else:
                own = installed.own_layer(view, T_camera_lidar)
        T_world_camera = T_world_frame @ se3.inverse(T_camera_lidar)
        twist = in_frame(self.twist(index), se3.inverse(T_camera_lidar))
        rng = np.random.default_rng([self.seed, 6, index])
        return self._trip.picture(solids, view, T_world_camera, twist, own, R_vehicle, rng)


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
