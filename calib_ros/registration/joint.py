"""The first step of an estimate: the optimum of the extrinsic, and of the clocks' offset where the frames show it.

The search takes the clocks as they are configured. Frames that move differently then disagree by what the offset moves them; if
that hides the match, it is repeated a scan period earlier and later, as drivers err that stamp a scan at its other end.

How a driver stamps scans without point times is found out as well: which way the scanner turns, and where a scan begins. Each
convention gives every edge point another time, and the vehicle's motion then another place: the right one makes all frames agree.
Which part of the scan is stamped is a time offset of half a scan period at most.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros.arrays import Transform
from calib_ros.config import Config, MotionConfig
from calib_ros.config.sensors import ESTIMATE
from calib_ros.lidar.deskew import moved, scan_times
from calib_ros.registration.features import FrameFeatures, at_time_offset, other_objective
from calib_ros.registration.judgement.clocks import MIN_FRAMES, Effect, TimeOffset, estimate_time_offset, with_known_motion
from calib_ros.registration.objective import Objective
from calib_ros.registration.progress import Progress
from calib_ros.registration.score.chance import UNDOUBTED_Z, null_distribution, p_value
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.registration.search.search import SearchResult
from calib_ros.result import Stamping

MakeObjective = Callable[..., Objective]  # of features; T_rows: (4, 4), where points fall in the image, for a rolling shutter
# Frames whose optima a scan period would move apart by more hide their match from a search: what counts as one optimum there.
APART_RAD, APART_M = np.deg2rad(0.5), 0.1
AHEAD, BEHIND = 0.0, 180.0  # deg, azimuth half a turn away from where a scan begins and ends
CONVENTIONS = (
    *(Stamping(spin, azimuth) for azimuth in (AHEAD, BEHIND) for spin in ("clockwise", "counterclockwise")),
    Stamping("none", AHEAD),
)


@dataclass(frozen=True, eq=False)
class Optimised:
    """An optimum T (4, 4) of the objective of features at the offset that was found.

    offset: what is known of the clocks; None if they are not estimated, or the frames tell nothing. seconds: by which the
    features were moved, as a change of motion.time_offset_s. stamping: of scans without point times, if not as set.
    """

    features: Sequence[FrameFeatures]
    objective: Objective
    T: Transform
    search: SearchResult | None
    offset: TimeOffset | None = None
    seconds: float = 0.0
    stamping: Stamping | None = None

    def clocks(self, motion: MotionConfig) -> tuple[float, Effect | None]:
        """Standard deviation, s, of the clocks' offset; and its effect, if it is known."""
        if self.offset is None:
            return motion.time_offset_sigma_s, None
        sigma, effect, prior_s = self.offset.sigma_s, self.offset.effect, motion.time_offset_sigma_s
        if not self.offset.exists(motion):  # it is taken to be 0, and known to that
            sigma = float(np.hypot(effect.sigma(prior_s), np.sqrt(self.offset.probability) * self.offset.seconds))
        return sigma, effect


