"""What else than the mount may make frames match badly: transforms, pictures and intrinsics that were mixed up.

Each is a guess of what was meant instead, and is tried: the extrinsic that is right if the guess is, refined, and compared with
chance like any other optimum. What may be wrong by little of the lens and the clocks is told at an optimum (lens.py,
clocks.py).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import permutations, product

import cv2
import numpy as np

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.errors import BadInputError
from calib_ros.lens import LENSES, PERSPECTIVE
from calib_ros.lidar.scanner_pose import ScannerPose
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.judgement.refusal import AS_RAW, joined
from calib_ros.registration.score.point_score import PointScore
from calib_ros.result import Cause

# Features of frames with these numbers, None = of all, had this camera taken them. Raises BadInputError if it cannot have.
AsTaken = Callable[[Camera, Sequence[int] | None], Sequence[FrameFeatures]]
OF_TRANSFORM = (Cause.INVERSE_TRANSFORM, Cause.BODY_FRAME, Cause.QUATERNION_ORDER, Cause.CLOUD_FRAME)
OF_PICTURE = (Cause.MIRRORED_IMAGE, Cause.ROTATED_IMAGE)
MIXED_UP = (*OF_TRANSFORM, *OF_PICTURE)
_BODY = se3.from_parts(se3.OPTICAL_FROM_BODY, np.zeros(3))
# Turns of the picture about the optical axis, clockwise.
_TURNS = {180: "upside down", 90: "turned by 90 deg clockwise", 270: "turned by 90 deg anticlockwise"}
PLACES, SAME_PLACE_M = 3, 0.1  # of the scanner in its clouds: how many are tried, and how far they are apart
# Of an image to this one, as pictures are resized; between them the lens is refined.
SIZES = (0.25, 1 / 3, 0.4, 0.5, 0.6, 2 / 3, 0.75, 0.8, 5 / 6, 0.9, 10 / 9, 1.2, 1.25, 4 / 3, 1.5, 5 / 3, 2.0, 2.5, 3.0, 4.0)
FOCALS = tuple(1.1 ** np.array([-6, -5, -4, -3, -2, 2, 3, 4, 5, 6]) - 1)  # shares of the focal length: of another lens
# Displacement at the corner, a share of the radius: 0.15 is KITTI's lens before it is rectified, 0.45 a fisheye.
BARREL = (-0.3, -0.15, 0.15, 0.3, 0.45)
NEAR_FOCALS = (-0.06, -0.04, -0.02, 0.02, 0.04, 0.06)  # of a fisheye, whose pictures are unrolled otherwise for each
LEAST_DISTORTION = 1e-9  # coefficient of an ideal fisheye: with none at all, a camera is a pinhole
STARTS, ROUNDS, SAME_K = 12, 40, 0.01  # of the search for a raw picture's K, and how well it has to fit, as a share of fx


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A guess of what is wrong.

    told: for people, beside the words of the cause. T: T_camera_lidar (4, 4) that is right if it holds. mirrored: the
    picture is mirrored left to right. lens: change of the focal length, as a share, and of the principal point, as shares of the
    image width. barrel: displacement at the corner that the picture has, a share of the radius, towards its centre. camera: that
    took the picture, by which it has to be rectified anew. usual: T is where the sensors of most vehicles nearly are: an optimum
    only near it says nothing.
    """

    cause: Cause
    told: str
    T: Transform
    mirrored: bool = False
    lens: tuple[float, float, float] = (0.0, 0.0, 0.0)
    barrel: float = 0.0
    camera: Camera | None = None
    usual: bool = False

    @property
    def message(self) -> str:
        """For people, what is wrong and how to mend it."""
        return joined([str(self.cause), self.told])

    @property
    def of_lens(self) -> bool:
        """Whether another camera took the pictures, and none was mixed up."""
        return self.cause not in MIXED_UP

    @property
    def rank(self) -> int:
        """The simpler, the lower."""
        return list(Cause).index(self.cause)

    def seen_by(self, score: PointScore) -> PointScore:
        """The score of the picture as it is if the guess holds."""
        atlas = score.atlas.mirrored() if self.mirrored else score.atlas
        atlas = atlas.with_distortion(self.barrel) if self.barrel else atlas
        return score.on(atlas.with_intrinsics(*self.lens) if any(self.lens) else atlas)


