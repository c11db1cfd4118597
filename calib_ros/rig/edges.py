"""From the recording of a rig to the edges of its graph: every pair of sensors that shares a view is registered, the others are
joined by how they move. Scans are read, searched for edges and aligned once, whatever the number of cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.config import Config, MotionConfig, update
from calib_ros.datasets.rig import RigSource
from calib_ros.datasets.source import Source, frame_positions, neighbours, spread_positions
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import Frame
from calib_ros.lidar.ego_motion import without_motion
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FeatureExtractor, ScanEdges
from calib_ros.registration.motion_guess.guess import motion_guess
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import LensEffect, Result
from calib_ros.rig.description import RigDescription
from calib_ros.rig.graph import SIGNIFICANCE, Edge, RigSolution, solve
from calib_ros.rig.lidars import MOTION_KIND, SCANS_KIND, SHARED, UNKNOWN_M, LidarScans, motion_edge, scan_edge, shared_view

# Half width of a search: two standard deviations of what the priors say, but no less than the odd centimetre of a mount.
SIGMAS, LEAST_DEG, LEAST_M = 2.0, 0.5, 0.05
LEAST_S, UNKNOWN_S = 1e-6, 1.0  # standard deviations, s, of one clock for all, and of one of which nothing is known
FAR = float(scipy.special.chdtri(1, SIGNIFICANCE))  # squared deviations
GRID, SEEN = (16, 9), 0.1  # cells of a picture, and the share of them with points which is a shared view
Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Measurement:
    """What became of a pair of sensors. edge: None where it failed. reason: why it did, or what else there is to know. result: of
    the registration of a camera and a LiDAR."""

    target: str
    source: str
    kind: str
    edge: Edge | None
    reason: str = ""
    result: Result | None = None


def priors_of(description: RigDescription, rig: RigSource) -> dict[str, tuple[Transform, Covariance]]:
    """T_reference_sensor and its covariance of every sensor but the reference, by the description or the recording. BadInputError
    names a sensor of which neither says anything."""
    found = {}
    for sensor in description.sensors:
        if sensor.name == description.reference:
            continue
        T = sensor.prior if sensor.prior is not None else rig.reference(sensor.name)
        if T is None:
            raise BadInputError(
                f"{rig.name} does not state where {sensor.name} is; set sensors.{sensor.name}.prior to translation_m and "
                "quaternion_xyzw, or a result file"
            )
        found[sensor.name] = sensor.believed(T)
    return found


class RigMeasurer:
    """Measures the edges of a rig. config: of all its cameras. frames: which of every pair, as --frames, or about how many,
    evenly spread. progress: gets what is done and the share of it."""

    def __init__(
        self,
        rig: RigSource,
        description: RigDescription,
        config: Config,
        frames: str | int = "all",
        progress: Progress | None = None,
    ) -> None:
        self.rig, self.description, self.config, self.frames = rig, description, config, frames
        self.priors = priors_of(description, rig)
        self.progress = progress or (lambda text, share: None)
        self.scans = {name: LidarScans(rig.scans(name), config.motion, self._window(name)) for name in description.lidars}
        self.shared: dict[str, ScanEdges] = {name: {} for name in description.lidars}

    def _window(self, lidar: str) -> tuple[int, int] | None:
        """From and to which scan the chosen frames last; None = all."""
        if self.frames == "all" or isinstance(self.frames, int) or not self.description.cameras:
            return None
        source = self.rig.pair(self.description.cameras[0], lidar)
        positions = self._positions(source)
        first, last = (source[k].moment_of_cloud + _ahead(source) for k in (min(positions), max(positions)))
        return first, last

    def _positions(self, source: Source) -> list[int]:
        if isinstance(self.frames, int):
            return spread_positions(self.frames, len(source))
        return frame_positions(self.frames, len(source))

    def measure(self) -> list[Measurement]:
        """All edges: LiDARs first, whose places narrow the search for cameras. Deterministic. Raises what reading raises."""
        out = self.between_lidars()
        known = self.solution(out)
        pairs = self.camera_pairs(known)
        for k, (camera, lidar) in enumerate(pairs):
            self.progress(f"{camera} with {lidar}", k / len(pairs))
            out.append(self.camera_edge(camera, lidar, known))
        out = in_step(out, self.config.motion)
        joined = {m.target for m in out if m.edge is not None}
        for camera in (name for name in self.description.cameras if name not in joined):
            out += self.by_motion(camera, known)
        return out

    def solution(self, measured: Sequence[Measurement]) -> RigSolution:
        """The graph's estimate from what was measured."""
        return solve([m.edge for m in measured if m.edge is not None], self.priors, self.description.reference)

    def between_lidars(self) -> list[Measurement]:
        """Edges of all pairs of LiDARs."""
        prior, pairs, out = self.solution([]), self.description.lidar_pairs, []
        for k, (a, b) in enumerate(pairs):
            self.progress(f"{a} with {b}", k / len(pairs))
            T, _ = prior.between(a, b)
            ends = (a, self.scans[a]), (b, self.scans[b])
            if shared_view(self.scans[a], self.scans[b], T) >= SHARED:
                out.append(self._tried(a, b, SCANS_KIND, scan_edge, *ends, T))
            else:
                out.append(Measurement(a, b, SCANS_KIND, None, "by their priors they share no view"))
            if out[-1].edge is None:
                out.append(self._tried(a, b, MOTION_KIND, motion_edge, *ends, T))
        return out

    def _tried(self, target: str, source: str, kind: str, make: Callable[..., Edge], *given: Any) -> Measurement:
        try:
            return Measurement(target, source, kind, make(*given))
        except CalibrationError as error:
            return Measurement(target, source, kind, None, str(error))

    def camera_pairs(self, known: RigSolution) -> list[tuple[str, str]]:
        """The pairs of a camera and a LiDAR to register: as described, else all that share a view."""
        pairs, lidars = self.description.camera_pairs, self.description.lidars
        if self.description.pairs is not None:
            return pairs

        def shares_view(camera: str, lidar: str) -> bool:
            own, T = self.rig.camera(camera), known.between(camera, lidar)[0]
            shares = [seen_share(own, T, points) for points in self.scans[lidar].glimpses]
            return bool(shares) and float(np.median(shares)) >= SEEN

        return sorted((pair for pair in pairs if shares_view(*pair)), key=lambda pair: lidars.index(pair[1]))

    def camera_edge(self, camera: str, lidar: str, known: RigSolution) -> Measurement:
        """Registration of a camera with a LiDAR, around where they are by what is known."""
        T, C = known.between(camera, lidar)
        source = self.rig.pair(camera, lidar)
        try:
            frames = self.frames_of(camera, lidar)
            calibrator = Calibrator(frames[0].camera, self.config_of(camera), scans=self.shared[lidar])
            result = calibrator.calibrate(frames, T, box_of(C))
        except CalibrationError as error:
            return Measurement(camera, lidar, "registration", None, str(error))
        result = replace(result, camera_frame=source.camera_frame, lidar_frame=source.lidar_frame)
        if not result.converged or result.covariance_with_intrinsics is None:
            return Measurement(camera, lidar, "registration", None, result.reason or result.status, result)
        twists = [frame.twist for frame in frames if frame.twist is not None]
        edge = Edge(
            camera, lidar, result.T_camera_lidar, result.covariance_with_intrinsics, "registration", result.time_offset_s,
            result.time_offset_sigma_s, np.asarray(np.mean(twists, axis=0)) if twists else None, result.frames_used,
        )  # fmt: skip
        return Measurement(camera, lidar, "registration", edge, result.reason, result)

    def by_motion(self, camera: str, known: RigSolution) -> list[Measurement]:
        """A camera that no scan can be seen with turns as the vehicle does: its rotation by tracked points and the motion of a
        LiDAR (hand-eye), the first of which that tells it. Its place is not told."""
        out = []
        for lidar in self.description.lidars:
            out.append(self._tried(camera, lidar, MOTION_KIND, self._turns, camera, lidar, known))
            if out[-1].edge is not None:
                break
        return out

    def _turns(self, camera: str, lidar: str, known: RigSolution) -> Edge:
        source, config = self.rig.pair(camera, lidar), self.config_of(camera)
        near = neighbours(source, self._positions(source))
        frames = [self._with_motion(frame, camera, lidar, source) for frame in near]
        guess = motion_guess(frames, FeatureExtractor(source.camera, config), config.search.seed)
        T, _ = known.between(camera, lidar)
        R = min((h[:3, :3] for h in guess.hypotheses), key=lambda R: se3.rotation_error_deg(R, T))
        C = np.diag(np.repeat([0.0, UNKNOWN_M**2], 3))
        C[:3, :3] = guess.covariance
        at = se3.inverse(T)[:3, 3]  # the camera stays where it is believed to be: it turns about itself
        return Edge(camera, lidar, se3.from_parts(R, -R @ at), C, MOTION_KIND, samples=len(frames))

    def frames_of(self, camera: str, lidar: str) -> list[Frame]:
        """The chosen frames of a pair, with the LiDAR's motion. Raises what reading raises."""
        source = self.rig.pair(camera, lidar)
        return [self._with_motion(source[i], camera, lidar, source) for i in self._positions(source)]

    def config_of(self, camera: str) -> Config:
        """The configuration with the camera's mask."""
        mask = self.description[camera].mask
        return update(self.config, {"image": {"mask": mask}}) if mask else self.config

    def _with_motion(self, frame: Frame, camera: str, lidar: str, source: Source) -> Frame:
        if without_motion(frame, self.config_of(camera).motion):
            return frame
        own = np.flatnonzero(self.scans[lidar].stamps == frame.moment_of_cloud + _ahead(source))
        return replace(frame, twist=self.scans[lidar].twist(int(own[0])) if len(own) else None)


