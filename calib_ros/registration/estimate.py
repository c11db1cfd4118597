"""The steps of an estimate after its optimum: leave outlier frames out, compare with the start, covariance, and its Result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import CalibrationError
from calib_ros.intrinsics import RefinedCamera, change_between
from calib_ros.registration.covariance import Direction, covariance, fused, unobservable_directions
from calib_ros.registration.joint import Optimised
from calib_ros.registration.judgement.clocks import Effect, offset_effect, with_known_motion
from calib_ros.registration.judgement.lens import LensEstimate
from calib_ros.registration.judgement.refusal import KEPT, LEFT_OUT, NO_INTENSITY, ONE_FRAME, Refusal, joined
from calib_ros.registration.objective import Objective, penalised
from calib_ros.registration.progress import SILENT, Progress
from calib_ros.registration.score.chance import NullDistribution, null_distribution
from calib_ros.registration.search.constraints import REFINEMENT_DEG, REFINEMENT_M, SearchBox
from calib_ros.result import CONVERGED, INSUFFICIENT, REFUSED, Cause, Evidence, LensEffect, RefusalCode, Result

UNOBSERVABLE_DEG, UNOBSERVABLE_M = 1.0, 0.3  # standard deviations beyond which a direction counts as unobservable
NEGLIGIBLE = 3e-5  # of the score: what steps of a thousandth of a degree leave of an optimum
OUTLIER_ROUNDS = 3  # an outlier frame may hide another
# Causes that a corrected camera may mend; of others, it would only be another wrong one.
OF_LENSES = (Cause.FOCAL_LENGTH, Cause.PRINCIPAL_POINT, Cause.NOT_RECTIFIED, Cause.ALREADY_RECTIFIED)
CAMERA_ROUNDS = 3  # after two, changes are those by which pictures differ that are rectified a fraction of a pixel apart


@dataclass(frozen=True, eq=False)
class Alignment:
    """An optimum T (4, 4) without the outlier frames, whose indices are in `outliers`. null: the null distribution around T."""

    T: Transform
    outliers: tuple[int, ...]
    null: NullDistribution


@dataclass(frozen=True, eq=False)
class Estimate:
    """The steps of an estimate from `initial` (4, 4), one after the other. start: what the constraints leave of it. T: the
    extrinsic (4, 4), with its covariance (6, 6), and the directions that no scene shows, along which it is the start. lens: what
    the scenes tell of it, None = nothing."""

    initial: Transform
    start: Transform
    optimised: Optimised
    alignment: Alignment
    evidence: Evidence
    T: Transform
    covariance: Covariance
    unobservable: tuple[Direction, ...]
    lens: LensEstimate | None

    @property
    def objective(self) -> Objective:
        """Of the features that the optimum is one of."""
        return self.optimised.objective

    def nuisance(self, config: Config, lens: LensEstimate | None) -> tuple[Covariance, LensEffect | None, Effect | None]:
        """What the clocks and this lens leave open of the optimum, however many such scenes there are: covariance (6, 6) by the
        clocks, how the lens moves it, and the effect of an offset as large as motion.max_time_offset_s; None where the motion is
        not known."""
        T, covariance, constraints = self.T, self.covariance, self.objective.constraints
        score = self.objective.smooth_score(T)
        sigma_s, clocks = self.optimised.clocks(config.motion)
        active = constraints.active_limits(T, score.at(-1).linearise(T)[0])  # not at its maximum along these
        limits = replace(constraints.limits, half=np.where(active, 0.0, constraints.limits.half))
        by_clocks, by_lens, any_offset = np.zeros((6, 6)), None, None
        if lens is not None and limits.open_axes.any():
            kept = [axis for direction in self.unobservable for axis in direction.axes]
            by_lens = lens.effect(constraints, covariance, kept)
        moving = with_known_motion(self.optimised.features, score) if limits.open_axes.any() else None
        if moving is not None:
            known = clocks is not None
            if clocks is None or active.any():  # else it is that of the same optimum
                clocks = offset_effect(moving[0], T, moving[1], limits)
            effect = replace(clocks, information=0.0) if known else clocks  # these scenes count only once
            by_clocks = effect.constrained(constraints, covariance, sigma_s).covariance(sigma_s)
            any_offset = clocks.constrained(constraints, covariance, config.motion.max_time_offset_s)
        return by_clocks, by_lens, any_offset

    def result(self, config: Config, lens: LensEstimate | None, refusal: Refusal | None, notes: Sequence[str]) -> Result:
        """The Result, with the start where it is refused. lens: see `nuisance`. notes: for its reason."""
        objective, features, search = self.objective, self.optimised.features, self.optimised.search
        names = [f.name or str(k) for k, f in enumerate(features)]
        outliers = [names[k] for k in self.alignment.outliers]
        used = len(features) - len(outliers)
        reasons = [
            str(refusal) if refusal else "",
            *notes,
            objective.remark,
            LEFT_OUT.format(", ".join(outliers)) if outliers else "",
            KEPT.format(", ".join(map(str, self.unobservable))) if self.unobservable else "",
            "" if all(f.has_reflectivity for f in features) else NO_INTENSITY,
            ONE_FRAME if used == 1 else "",
        ]
        found = Result(
            self.T,
            CONVERGED,
            joined(reasons),
            frames_used=used,
            initial=self.initial,
            frame_names=tuple(names),
            frames_left_out=tuple(outliers),
            data_stamp=max(f.stamp for f in features),
            score=objective.value(self.T),
            initial_score=objective.value(self.start),
            evidence=self.evidence,
            frame_scores=tuple(float(s) for s in objective.frame_scores(self.T)),
            starts=None if search is None else (search.agreed, search.optimised),
            intrinsics={} if self.lens is None else self.lens.in_files(),
        )
        if refusal is not None:
            found = replace(
                found, T_camera_lidar=self.initial, status=REFUSED, optimum=self.T, optimum_covariance=self.covariance
            )
            return replace(found, refusal=refusal.code, refusal_figures=refusal.figures, cause=refusal.cause)
        shared, by_lens, clocks = self.nuisance(config, lens)
        motion, offset, whole = config.motion, self.optimised.offset, self.covariance + shared
        moves, moment = (np.zeros((6, 1)), np.eye(1)) if by_lens is None else by_lens
        found = replace(
            found,
            covariance=whole,
            covariance_with_intrinsics=whole + moves @ moment @ moves.T,
            lens_effect=by_lens,
            shared_covariance=shared,
            clock_direction=None if clocks is None else clocks.direction,
            clock_sigma_s=None if clocks is None else clocks.sigma(motion.max_time_offset_s),
            clock_offset_s=None if offset is None else motion.time_offset_s + (self.optimised.seconds or offset.seconds),
        )
        if offset is None or not offset.observable(motion):
            return found
        seconds, sigma_s = motion.time_offset_s + self.optimised.seconds, self.optimised.clocks(motion)[0]
        return replace(found, time_offset_s=seconds, time_offset_sigma_s=sigma_s, stamping=self.optimised.stamping)


def insufficient(error: CalibrationError, initial: Transform, frames: int, notes: Sequence[str] = ()) -> Result:
    """The Result where the frames show too little to estimate anything."""
    reason, code = joined([str(error), *notes]), RefusalCode.TOO_FEW_FEATURES
    return Result(initial, INSUFFICIENT, reason, frames_used=frames, initial=initial, refusal=code)


def reject_outlier_frames(objective: Objective, T: Transform, progress: Progress = SILENT) -> Alignment:
    """The optimum without the frames that match no better than chance, which the objective leaves out from then on."""
    outliers: list[int] = []
    null = null_distribution(objective.edges.score, T)
    for _ in range(OUTLIER_ROUNDS):
        bad = null.outlier_frames()
        if not len(bad):
            break
        outliers += [int(j) for j in bad]
        objective.exclude(bad)
        T = objective.optimise(T, searched=True, progress=progress)
        null = null_distribution(objective.edges.score, T)
    return Alignment(T, tuple(sorted(outliers)), null)


def refine_start(objective: Objective, alignment: Alignment, start: Transform, progress: Progress = SILENT) -> Alignment:
    """The alignment; or, if it scores less than the start, which coarse levels may move to another optimum, the better of it and
    the optimum right at the start."""
    T = alignment.T
    if not penalised(objective, T) < penalised(objective, start):
        return alignment
    near = objective.refine(start, progress)
    better = near if penalised(objective, near) >= penalised(objective, T) else T
    alignment = reject_outlier_frames(objective, better, progress)
    missing = penalised(objective, start) - penalised(objective, alignment.T)
    return replace(alignment, T=start) if 0 < missing < NEGLIGIBLE else alignment


def observable_pose(
    objective: Objective, T: Transform, start: Transform, box: SearchBox | None, inflated: float, others: Sequence[Matrix] = ()
) -> tuple[Matrix, Covariance, tuple[Direction, ...]]:
    """The optimum T (4, 4) with its covariance, and the directions that no scene shows, which are kept from the start.

    box: that was searched, whose half widths are the standard deviations of a start that is fused. inflated: factor of the
    variance. others: optima (4, 4) nearby.
    """
    score, constraints, held = objective.smooth_score(T), objective.constraints, np.zeros(6)
    bias = objective.systematic_error
    C = covariance(score, T, systematic_error=bias, constraints=constraints, inflation=inflated, others=others)
    active = constraints.active_limits(T, score.at(-1).linearise(T)[0])
    if active.any():
        # At a limit the score is not at its maximum and its curvature means nothing: the limit gives the variance of that axis.
        held = np.where(active, np.minimum(np.diag(C), constraints.limits.half**2), 0.0)
        limits = replace(constraints.limits, half=np.where(active, 0.0, constraints.limits.half))
        constraints = replace(constraints, limits=limits)
        C = covariance(score, T, systematic_error=bias, constraints=constraints, inflation=inflated, others=others)
    unobservable = unobservable_directions(C, UNOBSERVABLE_DEG, UNOBSERVABLE_M)
    if not unobservable:
        return T, C + np.diag(held), ()
    deg, m = box.reach if box is not None else (0.0, 0.0)
    reach = [np.deg2rad(deg or REFINEMENT_DEG)] * 3 + [m or REFINEMENT_M] * 3
    kept, narrower = fused(T, C, start, np.diag(np.square(reach) * constraints.limits.open_axes))
    kept = objective.constraints.limits.clip(kept)  # composed rotations and translations exceed them by terms of second order
    if penalised(objective, kept) < penalised(objective, start):  # the score does observe them farther from the optimum
        return T, C + np.diag(held), ()
    return kept, narrower + np.diag(held), tuple(unobservable)


def refined_with_camera(first: Result, given: Camera, whole: Callable[[Camera], Result]) -> Result:
    """The estimate with intrinsics of its own, in rounds: pictures are rectified by the corrected camera, and what is left to
    correct is estimated. Where the last one is refused, like any other, there are no intrinsics.

    first: by the given camera. whole: the estimate by another camera, from the same start.
    """
    left = found = first.refined_camera
    result, clocks = first, np.zeros((6, 6))
    if left is None or found is None:  # too little is seen to estimate anything
        return first
    if left.settled or first.cause not in (None, *OF_LENSES):
        return replace(first, intrinsics=left.changes) if first.converged else replace(first, refined_camera=None)
    for _ in range(CAMERA_ROUNDS):
        result = whole(left.camera)
        if result.refined_camera is None or result.covariance is None or not result.converged:
            return replace(result, refined_camera=None)
        clocks = np.zeros((6, 6)) if result.shared_covariance is None else result.shared_covariance
        found, left = left, result.refined_camera
        if left.settled:
            break
    changes = {name: replace(change, value=change_between(given, found.camera, name)) for name, change in left.changes.items()}
    # About the camera that was used, with the change that is left: a second moment.
    off = np.array([change.value for change in left.changes.values()])
    both = np.r_[left.directions @ off, off]
    joint = RefinedCamera(found.camera, result.T_camera_lidar, changes, left.covariance + np.outer(both, both))
    whole_covariance = joint.covariance[:6, :6] + clocks
    return replace(result, covariance_with_intrinsics=whole_covariance, intrinsics=changes, refined_camera=joint)
