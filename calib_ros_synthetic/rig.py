"""A drive of a rig through a ray-cast world, with exact extrinsics: the embedded data of the demo and of the tests.

Everything follows from the parameters and the number of the measurement, not from the order of access. Only the vehicle moves.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.datasets.recent import Recent, Timed
from calib_ros.datasets.source import describe_camera
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, UNLABELLED, Frame, PointCloud
from calib_ros.frame import SemanticClass as Label
from calib_ros.lens import PERSPECTIVE
from calib_ros.stamps import nearest_index, nearest_pairs, pair_tolerance
from calib_ros_synthetic import ego
from calib_ros_synthetic.camera import CONDITIONS, Scene, render
from calib_ros_synthetic.lidar import OwnReturns, delivered, own_returns, scan
from calib_ros_synthetic.parameters import CHOICE, PARAMETERS, checked, known_of, named, parsed
from calib_ros_synthetic.rays import CameraView, row_motion
from calib_ros_synthetic.rigs import FIELDS, OPTICAL, RIGS, Lens, plain
from calib_ros_synthetic.scanners import PERIOD, RosetteScanner, in_frame, scanner
from calib_ros_synthetic.scenes import SCENES
from calib_ros_synthetic.solids import Floats, Solids
from calib_ros_synthetic.street import LIDAR_HEIGHT, RIDES, SPINS, STAMP_AT, WEAVING, Ride
from calib_ros_synthetic.wide import WideView

START = 1_600_000_000 * NANOSECONDS  # stamp of the first frame; 0 would mean "no stamp" to many tools
CACHED, CACHED_OF_PAIR = 64, 8  # measurements: of the clouds of several sensors, about 250 MB
SHIFT_M = 0.01  # by which one of several sensors stands beside its mount for each degree that it is turned
PHASE = 0.37  # of a period, by which each sensor begins after the one before: free-running sensors are never in step
# What draws random numbers: of a pair, and of several sensors.
SCAN, DRIVER, PICTURE = (5, 2), (9, 3), (6, 4)
Bytes = NDArray[np.uint8]


class SyntheticRig:
    """What the sensors of a rig measure on a drive.

    Parameters
    ----------
    rig : a name in rigs.RIGS; None = the plain one, a scanner of `rings` rings and a camera. seed : of scene, ride and tilt.
    rings : 16, 32, 64 (default) or 128 of a spinning LiDAR; 0 for a scanner without rings, which scans a never-repeating rosette
        ahead. A rig has its own scanner.
    frames, stride : of each pair, frames that are stride tenths of a second apart; the recording is that long. Sensors of more
        than one pair run at their own rates all the time.
    width, height : px, by default 1242x375 or the rig's, of which one alone keeps the shape.
    speed : m/s; at 0 the vehicle stops for every frame, where it would be at its usual speed. By default what is usual in the
        scene (5 m/s in the street), as far as the rig's vehicle can go.
    noise : factor on all sensor noise; 0 = none.
    tilt_deg : the camera of a pair is turned from its mount by this about an axis that depends on the seed; every one of several
        sensors about an axis of its own, and shifted by 1 cm for each degree.
    scene : a name in scenes.SCENES. condition : a name in camera.CONDITIONS, by default the rig's.
    fields : all, xyzir, xyzi or xyz: what the clouds hold, by default what the rig's driver gives.
    ride : steady, or weaving: the vehicle swerves, brakes and accelerates.
    image_late_ms : images are stamped that much late; jitter_ms : standard deviation of their stamps.
    stamp_at : start, middle or end, the part of the scan that its stamp refers to; middle is where the scanner faces ahead.
    spin : clockwise or counterclockwise, seen from above.
    clocks : factor on the differences between the sensors' clocks; 0 = one clock.
    knock : name of a sensor, or several joined by +, as on one bracket: displaced as one from knock_at seconds on (default: half
        of the drive), by knock_deg about an axis and by knock_m in a direction that depend on the seed.
    camera : Camera instead of the rig's; T_camera_lidar : extrinsic (4, 4) of a pair instead of the rig's.

    References are exact: `reference` before the knock, `reference_at` at any stamp, those of frames at theirs.
    Raises BadInputError for values out of range and for unknown names.
    """

    def __init__(
        self, rig: str | None = None, *, camera: Camera | None = None, T_camera_lidar: ArrayLike | None = None, **given: Any
    ) -> None:
        known = known_of(rig)
        if unknown := sorted(given.keys() - set(known)):
            raise BadInputError(f"synthetic drive: {', '.join(unknown)} does not go with this rig, which has {', '.join(known)}")
        p = {name: checked(name, given.get(name)) for name in known} | {"rig": rig}
        if rig is not None and p.get("rings") is not None:
            raise BadInputError(
                f"synthetic drive: rings={p['rings']} does not go with rig={rig}, which has its own scanner; leave it out"
            )
        defaults = {name: PARAMETERS[name][0] for name in known}
        world = named("scene", defaults["scene"] if p["scene"] is None else p["scene"], SCENES)
        self.model = plain(64 if p["rings"] is None else p["rings"]) if rig is None else RIGS[rig]
        cruise = min(world.cruise, self.model.top_speed)
        defaults |= {"speed": cruise} if self.model.is_pair else {"condition": self.model.condition}
        defaults |= {"rings": 64, "width": 1242, "height": 375} if rig is None else {}
        p = {name: defaults[name] if value is None else value for name, value in p.items()}
        for name, names in (("ride", RIDES), ("stamp_at", STAMP_AT), ("spin", SPINS), ("fields", FIELDS)):
            if p.get(name) is not None:
                named(name, p[name], dict.fromkeys(names))
        changed = [f"{k}={v}" for k, v in p.items() if v is not None and (k in ("seed", "rig") or v != defaults[k])]
        self.name = "synthetic:" + ",".join(changed)  # without what exists only in Python
        self.parameters: dict[str, Any] = {name: values[0] for name, values in PARAMETERS.items()} | p
        p = self.parameters
        self.seed: int = p["seed"]
        self.frames: int = p["frames"]
        self.step = p["stride"] * PERIOD
        self.duration = self.frames * self.step
        self.speed: float = cruise if p["speed"] is None else p["speed"]
        if not self.speed and not self.model.is_pair:
            raise BadInputError("synthetic drive: speed=0 does not go with several sensors, which measure at different times")
        self._fields = self.model.fields if rig is None else p["fields"] or self.model.fields  # the plain scanner gives all
        self._condition = named("condition", p["condition"] or self.model.condition, CONDITIONS)
        self._ride = Ride(self.seed, self.speed or cruise, p["ride"] == WEAVING)
        self._street = world(self.seed, self._ride.station(self.duration))
        self.cameras, self.lidars = self.model.cameras, self.model.lidars
        self.reference_sensor = self.lidars[0]
        self.knocked = tuple(filter(None, p["knock"].split("+")))
        for name in self.knocked:
            named("knock", name, self.model.sensors)
        self.knock_at: float = self.duration / 2 if p["knock_at"] is None else p["knock_at"]
        # The ride is that of a scanner above the origin of the vehicle's frame.
        self._T_ride_base = se3.from_parts(np.eye(3), [0.0, 0.0, 0.0 if self.model.vehicle is None else -LIDAR_HEIGHT])
        self._body = ego.body(self.model.vehicle or "")
        sensors, size = self.model.sensors, (p["width"], p["height"])
        self._lenses = {name: own.kind.camera(*size) for name, own in sensors.items() if isinstance(own.kind, Lens)}
        self._cameras = {name: camera or own for name, own in self._lenses.items()}
        self._scanners = {name: scanner(str(sensors[name].kind), sensors[name].rate) for name in self.lidars}
        self._made = Recent(CACHED_OF_PAIR if self.model.is_pair else CACHED)
        self._pose = lru_cache(maxsize=None)(self._mounted)
        self.view = lru_cache(maxsize=None)(self._view)
        self._own_layer = lru_cache(maxsize=None)(lambda camera, after: self._own_seen(camera, self._frame(camera, after)))
        self._own_returns = lru_cache(maxsize=None)(self._own_returns_of)
        self._T_camera_lidar = self._reference_of_pair() if self.model.is_pair else None
        if T_camera_lidar is not None:
            if not self.model.is_pair:
                raise BadInputError("synthetic drive: T_camera_lidar does not go with several sensors; leave it out")
            self._T_camera_lidar = se3.as_transform(T_camera_lidar, "T_camera_lidar")

    def camera(self, name: str) -> Camera:
        """The intrinsics of a camera."""
        return named("camera", name, self._cameras)

    def frame_id(self, name: str) -> str:
        """TF frame of a sensor."""
        if name in self.cameras:
            return name if self.model.is_pair else f"{name}_optical"
        return "base_link" if self.model.base_frame else name

    def reference(self, name: str) -> Floats:
        """T_reference_sensor (4, 4), exact, before the knock."""
        return np.asarray(se3.inverse(self._frame(self.reference_sensor, False)) @ self._frame(name, False))

    def reference_at(self, name: str, stamp: int) -> Floats:
        """T_reference_sensor (4, 4), exact, when the sensor stamps `stamp`, ns."""
        seconds = (stamp - START) / NANOSECONDS - self.clock_s(name)
        base, own = (self._frame(one, self._is_after(one, seconds)) for one in (self.reference_sensor, name))
        return np.asarray(se3.inverse(base) @ own)

    def prior(self, name: str) -> Floats:
        """T_reference_sensor (4, 4) by the drawing."""
        return np.asarray(se3.inverse(self.model.sensors[self.reference_sensor].pose()) @ self.model.sensors[name].pose())

    def clock_s(self, name: str) -> float:
        """By which the clock of a sensor is ahead."""
        clocks: float = self.parameters["clocks"]
        return clocks * self.model.sensors[name].late_ms / 1000

    def pair(self, camera: str, lidar: str) -> RigPair:
        """Images of a camera with the scans that swept its view at the nearest times, by the stamps of their own clocks."""
        return RigPair(self, camera, lidar)

    def scans(self, lidar: str) -> Timed:
        """All scans of a LiDAR with their stamps, ns."""
        return Timed(self.stamps(lidar), lambda index: self.scan(lidar, index)[0])

    def pictures(self, camera: str) -> Timed:
        """All images of a camera with their stamps, ns."""
        return Timed(self.stamps(camera), lambda index: self.picture(camera, index)[0])

    def stamps(self, name: str) -> NDArray[np.int64]:
        """Of all that a sensor measures (n,), ns, by its own clock."""
        if not self.model.is_pair:
            first, rate = self.seconds(name, 0), self.model.sensors[name].rate
            seconds = first + np.arange(max(1, int(np.ceil((self.duration - first) * rate - 1e-9)))) / rate
            return np.asarray(START + np.rint((seconds + self.clock_s(name)) * NANOSECONDS).astype(np.int64))
        stamps: NDArray[np.int64] = START + np.arange(self.frames) * round(self.step * NANOSECONDS)
        if name in self.lidars:
            return np.asarray(stamps + round(self._shift_s(name) * NANOSECONDS))
        late, jitter = (np.full(self.frames, self.parameters[k] / 1000) for k in ("image_late_ms", "jitter_ms"))
        if jitter[0]:
            late += jitter * [np.random.default_rng([self.seed, 11, k]).standard_normal() for k in range(self.frames)]
        stamps += round(self._delay_s() * NANOSECONDS) + np.rint(late * NANOSECONDS).astype(np.int64)
        return stamps

    def seconds(self, name: str, index: int) -> float:
        """When a sensor measures for the index-th time."""
        if self.model.is_pair:
            return index * int(self.parameters["stride"]) * PERIOD
        rate = self.model.sensors[name].rate
        return (PHASE * self._number(name)) % 1 / rate + index / rate

    def scan(self, lidar: str, index: int) -> tuple[PointCloud, Floats]:
        """Scan `index` of a LiDAR, with the twist (6,) of the frame that it is given in."""
        return self._made((lidar, index), lambda: self._scan(lidar, index))

    def picture(self, camera: str, index: int) -> tuple[Bytes, Bytes]:
        """Image `index` of a camera, with the classes of its pixels."""
        return self._made((camera, index), lambda: self._picture(camera, index))

    def T_camera_lidar(self, camera: str, image: int, lidar: str, scan: int) -> Floats:
        """The exact extrinsic (4, 4) between the sensors where they were at an image and at a scan."""
        if self._T_camera_lidar is not None:
            return self._T_camera_lidar
        T_base_camera, T_base_lidar = (
            self._pose(name, self._is_after(name, self.seconds(name, index))) for name, index in ((camera, image), (lidar, scan))
        )
        return np.asarray(se3.inverse(T_base_camera) @ T_base_lidar)

    def sweep_s(self, camera: str, lidar: str) -> float:
        """From a scan's stamp to when it sweeps the camera's axis; 0 for scanners that do not turn."""
        if isinstance(self._scanners[lidar], RosetteScanner):
            return 0.0
        axis = (self._pose(lidar, False)[:3, :3].T @ self._pose(camera, False)[:3, 2])[:2]
        return float(-np.arctan2(axis[1], axis[0]) / (2 * np.pi * self.model.sensors[lidar].rate))

    def _number(self, name: str) -> int:
        return list(self.model.sensors).index(name)

    def _rng(self, of: tuple[int, int], name: str, index: int) -> np.random.Generator:
        key = (of[0], index) if self.model.is_pair else (14, of[1], self._number(name), index)
        return np.random.default_rng([self.seed, *key])

    def _is_after(self, name: str, seconds: float) -> bool:
        return name in self.knocked and seconds >= self.knock_at

    def _shift_s(self, lidar: str) -> float:
        """From the middle of a scan to its stamp."""
        return STAMP_AT[self.parameters["stamp_at"]] / self.model.sensors[lidar].rate

    def _delay_s(self) -> float:
        """From the scan's stamp to the picture of a pair: a triggered camera waits until the scan sweeps its axis."""
        return self.sweep_s(self.cameras[0], self.lidars[0]) if self.model.triggered else 0.0

    def _mounted(self, name: str, after: bool) -> Floats:
        """T_base_sensor (4, 4): the seed turns the camera of a pair, and moves each of several sensors, from its mount."""
        T, tilt_deg = self.model.sensors[name].pose(), self.parameters["tilt_deg"]
        if self.model.is_pair:
            if name in self.cameras:
                axis = np.random.default_rng([self.seed, 7]).standard_normal(3)
                turn = np.r_[np.deg2rad(tilt_deg) * axis / np.linalg.norm(axis), 0, 0, 0]
                T[:3, :3] = T[:3, :3] @ se3.exp(turn)[:3, :3]
            return T
        axis, shift = (self._direction(0, self._number(name), k) for k in (0, 1))
        moved = _displacement(T[:3, 3], tilt_deg * axis, SHIFT_M * tilt_deg * shift)
        if after:
            centre = np.mean([self.model.sensors[own].pose()[:3, 3] for own in self.knocked], axis=0)
            deg, m = self.parameters["knock_deg"], self.parameters["knock_m"]
            moved = _displacement(centre, deg * self._direction(1, 0), m * self._direction(1, 1)) @ moved
        return np.asarray(moved @ T)

    def _direction(self, *of: int) -> Floats:
        axis = np.random.default_rng([self.seed, 14, *of]).standard_normal(3)
        return np.asarray(axis / np.linalg.norm(axis))

    def _reference_of_pair(self) -> Floats:
        """T_camera_lidar (4, 4) to the frame that clouds are given in."""
        camera, lidar = self.cameras[0], self.lidars[0]
        if self.model.vehicle is not None:
            return np.asarray(se3.inverse(self._pose(camera, False)) @ self._frame(lidar, False))
        axis, mount = np.random.default_rng([self.seed, 7]).standard_normal(3), self.model.sensors[camera].mount
        straight = se3.from_parts(OPTICAL.T, np.zeros(3))
        T = se3.perturb(straight, self.parameters["tilt_deg"] * axis / np.linalg.norm(axis), np.zeros(3))
        T[:3, 3] = -T[:3, :3] @ (mount.x, mount.y, mount.z)
        return T

    def _frame(self, name: str, after: bool) -> Floats:
        """T_base_frame (4, 4) of what a sensor gives."""
        if name in self.cameras:
            base, hung = self._hung(name, after)
            return np.asarray(base @ hung)
        return np.eye(4) if self.model.base_frame else self._pose(name, after)

    def _hung(self, camera: str, after: bool) -> tuple[Floats, Floats]:
        """Where a camera is: T_base_frame, T_frame_camera (4, 4); that of a pair by its extrinsic."""
        if self._T_camera_lidar is None:
            return self._pose(camera, after), np.eye(4)
        return self._frame(self.lidars[0], False), se3.inverse(self._T_camera_lidar)

    def _in_world(self, T_base: Floats, seconds: float) -> Floats:
        """The pose (4, 4) of a frame that lies at T_base (4, 4) on the vehicle."""
        return np.asarray(self._ride.pose(self._street, self._ride.station(seconds)) @ self._T_ride_base @ T_base)

    def _twist(self, T_base: Floats, seconds: float) -> Floats:
        """The twist (6,), rad/s and m/s, of such a frame in itself. It is constant during a measurement."""
        speed = self._ride.speed_at(seconds) if self.speed > 0 else 0.0
        ride = self._ride.twist(self._street, self._ride.station(seconds), speed)
        return ride if self.model.vehicle is None else in_frame(ride, self._T_ride_base @ T_base)

    def _view(self, name: str) -> CameraView:
        """The pixels of a camera."""
        camera, lens = self.camera(name), self.model.sensors[name].kind
        if isinstance(lens, Lens) and camera == self._lenses[name] and camera.model not in PERSPECTIVE:
            return WideView(camera, lens.field)
        return CameraView(camera)

    def _own_returns_of(self, lidar: str, after: bool) -> OwnReturns | None:
        """What a scanner hits of the vehicle; a pattern that never repeats has none of it, for that is near its blind zone."""
        if self._body is None or isinstance(self._scanners[lidar], RosetteScanner):
            return None
        return own_returns(self._body, self._scanners[lidar].beams()[0], self._pose(lidar, after))

    def _own_seen(self, camera: str, T_base_camera: Floats) -> ego.OwnLayer | None:
        """What a camera sees of the vehicle."""
        return None if self._body is None else ego.own_layer(self._body, self.view(camera), T_base_camera)

    def _scan(self, lidar: str, index: int) -> tuple[PointCloud, Floats]:
        seconds, street = self.seconds(lidar, index), self._street
        after, solids = self._is_after(lidar, seconds), street.around(self._ride.station(seconds))
        T_base_lidar = self._pose(lidar, after)
        T, twist = self._in_world(T_base_lidar, seconds), self._twist(T_base_lidar, seconds)
        device = replace(self._scanners[lidar], number=index * int(self.parameters["stride"]) if self.model.is_pair else index)
        # Everything is cast relative to the sensor: far from the world's origin float32 would be too coarse.
        cloud, hit = scan(
            *(street, solids.moved(-T[:3, 3]), device, T, twist, self.parameters["noise"], self._rng(SCAN, lidar, index)),
            visibility=self._condition.visibility,
            own=self._own_returns(lidar, after),
            reverse=self.parameters["spin"] != SPINS[0],
        )
        cloud, kept = delivered(self.model, T_base_lidar, cloud, twist, self._fields, self._rng(DRIVER, lidar, index))
        shift = self._shift_s(lidar)
        if shift and cloud.time is not None:  # the points' times count from the stamp
            cloud = replace(cloud, time=(cloud.time - shift).astype(np.float32))
        return replace(cloud, label=_labels(solids, hit[kept])), self._twist(self._frame(lidar, after), seconds)

    def _picture(
        self, camera: str, index: int, hung: tuple[Floats, Floats] | None = None, age_s: float = 0.0
    ) -> tuple[Bytes, Bytes]:
        """hung: where the camera is, see `_hung`; as the rig has it by default."""
        seconds, street, view = self.seconds(camera, index), self._street, self.view(camera)
        after, solids = self._is_after(camera, seconds), street.around(self._ride.station(seconds))
        base, T_frame_camera = hung or self._hung(camera, after)
        own = self._own_layer(camera, after) if hung is None else self._own_seen(camera, base @ T_frame_camera)
        seen_at, moving = seconds - (age_s if self.speed else 0.0), self._twist(base, seconds)
        T, later = self._in_world(base, seen_at), moving * self._delay_s()
        T = (T @ se3.exp(later) if later.any() else T) @ T_frame_camera
        twist, lens = in_frame(moving, T_frame_camera), T[:3, 3]
        R_vehicle = None if self.model.vehicle is None else self._in_world(np.eye(4), seen_at)[:3, :3]
        scene = Scene(
            *(street, solids.moved(-lens), lens, T[:3, :3], self._condition.lit(street.indoors), own, R_vehicle),
            *(row_motion(T, twist, self._condition.readout, view.x.shape[0]), twist),
        )
        noise = self.parameters["noise"] * self._condition.noise
        image, seen = render(scene, view, noise, self._rng(PICTURE, camera, index), self._condition)
        return image, _labels(solids, seen)


