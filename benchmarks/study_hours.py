"""Quiet driving and knocks: how often is a right extrinsic called suspect or moved, and how soon is a knock noticed?

The recalibrator sees a short drive lap after lap, with gaps between: every lap has its own errors of the images' stamps, and its
own frames that get lost. A knock turns or shifts the LiDAR at a random time, driving or standing.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.records import markdown
from benchmarks.study_runner import CLASSES_OFF, Case, End, FeaturesOf, Record, Study, Variant, frames_of
from calib_ros import se3
from calib_ros.errors import CalibrationError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.calibrator import Calibrator
from calib_ros.result import CONVERGED, MOVED, SUSPECT

Matrix = NDArray[np.float64]

RIGS = ("hdl64e_kitti", "os1_64_robot", "hdl32e_front", "pandar40p_roof", "vlp16_narrow", "os1_128_windshield")
FRAMES, WIDTH, GAP_S = 100, 480, 3.0  # of a lap at 10 Hz, and s between laps
QUIET_LAPS, LAPS, KNOCK_LAP = 30, 12, 7  # of a trial; the first lap of a knock, when the rest is deepest
JITTER_S, LOST = 0.004, 0.01
QUIET = "quiet"
KNOCKS = {"0.5 deg": (0.5, 0.0), "1.5 deg": (1.5, 0.0), "5 cm": (0.0, 0.05), "15 cm": (0.0, 0.15)}
WATCHED_S = 10.0  # after a knock


def drives(args: argparse.Namespace) -> Iterator[Case]:
    """A case for every rig, quiet or knocked, driving or standing; its trials differ by the draws."""
    sources = args.sources or [
        f"synthetic:rig={rig},seed={k + 3},frames={FRAMES},stride=1,ride={('steady', 'weaving')[k % 2]}"
        for k, rig in enumerate(RIGS)
    ]
    for number, name in enumerate(sources):
        frames = frames_of(name)
        for kind in (QUIET, *(f"{knock}, {how}" for knock in KNOCKS for how in ("driving", "standing"))):
            case = Case(f"{kind}", frames, number, source=name)
            yield case.begun([case.truth] * (args.trials or 1))


class Lap:
    """Frames as a vehicle would send them from a given time on."""

    def __init__(self, frames: Sequence[Frame], rng: np.random.Generator) -> None:
        self.frames, self.rng, self.seconds = frames, rng, 0.0
        self._first = frames[0].stamp

    def __iter__(self) -> Iterator[Frame]:
        begin = self.seconds
        for frame in self.frames:
            self.seconds = begin + (frame.stamp - self._first) / NANOSECONDS
            if self.rng.random() >= LOST:
                yield self.at(frame)
        self.seconds += GAP_S

    def at(self, frame: Frame) -> Frame:
        """A frame at the time that has come."""
        shift = round(self.seconds * NANOSECONDS) + self._first - frame.stamp
        late = round(self.rng.normal(0.0, JITTER_S) * NANOSECONDS)
        cloud = None if frame.cloud_stamp is None else frame.cloud_stamp + shift
        return replace(frame, stamp=frame.stamp + shift + late, cloud_stamp=cloud)


def knocked(frame: Frame, T: Matrix, knock: Matrix) -> Frame:
    """The scan of a LiDAR that was at T_camera_lidar (4, 4), and that `knock` (4, 4) has moved in the camera's frame."""
    M = se3.inverse(knock @ T) @ T
    xyz = (frame.cloud.xyz @ M[:3, :3].T + M[:3, 3]).astype(np.float32)
    return replace(frame, cloud=replace(frame.cloud, xyz=xyz))


def fed(recalibrator: Recalibrator, frame: Frame) -> str:
    """The status after a frame."""
    try:
        if recalibrator.wants(frame.stamp):
            recalibrator.ingest(frame)
    except CalibrationError:
        return recalibrator.current.result.status
    if recalibrator.ready():
        recalibrator.estimate()
    return recalibrator.current.result.status


