"""The first guess from motion: which rotation makes the images move as the LiDAR does, and what the motion does not show of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError, CalibrationError, TooFewFeaturesError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.registration.constraints import NOMINAL_BOX, SEMANTIC_BOX, SearchBox
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.motion_init.hand_eye import CLOCK_S, Fit, HandEye
from calib_ros.registration.motion_init.lidar_motion import Run, lidar_runs
from calib_ros.registration.motion_init.tracks import tracked_points

Matrix = NDArray[np.float64]

LEAST_M, LEAST_RAD = 0.5, np.deg2rad(3.0)  # of travel or of turning; tracked points and aligned scans wander a tenth of it
MIN_TRACKS, MIN_PAIRS = 100, 3
HYPOTHESES = 3
HIDDEN_DEG = 5.0  # standard deviation beyond which an axis is not shown: half of what a camera mounted by eye is known to
UPRIGHT_DEG = NOMINAL_BOX.reach[0] / 2  # standard deviation of a camera mounted by eye, whose box is two of them
UPRIGHT = np.array([0.0, -1, 0])  # the LiDAR's z axis in the frame of an upright camera
VERTICAL, ALONG = np.cos(np.deg2rad(45)), np.cos(np.deg2rad(30))  # how near axes have a name
SIGMAS, LEAST_DEG = 3.0, 5.0  # half width of the box: so many standard deviations, but no less; a search needs room
CLOCK_KNOWN_S = CLOCK_S / 2  # standard deviation of the clocks' offset at which the motion has told most of it
CLOCK_INFLATION = 2.5  # of that standard deviation: PLACEHOLDER
MIN_INLIERS = 0.6  # PLACEHOLDER
RUN_S, ENOUGH = 5.0, 0.8  # s of frames for a guess, and the share of it from which no further ones are looked for
CENTRES = (0.5, 0.2, 0.8, 0.0, 1.0)  # around which of the chosen frames, as shares of their number


@dataclass(frozen=True, eq=False)
class MotionGuess:
    """What consecutive frames tell of the extrinsic by their motion.

    Attributes
    ----------
    hypotheses : ndarray, shape (k, 4, 4)
        T_camera_lidar, best first; the camera is at the LiDAR, since motion tells little of its place.
    covariance : ndarray, shape (3, 3)
        Of the first one's rotation, a turn about the camera's axes, rad^2, with what was assumed where an axis is hidden.
    hidden : ndarray, shape (j, 3)
        Unit vectors in the camera's frame, about which the motion does not tell the rotation.
    time_offset_s : float or None
        What ``motion.time_offset_s`` lacks; None where the motion does not tell.
    time_sigma_s : float or None
        Its standard deviation, s.
    note : str
        For people, one line.
    """

    hypotheses: Matrix
    covariance: Matrix
    hidden: Matrix
    time_offset_s: float | None
    time_sigma_s: float | None
    note: str

    @property
    def sigma_deg(self) -> Matrix:
        """Standard deviations (3,) of the rotation about the camera's x, y and z axis, deg."""
        return np.asarray(np.rad2deg(np.sqrt(np.diag(self.covariance))))

    @property
    def box(self) -> SearchBox:
        """Where to search around a hypothesis."""
        x, y, z = np.clip(SIGMAS * self.sigma_deg, LEAST_DEG, SearchBox.MAX_DEG).tolist()
        return SearchBox((x, y, z), SEMANTIC_BOX.translation_m)


def motion_guess(frames: Sequence[Frame], extract: FeatureExtractor, seed: int = 0) -> MotionGuess:
    """The extrinsic from the motion in consecutive frames, a few seconds of them, without any prior.

    Frames are of extract.source_camera, in the order of their stamps; there may be gaps. Deterministic for a seed. Raises
    BadInputError for frames out of order, TooFewFeaturesError where nothing moves, pictures show nothing that can be tracked, or
    the motion leaves more than one axis open; MissingDependencyError where scans have to be aligned and small_gicp is missing.
    """
    if len(frames) < 2:
        raise TooFewFeaturesError(
            f"a first guess from motion needs consecutive frames, a few seconds of them; there is {len(frames)}"
        )
    if any(b.moment_of_cloud <= a.moment_of_cloud for a, b in zip(frames, frames[1:], strict=False)):
        raise BadInputError("frames for a first guess from motion must be in the order of their stamps, each with its own")
    runs, reasons = lidar_runs(frames, extract.config.motion)
    _check_motion(runs, reasons)
    tracks = tracked_points(frames, runs, extract)
    if len(tracks) < MIN_TRACKS or len(np.unique(tracks.pair)) < MIN_PAIRS:
        raise TooFewFeaturesError(
            f"only {len(tracks)} points could be tracked from picture to picture, {MIN_TRACKS} are needed: give a few seconds of "
            "frames that follow each other at 5 Hz or more, of scenes with texture"
        )
    solver = HandEye(tracks, runs, seed)
    fits = solver.hypotheses(HYPOTHESES)
    if fits[0].inliers < MIN_INLIERS:
        raise TooFewFeaturesError(
            f"only {fits[0].inliers:.0%} of the tracked points agree with the LiDAR's motion: check that images and clouds are of "
            "the same time, and the camera's intrinsics"
        )
    hidden = _hidden_axes(fits[0].covariance[:3, :3])
    travel = fits[0].R @ _travel(solver)
    _check_hidden(hidden, fits[0].R)
    if len(hidden):
        fits = [solver.fit(_upright(fit.R, hidden[0]), (UPRIGHT, np.deg2rad(UPRIGHT_DEG))) for fit in fits]
    hypotheses = np.array([se3.from_parts(fit.R, np.zeros(3)) for fit in fits])
    sigma = CLOCK_INFLATION * float(np.sqrt(fits[0].covariance[6, 6]))
    known = sigma < CLOCK_KNOWN_S
    offset = -fits[0].clock_s if known else None
    note = _note(runs, fits[0], hidden, travel, offset, sigma)
    return MotionGuess(hypotheses, fits[0].covariance[:3, :3], hidden, offset, sigma if known else None, note)