def transforms(T: Transform) -> Iterator[Hypothesis]:
    """The extrinsic T (4, 4) is another transform than it is said to be; the simplest first."""
    inverse = se3.inverse(T)
    yield Hypothesis(Cause.INVERSE_TRANSFORM, "it is T_lidar_camera where T_camera_lidar is expected", inverse)
    body = "it is that of the camera's body frame (camera_link: x forward, z up); add the rotation (-0.5, 0.5, -0.5, 0.5)"
    yield Hypothesis(Cause.BODY_FRAME, body, _BODY @ T)
    yield Hypothesis(Cause.BODY_FRAME, f"{body}, and invert it, which is T_lidar_link", _BODY @ inverse)
    twice = "the rotation from the camera's body frame to its optical frame is applied twice; leave one out"
    yield Hypothesis(Cause.BODY_FRAME, twice, se3.inverse(_BODY) @ T)
    yield Hypothesis(Cause.BODY_FRAME, f"{twice}, and invert the transform", se3.inverse(_BODY) @ inverse, usual=True)
    quaternion = se3.quaternion_from_rotation(T[:3, :3])
    for how, shift in (("it has w first, and was read as x, y, z, w", -1), ("it was read with w first, but is x, y, z, w", 1)):
        R = se3.rotation_from_quaternion(np.roll(quaternion, shift))
        yield Hypothesis(Cause.QUATERNION_ORDER, how, se3.from_parts(R, T[:3, 3]))


def pictures(T: Transform, camera: Camera) -> Iterator[Hypothesis]:
    """The image is mirrored or turned. Flipped, its principal point moves to the right, and downward."""
    (_, _, cx), (_, _, cy) = camera.K[:2].tolist()
    right, down = (camera.width - 1 - 2 * cx) / camera.width, (camera.height - 1 - 2 * cy) / camera.width
    yield Hypothesis(Cause.MIRRORED_IMAGE, "it is mirrored left to right", T, mirrored=True, lens=(0.0, right, 0.0))
    for deg, how in _TURNS.items():
        lens = (0.0, right, down) if deg == 180 else (0.0, 0.0, 0.0)
        yield Hypothesis(Cause.ROTATED_IMAGE, f"it is {how}", _turned(T, deg), lens=lens)
    flipped = "it is mirrored upside down"
    yield Hypothesis(Cause.MIRRORED_IMAGE, flipped, _turned(T, 180), mirrored=True, lens=(0.0, 0.0, down))


def clouds(T: Transform, poses: Sequence[ScannerPose], frames: Mapping[str, Matrix]) -> Iterator[Hypothesis]:
    """The points are in another frame than the extrinsic T (4, 4) is of. poses: of the scanner in the frame of its clouds.
    frames: T_camera_F of further frames F of the vehicle, by name."""
    for name, T_camera_frame in frames.items():
        what = f"they are in the frame {name}, not in that of the extrinsic; mend the cloud's frame_id or its driver"
        yield Hypothesis(Cause.CLOUD_FRAME, what, T_camera_frame)
    for pose in distinct_poses(poses):
        x, y, z = pose.centre
        what = f"the scanner stands at x {x:.2f}, y {y:.2f}, z {z:.2f} m of theirs, as in a frame of the vehicle"
        for R in (pose.rotation, np.eye(3)):
            yield Hypothesis(Cause.CLOUD_FRAME, what, T @ se3.inverse(se3.from_parts(R, pose.centre)))
    already = "they are in the camera's {} frame already, and the extrinsic is applied a second time"
    yield Hypothesis(Cause.CLOUD_FRAME, already.format("optical"), np.eye(4))
    yield Hypothesis(Cause.CLOUD_FRAME, already.format("body"), _BODY, usual=True)
    for R in axis_rotations():
        # For p_cloud = R p_expected, what each of the cloud's axes is of the expected ones.
        axes = ", ".join(f"{'-' if row[np.abs(row).argmax()] < 0 else ''}{'xyz'[np.abs(row).argmax()]}" for row in R)
        what = f"their x, y and z are {axes} of the extrinsic's; mend the driver's axes, or the transform to the cloud's frame"
        yield Hypothesis(Cause.CLOUD_FRAME, what, T @ se3.inverse(se3.from_parts(R, np.zeros(3))))


