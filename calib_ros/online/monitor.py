"""Is the current extrinsic still right? A test at every keyframe, with a false alarm rate that one sets."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as fisher

from calib_ros import se3
from calib_ros.config import MonitorConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.lidar.deskew import moved
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.covariance import covariance, distance
from calib_ros.registration.features import Features, FrameFeatures
from calib_ros.registration.score import FastScore
from calib_ros.registration.validation import null_distribution

# Is it the mount that moved, or the camera's clock? A late image shifts everything by the vehicle's own motion.
Matrix = NDArray[np.float64]
OFFSETS = np.round(np.arange(-0.2, 0.2001, 0.01), 2)  # s; beyond, nobody would pair the two
LEAST_S = 0.02  # a smaller offset is none: cameras are triggered to some milliseconds
FASTER = np.array([np.deg2rad(2.0)] * 3 + [1.0] * 3)  # rad/s, m/s; a slower vehicle does not tell
EXPLAINS = 0.9  # of the score that a moved mount reaches with six parameters, by the offset alone


@dataclass(frozen=True)
class Lateness:
    """How late the images are against the scans, s (negative: early), and the score with that, and without.

    offset_s: motion.time_offset_s that was allowed for already, s.
    """

    seconds: float
    score: float
    without: float
    offset_s: float = 0.0


def lateness(calibrator: Calibrator, keyframes: Sequence[Features], T: Matrix) -> Lateness | None:
    """The time offset with which the keyframes fit T (4, 4) best. None if the vehicle moves in none, or its motion is unknown.

    Keyframes at rest take part: they fit at any offset, and a vehicle that stops behind a late camera has not been knocked.
    At time tau after the image's moment a point that stands still is at exp(twist tau)^-1 of where it was, for all points alike.
    """
    own = [f.fast for f in keyframes]
    twists = [f.twist for f in own if f.twist is not None]
    if len(twists) < len(own) or not (np.abs(twists) >= FASTER).any():
        return None
    try:
        config, atlas = calibrator.config, calibrator.fast_objective(own, T).score.atlas  # the images stay as they are
        scores = [FastScore([_shifted(f, float(s)) for f in own], T, config.score, atlas=atlas).at(-1).value(T) for s in OFFSETS]
    except TooFewFeaturesError:
        return None
    best = int(np.argmax(scores))
    return Lateness(float(OFFSETS[best]), scores[best], scores[int(np.argmin(np.abs(OFFSETS)))], config.motion.time_offset_s)


def explained(found: Lateness | None, score: float) -> str:
    """In words, if the offset fits the keyframes as well as a moved mount would, which reaches `score`; else empty."""
    if found is None or abs(found.seconds) < LEAST_S or found.score < EXPLAINS * score:
        return ""
    late = "late" if found.seconds > 0 else "early"
    return (
        f"the images are {1000 * abs(found.seconds):.0f} ms {late} against the scans (that alone explains the difference): "
        f"synchronise the clocks, or set motion.time_offset_s to {found.offset_s + found.seconds:.3g}"
    )


def _shifted(frame: FrameFeatures, seconds: float) -> FrameFeatures:
    assert frame.twist is not None
    xyz = moved(frame.points.xyz, frame.twist, np.full(len(frame.points), seconds)).astype(np.float32)
    return replace(frame, points=replace(frame.points, xyz=xyz))


# A shift of this size is one unit of drift; measured on KITTI subsets, see the area under ROC of the "LM shift" test.
UNIT_ROTATION_DEG = 0.25
UNIT_TRANSLATION_M = 0.06

RIGHT, SUSPICIOUS, MOVED_AWAY, NOTHING_SEEN = "right", "suspect", "moved", "nothing seen"
TAILS = 8.0  # degrees of freedom of the errors' tails: squared and normalised they are F(6, TAILS), not chi squared
MATCH_REFERENCE = 50  # keyframes that tell how well a right extrinsic matches here
MATCH_LEARNED = 3  # of these, needed to judge
POOR_MATCH = 0.35  # of the usual standing out; right ones 0.4 to 2.5 times the usual, 2 deg off 0 to 0.4 times
FAIR_MATCH = 0.85  # a single frame may slide away along what it does not show, up to 3 deg; at a right extrinsic it matches still
SEEN_DEG, SEEN_M = 1.0, 0.3  # a scene that leaves more than this open (standard deviation) tells nothing


@dataclass(frozen=True, eq=False)
class Test:
    """What some keyframes say of an extrinsic.

    p_value: how probable a shift of this size is if it is right. shift: (6,) left twist to where the keyframes would have it,
    rad and m. matches: how far the score at the extrinsic itself stands out from its surroundings, in their standard
    deviations, median of the keyframes. sees: the keyframes tell something. score: where the keyframes would have it.
    """

    p_value: float
    shift: Matrix
    matches: float
    sees: bool
    score: float = 0.0

    @property
    def deg(self) -> float:
        """Angle of the shift."""
        return float(np.rad2deg(np.linalg.norm(self.shift[:3])))

    @property
    def m(self) -> float:
        """Length of the shift."""
        return float(np.linalg.norm(self.shift[3:]))


@dataclass(frozen=True, eq=False)
class Assessment:
    """What the monitor concludes. verdict: right, suspect, moved or nothing seen. since: keyframes, the newest ones, that were
    suspect. spoilt: the oldest of these, whose images and scans were not taken at the same time."""

    verdict: str
    text: str
    p_value: float
    since: int = 0
    spoilt: int = 0


def normalised_innovation(T_current: Matrix, T_estimate: Matrix) -> float:
    """How far the estimate (4, 4) lies from the current extrinsic (4, 4): |dr| / 0.25 deg + |dt| / 6 cm, no unit.

    Below 1 the difference is within what frames of a good calibration show; above 2 the calibration has most likely moved.
    """
    rotation = se3.rotation_error_deg(T_current, T_estimate) / UNIT_ROTATION_DEG
    return rotation + se3.translation_error_m(T_current, T_estimate) / UNIT_TRANSLATION_M


def examine(
    calibrator: Calibrator,
    keyframes: Sequence[Features],
    T: Matrix,
    spread: Matrix | None = None,
    anchor: Matrix | None = None,
) -> Test:
    """Climb from T (4, 4) on the keyframes alone: how far does the optimum lie, in units of what is uncertain?

    spread: covariance (6, 6) of T itself; None = T is exact. anchor: see Calibrator.fast_objective. A test of this kind finds
    smaller errors than the share of worse neighbours (Levinson and Thrun 2013), since it uses the shape of the score and
    not only its order.
    """
    try:
        objective = calibrator.fast_objective(keyframes, T, anchor)
        X = objective.optimise(T)
        score = objective.edge_score()
        C = covariance(score, X, systematic_error=objective.systematic_error, constraints=objective.constraints)
        matches = null_distribution(score, T).z_scores
    except TooFewFeaturesError:
        return Test(1.0, np.zeros(6), 0.0, False)
    sigma = np.sqrt(np.diag(C))
    shift = se3.log(X @ se3.inverse(T))
    squared, axes = distance(shift, C if spread is None else C + spread)
    p_value = float(fisher.sf(squared / axes, axes, TAILS)) if axes else 1.0
    sees = bool(sigma[:3].max() < np.deg2rad(SEEN_DEG) and sigma[3:].max() < SEEN_M)
    matched = float(np.nanmedian(matches)) if np.isfinite(matches).any() else 0.0
    return Test(p_value, shift, matched, sees, score.at(-1).value(X))


class Monitor:
    """Tests the newest keyframe alone, which a knock shows in at once, and the newest few together, which see small errors.

    What speaks against the extrinsic makes it suspect; the keyframes from there on decide. Not for several threads at once.
    config may be replaced at any time.
    """

    def __init__(self, config: MonitorConfig) -> None:
        self.config = config
        self._matched: deque[float] = deque(maxlen=MATCH_REFERENCE)
        self.reset()

    def reset(self) -> None:
        """The extrinsic was replaced: what was suspect is no more."""
        self._suspects, self._late = 0, False

    def check(
        self, calibrator: Calibrator, keyframes: Sequence[Features], T: Matrix, spread: Matrix, anchor: Matrix | None = None
    ) -> Assessment:
        """keyframes: all that T (4, 4), of covariance `spread` (6, 6), should hold for; the newest, which was not looked at yet,
        last. anchor: see Calibrator.fast_objective."""
        alone = examine(calibrator, keyframes[-1:], T, spread, anchor)
        self._suspects = self._suspects + 1 if self._suspects else 0
        window = max(self._suspects, min(self.config.window, len(keyframes)) if not self._suspects else 1)
        window = min(window, self.config.confirm if self._late else 2 * self.config.window)
        newest = keyframes[-window:]
        together = alone if window == 1 else examine(calibrator, newest, T, spread, anchor)
        if self._suspects:
            return self._decide(together, window, lambda: lateness(calibrator, newest, T))
        rate = self.config.false_alarm_rate / 2  # two tests
        # What shows in the newest alone began with it: of a window that it spoils, the others are still right.
        for test, count in ((alone, 1), (together, window)):
            if self._speaks_against(test, rate, count == 1):
                self._suspects = count
                return Assessment(SUSPICIOUS, self._words(test, count), test.p_value, count)
        if alone.sees:
            self._matched.append(alone.matches)
        if not together.sees:
            return Assessment(NOTHING_SEEN, "the scene tells nothing: few edges in the image or the scan", together.p_value)
        return Assessment(RIGHT, "the extrinsic fits the newest keyframes", min(alone.p_value, together.p_value))

    def _decide(self, together: Test, window: int, when: Callable[[], Lateness | None]) -> Assessment:
        """Suspect already: moved, a clock that is off, right after all, or one more keyframe. window: keyframes tested."""
        count, p_value = self._suspects, together.p_value
        against = self._speaks_against(together, self.config.false_alarm_rate, window == 1)
        if against and count >= self.config.confirm:
            late = explained(when(), together.score)
            self._late = self._late or bool(late)
            if late:
                return Assessment(SUSPICIOUS, late, p_value, count)
            since = window if self._late else count
            self.reset()
            return Assessment(MOVED_AWAY, f"the calibration has moved: {self._words(together, since)}", p_value, since)
        if together.sees and not against and count >= min(2, self.config.confirm):
            spoilt = max(count - window, 0) if self._late else 0
            self.reset()
            return Assessment(RIGHT, "the extrinsic fits the newest keyframes after all", p_value, count, spoilt)
        return Assessment(SUSPICIOUS, self._words(together, count), p_value, count)

    def _speaks_against(self, test: Test, rate: float, single: bool) -> bool:
        small = test.deg < self.config.least_deg and test.m < self.config.least_m
        wrong = test.p_value < rate and not small and (not single or self._matches(test) < FAIR_MATCH)
        return test.sees and (wrong or self._poor(test))

    def _poor(self, test: Test) -> bool:
        """The keyframes match hardly better at the extrinsic than beside it, where others matched well."""
        return self._matches(test) < POOR_MATCH

    def _matches(self, test: Test) -> float:
        """Standing out of the keyframes as a share of the usual; as usual while that is not known."""
        return test.matches / max(float(np.median(self._matched)), 1e-6) if len(self._matched) >= MATCH_LEARNED else 1.0

    def _words(self, test: Test, count: int) -> str:
        frames = f"the newest {count} keyframes" if count > 1 else "the newest keyframe"
        if self._poor(test):
            return f"{frames} hardly match at the current extrinsic (p = {test.p_value:.2g})"
        return f"{frames} would have it {test.deg:.2f} deg / {100 * test.m:.0f} cm elsewhere (p = {test.p_value:.2g})"
