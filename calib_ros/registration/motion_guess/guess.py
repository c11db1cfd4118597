"""The first guess: from motion, the rotation by which images move as the LiDAR does, and what the motion does not show of it; and
the registration from guesses by classes, motion or whatever is available, of which the best that comes out counts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Matrix
from calib_ros.errors import BadInputError, MissingDependencyError, TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.registration.classes import PoseHypothesis
from calib_ros.registration.estimate import insufficient
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.initial_guess import MOTION, SEMANTIC, nominal
from calib_ros.registration.judgement.refusal import joined
from calib_ros.registration.motion_guess.hand_eye import CLOCK_S, SAME_DEG, Fit, HandEye, distinct
from calib_ros.registration.motion_guess.tracks import Run, Tracks, lidar_runs, tracked_points
from calib_ros.registration.search.constraints import NOMINAL_BOX, SEMANTIC_BOX, SearchBox
from calib_ros.result import InitialSource, Result

LEAST_M, LEAST_RAD = 0.5, np.deg2rad(3.0)  # of travel or of turning; tracked points and aligned scans wander a tenth of it
MIN_TRACKS, MIN_PAIRS = 100, 3
# Share of the points' way in the images that the LiDAR's motion does not explain: 0.01 to 0.07, of other pictures 0.05 to 0.37.
MAX_UNEXPLAINED = 0.25
# Standard deviation of the LiDAR's turns as the pictures see them: 0.02 to 0.12 deg, of other pictures 0.20 to 1.5 deg and half
# of the turns themselves, or more.
MAX_TURN_ERROR_DEG, MAX_TURN_SHARE = 0.2, 0.45
HYPOTHESES = 3
FLOOR_DEG = 0.3  # standard deviation of what one drive has in common, intrinsics and ways of aligning scans among it
UPRIGHT_DEG = NOMINAL_BOX.reach[0] / 2  # standard deviation of cameras that are mounted upright or on a side, by eye
UPRIGHT = np.array([[0.0, -1, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0]])  # the LiDAR's z axis in the camera's frame
# Standard deviation of an axis beyond which that is assumed; is said to be; leaves open which of them; and is too much to search.
WEAK_DEG, HIDDEN_DEG, LOST_DEG = 2.0, 5.0, 15.0
ALONG = np.cos(np.deg2rad(30))  # an axis is the direction of travel
SIGMAS, LEAST_DEG = 3.0, 5.0  # half width of the box: so many standard deviations, but no less; a search needs room
CLOCK_KNOWN_S = CLOCK_S / 2  # standard deviation of the clocks' offset at which the motion has told most of it
CLOCK_INFLATION = 2.5  # of that: poses between two scans average their errors, which looks like a better fit

MIN_SCORE_RATIO = 0.8  # to the best score, for a hypothesis to be tried; one near the truth had 0.92 or more on KITTI
ROUNDS = 4  # of the search around a hypothesis, of which most are wrong: what they do not show, more rounds hardly do


Register = Callable[[Matrix | str, SearchBox | None], Result]  # an initial extrinsic (4, 4) or the name of a guess, and its box


@dataclass(frozen=True, eq=False)
class MotionGuess:
    """What consecutive frames tell of the extrinsic by their motion.

    hypotheses: (k, 4, 4) T_camera_lidar, best first; the camera is at the LiDAR, since motion tells little of its place.
    covariance: (3, 3) of the first one's rotation, a turn about the camera's axes, rad^2, with what was assumed where the motion
    does not tell about an axis. time_offset_s: what ``motion.time_offset_s`` lacks; None where the motion does not tell. note:
    for people, one line.
    """

    hypotheses: Matrix
    covariance: Matrix
    time_offset_s: float | None
    note: str

    @property
    def box(self) -> SearchBox:
        """Where to search around a hypothesis."""
        sigma_deg = np.rad2deg(np.sqrt(np.diag(self.covariance)))
        x, y, z = np.clip(SIGMAS * sigma_deg, LEAST_DEG, SearchBox.MAX_DEG).tolist()
        return SearchBox((x, y, z), SEMANTIC_BOX.translation_m)


def motion_guess(frames: Sequence[Frame], extract: FeatureExtractor, seed: int = 0) -> MotionGuess:
    """The extrinsic from the motion in consecutive frames, a few seconds of them, without any prior.

    Frames are of extract.source_camera, in the order of their stamps; there may be gaps. Deterministic for a seed. Raises
    BadInputError for frames out of order, TooFewFeaturesError where nothing moves, pictures show nothing that can be tracked, or
    the motion leaves more than one axis open; MissingDependencyError where scans have to be aligned and small_gicp is missing.
    """
    if len(frames) < 2:
        raise TooFewFeaturesError(
            f"a first guess from motion needs consecutive frames, a few seconds of them, and not {'one' if frames else 'none'}"
        )
    if any(b.moment_of_cloud <= a.moment_of_cloud for a, b in pairwise(frames)):
        raise BadInputError(
            "frames for a first guess from motion must be in the order of their stamps, each with its own; sources without "
            "stamps do not tell the motion"
        )
    runs, reasons = lidar_runs(frames, extract.config.motion)
    if not runs:
        why = f" ({reasons[0]})" if reasons else ""
        raise TooFewFeaturesError(f"the LiDAR's motion is known between no two frames{why}: give frames that follow each other")
    travelled, turned = _path(runs)
    if travelled < LEAST_M and turned < LEAST_RAD:
        raise TooFewFeaturesError(
            f"the vehicle stands still ({travelled:.2f} m, {np.rad2deg(turned):.1f} deg in all frames): a guess from motion "
            "needs a few seconds of driving, best with a bend"
        )
    return guess_from_tracks(tracked_points(frames, runs, extract), runs, seed)


def guess_from_tracks(tracks: Tracks, runs: Sequence[Run], seed: int = 0) -> MotionGuess:
    """The same from points tracked in the images and the LiDAR's motion. Raises TooFewFeaturesError."""
    pairs = len(np.unique(tracks.pair))
    if len(tracks) < MIN_TRACKS or pairs < MIN_PAIRS:
        found = (
            f"{len(tracks)} points could be tracked between {pairs} pairs of pictures" if pairs else "no point could be tracked"
        )
        raise TooFewFeaturesError(
            f"{found}, {MIN_TRACKS} between {MIN_PAIRS} are needed: give a few seconds of frames that follow each other at 5 Hz "
            "or more, of scenes with texture"
        )
    solver = HandEye(tracks, runs, seed)
    fits = solver.hypotheses(HYPOTHESES)
    motions = solver.motions()
    # Root mean square about every axis between two pictures.
    turns = np.sqrt(np.mean([se3.rotation_vector(R) ** 2 for R in motions[:, :3, :3]]))
    wrong, turn = np.rad2deg([fits[0].turn_error, float(turns)])
    if fits[0].unexplained > MAX_UNEXPLAINED or (wrong > MAX_TURN_ERROR_DEG and wrong > MAX_TURN_SHARE * turn):
        raise TooFewFeaturesError(
            f"the images do not move as the LiDAR does (turns {wrong:.2f} deg apart, of {turn:.2f} deg; "
            f"{fits[0].unexplained:.0%} of the way of points unexplained): check that images and clouds are of the same time and "
            "vehicle, and the intrinsics"
        )
    hidden = _hidden_axes(fits[0].covariance[:3, :3], HIDDEN_DEG)
    moved = -motions[:, :3, 3]  # the mean direction in which the LiDAR moves; of length 1 if it is always the same
    travel = fits[0].R @ np.asarray(moved.sum(axis=0) / max(float(np.linalg.norm(moved, axis=1).sum()), 1e-9))
    fits = [_with_upright(solver, fit) for fit in fits]
    covariance = fits[0].covariance[:3, :3] + np.deg2rad(FLOOR_DEG) ** 2 * np.eye(3)
    if len(_hidden_axes(covariance, LOST_DEG)):
        raise TooFewFeaturesError(
            "the motion does not tell the rotation, or only about one axis: give more frames in which the vehicle drives some "
            "metres, best round a bend"
        )
    hypotheses = np.array([se3.from_parts(fit.R, np.zeros(3)) for fit in fits])
    hypotheses = hypotheses[distinct(hypotheses, np.arange(float(len(fits))), SAME_DEG)]
    sigma = CLOCK_INFLATION * float(np.sqrt(fits[0].covariance[6, 6]))
    offset = -fits[0].clock_s if sigma < CLOCK_KNOWN_S else None
    return MotionGuess(hypotheses, covariance, offset, _note(runs, covariance, hidden, travel, offset, sigma))