def mix_ups(
    T: Transform, camera: Camera, poses: Sequence[ScannerPose] = (), frames: Mapping[str, Matrix] | None = None
) -> list[Hypothesis]:
    """All of the above for an extrinsic T (4, 4), each once, and none that is the extrinsic itself."""
    kept: list[Hypothesis] = []
    for guess in (*transforms(T), *pictures(T, camera), *clouds(T, poses, frames or {})):
        same = (own for own in kept if own.mirrored == guess.mirrored and np.allclose(own.T, guess.T, atol=1e-6))
        if next(same, None) is None and (guess.mirrored or not np.allclose(guess.T, T, atol=1e-6)):
            kept.append(guess)
    return kept


def resized(T: Transform, source: Camera, working: Camera, anew: bool = False) -> Iterator[Hypothesis]:
    """The intrinsics are those of another image size. source: as stated; working: whose image is worked on, a pinhole. anew:
    distorted pictures are rectified for every size; else sizes are ranked by the pictures as they were rectified, to first order.
    """
    for scale in SIZES:
        K = source.K * np.array([[scale, 1, scale], [1, scale, scale], [1, 1, 1]])
        lens = (scale - 1) * np.array([1.0, working.K[0, 2] / working.width, working.K[1, 2] / working.width])
        camera = replace(source, K=K) if distorts(source) else None
        lens = 0 * lens if anew and camera is not None else lens
        yield Hypothesis(Cause.OTHER_CAMERA, of_another_size(scale), T, lens=tuple(lens.tolist()), camera=camera)


def other_lenses(T: Transform, camera: Camera) -> Iterator[Hypothesis]:
    """The focal length, or the distortion, is that of quite another lens. camera: as it is stated."""
    if distorts(camera):
        return
    for share in FOCALS:
        yield Hypothesis(Cause.FOCAL_LENGTH, focal_words(share), T, lens=(share, 0.0, 0.0))
    for barrel in BARREL:
        corners = f"corners lie {abs(barrel):.0%} of the radius {'towards' if barrel > 0 else 'away from'} the centre"
        said = f"it is raw: {corners}; {AS_RAW}" if camera.said_rectified else f"its CameraInfo has no distortion: {corners}"
        yield Hypothesis(Cause.NOT_RECTIFIED, said, T, barrel=barrel)


def rectified_otherwise(T: Transform, camera: Camera) -> Iterator[Hypothesis]:
    """The image is not the one that camera_info is of: rectified already, or raw, with the other's K."""
    if not distorts(camera):
        return
    pinhole = Camera(camera.K, camera.width, camera.height)
    twice = "its CameraInfo has a distortion, which is removed a second time"
    yield Hypothesis(Cause.ALREADY_RECTIFIED, twice, T, camera=pinhole)
    mixed = "K in camera_info is that of the rectified image, but D and the image are raw; take both from one calibration"
    for alpha in (0.0, 1.0):
        with suppress(BadInputError):
            K = _of_raw(camera, alpha)
            if K is not None:
                yield Hypothesis(Cause.OTHER_CAMERA, mixed, T, camera=replace(camera, K=K))


def _of_raw(camera: Camera, alpha: float) -> Matrix | None:
    """K (3, 3) of the raw image, if that of the camera is what OpenCV makes for the rectified one; None if none is. alpha: as of
    cv2.getOptimalNewCameraMatrix. Its pixels are taken to be square: else several are."""
    if camera.model not in PERSPECTIVE:
        return None

    def off(raw: Matrix) -> Matrix:
        K = np.array([[raw[0], 0, raw[1]], [0, raw[0], raw[2]], [0, 0, 1]])
        made = np.asarray(cv2.getOptimalNewCameraMatrix(K, camera.D, (camera.width, camera.height), alpha)[0], float)
        return np.asarray(np.nan_to_num((made - camera.K)[[0, 0, 1, 1], [0, 2, 1, 2]] / camera.K[1, 1], nan=1e3))

    best, (fx, fy), centre = None, np.diag(camera.K)[:2], camera.K[:2, 2]
    for start in np.geomspace(0.5 * min(fx, fy), 3 * max(fx, fy), STARTS):  # of a lens that folds, it has several solutions
        from scipy.optimize import least_squares

        found = least_squares(off, [start, *centre], x_scale=[fx, fx, fx], max_nfev=ROUNDS)
        best = found if best is None or found.cost < best.cost else best
    if best is None or np.abs(best.fun).max() > SAME_K or np.abs([fx, fy] - best.x[0]).max() < SAME_K * fx:
        return None
    return np.array([[best.x[0], 0, best.x[1]], [0, best.x[0], best.x[2]], [0, 0, 1]], float)


