"""Which scan an image is paired with, for every way in which drivers stamp scans, and why some find none."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import MotionConfig
from calib_ros.frame import NANOSECONDS, PointCloud
from calib_ros.lidar.sweep import SweepOffset
from calib_ros.online.pairing import ClockDifference, PairingHealth, Synchronizer

MS = 10**6
T0 = 1_700_000_000 * NANOSECONDS
CAMERA = Camera(np.array([[400.0, 0, 320], [0, 400, 120], [0, 0, 1]]), 640, 240)  # 77 deg wide
FORWARD = se3.from_parts(se3.OPTICAL_FROM_BODY, [0.0, -0.1, -0.2])
STAMPED = {"start": 0.0, "middle": 0.5, "end": 1.0}


def turned(yaw_deg: float) -> np.ndarray:
    """T_camera_lidar of a camera that is turned to the left of the LiDAR's +x axis."""
    return FORWARD @ se3.from_parts(se3.rotation_from_euler(np.deg2rad(-yaw_deg), 0, 0), np.zeros(3))


@dataclass(frozen=True)
class Spinner:
    """A scanner that turns clockwise from azimuth cut_deg on, and stamps its scans at the start, in the middle or at the end."""

    stamped: str = "start"
    period: float = 0.1
    cut_deg: float = 180.0
    timed: bool = True

    def stamp_after_start(self) -> float:
        return STAMPED[self.stamped] * self.period

    def cloud(self) -> PointCloud:
        azimuth = np.deg2rad(np.repeat(np.arange(0.0, 360.0, 0.2), 16))
        height = np.tile(np.linspace(-2, 2, 16), 1800)
        xyz = np.c_[10 * np.cos(azimuth), 10 * np.sin(azimuth), height].astype(np.float32)
        time = np.mod(np.deg2rad(self.cut_deg) - azimuth, 2 * np.pi) / (2 * np.pi) * self.period - self.stamp_after_start()
        return PointCloud(xyz, time=time.astype(np.float32) if self.timed else None)

    def sweep_after_start(self, yaw_deg: float) -> float:
        """When it faces a direction."""
        return (self.cut_deg - yaw_deg) % 360 / 360 * self.period


def learnt(spinner: Spinner, T: np.ndarray = FORWARD, config: MotionConfig | None = None) -> float:
    """Offset in ms."""
    sweep = SweepOffset(config or MotionConfig())
    sweep.add(spinner.cloud(), CAMERA, T)
    assert sweep.ns is not None
    return sweep.ns / MS


@dataclass
class Drive:
    """Streams of a scanner and a camera, 30 s, and the pairs that a synchronizer makes of them. Times in ms after T0.
    phase: of the camera, s after the scan's start; None: when the scanner faces its view. jitter: half width of the images'
    moments, ms."""

    spinner: Spinner
    camera_period: float = 0.1
    phase: float | None = None
    jitter: float = 5.0
    tolerance_s: float = 0.0

    def __post_init__(self) -> None:
        rng = np.random.default_rng(0)
        spinner, swept = self.spinner, self.spinner.sweep_after_start(0.0)
        starts = 1000 * spinner.period * np.arange(int(30 / spinner.period))
        starts = starts + rng.uniform(-self.jitter / 5, self.jitter / 5, len(starts))
        images = 1000 * (self.camera_period * np.arange(int(30 / self.camera_period)))
        images += 1000 * (swept if self.phase is None else self.phase)
        self.images = np.sort(images + rng.uniform(-self.jitter, self.jitter, len(images)))
        self.sweeps = starts + 1000 * swept
        self.synchronizer = Synchronizer(self.tolerance_s, 8, None)
        sweep = SweepOffset(MotionConfig())
        # Images arrive 20 ms after their moment; a scan when it is complete, and 10 ms later.
        arrivals = [(t + 20, "image", t, t) for t in self.images.tolist()]
        arrivals += [
            (t + 1000 * spinner.period + 10, "cloud", t + 1000 * spinner.stamp_after_start(), t) for t in starts.tolist()
        ]
        self.pairs: list[tuple[float, float]] = []
        for _, kind, stamp, item in sorted(arrivals):
            at = T0 + round(stamp * MS)
            if kind == "image":
                self.pairs += self.synchronizer.add(True, at, item)
                continue
            self.pairs += self.synchronizer.add(False, at, item + 1000 * swept)
            if sweep.ns is None:
                sweep.add(spinner.cloud(), CAMERA, FORWARD)
                assert sweep.ns is not None
                self.pairs += self.synchronizer.set_cloud_offset(sweep.ns)

    @property
    def paired(self) -> float:
        """Share of the slower stream."""
        return len(self.pairs) / min(len(self.images), len(self.sweeps))

    @property
    def wrong(self) -> float:
        """Share of the pairs whose image another scan swept at a nearer time, by more than the jitter."""
        nearest = np.array([np.abs(self.sweeps - image).min() for image, _ in self.pairs])
        made = np.array([abs(image - sweep) for image, sweep in self.pairs])
        return float((made > nearest + 2.4 * self.jitter + 1e-6).mean())


