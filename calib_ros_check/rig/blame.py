"""Which sensors explain that edges of a rig are not as claimed: one that all its pairs share is named, rather than each pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import chi

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.rig.description import prior_covariance
from calib_ros.rig.graph import SIGNIFICANCE, Edge, RigSolution
from calib_ros.rig.moved import CLOCK, MOVED, NOTHING, RigHypothesis, hypotheses, verdict
from calib_ros_check.outcome import Tolerance
from calib_ros_check.tolerance import INTERVAL

CLAIMED_S = 0.005  # standard deviation of a claimed offset of clocks: what drivers leave


@dataclass(frozen=True, eq=False)
class Blame:
    """off: what each sensor that is off, or whose clock is, is said to be. doubts: what cannot be told apart, and what even this
    does not explain."""

    off: Mapping[str, str] = field(default_factory=dict)
    displaced: frozenset[str] = frozenset()
    doubts: tuple[str, ...] = ()

    @property
    def lines(self) -> tuple[str, ...]:
        """For people, each explanation once."""
        return tuple(dict.fromkeys([*self.off.values(), *self.doubts]))


def claimed(
    poses: Mapping[str, Transform], reference: str, tolerance: Tolerance, edges: Sequence[Edge] = (), clock_s: float = 0.0
) -> RigSolution:
    """Poses T_reference_sensor (4, 4) as a solution of which the check asks: known so well that 95 % of errors are within the
    tolerance, which is no displacement. edges: whose offsets of clocks are claimed to be clock_s, s."""
    sigmas = np.array([tolerance.deg, tolerance.m]) / chi.ppf(INTERVAL, 3)
    others = [name for name in poses if name != reference]
    covariance = np.zeros((6 * len(others), 6 * len(others)))
    for k, name in enumerate(others):
        covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = prior_covariance(poses[name], *sigmas)
    told = [replace(e, time_offset_s=clock_s, time_sigma_s=CLAIMED_S) for e in edges if e.time_offset_s is not None]
    return RigSolution(reference, poses, covariance, tuple(told))


def blame(before: RigSolution, edges: Sequence[Edge], off: bool, clocks: bool) -> Blame:
    """Sensors whose displacements, or clocks, explain edges against what is claimed, the most probable one first, until what is
    left is within what is claimed. off, clocks: whether any pair is known to be off, or to have wrong clocks."""
    kinds = {MOVED: off, CLOCK: clocks}
    names: dict[str, str] = {}
    displaced: set[str] = set()
    doubts: list[str] = []
    for k in range(len(before.poses) if edges and (off or clocks) else 0):
        # At first it is known that something is wrong.
        found = [h for h in hypotheses(before, edges) if kinds.get(h.kind, k > 0) and not {*h.sensors} & {*names}]
        total = sum(h.posterior for h in found)
        likely = verdict([replace(h, posterior=h.posterior / total) for h in found])[0] if total > 0 else ()
        # Of several that are off, none explains all: the first of them is as good as the next.
        several = len(likely) > 1 and max(h.p_value for h in likely) < SIGNIFICANCE
        if likely and several and likely[0].kind != NOTHING:
            likely = likely[:1]
        if len(likely) != 1 or likely[0].kind == NOTHING:
            some = [h for h in likely if h.kind != NOTHING]
            if len(some) == len(likely) > 1:
                doubts.append(f"cannot tell between: {'; '.join(map(_words, likely))}")
            elif likely and likely[0].p_value < SIGNIFICANCE:
                doubts.append("the edges fit badly even so: one of them may be wrong")
            break
        names |= dict.fromkeys(likely[0].sensors, _words(likely[0]))
        displaced |= {*likely[0].sensors} if likely[0].kind == MOVED else set()
        before = _after(before, likely[0])
    return Blame(names, frozenset(displaced), tuple(doubts))


def _words(found: RigHypothesis) -> str:
    text = str(found).replace(" moved by ", " is off by ").replace(" jumped by ", " is off by ")
    return f"{text} against {', '.join(found.others)}" if found.kind == MOVED else text


def _after(before: RigSolution, found: RigHypothesis) -> RigSolution:
    """The claim with what was found put right, as well as it is known."""
    if found.kind == CLOCK:
        late = float(found.displacement[0])
        sides = {e: (e.source == found.sensors[0]) - (e.target == found.sensors[0]) for e in before.edges}
        edges = [replace(e, time_offset_s=(e.time_offset_s or 0.0) + sides[e] * late) for e in before.edges]
        return replace(before, edges=tuple(edges))
    # Where the reference is among them, all others are displaced the other way.
    moves = [n for n in before.columns if (n in found.sensors) != (before.reference in found.sensors)]
    D = se3.exp(found.displacement)
    D = se3.inverse(D) if before.reference in found.sensors else D
    share = np.zeros((len(before.covariance), 6))
    for name in moves:
        share[before.columns[name]] = np.eye(6)
    poses = {name: D @ T if name in moves else T for name, T in before.poses.items()}
    covariance: Matrix = before.covariance + share @ found.covariance @ share.T
    return replace(before, poses=poses, covariance=covariance)
