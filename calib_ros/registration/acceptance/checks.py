"""Is the optimum of an estimate to be used? What speaks for it, and the checks that may refuse it.

`Acceptance.refusal` is the acceptance test; its single checks are functions of significance.py and of nuisance/. The node's
second test, over time, is the gate of online/tracker.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.config import NO_LIMIT_DEG, NO_LIMIT_M, Config
from calib_ros.config.sensors import MAX_OFFSET_S
from calib_ros.registration.acceptance.refusal import ObjectivesDisagree, Refusal, WrongTimes
from calib_ros.registration.acceptance.significance import (
    UNDOUBTED_Z,
    check_distance,
    check_improvement,
    check_significance,
    check_uncertainty,
    is_borderline,
    p_value,
    semantic_likelihood_ratio,
)
from calib_ros.registration.acceptance.split_half import disagreement, inflation
from calib_ros.registration.alignment import Alignment, ObservablePose
from calib_ros.registration.classes import consistency_score
from calib_ros.registration.features import FrameFeatures, views_of
from calib_ros.registration.joint import Optimised, estimates_offset
from calib_ros.registration.nuisance.lens import intrinsics
from calib_ros.registration.nuisance.parameters import NuisanceEstimate, estimate_parameters, wrong_parameter
from calib_ros.registration.nuisance.time_offset import ClockOffset, with_known_motion
from calib_ros.registration.objective import Objective, penalised
from calib_ros.registration.objective_maker import trust_region
from calib_ros.registration.progress import SILENT, Progress
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.registration.search.search import SearchResult, search_decoy
from calib_ros.result import Evidence


@dataclass(frozen=True, eq=False)
class Acceptance:
    """The checks of an estimate. image_width: px, of the recorded image. box: that was searched, if any."""

    config: Config
    image_width: int
    box: SearchBox | None

    @property
    def searched(self) -> bool:
        """Whether a search led to it."""
        return self.box is not None and not self.box.is_empty

    def evidence(self, objective: Objective, alignment: Alignment, search: SearchResult | None) -> Evidence:
        """What speaks for the optimum. Without a search, in doubt, a decoy is searched as far as a refinement goes."""
        score, limits, z_score = objective.edges.score, objective.constraints.limits, alignment.null.z_score
        decoy_z, rounds = (None, 1) if search is None else (search.decoy_z, search.rounds)
        if z_score < UNDOUBTED_Z and decoy_z is None:
            deg, m = trust_region()
            box = SearchBox(min(deg, SearchBox.MAX_DEG), min(m, SearchBox.MAX_M))
            decoy_z = search_decoy(score, alignment.T, box, self.config.search, limits)
        halves = disagreement(objective.smooth_score(alignment.T), alignment.T, limits)
        return Evidence(z_score, decoy_z, p_value(z_score, decoy_z, rounds), halves)

    def refusal(
        self,
        objective: Objective,
        initial: Transform,
        start: Transform,
        optimised: Optimised,
        alignment: Alignment,
        evidence: Evidence,
        pose: ObservablePose,
        intrinsics: Sequence[NuisanceEstimate],
        progress: Progress = SILENT,
    ) -> Refusal | None:
        """Why the extrinsic of an estimate from `initial` (4, 4) is not to be used: the first check that fails. start: what the
        constraints leave of initial."""
        score, initial_score = objective.value(pose.T), objective.value(start)
        is_worse = penalised(objective, pose.T) < penalised(objective, start)
        return (
            check_improvement(is_worse, score, initial_score)
            or self.check_sensors(objective, alignment, evidence, optimised, intrinsics)
            or check_distance(initial, alignment.T, objective.constraints.limits)
            or self.check_match(optimised.features, objective, alignment, evidence)
            or self.check_uncertainty(objective, pose)
            or check_agreement(objective, pose.T, progress)
        )

    def check_match(
        self, features: Sequence[FrameFeatures], objective: Objective, alignment: Alignment, evidence: Evidence
    ) -> Refusal | None:
        """Do LiDAR and image match at the optimum better than by chance? In doubt, the classes have a say."""
        kept = [f for k, f in enumerate(features) if k not in alignment.outliers]
        views = views_of(kept)
        largest, ratio = self.config.refine.max_p_value, 1.0
        if is_borderline(evidence.p_value, largest):
            ratio = semantic_likelihood_ratio(consistency_score(views), alignment.T)
        score = objective.edges.score.at(-1).value(alignment.T)
        return check_significance(score, evidence.z_score, evidence.decoy_z_score, evidence.p_value, largest, ratio)

    def intrinsics(self, objective: Objective, alignment: Alignment, evidence: Evidence) -> tuple[NuisanceEstimate, ...]:
        """What the scenes tell of the intrinsics at the optimum; far from the given ones only where that may refuse it."""
        parameters = intrinsics(self.config.camera, self.image_width)
        search, inflated = self._asks_sensors(evidence), inflation(evidence.disagreement)
        return estimate_parameters(parameters, objective.edges.score, alignment.T, objective.constraints.limits, inflated, search)

    def _asks_sensors(self, evidence: Evidence) -> bool:
        """Of a search, whose optimum is new, where it is not one of chance, and something is asked of the extrinsic."""
        refine = self.config.refine
        limited = refine.tolerance_deg < NO_LIMIT_DEG or refine.tolerance_m < NO_LIMIT_M
        return self.searched and limited and evidence.p_value <= refine.max_p_value

    def check_sensors(
        self,
        objective: Objective,
        alignment: Alignment,
        evidence: Evidence,
        optimised: Optimised,
        intrinsics: Sequence[NuisanceEstimate],
    ) -> Refusal | None:
        """Are the intrinsics others than given, or the offset of the clocks?"""
        features, wrong = optimised.features, self._check_offset(optimised)
        if wrong is not None or not self._asks_sensors(evidence):
            return wrong
        refine, motion, inflated = self.config.refine, self.config.motion, inflation(evidence.disagreement)
        found = list(intrinsics)
        moving = with_known_motion(features, objective.edges.score)
        # An offset that was found may be the best of those that were looked at only.
        unknown = optimised.seconds != 0 or not estimates_offset(features, self.config)
        if moving is not None and unknown:
            clocks = ClockOffset(motion.time_offset_sigma_s, moving[1])
            found += estimate_parameters([clocks], moving[0], alignment.T, objective.constraints.limits, inflated, search=True)
        return wrong_parameter(found, refine.tolerance_deg, refine.tolerance_m)

    def _check_offset(self, optimised: Optimised) -> WrongTimes | None:
        """Is the time offset one that can be used, or does nothing near match?"""
        offset, motion = optimised.offset, self.config.motion
        if offset is None:
            return None
        too_far = abs(motion.time_offset_s + optimised.seconds) > MAX_OFFSET_S
        # Nobody is told of an offset that is not observable: the extrinsic would be that of other clocks.
        unobservable = optimised.seconds != 0 and not offset.observable(motion)
        if too_far or unobservable or offset.suspected(motion):
            return WrongTimes(optimised.seconds if unobservable else offset.seconds, offset.gain)
        return None

    def check_uncertainty(self, objective: Objective, pose: ObservablePose) -> Refusal | None:
        """Do the scenes tell the extrinsic well enough? Only of a search: a refinement has a start to rely on, and is fused with
        it. What intrinsics and clocks leave open is not asked: more scenes would not help."""
        if not self.searched or objective.agreement is not None:
            return None
        return check_uncertainty(pose.covariance, self.config.refine.tolerance_deg, self.config.refine.tolerance_m)


def check_agreement(objective: Objective, T: Transform, progress: Progress = SILENT) -> ObjectivesDisagree | None:
    """If the edges, begun at the optimum T (4, 4) of another objective, end far away, one of the two is wrong."""
    if objective.agreement is None:
        return None
    other = objective.edges.optimise(T, False, progress)
    deg, m = se3.rotation_error_deg(T, other), se3.translation_error_m(T, other)
    return None if deg <= objective.agreement[0] and m <= objective.agreement[1] else ObjectivesDisagree(deg, m)
