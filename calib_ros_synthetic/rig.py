"""A drive of a rig of several sensors through one world: each is rendered at its own times, once whatever needs it."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import lru_cache
from inspect import signature
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.datasets.recent import Recent, Timed
from calib_ros.datasets.source import Source, describe_camera
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.stamps import nearest_index, nearest_pairs, pair_tolerance
from calib_ros_synthetic.conditions import CONDITIONS
from calib_ros_synthetic.drive import LIMITS, START, SyntheticDrive, checked, parsed
from calib_ros_synthetic.installation import Installation, sweep_s
from calib_ros_synthetic.multi_rigs import MULTI_RIGS, displacement
from calib_ros_synthetic.ride import RIDES, STEADY, WEAVING, Ride
from calib_ros_synthetic.rigs import RIGS, Fields
from calib_ros_synthetic.scanners import PERIOD, RosetteScanner
from calib_ros_synthetic.scenes import SCENES
from calib_ros_synthetic.solids import Floats
from calib_ros_synthetic.trip import Trip, labels_of, named

CACHED = 64  # measurements: of the clouds, about 250 MB
SHIFT_M = 0.01  # by which a sensor stands beside its mount for each degree that it is turned
PHASE = 0.37  # of a period, by which each sensor begins after the one before: free-running sensors are never in step
RIG_LIMITS = {name: LIMITS[name] for name in ("seed", "frames", "stride", "width", "speed", "noise", "tilt_deg")} | {
    "clocks": (float, 0.0, 100.0),
    "knock_at": (float, 0.0, 100_000.0),
    "knock_deg": (float, 0.0, 20.0),
    "knock_m": (float, 0.0, 2.0),
}
RIG_NAMES = ("rig", "scene", "condition", "ride", "knock")
OF_PAIR = ("camera", "lidar")  # which one, where the text stands for a single source
Picture = tuple[NDArray[np.uint8], NDArray[np.uint8]]  # image, classes of its pixels
Scan = tuple[PointCloud, NDArray[np.float64]]  # cloud, twist


class SyntheticRig:
    """The recording of a rig in MULTI_RIGS; see `SyntheticDrive` for what is not said here.

    Parameters
    ----------
    frames, stride : of each pair, frames that are stride tenths of a second apart; the recording is that long. Sensors run at
        their own rates all the time.
    tilt_deg : every sensor is turned from its mount by this about an axis of its own, and shifted by 1 cm for each degree.
    clocks : factor on the differences between the sensors' clocks; 0 = one clock.
    knock : name of a sensor, or several joined by +, as on one bracket: displaced as one from knock_at seconds on (default: half
        of the drive), by knock_deg about an axis and by knock_m in a direction that depend on the seed.

    References are exact: `reference` before the knock, `reference_at` at any stamp, those of frames at theirs.
    """

    def __init__(
        self,
        rig: str,
        seed: int = 0,
        frames: int = 20,
        *,
        stride: int = 10,
        width: int | None = None,
        speed: float | None = None,
        noise: float = 1.0,
        tilt_deg: float = 2.0,
        clocks: float = 1.0,
        scene: str = "street",
        condition: str = "clear",
        ride: str = STEADY,
        knock: str = "",
        knock_at: float | None = None,
        knock_deg: float = 1.0,
        knock_m: float = 0.05,
    ) -> None:
        values = locals()
        given = {name: values[name] for name in (*RIG_LIMITS, *RIG_NAMES)}
        self._rig, world = named("rig", rig, MULTI_RIGS), named("scene", scene, SCENES)
        named("ride", ride, dict.fromkeys(RIDES))
        p = given | {name: checked(name, given[name], RIG_LIMITS) for name in RIG_LIMITS if given[name] is not None}
        defaults = {name: own.default for name, own in signature(SyntheticRig).parameters.items()}
        changed = [f"{k}={v}" for k, v in p.items() if k in ("seed", "rig") or v != defaults[k]]
        self.name = "synthetic:" + ",".join(changed)
        self.seed: int = p["seed"]
        self.frames: int = p["frames"]
        self.step = p["stride"] * PERIOD
        self.duration = self.frames * self.step
        cruise = world.cruise if speed is None else p["speed"]
        if not cruise:
            raise BadInputError("synthetic drive: speed=0 does not go with several sensors, which measure at different times")
        way = Ride(self.seed, cruise, ride == WEAVING)
        street = world(self.seed, way.station(self.duration))
        self.trip = Trip(street, way, named("condition", condition, CONDITIONS), p["noise"])
        self.facts = {
            "rig": f"{rig}: {self._rig.why}",
            "source": f"{self.name}, a ray-cast {scene.replace('_', ' ')} with exact ground truth",
            "motion": f"{cruise:g} m/s, {ride}",
        }
        self._sensors = self._rig.sensors
        self._clocks: float = p["clocks"]
        self._width: int | None = p["width"]
        self.cameras = tuple(name for name, sensor in self._sensors.items() if sensor.is_camera)
        self.lidars = tuple(name for name, sensor in self._sensors.items() if not sensor.is_camera)
        self.reference_sensor = self.lidars[0]
        self._displaced = {name: self._tilted(name, p["tilt_deg"]) for name in self._sensors}
        self.knocked = tuple(named("knock", own, {n: n for n in self._sensors}) for own in filter(None, knock.split("+")))
        self.knock_at: float = self.duration / 2 if knock_at is None else p["knock_at"]
        self._knock = self._knock_of(p["knock_deg"], p["knock_m"]) if self.knocked else np.eye(4)
        self._made = Recent(CACHED)
        self._installed = lru_cache(maxsize=None)(self._install)
        self._view = lru_cache(maxsize=None)(lambda camera: self._installed(camera, False).view(self.camera(camera)))
        self._own = lru_cache(maxsize=None)(self._own_layer)

    @classmethod
    def from_text(cls, text: str) -> SyntheticRig:
        """Of `synthetic:rig=six_cameras_one_lidar,seed=3` or the like."""
        return cls(**parsed(text, RIG_LIMITS, RIG_NAMES))

    def camera(self, name: str) -> Camera:
        """The intrinsics of a camera."""
        return self._installed(self._known(name, self.cameras), False).camera

    def frame_id(self, name: str) -> str:
        """TF frame of a sensor."""
        return f"{name}_optical" if self._sensors[name].is_camera else name

    def reference(self, name: str) -> Floats:
        """T_reference_sensor (4, 4), exact, before the knock."""
        return np.asarray(se3.inverse(self._pose(self.reference_sensor, False)) @ self._pose(name, False))

    def reference_at(self, name: str, stamp: int) -> Floats:
        """T_reference_sensor (4, 4), exact, when the sensor stamps `stamp`, ns."""
        seconds = self._seconds(name, stamp)
        base, own = (self._pose(one, self._is_after(one, seconds)) for one in (self.reference_sensor, name))
        return np.asarray(se3.inverse(base) @ own)

    def prior(self, name: str) -> Floats:
        """T_reference_sensor (4, 4) by the drawing."""
        return np.asarray(se3.inverse(self._sensors[self.reference_sensor].pose()) @ self._sensors[name].pose())

    def clock_s(self, name: str) -> float:
        """By which the clock of a sensor is ahead."""
        return self._clocks * self._sensors[name].late_ms / 1000

    def pair(self, camera: str, lidar: str) -> RigPair:
        """Images of a camera with the scans that swept its view at the nearest times, by the stamps of their own clocks."""
        return RigPair(self, self._known(camera, self.cameras), self._known(lidar, self.lidars))

    def scans(self, lidar: str) -> Timed:
        """All scans of a LiDAR with their stamps, ns."""
        return Timed(self.stamps(self._known(lidar, self.lidars)), lambda index: self.scan(lidar, index)[0])

    def pictures(self, camera: str) -> Timed:
        """All images of a camera with their stamps, ns."""
        return Timed(self.stamps(self._known(camera, self.cameras)), lambda index: self.picture(camera, index)[0])

    def stamps(self, name: str) -> NDArray[np.int64]:
        """Of all that a sensor measures (n,), ns, by its own clock."""
        rate, phase = self._sensors[name].rate, self._phase(name)
        seconds = phase + np.arange(max(1, int(np.ceil((self.duration - phase) * rate - 1e-9)))) / rate
        return START + np.rint((seconds + self.clock_s(name)) * NANOSECONDS).astype(np.int64)

    def scan(self, lidar: str, index: int) -> Scan:
        """Scan `index` of a LiDAR, with the scanner's twist (6,)."""
        return self._made((lidar, index), lambda: self._scan(lidar, index))

    def picture(self, camera: str, index: int) -> Picture:
        """Image `index` of a camera, with the classes of its pixels."""
        return self._made((camera, index), lambda: self._picture(camera, index))

    def T_camera_lidar(self, camera: str, image: int, lidar: str, scan: int) -> Floats:
        """The exact extrinsic (4, 4) between the sensors where they were at an image and at a scan."""
        T_base_camera, T_base_lidar = (
            self._pose(name, self._is_after(name, self._time(name, index))) for name, index in ((camera, image), (lidar, scan))
        )
        return np.asarray(se3.inverse(T_base_camera) @ T_base_lidar)

    def sweep_s(self, camera: str, lidar: str) -> float:
        """From a scan's stamp to when it sweeps the camera's axis; 0 for scanners that do not turn."""
        if isinstance(self._installed(lidar, False).scanner, RosetteScanner):
            return 0.0
        return sweep_s(self._pose(lidar, False), self._pose(camera, False), self._sensors[lidar].rate)

    def describe_lidar(self, name: str) -> str:
        """For people."""
        return self._installed(name, False).scanner.describe()

    def _known(self, name: str, names: tuple[str, ...]) -> str:
        return named("camera" if names is self.cameras else "lidar", name, {own: own for own in names})

    def _number(self, name: str) -> int:
        return list(self._sensors).index(name)

    def _rng(self, *of: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, 14, *of])

    def _phase(self, name: str) -> float:
        return (PHASE * self._number(name)) % 1 / self._sensors[name].rate

    def _time(self, name: str, index: int) -> float:
        return self._phase(name) + index / self._sensors[name].rate

    def _seconds(self, name: str, stamp: int) -> float:
        return (stamp - START) / NANOSECONDS - self.clock_s(name)

    def _is_after(self, name: str, seconds: float) -> bool:
        return name in self.knocked and seconds >= self.knock_at

    def _tilted(self, name: str, tilt_deg: float) -> Floats:
        """How the seed moves a sensor from its mount."""
        axis, shift = _unit(self._rng(0, self._number(name), 0)), _unit(self._rng(0, self._number(name), 1))
        return displacement(self._sensors[name].pose()[:3, 3], tilt_deg * axis, SHIFT_M * tilt_deg * shift)

    def _knock_of(self, deg: float, m: float) -> Floats:
        centre = np.mean([self._sensors[name].pose()[:3, 3] for name in self.knocked], axis=0)
        return displacement(centre, deg * _unit(self._rng(1, 0)), m * _unit(self._rng(1, 1)))

    def _install(self, name: str, after: bool) -> Installation:
        displaced = self._knock @ self._displaced[name] if after else self._displaced[name]
        return self._sensors[name].installed(self._rig.vehicle, self._width, displaced)

    def _pose(self, name: str, after: bool) -> Floats:
        """T_base_sensor (4, 4)."""
        own = self._installed(name, after)
        return own.T_base_camera if self._sensors[name].is_camera else own.T_base_lidar

    def _own_layer(self, camera: str, after: bool) -> Any:
        own = self._installed(camera, after)
        return own.own_layer(self._view(camera), own.reference)

    def _scan(self, lidar: str, index: int) -> Scan:
        seconds, number, trip = self._time(lidar, index), self._number(lidar), self.trip
        own = self._installed(lidar, self._is_after(lidar, seconds))
        T, twist = own.pose(trip.pose(seconds), own.T_base_lidar), own.twist(trip.twist(seconds), own.T_base_lidar)
        solids = trip.street.around(trip.station(seconds))
        cloud, hit = trip.scan(solids, own.scanner, index, T, twist, own.own_returns, self._rng(2, number, index))
        cloud, kept = own.delivered(cloud, twist, Fields.ALL, self._rng(3, number, index))
        return replace(cloud, label=labels_of(solids, hit[kept])), twist

    def _picture(self, camera: str, index: int) -> Picture:
        seconds, trip = self._time(camera, index), self.trip
        after = self._is_after(camera, seconds)
        own, ride = self._installed(camera, after), trip.pose(seconds)
        T, twist = own.pose(ride, own.T_base_camera), own.twist(trip.twist(seconds), own.T_base_camera)
        solids = trip.street.around(trip.station(seconds))
        rng = self._rng(4, self._number(camera), index)
        image, seen = trip.picture(solids, self._view(camera), T, twist, self._own(camera, after), ride[:3, :3], rng)
        return image, labels_of(solids, seen)