def driven(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """said: of a quiet drive seconds, suspicions and movements; of a knock the seconds until it is not converged, and until it is
    called moved; nan for never."""
    rng = np.random.default_rng([case.number, trial, sum(map(ord, case.group))])
    start = se3.perturb(case.truth, 0.2 * np.ones(3) / 3**0.5, 0.02 * np.ones(3) / 3**0.5)
    config = replace(calibrator.config, search=replace(calibrator.config.search, rotation_deg=0.0, translation_m=0.0))
    recalibrator, lap = Recalibrator(calibrator.extract.source_camera, start, config), Lap(case.frames, rng)
    counts, before, settled_s = {SUSPECT: 0, MOVED: 0}, "", 0.0
    kind, _, how = case.group.partition(", ")
    for n in range(QUIET_LAPS if kind == QUIET else LAPS):
        knock_at = int(rng.integers(len(case.frames) // 2)) if kind != QUIET and n >= KNOCK_LAP else None
        for k, frame in enumerate(lap):
            if knock_at is not None and k >= knock_at and recalibrator.current.result.status == CONVERGED:
                return _after_knock(recalibrator, lap, frame, kind, how, case, rng)
            status = fed(recalibrator, frame)
            settled_s += 0.1 * (status in (CONVERGED, SUSPECT, MOVED))
            if status != before and status in counts:
                counts[status] += 1
            before = status
    said = f"{settled_s:.1f} {counts[SUSPECT]} {counts[MOVED]}" if kind == QUIET else "nan nan"
    return End.at(recalibrator.current.result.T_camera_lidar, case.truth, before, said)


def _after_knock(
    recalibrator: Recalibrator, lap: Lap, frame: Frame, kind: str, how: str, case: Case, rng: np.random.Generator
) -> End:
    deg, m = KNOCKS[kind]
    turn, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    knock = se3.perturb(np.eye(4), deg * turn, m * shift)
    first: dict[str, float] = {}
    place = next(k for k, own in enumerate(case.frames) if own.image is frame.image)
    begin = lap.seconds
    while lap.seconds - begin < WATCHED_S:
        if how == "driving":
            place = (place + 1) % len(case.frames)
            lap.seconds += GAP_S * (place == 0)
            begin += GAP_S * (place == 0)
        lap.seconds += 0.1
        status = fed(recalibrator, lap.at(knocked(case.frames[place], case.truth, knock)))
        if status != CONVERGED:
            first.setdefault("unusable", lap.seconds - begin)
        if status == MOVED:
            first.setdefault(MOVED, lap.seconds - begin)
            break
    said = " ".join(f"{first.get(name, np.nan):.1f}" for name in ("unusable", MOVED))
    return End.at(recalibrator.current.result.T_camera_lidar, case.truth, recalibrator.current.result.status, said)


def table(records: Sequence[Record]) -> str:
    """Quiet hours, and a line per kind of knock."""
    quiet = np.array([[float(v) for v in r.said.split()] for r in records if r.group == QUIET]).reshape(-1, 3).sum(axis=0)
    hours = quiet[0] / 3600
    out = markdown(["quiet hours", "suspect", "moved"], [[f"{hours:.2f}", int(quiet[1]), int(quiet[2])]])
    rows = []
    for group in dict.fromkeys(r.group for r in records if r.group != QUIET):
        times = np.array([[float(v) for v in r.said.split()] for r in records if r.group == group])
        shares = [f"{100 * np.mean(times[:, 0] <= s):.0f} %" for s in (1.0, 5.0, WATCHED_S)]
        rows.append([group, len(times), *shares, f"{100 * np.mean(np.isfinite(times[:, 1])):.0f} %"])
    return out + "\n" + markdown(["knock", "trials", "unusable in 1 s", "in 5 s", "in 10 s", "moved in 10 s"], rows)


# Triggered sensors: laps at one speed do not tell an offset of the clocks.
STUDY = Study(drives, driven, table, {"": Variant({**CLASSES_OFF, "motion": {"max_time_offset_s": 0.0}})})