# ---- the moment of the sweep ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("stamped", "offset"), [("start", 50.0), ("middle", 0.0), ("end", -50.0)])
@pytest.mark.parametrize("timed", [True, False])
def test_the_sweep_is_found_for_every_stamping(stamped, offset, timed):
    stated = MotionConfig(stamp_at=stamped, stamp_azimuth_deg={"middle": 0.0}.get(stamped, 180.0), from_scans="always")
    assert learnt(Spinner(stamped, timed=timed), config=stated) == offset


@pytest.mark.parametrize(
    ("timed", "yaw", "config", "offset"),
    [
        (False, 0, {}, 0.0),
        (False, 90, {}, 0.0),
        (True, 0, {"deskew": "off"}, 0.0),  # compensated to the stamp
        (True, 0, {"time_offset_s": 0.03}, 80.0),
        *((True, yaw, {}, pytest.approx(1000 * Spinner().sweep_after_start(yaw), abs=2.6)) for yaw in (-90, -45, 45, 90)),
        (False, 0, {"time_offset_s": -0.2}, -200.0),
    ],
)
def test_the_sweep_of_side_cameras_of_clouds_without_stated_stamping_and_with_a_known_time_offset(timed, yaw, config, offset):
    assert learnt(Spinner("start", timed=timed), turned(yaw), MotionConfig(**config)) == offset


def test_the_moment_follows_the_camera_but_not_the_scene():
    sweep = SweepOffset(MotionConfig())
    cloud = Spinner("start").cloud()
    sweep.add(cloud, CAMERA, FORWARD)
    rng = np.random.default_rng(0)
    for _ in range(20):  # parts of the view return nothing, such as the sky beside a house
        side = rng.uniform(-20, 20)
        sweep.add(cloud.select(np.abs(np.rad2deg(np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])) - side) < 25), CAMERA, FORWARD)
        assert sweep.ns == pytest.approx(50 * MS, abs=5 * MS)
    sweep.add(cloud, CAMERA, turned(90))
    assert sweep.ns == 25 * MS


