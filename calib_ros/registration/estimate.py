"""What an estimate found, and the Result that reports it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calib_ros.arrays import Transform
from calib_ros.config import MotionConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.intrinsics import IntrinsicEstimate
from calib_ros.registration.acceptance.refusal import NO_INTENSITY, ONE_FRAME, Refusal, joined, outliers_note, unobservable_note
from calib_ros.registration.alignment import Alignment, ObservablePose
from calib_ros.registration.joint import Optimised
from calib_ros.registration.nuisance.covariance import Nuisance
from calib_ros.registration.nuisance.parameters import NuisanceEstimate
from calib_ros.registration.objective import Objective
from calib_ros.result import CONVERGED, INSUFFICIENT, REFUSED, Evidence, RefusalCode, Result


@dataclass(frozen=True, eq=False)
class Estimate:
    """The steps of an estimate from `initial` (4, 4), one after the other. start: what the constraints leave of it. refusal: None
    = accepted."""

    initial: Transform
    start: Transform
    optimised: Optimised
    alignment: Alignment
    evidence: Evidence
    pose: ObservablePose
    intrinsics: Sequence[NuisanceEstimate]
    nuisance: Nuisance
    refusal: Refusal | None

    def result(self, objective: Objective, motion: MotionConfig, notes: Sequence[str]) -> Result:
        """The Result, with the extrinsic that it started from where it is refused. notes: for its reason."""
        features, refusal, search = self.optimised.features, self.refusal, self.optimised.search
        names = [f.name or str(k) for k, f in enumerate(features)]
        outliers, clocks, largest_s = [names[k] for k in self.alignment.outliers], self.nuisance.clocks, motion.max_time_offset_s
        used = len(features) - len(outliers)
        known = None if refusal or not self.offset_is_known(motion) else self.optimised
        reasons = [
            str(refusal) if refusal else "",
            *notes,
            outliers_note(outliers) if outliers else "",
            unobservable_note(self.pose.unobservable) if self.pose.unobservable else "",
            "" if all(f.has_reflectivity for f in features) else NO_INTENSITY,
            ONE_FRAME if used == 1 else "",
        ]
        return Result(
            self.initial if refusal else self.pose.T,
            REFUSED if refusal else CONVERGED,
            joined(reasons),
            frames_used=used,
            initial=self.initial,
            frame_names=tuple(names),
            frames_left_out=tuple(outliers),
            refusal=refusal.code if refusal else None,
            refusal_figures=refusal.figures if refusal else {},
            optimum=self.pose.T if refusal else None,
            data_stamp=max(f.stamp for f in features),
            score=objective.value(self.pose.T),
            initial_score=objective.value(self.start),
            evidence=self.evidence,
            frame_scores=tuple(float(s) for s in objective.frame_scores(self.pose.T)),
            starts=None if search is None else (search.agreed, search.optimised),
            intrinsics={e.parameter.name: _intrinsic(e) for e in self.intrinsics},
            covariance=None if refusal else self.pose.covariance + self.nuisance.covariance,
            shared_covariance=None if refusal else self.nuisance.covariance,
            clock_covariance=None if refusal or clocks is None else clocks.covariance(largest_s),
            clock_sigma_s=None if refusal or clocks is None else clocks.sigma(largest_s),
            time_offset_s=None if known is None else motion.time_offset_s + known.seconds,
            time_offset_sigma_s=None if known is None else known.clocks(motion)[0],
            stamping=None if known is None else known.stamping,
        )

    def offset_is_known(self, motion: MotionConfig) -> bool:
        """Whether the scenes tell the offset of the clocks."""
        return self.optimised.offset is not None and self.optimised.offset.observable(motion)


def _intrinsic(estimate: NuisanceEstimate) -> IntrinsicEstimate:
    unit = estimate.parameter.unit
    return IntrinsicEstimate(unit * estimate.value, unit * estimate.sigma, estimate.is_observable)


def insufficient(error: TooFewFeaturesError, initial: Transform, frames: int, notes: Sequence[str]) -> Result:
    """The Result where the frames show too little to estimate anything."""
    reason, code = joined([str(error), *notes]), RefusalCode.TOO_FEW_FEATURES
    return Result(initial, INSUFFICIENT, reason, frames_used=frames, initial=initial, refusal=code)
