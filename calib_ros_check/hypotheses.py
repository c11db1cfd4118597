"""What else than the mount may make an extrinsic look wrong: transforms and pictures that were mixed up.

Each is a guess of what was meant instead, and is tried: the extrinsic that is right if the guess is, refined, and compared with
chance like any other optimum.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.lidar.scanner_pose import ScannerPose
from calib_ros.registration.score.point_score import PointScore
from calib_ros_check.evidence import Candidate
from calib_ros_check.outcome import Cause, CauseFinding, CauseState

_BODY = se3.from_parts(se3.OPTICAL_FROM_BODY, np.zeros(3))
# Turns of the picture about the optical axis, clockwise.
_TURNS = {180: "upside down", 90: "turned by 90 deg clockwise", 270: "turned by 90 deg anticlockwise"}
TURNED = "the image is {}; turn it back, or mend the driver's rotation"
AXIS_LETTERS = "xyz"
PLACES, SAME_PLACE_M = 3, 0.1  # of the scanner in its clouds: how many are tried, and how far they are apart
SLACK = 5.0  # of `predicted`: a turned picture moves the centre of a lens by some per cent of its width
ALIKE = 0.85  # of the best z-score; hypotheses that lead to the same extrinsic differ by the points that they keep in view


@dataclass(frozen=True, eq=False)
class MixUp:
    """A guess of what was mixed up.

    T: T_camera_lidar (4, 4) that is right if it holds. message: for people, what is wrong and how to mend it. mirrored: the
    picture is mirrored left to right. centre: (2,) where the principal point then is in the picture as it came, as a change in
    shares of its width. usual: T is where the sensors of most vehicles nearly are: an optimum only near it says nothing.
    """

    cause: Cause
    T: Transform
    message: str
    mirrored: bool = False
    centre: tuple[float, float] = (0.0, 0.0)
    usual: bool = False
    unknowns = 1
    min_relative_gain = 0.0

    @property
    def finding(self) -> CauseFinding:
        """That it holds; clocks and intrinsics are not judged before it is mended."""
        return CauseFinding(self.cause, CauseState.FOUND, self.message)

    def seen_by(self, score: PointScore) -> PointScore:
        """The score of the picture as it is if the guess holds."""
        if self.mirrored:
            score = score.mirrored()
        return score.with_intrinsics(0.0, *self.centre) if any(self.centre) else score


def predicted(candidate: Candidate[MixUp]) -> float:
    """How far its optimum lies from what a mix-up predicts, see `_distance`."""
    return _distance(candidate.T, candidate.hypothesis.T)


def says_more_than(candidate: Candidate[MixUp], T: Transform) -> bool:
    """Whether the optimum is nearer to what a mix-up predicts than to the extrinsic T (4, 4) as it was given: else the latter is
    just off. A mirrored or moved picture has no extrinsic that could be compared."""
    of_picture = candidate.hypothesis.mirrored or any(candidate.hypothesis.centre)
    return of_picture or predicted(candidate) < _distance(candidate.T, T)


def _distance(a: Matrix, b: Matrix) -> float:
    """Between two extrinsics (4, 4), in units of half a degree and 10 cm."""
    xi = se3.log(a @ se3.inverse(b))
    return float(np.rad2deg(np.linalg.norm(xi[:3])) / 0.5 + np.linalg.norm(xi[3:]) / 0.1)


def hypotheses(
    T: Transform, camera: Camera, poses: Sequence[ScannerPose] = (), frames: Mapping[str, Matrix] | None = None
) -> list[MixUp]:
    """All that is tried for an extrinsic T (4, 4), the simplest explanations first.

    poses: of the scanner in the frame of its clouds. frames: T_camera_F of further frames F of the vehicle, by name.
    """
    own = [*_transforms(T), *of_pictures(T, camera), *_clouds(T, poses, frames or {})]
    kept: list[MixUp] = []
    for guess in own:
        same = (k for k in kept if k.mirrored == guess.mirrored and np.allclose(k.T, guess.T, atol=1e-6))
        if next(same, None) is None and (guess.mirrored or not np.allclose(guess.T, T, atol=1e-6)):
            kept.append(guess)
    return kept


def _transforms(T: Transform) -> Iterator[MixUp]:
    inverse = se3.inverse(T)
    what = "the transform is given the wrong way round: it is T_lidar_camera where T_camera_lidar is expected; invert it"
    yield MixUp(Cause.INVERSE_TRANSFORM, inverse, what)
    body = (
        "the transform is that of the camera's body frame (camera_link: x forward, z up) instead of its optical frame "
        "(x right, z forward)"
    )
    to_optical = "add the rotation between the two, quaternion (-0.5, 0.5, -0.5, 0.5)"
    yield MixUp(Cause.BODY_FRAME, _BODY @ T, f"{body}; {to_optical}")
    yield MixUp(Cause.BODY_FRAME, _BODY @ inverse, f"{body}, and the wrong way round (T_lidar_link); invert it, and {to_optical}")
    twice = "the rotation from the camera's body frame to its optical frame is applied twice; leave one out"
    yield MixUp(Cause.BODY_FRAME, se3.inverse(_BODY) @ T, twice)
    yield MixUp(Cause.BODY_FRAME, se3.inverse(_BODY) @ inverse, f"{twice}, and invert the transform")


def of_pictures(T: Transform, camera: Camera) -> Iterator[MixUp]:
    """The image is mirrored or turned. Flipped, its principal point moves to the right, and downward."""
    (_, _, cx), (_, _, cy) = camera.K[:2].tolist()
    right, down = (camera.width - 1 - 2 * cx) / camera.width, (camera.height - 1 - 2 * cy) / camera.width
    mirrored = "the image is mirrored left to right; flip it, or switch the driver's mirroring off"
    yield MixUp(Cause.MIRRORED_IMAGE, T, mirrored, mirrored=True, centre=(right, 0.0))
    for deg, how in _TURNS.items():
        centre = (right, down) if deg == 180 else (0.0, 0.0)
        yield MixUp(Cause.ROTATED_IMAGE, _turned(T, deg), TURNED.format(how), False, centre)
    flipped = "the image is mirrored upside down; flip it, or switch the driver's mirroring off"
    yield MixUp(Cause.MIRRORED_IMAGE, _turned(T, 180), flipped, mirrored=True, centre=(0.0, down))


def upside_down(T: Transform) -> MixUp:
    """The image is upside down, seen by a camera whose principal point is turned as well."""
    return MixUp(Cause.ROTATED_IMAGE, _turned(T, 180), TURNED.format(_TURNS[180]))


def _clouds(T: Transform, poses: Sequence[ScannerPose], frames: Mapping[str, Matrix]) -> Iterator[MixUp]:
    for name, T_camera_frame in frames.items():
        what = f"the points are in the frame {name}, not in that of the extrinsic; mend the cloud's frame_id or its driver"
        yield MixUp(Cause.CLOUD_FRAME, T_camera_frame, what)
    for pose in distinct_poses(poses):
        x, y, z = pose.centre
        what = (
            f"the points are not in the scanner's frame: it stands at x {x:.2f}, y {y:.2f}, z {z:.2f} m of theirs, as in a frame "
            "of the vehicle; publish them in the scanner's frame, or use the extrinsic of theirs"
        )
        yield MixUp(Cause.CLOUD_FRAME, T @ se3.inverse(se3.from_parts(pose.rotation, pose.centre)), what)
        yield MixUp(Cause.CLOUD_FRAME, T @ se3.inverse(se3.from_parts(np.eye(3), pose.centre)), what)
    already = "the points are in the camera's {} frame already; the extrinsic is applied a second time"
    yield MixUp(Cause.CLOUD_FRAME, np.eye(4), already.format("optical"))
    yield MixUp(Cause.CLOUD_FRAME, _BODY, already.format("body"), usual=True)
    for R in axis_rotations():
        # For p_cloud = R p_expected, what each of the cloud's axes is of the expected ones.
        axes = ", ".join(f"{'-' if row[np.abs(row).argmax()] < 0 else ''}{AXIS_LETTERS[np.abs(row).argmax()]}" for row in R)
        what = (
            f"the points have other axes than the extrinsic expects: their x, y and z are its {axes}; mend the driver's "
            "axes, or the transform to the frame that the cloud names"
        )
        yield MixUp(Cause.CLOUD_FRAME, T @ se3.inverse(se3.from_parts(R, np.zeros(3))), what)


def distinct_poses(poses: Sequence[ScannerPose]) -> list[ScannerPose]:
    """Where the scanner may stand in its clouds, the place that most scans show first. A single scan may hide it."""
    found: list[tuple[int, ScannerPose]] = []
    for pose in poses:
        if not pose.is_cloud_frame and not any(_same_place(pose, other) for _, other in found):
            found.append((sum(_same_place(pose, other) for other in poses), pose))
    return [pose for _, pose in sorted(found, key=lambda own: -own[0])[:PLACES]]


def _same_place(pose: ScannerPose, other: ScannerPose) -> bool:
    return bool(np.linalg.norm(pose.centre - other.centre) < SAME_PLACE_M)


def axis_rotations() -> list[Matrix]:
    """The 23 rotations (3, 3) that exchange axes, turns about z first."""
    out = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[np.arange(3), order] = signs
            if np.linalg.det(R) > 0 and not np.allclose(R, np.eye(3)):
                out.append(R)
    return sorted(out, key=lambda R: (R[2, 2] < 0.5, round(float(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))), 6)))


def _turned(T: Transform, deg: float) -> Matrix:
    """T (4, 4) of a camera that is turned about its optical axis."""
    return se3.exp([0.0, 0.0, np.deg2rad(deg), 0.0, 0.0, 0.0]) @ T


def simplest(best: Candidate[MixUp], tried: Sequence[Candidate[MixUp]]) -> Candidate[MixUp]:
    """Of all mix-ups that match about as well as the best one, that which predicts its optimum best; else the simplest."""
    alike = [own for own in tried if own.z_score >= ALIKE * best.z_score]
    nearest = min(predicted(own) for own in alike)
    near = [own for own in alike if predicted(own) <= nearest + SLACK]
    return min(near, key=lambda own: list(Cause).index(own.hypothesis.cause))