class RigPair:
    """One camera and one LiDAR of a rig as a source: up to rig.frames frames, rig.step seconds apart."""

    def __init__(self, rig: SyntheticRig, camera: str, lidar: str) -> None:
        self.rig, self._names, self.camera = rig, (camera, lidar), rig.camera(camera)
        self.cameras = rig.cameras
        named("lidar", lidar, rig._scanners)
        self.name = rig.name if rig.model.is_pair else f"{rig.name},camera={camera},lidar={lidar}"
        self.reference = rig.T_camera_lidar(camera, 0, lidar, 0)
        self.camera_frame, self.lidar_frame = rig.frame_id(camera), rig.frame_id(lidar)
        self._images, self._clouds = rig.stamps(camera), rig.stamps(lidar)
        self._pairs = [(k, k) for k in range(rig.frames)]
        if not rig.model.is_pair:
            moments = self._clouds + round(rig.sweep_s(camera, lidar) * NANOSECONDS)
            periods = tuple(round(rig.duration / len(own) * NANOSECONDS) for own in (self._images, self._clouds))
            pairs = np.stack(nearest_pairs(self._images, moments, pair_tolerance((periods[0], periods[1]), 0.0)), axis=1)
            wanted = START + np.rint((np.arange(rig.frames) * rig.step) * NANOSECONDS).astype(np.int64)
            self._pairs = pairs[np.unique(nearest_index(self._clouds[pairs[:, 1]], wanted))].tolist()

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`, whose reference is that of its moment. IndexError past either end."""
        camera, lidar = self._names
        image_at, scan_at = self._pairs[index]
        return self._frame(index, self.rig.picture(camera, image_at), self.rig.T_camera_lidar(camera, image_at, lidar, scan_at))

    def moved(self, index: int, T_camera_lidar: Floats, age_s: float = 0.0) -> Frame:
        """Frame `index` with the camera mounted at T_camera_lidar (4, 4), which is the frame's reference.

        age_s: the image shows the world as seen that long before its stamp.
        """
        (camera, lidar), (image_at, scan_at), rig = self._names, self._pairs[index], self.rig
        T_base_lidar = rig._frame(lidar, rig._is_after(lidar, rig.seconds(lidar, scan_at)))
        seen = rig._picture(camera, image_at, (T_base_lidar, se3.inverse(T_camera_lidar)), age_s)
        return self._frame(index, seen, T_camera_lidar)

    def pose(self, index: int) -> Floats:
        """T_world_lidar (4, 4) at the scan's stamp, of the frame that clouds are given in; z is up, the road lies at z = 0."""
        rig, lidar = self.rig, self._names[1]
        seconds = rig.seconds(lidar, self._pairs[index][1])
        return rig._in_world(rig._frame(lidar, rig._is_after(lidar, seconds)), seconds)

    def describe(self) -> dict[str, str]:
        """Facts for people."""
        (camera, lidar), rig, p = self._names, self.rig, self.rig.parameters
        tilt, t = se3.rotation_error_deg(OPTICAL.T, self.reference), self.reference[:3, 3]
        facts = {
            "source": f"{rig.name}, a ray-cast {p['scene'].replace('_', ' ')} with exact ground truth",
            "frames": f"{len(self)}, every {rig.step:g} s, {rig._ride.station(rig.duration) / rig.frames:.3g} m apart",
            "camera": describe_camera(self.camera),
            "LiDAR": rig._scanners[lidar].describe(),
            "motion": f"{rig.speed:g} m/s, {p['ride']}" if rig.speed else "stops for every frame",
            "noise": f"{p['noise']:g} x the default",
            "reference": f"{tilt:.2f} deg from looking straight ahead, translation {t[0]:.3f} {t[1]:.3f} {t[2]:.3f} m",
        }
        if p["rig"] is not None:
            facts["rig"] = f"{p['rig']}: {rig.model.why}"
        if not rig.model.is_pair:
            facts["frames"] += f"; of {len(self._images)} images and {len(self._clouds)} scans"
            for kind, names, chosen in (("cameras", rig.cameras, camera), ("lidars", rig.lidars, lidar)):
                facts[kind] = ", ".join(f"{name} (chosen)" if name == chosen else name for name in names)
            facts["clocks"] = f"the camera's is {1000 * (rig.clock_s(camera) - rig.clock_s(lidar)):+g} ms ahead of the LiDAR's"
        return facts

    def _frame(self, index: int, seen: tuple[Bytes, Bytes], reference: Floats) -> Frame:
        image_at, scan_at = self._pairs[index]
        cloud, twist = self.rig.scan(self._names[1], scan_at)
        return Frame(
            image=seen[0].copy(),
            cloud=deepcopy(cloud),  # what is kept must not change when a caller modifies its frame
            camera=self.camera,
            stamp=int(self._images[image_at]),
            cloud_stamp=int(self._clouds[scan_at]),
            reference=reference.copy(),
            name=f"{range(len(self))[index]:06d}",
            twist=twist.copy(),
            compensated=self.rig.model.compensated,
            classes=seen[1].copy(),
        )


def open_drive(text: str, camera: str | int | None = None) -> RigPair:
    """What a text `synthetic[:...]` stands for: one camera, of several by name or number, with one LiDAR; by default the first,
    or those that the text names by camera=, lidar=."""
    asked = parsed(text)
    own, lidar = (asked.pop(name, None) for name in CHOICE)
    rig = SyntheticRig(**asked)
    name = own or rig.cameras[0]
    if camera is not None and not rig.model.is_pair:
        name = rig.cameras[camera] if isinstance(camera, int) and 0 <= camera < len(rig.cameras) else str(camera)
    return rig.pair(name, lidar or rig.lidars[0])


def open_rig(text: str) -> SyntheticRig | None:
    """The rig of several sensors that a text stands for; None if it is of one camera and one LiDAR, or names a pair."""
    asked = parsed(text)
    if asked.keys() & set(CHOICE) or RIGS.get(asked.get("rig", ""), plain(0)).is_pair:
        return None
    return SyntheticRig(**asked)


def _displacement(centre: Floats, rotation_deg: Floats, shift_m: Floats) -> Floats:
    """(4, 4): turns what is mounted around a place on the vehicle (3,) about it by a rotation vector (3,), and shifts it (3,)."""
    R = se3.exp(np.r_[np.deg2rad(rotation_deg), 0, 0, 0])[:3, :3]
    return se3.from_parts(R, centre + shift_m - R @ centre)


def _labels(solids: Solids, ids: NDArray[np.int32]) -> Bytes:
    """SemanticClass of what rays have met, as `cast` writes it."""
    # Ids below 0 index this table from its end: own vehicle, curb, pavement and road, then the sky.
    return np.asarray(np.r_[solids.label, UNLABELLED, [Label.GROUND] * 3, Label.SKY].astype(np.uint8)[ids])