def test_a_camera_that_looks_at_the_cut_keeps_one_side_of_it():
    """Half of its points are of the scan's start, half of its end."""
    spinner = Spinner("start", cut_deg=0.0)
    sweep, cloud, rng = SweepOffset(MotionConfig()), spinner.cloud(), np.random.default_rng(1)
    moments = set()
    for _ in range(30):
        sweep.add(cloud.select(rng.random(len(cloud)) < 0.5), CAMERA, FORWARD)
        assert sweep.ns is not None
        moments.add(sweep.ns // MS)
    assert len(moments) == 1
    assert min(moments) <= 15 or min(moments) >= 85  # of either side, and not in between, where nothing is measured


# ---- pairs ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stamped", STAMPED)
@pytest.mark.parametrize(
    ("options", "share"),
    [
        *(({"period": 1 / scan, "camera_period": 1 / camera}, 0.97) for camera in (10, 15, 20, 30) for scan in (5, 10, 20)),
        # At phase 0 the scan before and the one after are equally near: where the choice changes sides, two messages stay alone.
        ({"phase": 0.0}, 0.8),
        *(({"phase": phase}, 0.97) for phase in (0.01, 0.025, 0.05, 0.075, 0.09)),
        ({"period": 0.2, "camera_period": 0.2, "jitter": 15.0}, 0.95),
        ({"tolerance_s": 0.05}, 0.97),
    ],
    ids=str,
)
def test_every_stamping_rate_and_phase_pairs_with_the_scan_that_swept_the_view(stamped, options, share):
    drive = Drive(Spinner(stamped, options.get("period", 0.1)), **{k: v for k, v in options.items() if k != "period"})
    assert drive.paired >= share
    assert drive.wrong == 0.0
    assert PairingHealth(drive.synchronizer).check() == ""


def test_nothing_pairs_before_the_sweep_is_known():
    synchronizer = Synchronizer(0.0, 8, None)
    for k in range(20):
        assert synchronizer.add(True, T0 + 100 * k * MS, k) == synchronizer.add(False, T0 + (100 * k - 60) * MS, k) == []
    pairs = synchronizer.set_cloud_offset(60 * MS)
    assert [image for image, _ in pairs] == [cloud for _, cloud in pairs]
    assert len(pairs) >= 7
    assert synchronizer.set_cloud_offset(60 * MS) == []


# ---- what goes wrong --------------------------------------------------------------------------------------------------------


class Watched:
    """A synchronizer fed in real order, and what is said about it once a second of the data's time."""

    def __init__(self, tolerance_s: float = 0.0, capacity: int = 8) -> None:
        self.synchronizer = Synchronizer(tolerance_s, capacity)
        self.health = PairingHealth(self.synchronizer)

    def feed(self, images: np.ndarray, clouds: np.ndarray, image_delay: float = 0.0, image_clock: float = 0.0) -> list[str]:
        """Times of measurement in ms; image_delay: of the delivery, image_clock: of the stamps."""
        arrivals = sorted([(t + image_delay, "image", t + image_clock) for t in images] + [(t, "cloud", t) for t in clouds])
        said, second = [self.health.check()], 1000.0
        for at, kind, stamp in arrivals:
            while at >= second:
                said.append(self.health.check())
                second += 1000.0
            self.synchronizer.add(kind == "image", T0 + round(stamp * MS), None)
        return said


def ticks(hz: float, seconds: float = 20.0, jitter: float = 3.0, lost: float = 0.0, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * hz)) * 1000 / hz
    return np.sort(t + rng.uniform(-jitter, jitter, len(t)))[rng.random(len(t)) >= lost]


@pytest.mark.parametrize(
    ("watched", "streams", "said"),
    [
        ({}, {"image_clock": -3_600_000.0}, "^100% of the .* stamped 3600 s before the newest cloud"),
        ({}, {"image_clock": 37_000.0}, "stamped 37 s after the newest cloud"),
        ({}, {"image_clock": -1e12}, "stamped 11574 days before the newest cloud"),
        ({}, {"images": ticks(10, lost=0.6), "clouds": ticks(10, seed=1, lost=0.5)}, "^[^;]* are missing between"),
        ({"capacity": 4}, {"clouds": ticks(20, seed=1), "image_delay": 700.0}, "queue of the other one holds; lower the rate"),
        ({"capacity": 20}, {"clouds": ticks(20, seed=1), "image_delay": 700.0}, "^; "),
        ({"tolerance_s": 0.01}, {"image_clock": 40.0}, r"0\.01 s are allowed.*online\.pair_tolerance_s"),
        # Clocks are not blamed for what is lost, and no limit is to be raised that does not bind.
        ({}, {"clouds": ticks(10, 8.0, seed=1)}, "; no clouds have come for 12 s; see that their driver runs[^;]*$"),
        ({}, {"images": ticks(30, 2.0)}, "; no images have come for 18 s; see that their driver runs[^;]*$"),
        ({}, {"clouds": ticks(10, seed=1, lost=0.5)}, r"; \d+% of the clouds are missing between those that came; see [^;]*$"),
        ({}, {"images": ticks(1), "clouds": ticks(1, seed=1) + 450}, r"0\.12 s are allowed.* or raise online\.pair_tolerance_s$"),
    ],
)
def test_why_no_partner_is_found(watched, streams, said):
    """What is told of it, and the cause that would be."""
    own = Watched(**watched)
    told = own.feed(**{"images": ticks(10), "clouds": ticks(10, seed=1), **streams})[-1]
    assert re.search(said, f"{told}; {own.health.cause()}")