class RigPair:
    """One camera and one LiDAR of a rig as a source: up to rig.frames frames, rig.step seconds apart."""

    def __init__(self, rig: SyntheticRig, camera: str, lidar: str) -> None:
        self._rig, self._names, self.cameras = rig, (camera, lidar), rig.cameras
        self.name = f"{rig.name},camera={camera},lidar={lidar}"
        self.camera = rig.camera(camera)
        self.camera_frame, self.lidar_frame = rig.frame_id(camera), rig.frame_id(lidar)
        self._images, self._clouds = rig.stamps(camera), rig.stamps(lidar)
        moments = self._clouds + round(rig.sweep_s(camera, lidar) * NANOSECONDS)
        periods = tuple(round(rig.duration / len(own) * NANOSECONDS) for own in (self._images, self._clouds))
        pairs = np.stack(nearest_pairs(self._images, moments, pair_tolerance((periods[0], periods[1]), 0.0)), axis=1)
        wanted = START + np.rint((np.arange(rig.frames) * rig.step) * NANOSECONDS).astype(np.int64)
        self._pairs = pairs[np.unique(nearest_index(self._clouds[pairs[:, 1]], wanted))].tolist()
        self.reference = rig.T_camera_lidar(camera, 0, lidar, 0)

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`, whose reference is that of its moment. IndexError past either end."""
        image_at, scan_at = self._pairs[index]
        camera, lidar = self._names
        image, classes = self._rig.picture(camera, image_at)
        cloud, twist = self._rig.scan(lidar, scan_at)
        return Frame(
            image=image.copy(),
            cloud=deepcopy(cloud),  # what is kept must not change when a caller modifies its frame
            camera=self.camera,
            stamp=int(self._images[image_at]),
            cloud_stamp=int(self._clouds[scan_at]),
            reference=self._rig.T_camera_lidar(camera, image_at, lidar, scan_at),
            name=f"{range(len(self))[index]:06d}",
            twist=twist,
            classes=classes.copy(),
        )

    def describe(self) -> dict[str, str]:
        """Facts for people."""
        camera, lidar = self._names
        ahead = (self._rig.clock_s(camera) - self._rig.clock_s(lidar)) * 1000
        return self._rig.facts | {
            "frames": f"{len(self)} of {len(self._images)} images and {len(self._clouds)} scans, {self._rig.step:g} s apart",
            "cameras": _chosen(self._rig.cameras, camera),
            "lidars": _chosen(self._rig.lidars, lidar),
            "camera": describe_camera(self.camera),
            "LiDAR": self._rig.describe_lidar(lidar),
            "clocks": f"the camera's is {ahead:+g} ms ahead of the LiDAR's",
        }


def open_drive(text: str, camera: str | int | None = None) -> Source:
    """What a text `synthetic[:...]` stands for: a drive, or of a rig of several sensors one camera, by name or number, with one
    LiDAR; by default the first, or those that the text names by camera=, lidar=."""
    if not is_multi_rig(text):
        named("rig", _rig_in(text) or next(iter(RIGS)), dict.fromkeys((*RIGS, *MULTI_RIGS)))
        return SyntheticDrive.from_text(text)
    asked = parsed(text, RIG_LIMITS, (*RIG_NAMES, *OF_PAIR))
    own, lidar = (asked.pop(name, None) for name in OF_PAIR)
    rig = SyntheticRig(**asked)
    name = (own or rig.cameras[0]) if camera is None else camera
    if isinstance(name, int) and 0 <= name < len(rig.cameras):
        name = rig.cameras[name]
    return rig.pair(str(name), lidar or rig.lidars[0])


def open_rig(text: str) -> SyntheticRig | None:
    """The rig of several sensors that a text stands for; None if it is of one camera and one LiDAR, or names a pair."""
    if not is_multi_rig(text) or parsed(text, RIG_LIMITS, (*RIG_NAMES, *OF_PAIR)).keys() & set(OF_PAIR):
        return None
    return SyntheticRig.from_text(text)


def is_multi_rig(text: str) -> bool:
    """Whether a text names a rig of several sensors."""
    return _rig_in(text) in MULTI_RIGS


def _rig_in(text: str) -> str:
    items = (part.partition("=") for part in text.partition(":")[2].split(","))
    return "".join(value.strip() for key, _, value in items if key.strip() == "rig")


def _chosen(names: tuple[str, ...], chosen: str) -> str:
    return ", ".join(f"{name} (chosen)" if name == chosen else name for name in names)


def _unit(rng: np.random.Generator) -> Floats:
    axis = rng.standard_normal(3)
    return np.asarray(axis / np.linalg.norm(axis))