def _path(runs: Sequence[Run]) -> tuple[float, float]:
    """Largest distance in m and turn in rad of the LiDAR from where a run began."""
    poses = np.concatenate([run.poses for run in runs])
    turns = np.array([np.linalg.norm(se3.rotation_vector(R)) for R in poses[:, :3, :3]])
    return float(np.linalg.norm(poses[:, :3, 3], axis=1).max()), float(turns.max())


def _hidden_axes(covariance: Matrix, limit_deg: float) -> Matrix:
    """Unit vectors (j, 3) about which the rotation is less known than limit_deg, least known first."""
    variance, axes = np.linalg.eigh(covariance)
    return np.asarray(axes.T[variance > np.deg2rad(limit_deg) ** 2][::-1])


def _with_upright(solver: HandEye, fit: Fit) -> Fit:
    """The fit, and where the motion shows an axis weakly or not, with the assumption that the camera is upright or on a side."""
    own = fit.covariance[:3, :3]
    if not len(_hidden_axes(own, WEAK_DEG)):
        return fit
    hidden = _hidden_axes(own, LOST_DEG)
    R, up = fit.R, UPRIGHT[0]
    if len(hidden):  # turned about it so that the LiDAR's z axis points up in the image as far as it can
        axis, z = hidden[0], R[:, 2]
        angle = np.arctan2(up @ np.cross(axis, z), up @ z - (axis @ z) * (axis @ up))
        R = np.asarray(se3.rotation_from_vector(angle * axis) @ R)
    else:
        up = UPRIGHT[np.argmax(UPRIGHT @ R[:, 2])]
        reach = np.deg2rad(SIGMAS * np.hypot(UPRIGHT_DEG, WEAK_DEG)) + SIGMAS * np.sqrt(np.linalg.eigvalsh(own)[-1])
        if np.arccos(np.clip(up @ R[:, 2], -1, 1)) > reach:
            return fit
    return solver.fit(R, (up, np.deg2rad(UPRIGHT_DEG)))