def in_step(measured: Sequence[Measurement], motion: MotionConfig) -> list[Measurement]:
    """The same by one clock of every sensor and one lens of every camera, where each registration came with its own.

    Offsets that several pairs tell of are put together, and extrinsics moved to them. A lens that is off moves all extrinsics of
    its camera alike, to where it projects right as it is stated: an error is how else the others move than the most certain one.
    """
    edges = {m.edge: m.result for m in measured if m.edge is not None}
    names = sorted({name for edge in edges for name in (edge.target, edge.source)})

    def way(edge: Edge) -> Matrix:
        return np.array([(name == edge.source) - (name == edge.target) for name in names], float)

    given_s, prior_s, lenses = motion.time_offset_s, max(motion.time_offset_sigma_s, LEAST_S), dict[str, Result]()
    # Half of the variance of a difference; of a clock that a camera's frames have shown to be elsewhere nothing is known.
    prior, information, late = np.full(len(names), 2 / prior_s**2), np.zeros((len(names), len(names))), np.zeros(len(names))
    for edge in sorted(edges, key=lambda edge: float(np.trace(edge.covariance))):
        r, a, seconds, sigma, used = edges[edge], way(edge), edge.time_offset_s, edge.time_sigma_s, True
        if r is not None:
            used = seconds is not None and seconds != given_s
            seconds, sigma = None if r.clock_offset_s is None else r.clock_offset_s - given_s, r.clock_sigma_s
            prior[names.index(edge.target)] *= not used
            lenses.setdefault(edge.target, r)
        # What is farther off than clocks are is the best match of chance, unless it is told so well that it was used.
        if seconds is not None and sigma and (used or seconds**2 < FAR * (sigma**2 + prior_s**2)):
            information, late = information + np.outer(a, a) / sigma**2, late + a * seconds / sigma**2
    covariance, out = np.linalg.inv(information + np.diag(prior + UNKNOWN_S**-2.0)), []
    for m in measured:
        if m.edge is not None and m.result is not None and m.result.shared_covariance is not None:
            a, at, lens, along = way(m.edge), m.edge.time_offset_s, m.result.lens_effect, m.result.clock_direction
            seconds, sigma = given_s + float(a @ covariance @ late), float(np.sqrt(a @ covariance @ a))
            along = np.zeros(6) if along is None else along
            C = m.edge.covariance - m.result.shared_covariance + sigma**2 * np.outer(along, along)
            if lens is not None and (best := lenses[m.target].lens_effect) is not None:
                C += apart(lens, best) - lens[0] @ lens[1] @ lens[0].T
            T = se3.exp(along * (seconds - (given_s if at is None else at))) @ m.edge.T
            told = m.edge if at is None else replace(m.edge, time_offset_s=seconds, time_sigma_s=sigma)
            m = replace(m, edge=replace(told, T=T, covariance=C))
        out.append(m)
    return out


