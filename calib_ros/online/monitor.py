"""Is the current extrinsic still right? A sequential test over keyframes, with as many false alarms per hour as one sets."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
import scipy

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.config import MonitorConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.online.evidence import MIN_REMEMBERED, REMEMBERED, MatchEvidence, ShiftNoise, shift_evidence
from calib_ros.online.glance import EVERY_S
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.covariance import REGIONS, covariance, disagreement, distance, effective_points, scenes_of
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.judgement.clocks import STAMP_SCATTER_S, at_offset
from calib_ros.registration.score.chance import HIGHEST_DECOY_Z, null_distribution
from calib_ros.registration.score.point_score import MARGIN, MIN_POINTS, near_image

# The test at a keyframe.
IN_DOUBT = 0.05  # p-value below which halves of the data have a say
WINDOW = 5  # newest keyframes tested together: more tell more, but later
FAILED_WINDOWS = 2  # a suspicion that has not grown to a movement in so many windows is dropped
# Tests of an hour: of a keyframe or look every EVERY_S alone, with others, and by how well it matches. So many times rarer than
# suspicions are movements that there were none.
TESTS_PER_HOUR, MOVED_RARER = 3 * 3600 / EVERY_S, 10.0
DOUBT = np.log(20.0)  # evidence from which on the next frames are tested as well, whatever they show
# Of the usual number of edge points in view: a keyframe that has fewer, and fewer than MIN_POINTS, shows next to nothing.
POOR_SHARE = 0.25
CONFIRM = 3  # keyframes that confirm a movement: fewer may show one odd scene, more keep a wrong extrinsic in use
LEAST_DEG, LEAST_M = 0.15, 0.04  # smaller movements are within what estimates scatter by, and these follow them
# A vehicle in a city, for scans whose motion is unknown. KITTI drive 0005 at 3 to 6 m/s, not de-skewed, fits 0.2 deg / 8 cm
# beside the extrinsic; with these and its camera 0.22 deg / 11 cm are allowed for.
USUAL_TURN_DEG_S, USUAL_SPEED_M_S = 20.0, 10.0
MAX_SIGMA_DEG, MAX_SIGMA_M = 1.0, 0.3  # a scene that leaves more than this open (standard deviation) is inconclusive

# One unit of normalised innovation; measured on KITTI subsets, see the area under ROC of the "LM shift" test.
UNIT_ROTATION_DEG = 0.25
UNIT_TRANSLATION_M = 0.06

# Has the mount moved, or is the camera's clock off? A late image shifts everything by the vehicle's own motion.
TIME_OFFSETS_S = np.round(np.arange(-0.2, 0.2001, 0.01), 2)  # beyond, nobody would pair the two
MIN_TIME_OFFSET_S = 0.02  # a smaller offset is none: cameras are triggered to some milliseconds
MIN_TWIST = np.array([np.deg2rad(2.0)] * 3 + [1.0] * 3)  # rad/s, m/s; the offset of a slower vehicle is not observable
EXPLAINED_SHARE = 0.9  # of the score that a displaced mount reaches with six parameters, by the time offset alone


class Verdict(Enum):
    """What the monitor concludes about the current extrinsic."""

    CONSISTENT = "consistent"
    INCONCLUSIVE = "inconclusive"  # too few edges in view, or an optimum that may have slid
    SUSPECT = "suspect"  # the next keyframes decide
    MOVED = "moved"


@dataclass(frozen=True, eq=False)
class Assessment:
    """Result of the monitor at a keyframe.

    message: for a person. since: how many of the newest keyframes spoke against the extrinsic. out_of_sync: how many of these,
    the oldest ones, have images and scans that were not taken at the same time. since_stamp: of the oldest of those that spoke
    against it, ns; 0 if none did.
    """

    verdict: Verdict
    message: str
    p_value: float
    since: int = 0
    out_of_sync: int = 0
    since_stamp: int = 0


@dataclass(frozen=True, eq=False)
class ShiftTest:
    """How far the optimum of some keyframes lies from an extrinsic.

    evidence: log likelihood ratio of a movement against none, see `shift_evidence`; of an optimum that may be chance it says
    nothing. p_value: probability of a shift of at least this size if the extrinsic is right. shift: (6,) left twist to the
    optimum, rad and m. z_score: how far the score at the extrinsic lies above the null distribution of its surroundings, in
    standard deviations, median of the keyframes. conclusive: the keyframes constrain the extrinsic. score: at the optimum.
    points: edge points that a keyframe's z-score rests on, those that weigh little counted less. significant: the optimum is
    better than those that decoys reach by chance, so that its place means something. keyframes: how many took part. squared,
    axes, freedom: of the shift, by a covariance that is not scaled: see ShiftNoise.
    """

    p_value: float
    shift: Matrix
    z_score: float
    conclusive: bool
    score: float = 0.0
    points: float = 1.0
    significant: bool = True
    keyframes: int = 1
    evidence: float = 0.0
    squared: float = 0.0
    axes: int = 0
    freedom: float = 1.0

    @property
    def deg(self) -> float:
        """Angle of the shift."""
        return float(np.rad2deg(np.linalg.norm(self.shift[:3])))

    @property
    def m(self) -> float:
        """Length of the shift."""
        return float(np.linalg.norm(self.shift[3:]))


class Monitor:
    """Tests the newest keyframe alone, where a mount displacement shows at once, and the newest few together, which show small
    errors.

    Evidence against the extrinsic makes it suspect; the keyframes from there on decide. Not thread-safe. config may be replaced
    at any time. in_doubt: the next frames are worth a test, whatever they show.
    """

    def __init__(self, config: MonitorConfig) -> None:
        self.config = config
        self._match, self._noise = MatchEvidence(), ShiftNoise()
        self._counts: deque[int] = deque(maxlen=REMEMBERED)  # of the edge points that keyframes had in view
        self.reset()

    def reset(self) -> None:
        """Start anew: the extrinsic was replaced."""
        self._suspects, self._out_of_sync, self.in_doubt = 0, False, False
        self._match.reset()

    def informative(self, keyframes: Sequence[FrameFeatures], T: Transform) -> list[FrameFeatures]:
        """Those keyframes that do not show next to nothing at T (4, 4), compared with what is usual here; all while that is not
        known."""
        counts = list(self._counts)  # at once: a check on another thread may add to them
        if len(counts) < MIN_REMEMBERED:
            return list(keyframes)
        least = min(MIN_POINTS, POOR_SHARE * float(np.median(counts)))
        return [k for k in keyframes if points_in_view(k, T) >= least]

    def check(
        self,
        calibrator: Calibrator,
        keyframes: Sequence[FrameFeatures],
        T: Transform,
        spread: Covariance,
        anchor: Transform | None = None,
        same_scene: bool = False,
        clock_sigma_s: float | None = None,
    ) -> Assessment:
        """Test T (4, 4) of covariance `spread` (6, 6) against the keyframes it should hold for, the newest one last.

        To be called once per keyframe. anchor: see ObjectiveMaker.of_edges. same_scene: the newest one shows what the one before
        it has shown. clock_sigma_s: see measure_shift.
        """

        def shift_of(tested: Sequence[FrameFeatures]) -> ShiftTest:
            return measure_shift(calibrator, tested, T, spread, anchor, self._noise.scale, clock_sigma_s)

        alone = shift_of(keyframes[-1:])
        if alone.conclusive:
            self._match.add(alone.z_score, alone.points, same_scene)
        self._suspects = self._suspects + 1 if self._suspects else 0
        window = max(self._suspects, min(WINDOW, len(keyframes)) if not self._suspects else 1)
        window = min(window, CONFIRM if self._out_of_sync else FAILED_WINDOWS * WINDOW)
        newest = keyframes[-window:]
        informative = self.informative(newest, T) or newest[-1:]
        together = alone if window == 1 else shift_of(informative)
        if self._suspects:
            several = together.keyframes >= min(CONFIRM, len(newest))  # not one of them, tested again and again
            return self._decide(calibrator, informative, T, together, window, several)
        # What shows in the newest alone began with it: the others in a window that it spoils are still right.
        against = (
            (self._evidence(alone, keyframes[-1:]), 1),
            (self._match.evidence, self._match.count),
            (self._evidence(together, newest), window),
        )
        self.in_doubt = max(evidence for evidence, _ in against) >= DOUBT
        count = next((count for evidence, count in against if evidence >= self._threshold()), 0)
        if count:
            self._suspects = count
            test = alone if count == 1 else together
            return Assessment(Verdict.SUSPECT, self._describe(test, count), test.p_value, count)
        if alone.conclusive and alone.significant and not same_scene:
            self._match.learn(alone.z_score, alone.points)
            if clock_sigma_s is None:  # else shifts are small beside what the clocks may do
                self._noise.learn(alone.squared, alone.axes, alone.freedom)
            self._counts.append(points_in_view(keyframes[-1], T))
        # An optimum that may be chance speaks neither against the extrinsic nor for it.
        if not (together.conclusive and together.significant) or self.in_doubt:
            message = (
                "it fits better elsewhere: further keyframes decide" if self.in_doubt else "few edges in the image or the scan"
            )
            return Assessment(Verdict.INCONCLUSIVE, f"the scene is inconclusive: {message}", together.p_value)
        p_value = min(alone.p_value, together.p_value)
        return Assessment(Verdict.CONSISTENT, "the extrinsic fits the newest keyframes", p_value)

    def _threshold(self, rarer: float = 1.0) -> float:
        """Evidence that false alarms reach as often per hour as configured, or so many times rarer."""
        return float(np.log(rarer * TESTS_PER_HOUR / self.config.false_alarms_per_hour))

    def _decide(
        self,
        calibrator: Calibrator,
        newest: Sequence[FrameFeatures],
        T: Transform,
        together: ShiftTest,
        window: int,
        several: bool,
    ) -> Assessment:
        """Suspect already: moved, a clock that is off, right after all, or one more keyframe. newest: those tested, of `window`
        keyframes. several: they are enough to confirm a movement."""
        count, p_value = self._suspects, together.p_value
        evidence = max(self._evidence(together, newest), self._match.evidence)
        if evidence >= self._threshold(MOVED_RARER) and several and count >= CONFIRM:
            if out_of_sync := clocks_that_explain(calibrator, newest, T, together.score):
                self._out_of_sync = True
                return Assessment(Verdict.SUSPECT, out_of_sync, p_value, count)
            since = window if self._out_of_sync else count
            message = f"the calibration has moved: {self._describe(together, since)}"
            self.reset()
            return Assessment(Verdict.MOVED, message, p_value, since)
        limit = self._threshold() if count >= FAILED_WINDOWS * WINDOW else 0.0  # 0: they rather speak for it
        if together.conclusive and evidence < limit and count >= 2:
            without_sync = max(count - window, 0) if self._out_of_sync else 0
            self.reset()
            message = "the extrinsic fits the newest keyframes after all"
            return Assessment(Verdict.CONSISTENT, message, p_value, count, without_sync)
        return Assessment(Verdict.SUSPECT, self._describe(together, count), p_value, count)

    def _evidence(self, test: ShiftTest, keyframes: Sequence[FrameFeatures]) -> float:
        """What the shift of the tested keyframes says against the extrinsic; less than nothing where it cannot count."""
        # A small shift may be one that the estimates follow, or that a scan bent by unknown motion has.
        seconds = max(k.unknown_motion_s for k in keyframes)
        least_deg = max(LEAST_DEG, USUAL_TURN_DEG_S * seconds)
        is_small = test.deg < least_deg and test.m < max(LEAST_M, USUAL_SPEED_M_S * seconds)
        counts = test.conclusive and test.significant and not is_small
        return test.evidence if counts else min(test.evidence, 0.0)

    def _describe(self, test: ShiftTest, count: int) -> str:
        frames, verb = (f"the newest {count} keyframes", "") if count > 1 else ("the newest keyframe", "es")
        if not test.significant or self._match.evidence > test.evidence:
            return f"{frames} hardly match{verb} at the current extrinsic"  # the p-value is that of a shift
        shift = f"{test.deg:.2f} deg / {100 * test.m:.0f} cm"
        p = f"p = {test.p_value:.2g}" if test.p_value else "p < 1e-300"
        return f"{frames} fit{'s' if count == 1 else ''} best {shift} away from the current extrinsic ({p})"


def measure_shift(
    calibrator: Calibrator,
    keyframes: Sequence[FrameFeatures],
    T: Transform,
    spread: Covariance | None = None,
    anchor: Transform | None = None,
    scale: float = 1.0,
    clock_sigma_s: float | None = None,
) -> ShiftTest:
    """Optimise from T (4, 4) on the keyframes alone: how far does the optimum lie, in units of the uncertainty?

    spread: covariance (6, 6) of T itself; None = T is exact. anchor: see ObjectiveMaker.of_edges. scale: of both covariances, see
    ShiftNoise. clock_sigma_s: standard deviation of the clocks' offset, None = as configured. A test of this kind finds smaller
    errors than the share of worse neighbours (Levinson and Thrun 2013), since it uses the shape of the score and not only its
    order.
    """
    try:
        objective = calibrator.objectives.of_edges(keyframes, T, anchor)
        X = objective.optimise(T)
        score = objective.score
        C = covariance(score, X, systematic_error=objective.systematic_error, constraints=objective.constraints)
        sigma = np.sqrt(np.diag(C))  # what the scene shows; a fast vehicle's clocks do not make it poor
        configured = calibrator.config.motion.time_offset_sigma_s
        C = C + clock_covariance(keyframes, T, configured if clock_sigma_s is None else clock_sigma_s)
        null = null_distribution(score, T)
    except TooFewFeaturesError:
        return ShiftTest(1.0, np.zeros(6), 0.0, False)
    shift = se3.log(X @ se3.inverse(T))
    known = np.zeros((6, 6)) if spread is None else spread
    freedom, together = REGIONS * scenes_of(score), C + known  # see noise_level: its prior makes up for the unknowns
    squared, axes = distance(shift, together)
    together *= scale
    p_value = _p_value(shift, together, freedom)
    if p_value < IN_DOUBT:  # a biased optimum shows in halves that disagree; they take longer than all the rest
        halves = disagreement(score, X, objective.constraints.limits)
        together = scale * (max(halves, 1.0) * C + known)
        p_value = _p_value(shift, together, freedom)
    conclusive = bool(sigma[:3].max() < np.deg2rad(MAX_SIGMA_DEG) and sigma[3:].max() < MAX_SIGMA_M)
    z_score = float(np.nanmedian(null.z_scores)) if np.isfinite(null.z_scores).any() else 0.0
    reached = score.at(-1).value(X)
    points = effective_points(score) / max(len(np.unique(score.frame)), 1)
    significant = (reached - null.mean) / null.spread > HIGHEST_DECOY_Z
    evidence = shift_evidence(shift, together, freedom)
    of_all = (evidence, squared, axes, freedom)
    return ShiftTest(p_value, shift, z_score, conclusive, reached, points, significant, len(keyframes), *of_all)


def clock_covariance(keyframes: Sequence[FrameFeatures], T: Transform, sigma_s: float) -> Covariance:
    """What clocks that are known to sigma_s add (6, 6) to the optimum of keyframes at T (4, 4): an offset that all have in
    common, and stamps that scatter by at most STAMP_SCATTER_S. At time tau beside the image a vehicle of this twist has moved by
    twist tau."""
    twists = np.array([np.zeros(6) if k.twist is None else k.twist for k in keyframes])
    flows = twists @ se3.adjoint(T).T  # (n, 6), of each keyframe's own optimum
    common, scatter = sigma_s * flows.mean(axis=0), min(sigma_s, STAMP_SCATTER_S) * flows / len(flows)
    return np.asarray(np.outer(common, common) + scatter.T @ scatter)


def points_in_view(frame: FrameFeatures, T: Transform) -> int:
    """Number of edge points of a keyframe in the picture or near it at T (4, 4)."""
    return len(near_image(frame.points.xyz, T, frame.camera, MARGIN))


def _p_value(shift: Matrix, covariance: Covariance, freedom: float) -> float:
    """Probability of a shift (6,) of at least this size, its covariance known with so many degrees of freedom."""
    squared, axes = distance(shift, covariance)
    return float(scipy.special.fdtrc(axes, freedom, max(squared, 0.0) / axes)) if axes else 1.0


def normalised_innovation(T_current: Transform, T_estimate: Transform) -> float:
    """How far the estimate (4, 4) lies from the current extrinsic (4, 4): |dr| / 0.25 deg + |dt| / 6 cm, no unit.

    Below 1 the difference is within what frames of a good calibration show; above 2 the calibration has most likely moved.
    """
    rotation = se3.rotation_error_deg(T_current, T_estimate) / UNIT_ROTATION_DEG
    return rotation + se3.translation_error_m(T_current, T_estimate) / UNIT_TRANSLATION_M


def clocks_that_explain(calibrator: Calibrator, keyframes: Sequence[FrameFeatures], T: Transform, reached: float) -> str:
    """What is off and what to do, for a person, if a time offset of the images against the scans fits the keyframes at T (4, 4)
    as well as a displaced mount, which reaches a score; else "", also where the vehicle moves in none or its motion is unknown.

    Keyframes at rest take part: they fit at any offset, and a vehicle that stops behind a late camera keeps its mount.
    At time tau after the image's moment a static point is at exp(twist tau)^-1 of where it was, for all points alike.
    """
    twists = np.array([f.twist for f in keyframes if f.twist is not None])
    if len(twists) < len(keyframes) or not (np.abs(twists) >= MIN_TWIST).any():
        return ""
    try:
        score = calibrator.objectives.of_edges(keyframes, T).score
    except TooFewFeaturesError:
        return ""
    scores = [at_offset(score, T, twists, float(seconds))[0].at(-1).value(T) for seconds in TIME_OFFSETS_S]
    best = int(np.argmax(scores))
    seconds = float(TIME_OFFSETS_S[best])
    if abs(seconds) < MIN_TIME_OFFSET_S or scores[best] < EXPLAINED_SHARE * reached:
        return ""
    return (
        f"the images are {1000 * abs(seconds):.0f} ms {'late' if seconds > 0 else 'early'} against the scans (that "
        "alone explains the difference): synchronise the clocks, or set motion.time_offset_s to "
        f"{calibrator.config.motion.time_offset_s + seconds:.3g}"
    )