@dataclass(frozen=True, eq=False)
class JointSearch:
    """Looks for the optimum in a search box around the initial extrinsic (4, 4), or from that itself. near: see
    Calibrator.estimate."""

    make_objective: MakeObjective
    initial: Transform
    box: SearchBox | None
    config: Config
    progress: Progress
    near: bool = False

    def optimum(self, features: Sequence[FrameFeatures]) -> Optimised:
        """Of the features; with points where the rows of the image see them from it, if its shutter is a rolling one."""
        found = self._at_any_offset(features)
        if not self.config.motion.readout_s:
            return found
        objective = self.make_objective(found.features, T_rows=found.T)
        return replace(found, objective=objective, T=objective.optimise(found.T, searched=True, progress=self.progress))

    def _at_any_offset(self, features: Sequence[FrameFeatures]) -> Optimised:
        config, period_s, found = self.config, self.config.motion.scan_period_s, self._near(features)
        if found.search is None or not estimates_offset(features, config):
            return found
        twists = np.array([f.twist for f in features if f.twist is not None])
        way = np.abs(twists - twists.mean(axis=0)).max(axis=0) * period_s
        if way[:3].max() <= APART_RAD and way[3:].max() <= APART_M:
            return found

        def z_score(found: Optimised) -> float:
            return null_distribution(found.objective.edges.score, found.T).z_score

        tried, best, highest = 1, found, z_score(found)
        for seconds in (-period_s, period_s):
            search = best.search
            if search is None or highest >= UNDOUBTED_Z:
                break
            if p_value(highest, search.decoy_z, tried * search.rounds) <= config.refine.max_p_value:
                break
            tried += 1
            found = self._near([at_time_offset(f, seconds) for f in features])
            if (own := z_score(found)) > highest:
                best, highest = replace(found, seconds=found.seconds + seconds), own
        if best.search is None or tried == 1:
            return best
        return replace(best, search=replace(best.search, rounds=tried * best.search.rounds))  # as many more optima of chance

    def _near(self, features: Sequence[FrameFeatures]) -> Optimised:
        """The optimum of features near the offset that they are at."""
        motion, objective = self.config.motion, self.make_objective(features)
        search = None if self.box is None or self.box.is_empty else objective.edges.search(self.initial, self.box, self.progress)
        begin = self.initial if search is None else search.T
        if self.near and objective is not objective.edges:
            T = objective.refine(begin, self.progress)
        else:
            T = objective.optimise(begin, searched=search is not None, progress=self.progress)
        moving = with_known_motion(features, objective.edges.score) if estimates_offset(features, self.config) else None
        if moving is None:
            return Optimised(features, objective, T, search)
        limits, prior = objective.constraints.limits, objective.constraints.prior
        offset = estimate_time_offset(moving[0], T, limits, prior, moving[1], motion, search is not None)
        stamping, by_azimuth = None, any(f.twist is not None and f.timed_by_azimuth for f in features)
        untold = by_azimuth and motion.stamping == "auto" and all(f.own is None for f in features)
        if offset is not None and search is not None and untold:
            for other in CONVENTIONS:
                if (after := at_stamping(motion, other)) == motion:
                    continue
                score = self.make_objective([restamped(f, motion, after) for f in features]).edges.score
                found = estimate_time_offset(score, T, limits, prior, moving[1], motion, search=True)
                if found is None:
                    continue
                log_ratio = (found.score - offset.score) / max(found.noise, offset.noise)
                if log_ratio > np.log(len(CONVENTIONS) - 1):  # of the same edge points, one of so many that were tried
                    offset, stamping = found, other
        if offset is None or not (offset.exists(motion) or stamping):
            return Optimised(features, objective, T, search, offset)
        if stamping is not None:
            features = [restamped(f, motion, at_stamping(motion, stamping)) for f in features]
        features = [at_time_offset(f, offset.seconds) for f in features]
        objective = self.make_objective(features)
        T = objective.optimise(limits.clip(offset.T), searched=True, progress=self.progress)
        return Optimised(features, objective, T, search, offset, offset.seconds, stamping)


def clocks_are_estimated(config: Config) -> bool:
    """Whether the clocks' offset is to be estimated wherever frames show it."""
    motion, other = config.motion, other_objective(config)
    return motion.time_offset == ESTIMATE and motion.max_time_offset_s > 0 and (other is None or other.moves_points)


def estimates_offset(features: Sequence[FrameFeatures], config: Config) -> bool:
    """Whether the clocks' offset is estimated from these features: points that another objective keeps cannot be moved."""
    moving = sum(f.twist is not None for f in features)
    return clocks_are_estimated(config) and moving >= MIN_FRAMES and all(f.own is None for f in features)


def at_stamping(config: MotionConfig, stamping: Stamping) -> MotionConfig:
    """The configuration that says so."""
    return replace(config, spin=stamping.spin, stamp_azimuth_deg=stamping.azimuth_deg, stamp_at="middle")


def restamped(features: FrameFeatures, before: MotionConfig, after: MotionConfig) -> FrameFeatures:
    """Features extracted by `before` with points where `after` has them; the same if their times do not come from the azimuth, or
    the LiDAR's velocity is not known."""
    points = features.points
    if not features.timed_by_azimuth or features.twist is None or points.time is None or features.own is not None:
        return features
    measured = moved(points.xyz, features.twist, -points.time.astype(float))
    change = scan_times(measured, after, points.pose) - scan_times(measured, before, points.pose)
    time = points.time + change
    points = replace(points, xyz=moved(measured, features.twist, time).astype(np.float32), time=time.astype(np.float32))
    plain = None if features.plain is None else restamped(features.plain, before, after)
    return replace(features, points=points, plain=plain, view=None)  # points of a view have no times


def convention(stamping: Stamping, seconds: float, scan_period_s: float) -> tuple[str, float]:
    """What to set for a driver that stamps as was found, for people, by the nearest usual convention; and the time offset that is
    left then, s. seconds: that of `stamping`, whose scans are stamped half a turn after they begin."""
    halves = {"start": 0.5, "middle": 0.0, "end": -0.5} if stamping.spin != "none" else {"middle": 0.0}
    name, azimuth = min(halves, key=lambda n: abs(seconds - halves[n] * scan_period_s)), stamping.azimuth_deg
    if name != "middle":
        azimuth = azimuth + 180.0 if azimuth <= 0 else azimuth - 180.0
    found = f"motion.spin: {stamping.spin}, motion.stamp_at: {name}, motion.stamp_azimuth_deg: {azimuth:g}"
    return found, seconds - halves[name] * scan_period_s