def fisheyes(T: Transform, camera: Camera) -> Iterator[Hypothesis]:
    """The image is that of a fisheye, which is said to be rectified, far beyond a distortion that bends a picture; or the focal
    length of a fisheye is another one."""
    if camera.is_pinhole:
        D = np.array([LEAST_DISTORTION, 0.0, 0.0, 0.0])
        lens = replace(camera, model="equidistant", D=D)
        cure = AS_RAW if camera.said_rectified else "give 'equidistant' with its coefficients"
        yield Hypothesis(Cause.NOT_RECTIFIED, f"it is that of a fisheye; {cure}", T, camera=lens)
    elif not camera.is_sphere and camera.model not in PERSPECTIVE:
        for share in NEAR_FOCALS:
            K = camera.K * np.array([[1 + share, 1, 1], [1, 1 + share, 1], [1, 1, 1]])
            said = f"the scenes match clearly better with {focal_words(share)}"
            yield Hypothesis(Cause.FOCAL_LENGTH, said, T, camera=replace(camera, K=K))


def turned_over(T: Transform, camera: Camera) -> Hypothesis:
    """The image of a distorted camera is upside down: principal point and tangential distortion are turned as well."""
    K, D = camera.K.copy(), np.array(camera.D, float)
    K[:2, 2] = camera.width - 1 - K[0, 2], camera.height - 1 - K[1, 2]
    if len(D):
        D[[k for k in LENSES[camera.model].off_radius if k < len(D)]] *= -1
    return Hypothesis(Cause.ROTATED_IMAGE, f"it is {_TURNS[180]}", _turned(T, 180), camera=replace(camera, K=K, D=D))


def distinct_poses(poses: Sequence[ScannerPose]) -> list[ScannerPose]:
    """Where the scanner may stand in its clouds, the place that most scans show first. A single scan may hide it."""

    def same(pose: ScannerPose, other: ScannerPose) -> bool:
        return bool(np.linalg.norm(pose.centre - other.centre) < SAME_PLACE_M)

    found: list[tuple[int, ScannerPose]] = []
    for pose in poses:
        if not pose.is_cloud_frame and not any(same(pose, other) for _, other in found):
            found.append((sum(same(pose, other) for other in poses), pose))
    return [pose for _, pose in sorted(found, key=lambda own: -own[0])[:PLACES]]


def axis_rotations() -> list[Matrix]:
    """The 23 rotations (3, 3) that exchange axes, turns about z first."""
    signed = product(permutations(np.eye(3)), product((1.0, -1.0), repeat=3))
    turns = (np.array(rows) * np.array(signs)[:, None] for rows, signs in signed)
    out = [R for R in turns if np.linalg.det(R) > 0 and not np.allclose(R, np.eye(3))]
    return sorted(out, key=lambda R: (R[2, 2] < 0.5, round(float(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))), 6)))


def _turned(T: Transform, deg: float) -> Matrix:
    """T (4, 4) of a camera that is turned about its optical axis."""
    return se3.exp([0.0, 0.0, np.deg2rad(deg), 0.0, 0.0, 0.0]) @ T


def distorts(camera: Camera) -> bool:
    """Whether CameraInfo says that the image is distorted."""
    return not (camera.is_pinhole or camera.is_sphere)


def focal_words(share: float) -> str:
    """Another focal length, in words."""
    return f"a focal length {abs(share):.1%} {'longer' if share > 0 else 'shorter'}"


def of_another_size(scale: float) -> str:
    """What is wrong with intrinsics of an image that is smaller by this factor, in words."""
    times = f"{scale:.2g} times smaller" if scale > 1 else f"{1 / scale:.2g} times larger"
    return f"CameraInfo is of an image {times}: scale fx, fy, cx and cy by {scale:.3g}"
