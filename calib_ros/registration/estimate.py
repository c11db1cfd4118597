"""The steps of an estimate after its optimum: leave outlier frames out, compare with the start, covariance, acceptance, Result.

`refusal_of` is the acceptance test: no better than the start, other intrinsics or clocks, at the end of the trust region, no
better than chance, not known well enough, another objective elsewhere. Its limits are those of the stage ``refine``. One more
test follows elsewhere: of the node, over time (the gate of online/tracker.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.config import NO_LIMIT_DEG, NO_LIMIT_M, Config, MotionConfig
from calib_ros.config.sensors import FARTHEST_OFFSET_S, MAX_OFFSET_S
from calib_ros.errors import CalibrationError
from calib_ros.intrinsics import RefinedCamera, change_between
from calib_ros.registration.classes import consistency_score
from calib_ros.registration.covariance import Direction, covariance, disagreement, fused, inflation, open_directions, scenes_of
from calib_ros.registration.features import views_of
from calib_ros.registration.joint import Optimised, estimates_offset
from calib_ros.registration.judgement.clocks import Effect, offset_effect, refuse_clocks, with_known_motion
from calib_ros.registration.judgement.lens import LensEstimate
from calib_ros.registration.judgement.refusal import (
    BUT_FOR_PRIOR,
    KEPT,
    LEFT_OUT,
    NO_INTENSITY,
    ONE_FRAME,
    Refusal,
    joined,
    refused,
    wrong_times,
)
from calib_ros.registration.objective import Objective, penalised, trust_region
from calib_ros.registration.progress import SILENT, Progress
from calib_ros.registration.score.chance import (
    HIGHEST_DECOY_Z,
    UNDOUBTED_Z,
    NullDistribution,
    null_distribution,
    null_extrinsics,
    p_value,
)
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import NEARLY, REFINEMENT_DEG, REFINEMENT_M, SearchBox
from calib_ros.registration.search.search import SearchResult, search_decoy
from calib_ros.result import CONVERGED, INSUFFICIENT, REFUSED, Cause, Evidence, LensEffect, RefusalCode, Result

UNOBSERVABLE_DEG, UNOBSERVABLE_M = 1.0, 0.3  # standard deviations beyond which a direction counts as unobservable
NEGLIGIBLE = 3e-5  # of the score: what steps of a thousandth of a degree leave of an optimum
OUTLIER_ROUNDS = 3  # an outlier frame may hide another
# Causes that a corrected camera may mend; of others, it would only be another wrong one.
OF_LENSES = (Cause.FOCAL_LENGTH, Cause.PRINCIPAL_POINT, Cause.NOT_RECTIFIED, Cause.ALREADY_RECTIFIED)
CAMERA_ROUNDS = 3  # after two, changes are those by which pictures differ that are rectified a fraction of a pixel apart
WITH_90_PERCENT = 1.645  # standard deviations that a normal error exceeds in one of ten cases

# Semantic consistency: share of the null distribution that meets the classes better, and standard deviations above its mean. Of
# 43 right optima of single KITTI frames 34 are consistent and 3 inconsistent, of 74 wrong ones 11 and 39.
CONSISTENT_RANK, CONSISTENT_Z = 0.02, 1.5
INCONSISTENT_RANK = 0.15
# How much more probable the classes make a right optimum than a wrong one, from these counts.
RATIO_CONSISTENT, RATIO_INCONSISTENT = 5.0, 1 / 7.0


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

    def nuisance(self, config: Config, lens: LensEstimate | None) -> tuple[Covariance, LensEffect | None, Effect | None]:
        """What the clocks and this lens leave open of the optimum, however many such scenes there are: covariance (6, 6) by the
        clocks, how the lens moves it, and the effect of an offset as large as motion.max_time_offset_s; None where the motion is
        not known."""
        T, covariance, constraints = self.T, self.covariance, self.optimised.objective.constraints
        score = self.optimised.objective.smooth_score(T)
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
        objective, features, search = self.optimised.objective, self.optimised.features, self.optimised.search
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
    code = RefusalCode.TOO_FEW_FEATURES
    reason = joined([str(code), str(error), *notes])
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
    unobservable = open_directions(C, UNOBSERVABLE_DEG, UNOBSERVABLE_M)
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


def evidence_of(config: Config, objective: Objective, alignment: Alignment, search: SearchResult | None) -> Evidence:
    """What speaks for the optimum. Without a search, in doubt, a decoy is searched as far as a refinement goes."""
    score, limits, z_score = objective.edges.score, objective.constraints.limits, alignment.null.z_score
    decoy_z, rounds = (None, 1) if search is None else (search.decoy_z, search.rounds)
    if z_score < UNDOUBTED_Z and decoy_z is None:
        deg, m = trust_region()
        box = SearchBox(min(deg, SearchBox.MAX_DEG), min(m, SearchBox.MAX_M))
        decoy_z = search_decoy(score, alignment.T, box, config.search, limits)
    halves = disagreement(objective.smooth_score(alignment.T), alignment.T, limits)
    return Evidence(z_score, decoy_z, p_value(z_score, decoy_z, rounds), halves, scenes_of(score))


def refusal_of(found: Estimate, config: Config, camera: Camera, searched: bool, progress: Progress) -> Refusal | None:
    """Why the extrinsic of an estimate is not to be used: the first check that fails. camera: as it is stated. searched: a search
    led to it."""
    objective, T, start, limits = found.optimised.objective, found.T, found.start, found.optimised.objective.constraints.limits
    if penalised(objective, T) < penalised(objective, start):
        scores = {"score": objective.value(T), "initial_score": objective.value(start)}
        why = BUT_FOR_PRIOR if scores["score"] >= scores["initial_score"] else ""
        return refused(RefusalCode.WORSE_THAN_START, why, **scores)
    wrong = _check_intrinsics_and_clocks(found, config, camera, searched)
    if wrong is not None:
        return wrong
    reached, region = found.alignment.T, limits.trust_region
    # At its end the score still rises: no optimum, or one that the start does not justify.
    if region is not None:
        moved = np.abs(se3.log(reached @ se3.inverse(region.T)))
        if (moved >= NEARLY * region.half)[limits.open_axes].any():
            deg, m = se3.error(found.initial, reached)
            reach = {"max_rotation_deg": np.rad2deg(region.half[0]), "max_translation_m": region.half[3]}
            return refused(RefusalCode.TOO_FAR_FROM_START, rotation_deg=deg, translation_m=m, **reach)
    wrong = _check_match(found, config.refine.max_p_value)
    # Only of a search: a refinement has a start to rely on, and is fused with it. What intrinsics and clocks leave open is
    # not asked: more scenes would not help.
    if wrong is None and searched and objective.agreement is None:
        wrong = check_uncertainty(found.covariance, config.refine.tolerance_deg, config.refine.tolerance_m)
    if wrong is None and objective.agreement is not None:
        # If the edges, begun at the optimum of another objective, end far away, one of the two is wrong.
        deg, m = se3.error(T, objective.edges.optimise(T, False, progress))
        if not (deg <= objective.agreement[0] and m <= objective.agreement[1]):
            return refused(RefusalCode.OBJECTIVES_DISAGREE, rotation_deg=deg, translation_m=m)
    return wrong


def _check_match(found: Estimate, largest: float) -> Refusal | None:
    """Do LiDAR and image match at the optimum better than by chance? In doubt, the classes have a say."""
    T, evidence, ratio = found.alignment.T, found.evidence, 1.0
    if largest * RATIO_INCONSISTENT < evidence.p_value <= largest * RATIO_CONSISTENT:  # they can change the verdict
        kept = [f for k, f in enumerate(found.optimised.features) if k not in found.alignment.outliers]
        ratio = semantic_likelihood_ratio(consistency_score(views_of(kept)), T)
    if evidence.p_value <= largest * ratio:
        return None
    score, decoy_z = found.optimised.objective.edges.score.at(-1).value(T), evidence.decoy_z_score
    if not score > 0:  # that of the mean of the maps; less, or NaN, is of an image that shows nothing
        return refused(RefusalCode.LOW_SCORE, score=score)
    classes = "few labelled points meet pixels of their class there" if ratio < 1 else ""
    figures = {"z_score": evidence.z_score, "decoy_z": HIGHEST_DECOY_Z if decoy_z is None else decoy_z}
    figures |= {"p_value": evidence.p_value, "largest": largest * ratio, "inconsistent": ratio < 1}
    return refused(RefusalCode.NOT_SIGNIFICANT, classes, **figures)


def _check_intrinsics_and_clocks(found: Estimate, config: Config, camera: Camera, searched: bool) -> Refusal | None:
    """Are the intrinsics others than given, or the offset of the clocks? Where something is asked of the extrinsic."""
    optimised, objective, evidence, refine = found.optimised, found.optimised.objective, found.evidence, config.refine
    wrong, tolerance = check_offset(optimised, config.motion), (refine.tolerance_deg, refine.tolerance_m)
    limited = tolerance[0] < NO_LIMIT_DEG or tolerance[1] < NO_LIMIT_M
    if evidence.p_value > refine.max_p_value:  # where nothing matches, neither do clocks
        return None if wrong is None else replace(wrong, cause=None)
    fault = found.lens.fault(camera, *tolerance) if limited and found.lens is not None else None
    # A lens that is plainly wrong looks like other clocks, too, and those in vain: it is wrong at theirs as well.
    if fault is not None and (wrong is None or fault.code is RefusalCode.WRONG_INTRINSICS):
        return fault
    if wrong is not None or not limited:
        return wrong
    if not searched:
        return None
    moving = with_known_motion(optimised.features, objective.edges.score)
    # An offset that was found may be the best of those that were looked at only.
    if moving is not None and (optimised.seconds != 0 or not estimates_offset(optimised.features, config)):
        limits, prior_s = objective.constraints.limits, config.motion.time_offset_sigma_s
        inflated = inflation(evidence.disagreement)
        return refuse_clocks(moving[0], found.alignment.T, moving[1], limits, prior_s, tolerance, inflated)
    return None


def check_offset(optimised: Optimised, motion: MotionConfig) -> Refusal | None:
    """Is the time offset one that can be used, or does nothing near match?"""
    offset = optimised.offset
    if offset is None:
        return None
    in_all = motion.time_offset_s + optimised.seconds
    too_far = abs(optimised.seconds) > MAX_OFFSET_S or abs(in_all) > FARTHEST_OFFSET_S
    # Nobody is told of an offset that is not observable: the extrinsic would be that of other clocks.
    unobservable = optimised.seconds != 0 and not offset.observable(motion)
    if too_far or unobservable or offset.suspected(motion):
        return wrong_times(optimised.seconds if unobservable else offset.seconds, offset.gain)
    return None


def leaves_doubt(result: Result) -> bool:
    """Can classes change this result of an estimate without them? They help to find an optimum, and to tell it from chance."""
    if result.cause is not None or result.refusal in (RefusalCode.WRONG_INTRINSICS, RefusalCode.WRONG_TIMES):
        return False
    return not result.converged or result.evidence is None or result.evidence.z_score < UNDOUBTED_Z


def largest_sigmas(tolerance_deg: float, tolerance_m: float) -> tuple[float, float]:
    """Standard deviations, deg and m, of the axes of a rotation and a shift that are within the tolerance with 90 %, where the
    axes share it alike."""
    share = 1 / (WITH_90_PERCENT * np.sqrt(3))
    return share * tolerance_deg, share * tolerance_m


def check_uncertainty(covariance: Covariance, tolerance_deg: float, tolerance_m: float) -> Refusal | None:
    """Is an extrinsic of this covariance (6, 6) known to within the tolerance? Its rotation and its shift, with 90 %."""
    sigma = np.sqrt(np.diag(covariance))
    limits = largest_sigmas(tolerance_deg, tolerance_m)
    if max(np.rad2deg(np.linalg.norm(sigma[:3])) / limits[0], np.linalg.norm(sigma[3:]) / limits[1]) <= np.sqrt(3):
        return None
    told = ", ".join(map(str, open_directions(covariance, *limits)[:2])) + " (standard deviations)"
    return refused(RefusalCode.TOO_UNCERTAIN, told, tolerance_deg=tolerance_deg, tolerance_m=tolerance_m)


def semantic_likelihood_ratio(consistency: PointScore | None, T: Transform) -> float:
    """How much more probable classes make it that T_camera_lidar (4, 4) is right, by its rank in the null distribution; 1.0
    without classes."""
    if consistency is None:
        return 1.0
    level = consistency.n_levels - 1
    here, others = consistency.at(level).value(T), consistency.values(null_extrinsics(T), level)
    beaten_by = float((others > here).mean())
    if beaten_by <= CONSISTENT_RANK and here - others.mean() >= CONSISTENT_Z * others.std():
        return RATIO_CONSISTENT
    return RATIO_INCONSISTENT if beaten_by > INCONSISTENT_RANK else 1.0