def _note(runs: Sequence[Run], covariance: Matrix, hidden: Matrix, travel: Matrix, offset: float | None, sigma: float) -> str:
    travelled, turned = _path(runs)
    frames = sum(map(len, runs))
    deg = ", ".join(f"{s:.1f}" for s in np.rad2deg(np.sqrt(np.diag(covariance))))
    parts = [f"first guess from the motion in {frames} frames ({travelled:.1f} m, {np.rad2deg(turned):.0f} deg): +-{deg} deg"]
    for axis in hidden:
        x, y, z = axis
        along = abs(float(axis @ travel)) > ALONG
        name = "about the direction of travel" if along else f"about ({x:.2f} {y:.2f} {z:.2f}) of the camera"
        parts.append(f"the rotation {name} was hardly shown, and the camera taken as upright or on a side")
    if offset is not None and abs(offset) > SIGMAS * sigma:
        parts.append(f"clocks {1000 * offset:.0f} +-{1000 * sigma:.0f} ms apart (motion.time_offset_s)")
    return "; ".join(parts)


def search_boxes(box: SearchBox) -> tuple[SearchBox, ...]:
    """What is searched around every hypothesis: half the box in two rounds, and the box, where none converged. An empty box is
    refined in once."""
    if box.is_empty:
        return (box,)
    near = np.array_split(box.half_width() / 2, 2)
    (rx, ry, rz), (tx, ty, tz) = np.rad2deg(near[0]).tolist(), near[1].tolist()
    return SearchBox((rx, ry, rz), (tx, ty, tz), 2), replace(box, rounds=box.rounds or ROUNDS)


def best_registration(
    hypotheses: Sequence[PoseHypothesis], estimate: Callable[[Matrix, SearchBox], Result], box: SearchBox = SEMANTIC_BOX
) -> tuple[Result, int]:
    """The result that counts, and how many hypotheses were tried: converged before not, then by score.

    estimate: T_camera_lidar (4, 4) and the box around it -> Result of the registration from there. A hypothesis is tried after
    the first only if it scores nearly as much.
    """
    tried = [h for h in hypotheses if h.score >= MIN_SCORE_RATIO * hypotheses[0].score]
    results: list[Result] = []
    for around in search_boxes(box):
        results += [estimate(h.T, around) for h in tried]
        if any(r.converged for r in results):
            break
    return better(results), len(tried)


def better(results: Sequence[Result]) -> Result:
    """The result that counts: converged before not, then by score."""
    return max(results, key=lambda r: (r.converged, np.nan_to_num(r.score, nan=-np.inf)))


def from_motion(
    register: Register, frames: int, consecutive: Sequence[Frame], extract: FeatureExtractor, box: SearchBox | None
) -> Result:
    """Registers so many frames from the hypotheses of the motion in consecutive ones. box: None = as the guess proposes. Raises
    MissingDependencyError as `motion_guess`."""
    try:
        guess = motion_guess(consecutive, extract, extract.config.search.seed)
    except TooFewFeaturesError as error:
        return insufficient(error, nominal(), frames)
    hypotheses = [PoseHypothesis(T, 1.0, 0.0, MOTION, 0) for T in guess.hypotheses]
    result, _ = best_registration(hypotheses, register, box or guess.box)
    return replace(result, reason=joined([result.reason, guess.note]), origin=InitialSource.MOTION)


def from_anything(
    register: Register, frames: int, consecutive: Sequence[Frame], extract: FeatureExtractor, box: SearchBox | None, classes: bool
) -> Result:
    """The first that converges from motion, from classes where there are some, and from the nominal extrinsic; else the best."""
    tried = {}
    try:
        tried[MOTION] = from_motion(register, frames, consecutive, extract, box)
    except (BadInputError, MissingDependencyError) as error:
        tried[MOTION] = insufficient(error, nominal(), frames)
    if not tried[MOTION].converged and classes:
        tried[SEMANTIC] = register(SEMANTIC, box)
    if not any(result.converged for result in tried.values()):
        tried["nominal"] = replace(register(nominal(), box or NOMINAL_BOX), origin=InitialSource.NOMINAL)
    best = better(list(tried.values()))
    others = [f"not by {name}: {result.reason}" for name, result in tried.items() if result is not best]
    return replace(best, reason=joined([best.reason, *others]))
