"""Other cameras that may have taken pictures with a lens distortion.

Without a distortion another camera only samples the same maps elsewhere (`LensChange`). With one, the pictures were rectified
by it, and have to be rectified anew: as if they were rectified already, or by intrinsics of another image size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.lens import LENSES
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.nuisance.parameters import REACH, noise_of
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits
from calib_ros_check.causes import (
    ALREADY_RECTIFIED,
    FISHEYE_AS_RECTIFIED,
    UNRECTIFIED_FISHEYE,
    centre_finding,
    distorts,
    focal_finding,
    of_another_size,
)
from calib_ros_check.evidence import Candidate, H
from calib_ros_check.outcome import Cause, CauseFinding, CauseState
from calib_ros_check.sensors import SIZES, LensChange

FOCAL = (-0.06, -0.04, -0.02, 0.02, 0.04, 0.06)  # shares of the focal length: each takes new edges of all pictures
LEAST_DISTORTION = 1e-9  # coefficient of an ideal fisheye: with none at all, a camera is a pinhole
# Features of frames with these numbers, None = of all, had this camera taken them. Raises BadInputError if it cannot have.
AsTaken = Callable[[Camera, Sequence[int] | None], Sequence[FrameFeatures]]


@dataclass(frozen=True)
class CameraGuess:
    """Another camera that may have taken the pictures.

    finding: what is said where it has. start: (4, 4) where its extrinsic is looked for; None = at that which the camera as given
    has.
    """

    finding: CauseFinding
    camera: Camera
    start: Transform | None = None
    unknowns = 1
    min_relative_gain = 0.02  # a rolling shutter may gain 1 %


def gain_over(given: PointScore, T_given: Transform, candidate: Candidate[H], tried: int) -> Candidate[H]:
    """A candidate, the best of so many, with what it gains over the camera as it is given, at its optimum T_given (4, 4)."""
    noise = noise_of(given, T_given, Limits(T_given, REACH))
    at_optimum = replace(candidate, value=candidate.score.at(-1).value(candidate.T), tried=tried)
    return at_optimum.against(given.at(-1).value(T_given), noise)


def rectified_already(camera: Camera) -> Iterator[CameraGuess]:
    """The image shows no distortion, if its CameraInfo has one."""
    if distorts(camera):
        yield CameraGuess(_found(Cause.ALREADY_RECTIFIED, ALREADY_RECTIFIED), Camera(camera.K, camera.width, camera.height))


def other_centre(camera: Camera, centre: LensChange, start: Transform) -> Iterator[CameraGuess]:
    """Another principal point of a lens with a distortion, which may lie so far beside that it looks like a rotation. start:
    (4, 4), without that rotation."""
    if distorts(camera):
        K = camera.K.copy()
        K[:2, 2] += camera.width * np.array([centre.u, centre.v])
        yield CameraGuess(centre_finding(centre, camera, CauseState.FOUND), replace(camera, K=K), start)


def unrectified_fisheye(camera: Camera) -> Iterator[CameraGuess]:
    """The image of a fisheye, if its CameraInfo says that it is rectified: far beyond a distortion that bends a picture."""
    if camera.is_pinhole:
        D = np.array([LEAST_DISTORTION, 0.0, 0.0, 0.0])
        message = FISHEYE_AS_RECTIFIED if camera.said_rectified else UNRECTIFIED_FISHEYE
        yield CameraGuess(_found(Cause.NOT_RECTIFIED, message), replace(camera, model="equidistant", D=D))


def other_focal_lengths(camera: Camera) -> Iterator[CameraGuess]:
    """Focal lengths nearby of a fisheye, whose pictures are unrolled otherwise for each."""
    for share in FOCAL:
        K = camera.K * np.array([[1 + share, 1, 1], [1, 1 + share, 1], [1, 1, 1]])
        yield CameraGuess(focal_finding(share), replace(camera, K=K))


def camera_guesses(camera: Camera) -> Iterator[CameraGuess]:
    """All guesses about a camera that is quite another."""
    yield from unrectified_fisheye(camera)
    yield from rectified_already(camera)
    if distorts(camera):
        for scale in SIZES:
            K = camera.K * np.array([[scale, 1, scale], [1, scale, scale], [1, 1, 1]])
            yield CameraGuess(_found(Cause.OTHER_CAMERA, f"CameraInfo is {of_another_size(scale)}"), replace(camera, K=K))


def _found(cause: Cause, message: str) -> CauseFinding:
    return CauseFinding(cause, CauseState.FOUND, message)


def turned_over(camera: Camera) -> Camera:
    """The camera of the same pictures upside down: principal point and tangential distortion are turned."""
    K, D = camera.K.copy(), np.array(camera.D, float)
    K[:2, 2] = camera.width - 1 - K[0, 2], camera.height - 1 - K[1, 2]
    if len(D):
        D[[k for k in LENSES[camera.model].off_radius if k < len(D)]] *= -1
    return replace(camera, K=K, D=D)