def apart(lens: LensEffect, other: LensEffect) -> Covariance:
    """How far a lens that is off moves two extrinsics of its camera apart, second moment (6, 6): see `Result.lens_effect`."""
    return np.asarray((lens[0] - other[0]) @ other[1] @ (lens[0] - other[0]).T)


def _ahead(source: Source) -> int:
    """What a source has taken out of the stamps of its clouds, ns; of the LiDAR's own scans it is not."""
    return int(getattr(source, "cloud_ahead_ns", 0))


def box_of(covariance: Covariance) -> SearchBox:
    """Where to search around an extrinsic of this covariance (6, 6)."""
    sigma = SIGMAS * np.sqrt(np.diag(covariance))
    rx, ry, rz = np.clip(np.rad2deg(sigma[:3]), LEAST_DEG, SearchBox.MAX_DEG).tolist()
    tx, ty, tz = np.clip(sigma[3:], LEAST_M, SearchBox.MAX_M).tolist()
    return SearchBox((rx, ry, rz), (tx, ty, tz))


def seen_share(camera: Camera, T: Transform, points: Matrix) -> float:
    """Share of the cells of a camera's picture in which points (n, 3) lie by T_camera_lidar (4, 4)."""
    uv, inside = camera.project(se3.transform(T, points))
    cell = np.floor((uv[inside] + 0.5) / [camera.width, camera.height] * GRID)
    return len(np.unique(cell, axis=0)) / (GRID[0] * GRID[1])
