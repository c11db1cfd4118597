"""Is the camera quite another? Focal length, principal point and lens distortion, tried and compared where nothing matches.

Every family of changes is one more hypothesis about the same data: it is preferred where it gains clearly more than noise, and
the family with the highest likelihood, its number of unknowns paid for, names the cause. What is wrong by little is told at an
optimum (registration/judgement/lens.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from heapq import nlargest
from itertools import chain, product
from operator import attrgetter

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.lens import PERSPECTIVE
from calib_ros.registration.nuisance.parameters import LEVELS, NEAR_LEVELS, POINTS, REACH, noise_of
from calib_ros.registration.progress import SILENT, Progress
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits
from calib_ros_check.evidence import PARAMETER_PENALTY, Candidate, fit, shows_noise
from calib_ros_check.outcome import Tolerance

FOCAL = (-0.06, -0.04, -0.02, -0.01, 0.01, 0.02, 0.04, 0.06)  # shares of the focal length
CENTRE = (-0.03, -0.015, 0.015, 0.03)  # shares of the image width, each way
# Displacement at the corner of the image, as a share of the radius: 0.15 is KITTI's lens before it is rectified, 0.45 a fisheye.
BARREL = (-0.3, -0.2, -0.12, -0.06, -0.03, 0.03, 0.06, 0.12, 0.2, 0.3, 0.45)
SIZES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)  # of the image to which intrinsics may belong, and of this one
FAR_FOCAL = tuple(1.07 ** np.arange(-10, 11) - 1)  # of other lenses; edges at the border are then within reach of blurred maps
BEST = 3  # of quite different cameras, how many are followed: which one is best is seen only when all of it is fitted
STEPS = (0.02, 0.01, 0.005)  # of a joint descent: shares of the focal length, of the image width, of the radius
NAMES = ("focal", "u", "v", "barrel")
ROUNDS = 4
MIN_RELATIVE_GAIN = 0.05  # share of the score; a rolling shutter may gain some per cent


@dataclass(frozen=True)
class LensChange:
    """A change of a camera. focal: of its focal length, as a share; u, v: of its principal point, as shares of the image width;
    barrel: displacement at the corner, as a share of the radius, positive = the picture is compressed towards its centre."""

    focal: float = 0.0
    u: float = 0.0
    v: float = 0.0
    barrel: float = 0.0
    min_relative_gain = MIN_RELATIVE_GAIN

    @property
    def unknowns(self) -> int:
        """How many things it changes."""
        return sum(value != 0 for value in (self.focal, self.u, self.v, self.barrel))

    def seen_by(self, score: PointScore, distorted: PointScore | None = None) -> PointScore:
        """The score of a camera that is changed so. distorted: the score with this distortion, if it is there already."""
        if self.barrel:
            score = distorted or score.with_distortion(self.barrel)
        return score.with_intrinsics(self.focal, self.u, self.v) if self.focal or self.u or self.v else score


LensFit = Candidate[LensChange]
PENALISED_GAIN = attrgetter("penalised_gain")


def lenses(camera: Camera) -> Iterator[LensChange]:
    """Changes of a camera that are tried where nothing matches."""
    yield from (LensChange(focal=x) for x in FOCAL)
    yield from (LensChange(u=x) for x in CENTRE)
    yield from (LensChange(v=x) for x in CENTRE)
    yield from (LensChange(barrel=x) for x in BARREL)
    yield from (LensChange(focal=x) for x in FAR_FOCAL)
    yield from (scaled(camera, x) for x in SIZES)


def scaled(camera: Camera, scale: float) -> LensChange:
    """The change of a camera whose intrinsics are those of an image that is smaller by this factor."""
    return LensChange(scale - 1, (scale - 1) * camera.K[0, 2] / camera.width, (scale - 1) * camera.K[1, 2] / camera.width)


def judged(score: PointScore) -> bool:
    """Whether intrinsics can be judged: by several scenes, one may gain much by chance, and not on unrolled pictures, where a
    shift is a rotation and lenses of another focal length are unrolled otherwise."""
    return shows_noise(score) and not score.camera.is_sphere


def fit_lens(score: PointScore, T: Transform, progress: Progress = SILENT) -> LensFit:
    """The change of the camera, to one that may be quite another, that matches best around T (4, 4), the extrinsic refined for
    each. Without any gain it is `LensChange()`. progress: of the changes that are always tried."""
    tried = list(lenses(score.camera))
    fitting = _Fitting(score, T, progress, len(tried))
    ends = (fitting.end(lens, T, LEVELS) for lens in tried)  # one after the other: each may hold maps of its own
    ends = (fitting.descend(end, STEPS[0]) for end in nlargest(BEST, ends, key=lambda end: end.value))
    best = max(chain([fitting.given], ends), key=PENALISED_GAIN)
    if best.significant:
        for step in STEPS:
            best = fitting.descend(best, step)
        if best.hypothesis.unknowns:
            return replace(best, parts=fitting.parts(best))
    return best


def centre_instead(score: PointScore, T_checked: Transform, T_found: Transform, tolerance: Tolerance) -> LensChange | None:
    """The principal point that explains the frames as well as the rotation from T_checked to T_found (4, 4), the optimum of the
    score; None if none does.

    A rotation of some degrees about an axis across the view differs from it by the perspective of the corners only.
    """
    best = _Fitting(score, T_found).end(*_as_checked(score.camera, T_checked, T_found), LEVELS)
    return best.hypothesis if tolerance.covers(T_checked, best.T) and -best.gain <= PARAMETER_PENALTY else None


def centre_of(camera: Camera, T_checked: Transform, T_found: Transform) -> LensChange:
    """The change of the principal point that looks like the rotation from T_checked to T_found (4, 4)."""
    turn = Rotation.from_matrix(T_found[:3, :3] @ T_checked[:3, :3].T).as_rotvec()
    across = np.array([turn[1], -turn[0]])
    u, v = camera.focal * (across if camera.model not in PERSPECTIVE else np.tan(across))
    return LensChange(u=float(u) / camera.width, v=float(v) / camera.width)


def _as_checked(camera: Camera, T_checked: Transform, T_found: Transform) -> tuple[LensChange, Matrix]:
    """The principal point that looks like the rotation from T_checked to T_found (4, 4), and the extrinsic without it."""
    return centre_of(camera, T_checked, T_found), se3.from_parts(T_checked[:3, :3], T_found[:3, 3])


class _Fitting:
    """Compares changes of the camera around T (4, 4) with the camera as it is given. planned: how many at least."""

    def __init__(self, score: PointScore, T: Transform, progress: Progress = SILENT, planned: int = 1) -> None:
        self._score = score.subset(POINTS, np.random.default_rng(0))
        self._progress, self._planned, self._done = progress, planned, 0
        self._distorted = 0.0, self._score  # the last distortion that was asked for
        # Coarse levels may have their optimum elsewhere.
        here = Candidate(self._score, T, LensChange(), self._score.at(-1).value(T), tried=planned)
        self.given = max(self._end(LensChange(), T, LEVELS), here, key=lambda end: end.value)
        self._noise = noise_of(self._score, self.given.T, Limits(self.given.T, REACH))

    def end(self, lens: LensChange, start: Transform, levels: tuple[int, ...]) -> LensFit:
        """The optimum of a change, from a start, and what it gains over the camera as it is given."""
        return self._end(lens, start, levels).against(self.given.value, self._noise)

    def _end(self, lens: LensChange, start: Transform, levels: tuple[int, ...]) -> LensFit:
        self._progress(min(self._done / self._planned, 1.0))
        self._done += 1
        if lens.barrel and lens.barrel != self._distorted[0]:  # resampling all pictures takes longer than a refinement
            self._distorted = lens.barrel, self._score.with_distortion(lens.barrel)
        seen = lens.seen_by(self._score, self._distorted[1])
        return replace(fit(lens, seen, start, levels), tried=self._planned)

    def parts(self, best: LensFit) -> dict[str, float]:
        """What is lost without each of the things that are changed, the others as they are."""
        lens = best.hypothesis
        changed = [name for name in NAMES if getattr(lens, name)]
        return {name: best.gain - self.end(replace(lens, **{name: 0.0}), best.T, NEAR_LEVELS).gain for name in changed}

    def descend(self, best: LensFit, step: float) -> LensFit:
        """Coordinate by coordinate, as long as it is worth it."""
        for _ in range(ROUNDS):
            before = best
            for name, sign in product(NAMES, (1, -1)):
                lens = replace(best.hypothesis, **{name: round(getattr(best.hypothesis, name) + sign * step, 6)})
                best = max(best, self.end(lens, best.T, NEAR_LEVELS), key=PENALISED_GAIN)
            if best is before:
                break
        return best