# ---- clocks of other epochs --------------------------------------------------------------------------------------------------


def difference(ahead_s: float, camera_hz: float = 10, scan_hz: float = 10, delay_ms: float = 0.0) -> ClockDifference:
    """After 20 s, of which the first stamps are of images alone."""
    clocks = ClockDifference()
    times = [(t + delay_ms, False, t) for t in ticks(camera_hz)] + [(t + 500, True, t + 500) for t in ticks(scan_hz, seed=1)]
    changes = 0
    for _, is_cloud, t in sorted(times):
        stamp = T0 + round(t * MS)
        changes += clocks.add(not is_cloud, stamp + is_cloud * round(ahead_s * NANOSECONDS))
    assert changes == (clocks.ahead != 0)
    return clocks


@pytest.mark.parametrize("ahead_s", [37.0, -37.0, 18.0, -19.0])
@pytest.mark.parametrize(("camera_hz", "scan_hz"), [(10, 10), (30, 10), (5, 20)])
def test_time_scales_are_told_apart_exactly(ahead_s, camera_hz, scan_hz):
    clocks = difference(ahead_s, camera_hz, scan_hz, delay_ms=60.0)
    assert clocks.ahead == ahead_s * NANOSECONDS
    assert f"stamped {abs(ahead_s):.0f} s {'after' if ahead_s > 0 else 'before'} images" in clocks.describe()


@pytest.mark.parametrize(
    ("ahead_s", "found"),
    [
        *((ahead_s, pytest.approx(ahead_s, abs=0.1)) for ahead_s in (3600.0, -1.6e9, 250.4)),
        *((ahead_s, 0) for ahead_s in (0.0, 0.05, -0.8, 5.0, -40.0)),  # messages that wait
    ],
)
def test_other_epochs_are_known_as_well_as_messages_arrive(ahead_s, found):
    clocks = difference(ahead_s)
    assert (clocks.ahead / NANOSECONDS, bool(clocks.describe())) == (found, found != 0)


@pytest.mark.parametrize("period", [33, 100])
def test_a_stream_that_goes_on_alone_tells_nothing_of_the_clocks(period):
    """Although it is 18 s ahead after a while, as GPS time is, and then a minute."""
    clocks = ClockDifference()
    clocks.add(False, T0)
    assert not any(clocks.add(True, T0 + t * MS) for t in range(0, 90_000, period))


def test_a_clock_that_jumps_between_pairs_has_time_to_come_back():
    clocks, jump, time = ClockDifference(), 3600 * NANOSECONDS, itertools.count(T0, 100 * MS)

    def changed(seconds: float, ahead: int) -> int:
        stamps = list(itertools.islice(time, round(10 * seconds)))
        return sum(clocks.add(True, stamp, True) + clocks.add(False, stamp + ahead, True) for stamp in stamps)

    assert changed(5, 0) + changed(5, jump) + changed(5, 0) + changed(9, jump) == 0
    assert (changed(2, jump), clocks.ahead) == (1, pytest.approx(jump, abs=100 * MS))
    assert (changed(2, 0), clocks.ahead) == (1, 0)