def neighbours(source: Source, positions: Sequence[int], max_gap_s: float) -> list[Frame]:
    """Frames of a source that follow each other, around some of the given positions, together RUN_S long or what there is, in order.

    What cannot be read ends a run. max_gap_s: the largest time between frames that follow each other.
    """
    found: dict[int, Frame] = {}
    seconds = 0.0
    for share in CENTRES:
        centre = positions[min(int(share * len(positions)), len(positions) - 1)]
        if centre in found:
            continue
        for towards in (1, -1):
            k, last, span = centre, found.get(centre), 0.0
            while True:
                frame = _read(source, k)
                if frame is None:
                    break
                if last is not None and k != centre:
                    gap = abs(frame.moment_of_cloud - last.moment_of_cloud) / NANOSECONDS
                    if not 0 < gap <= max_gap_s:
                        break
                    span += gap
                found[k], last = frame, frame
                k += towards
                if span >= RUN_S / 2 or k in found:
                    break
            seconds += span
        if seconds >= ENOUGH * RUN_S:
            break
    return sorted(found.values(), key=lambda frame: frame.moment_of_cloud)


def _read(source: Source, position: int) -> Frame | None:
    try:
        return source[position] if 0 <= position < len(source) else None
    except CalibrationError:
        return None


def _check_motion(runs: Sequence[Run], reasons: Sequence[str]) -> None:
    """TooFewFeaturesError where the LiDAR's motion is unknown, or too small."""
    if not runs:
        why = f" ({reasons[0]})" if reasons else ""
        raise TooFewFeaturesError(f"the LiDAR's motion is known between no two frames{why}: give frames that follow each other")
    travelled, turned = _path(runs)
    if travelled < LEAST_M and turned < LEAST_RAD:
        raise TooFewFeaturesError(
            f"the vehicle stands still ({travelled:.2f} m, {np.rad2deg(turned):.1f} deg in all frames): a first guess from motion "
            "needs a few seconds of driving, best with a bend"
        )


def _path(runs: Sequence[Run]) -> tuple[float, float]:
    """Largest distance in m and turn in rad of the LiDAR from where a run began."""
    poses = np.concatenate([run.poses for run in runs])
    turns = Rotation.from_matrix(poses[:, :3, :3]).magnitude()
    return float(np.linalg.norm(poses[:, :3, 3], axis=1).max()), float(turns.max())


def _travel(solver: HandEye) -> Matrix:
    """Mean direction (3,) in which the LiDAR moves, in its own frame; length 1 if it is always the same."""
    moved = -solver.motions()[:, :3, 3]
    return np.asarray(moved.sum(axis=0) / max(float(np.linalg.norm(moved, axis=1).sum()), 1e-9))


def _hidden_axes(covariance: Matrix) -> Matrix:
    """Unit vectors (j, 3) about which the rotation is unknown, most unknown first."""
    variance, axes = np.linalg.eigh(covariance)
    return np.asarray(axes.T[variance > np.deg2rad(HIDDEN_DEG) ** 2][::-1])


def _check_hidden(hidden: Matrix, R: Matrix) -> None:
    """TooFewFeaturesError where a camera's being upright does not tell what the motion has hidden."""
    if len(hidden) > 1:
        raise TooFewFeaturesError(
            "the motion is too small to tell the rotation about more than one axis: give more frames, of a bend if possible"
        )
    if len(hidden) and abs(float(hidden[0] @ R[:, 2])) > VERTICAL:
        raise TooFewFeaturesError(
            "the motion does not tell to which side the camera looks: the vehicle only turned on the spot; give frames in which it "
            "drives some metres"
        )


def _upright(R: Matrix, axis: Matrix) -> Matrix:
    """R (3, 3) turned about an axis (3,) of the camera so that the LiDAR's z axis points upwards in the image as far as it can."""
    z = R[:, 2]
    angle = np.arctan2(UPRIGHT @ np.cross(axis, z), UPRIGHT @ z - (axis @ z) * (axis @ UPRIGHT))
    return np.asarray(Rotation.from_rotvec(angle * axis).as_matrix() @ R)


def _note(runs: Sequence[Run], fit: Fit, hidden: Matrix, travel: Matrix, offset: float | None, sigma: float) -> str:
    travelled, turned = _path(runs)
    frames = sum(map(len, runs))
    deg = ", ".join(f"{s:.1f}" for s in np.rad2deg(np.sqrt(np.diag(fit.covariance)[:3])))
    parts = [f"first guess from the motion in {frames} frames ({travelled:.1f} m, {np.rad2deg(turned):.0f} deg): +-{deg} deg"]
    for axis in hidden:
        x, y, z = axis
        along = abs(float(axis @ travel)) > ALONG
        name = "about the direction of travel" if along else f"about ({x:.2f} {y:.2f} {z:.2f}) of the camera"
        parts.append(f"the rotation {name} was not shown, and the camera taken as upright")
    if offset is not None:
        parts.append(f"clocks {1000 * offset:.0f} +-{1000 * sigma:.0f} ms apart (motion.time_offset_s)")
    return "; ".join(parts)
