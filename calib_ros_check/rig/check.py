"""The check of a rig: every pair that shares a view is checked, and the graph of their edges says which sensor is off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import scipy

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.datasets.open import open_rig
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import Frame
from calib_ros.io import AsJson
from calib_ros.registration.judgement.judge import CONFIDENCE
from calib_ros.result import VERSION, Cause
from calib_ros.rig.description import MAX_SIGMA_DEG, MAX_SIGMA_M, RigDescription, prior_covariance, read_rig
from calib_ros.rig.edges import Measurement, Progress, RigMeasurer
from calib_ros.rig.graph import SIGNIFICANCE, Edge, RigSolution, solve
from calib_ros.rig.moved import CLOCK, MOVED, NOTHING, RigHypothesis, hypotheses, verdict
from calib_ros.rig.report import load, loop_dict
from calib_ros_check.checker import Checker
from calib_ros_check.outcome import CheckResult, CheckVerdict, Tolerance, plain
from calib_ros_check.recording import FRAMES, REFERENCE, TF, CheckOptions
from calib_ros_check.tolerance import INTERVAL, MORE_FRAMES, Judgement, judge, unknown

CLAIMED_S = 0.005  # standard deviation of a claimed offset of clocks: what drivers leave
PASS, FAIL, INCONCLUSIVE = CheckVerdict.PASS, CheckVerdict.FAIL, CheckVerdict.INCONCLUSIVE
OF_ONE_PAIR = ("camera", "image_topic", "points_topic", "camera_info_topic")


@dataclass(frozen=True, eq=False)
class Blame:
    """off: what each sensor that is off, or whose clock is, is said to be. doubts: what cannot be told apart, and what even this
    does not explain."""

    off: Mapping[str, str] = field(default_factory=dict)
    displaced: frozenset[str] = frozenset()
    doubts: tuple[str, ...] = ()


def claimed(
    poses: Mapping[str, Transform], reference: str, tolerance: Tolerance, edges: Sequence[Edge] = (), clock_s: float = 0.0
) -> RigSolution:
    """Poses T_reference_sensor (4, 4) as a solution of which the check asks: known so well that 95 % of errors are within the
    tolerance, which is no displacement. edges: whose offsets of clocks are claimed to be clock_s, s."""
    sigmas = np.array([tolerance.deg, tolerance.m]) / np.sqrt(2 * scipy.special.gammaincinv(3 / 2, INTERVAL))
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


@dataclass(frozen=True, eq=False)
class PairCheck:
    """The check of a pair: T_target_source as given, by a measured edge, None where there is none; or of a sensor's pose against
    the sensor `source`, in its own axes, by all edges. check: of a camera with a LiDAR; frame: one of its frames, to be drawn."""

    target: str
    source: str
    kind: str
    judgement: Judgement
    reason: str
    edge: Edge | None = None
    check: CheckResult | None = None
    frame: Frame | None = None

    @property
    def verdict(self) -> CheckVerdict:
        """With other causes than the extrinsic."""
        return self.judgement.verdict if self.check is None else self.check.verdict

    @property
    def trusted(self) -> Edge | None:
        """The edge, unless it is one of an optimum elsewhere that does not convince."""
        doubtful = self.verdict is INCONCLUSIVE and not self.judgement.p_within > 1 - CONFIDENCE
        return None if doubtful else self.edge

    @property
    def cause(self) -> Cause | None:
        """What else than the mount is wrong."""
        return None if self.check is None else self.check.cause


@dataclass(frozen=True, eq=False)
class RigCheck(AsJson):
    """Whether the extrinsics of a rig are right to within a tolerance.

    verdict: fail where any sensor fails, pass where all pass. given: T_reference_sensor (4, 4) as checked. sensors: by name; of
    one against itself no error is known. solution: by the pairs' edges alone, with loops, rejected and doubted edges. blame:
    which sensors explain what is off.
    """

    verdict: CheckVerdict
    reason: str
    tolerance: Tolerance
    given: Mapping[str, Transform]
    sensors: Mapping[str, PairCheck]
    pairs: Sequence[PairCheck]
    solution: RigSolution
    blame: Blame
    source: str = ""
    notes: Sequence[str] = ()
    cameras: Sequence[str] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain values, None for what is not known; docs/rig.md."""
        s = self.solution
        return {
            "verdict": self.verdict.value,
            "reason": self.reason,
            "source": self.source,
            "reference": s.reference,
            "tolerance": plain(self.tolerance),
            "sensors": {
                name: {**_told(own), "against": own.source,
                       "T_checked": plain(self.given[name]), "T_estimated": plain(s.poses[name]),
                       "covariance": plain(s.marginal(name))}
                for name, own in self.sensors.items()
            },
            "pairs": [
                {"target": p.target, "source": p.source, "kind": p.kind, **_told(p),
                 "check": None if p.check is None else p.check.to_dict()}
                for p in self.pairs
            ],
            "off": dict(self.blame.off),
            "rejected": [e.name for e in s.rejected],
            "doubted": [e.name for e in s.doubted],
            "loops": [loop_dict(loop) for loop in s.loops],
            "notes": list(self.notes),
            "version": VERSION,
        }  # fmt: skip


def _told(own: PairCheck) -> dict[str, Any]:
    parts = {name: plain(getattr(own.judgement, name)) for name in ("p_within", "rotation", "translation", "axes")}
    return {"verdict": own.verdict.value, "reason": own.reason, **parts}


def as_given(description: RigDescription, extrinsic: str = REFERENCE) -> RigDescription:
    """The description with the extrinsics that are to be checked as priors: its own by ``reference``, the recording's by ``tf``,
    or those of a result of `calib-ros rig`, a file. BadInputError for one of other sensors."""
    if extrinsic == REFERENCE:
        return description
    poses: Mapping[str, Transform] = {} if extrinsic == TF else load(extrinsic).poses
    missing = [s.name for s in description.sensors if s.name not in poses]
    if extrinsic != TF and missing:
        raise BadInputError(f"--extrinsic {extrinsic} has no {missing[0]}, but {', '.join(poses)}; give a result of this rig")
    base = None if extrinsic == TF else se3.inverse(poses[description.reference])
    sensors = [replace(s, prior=None if base is None else base @ poses[s.name]) for s in description.sensors]
    return replace(description, sensors=tuple(sensors))


def check_recording(path: str, options: CheckOptions, progress: Progress | None = None) -> RigCheck:
    """Check the rig that options describe by a recording. BadInputError for what cannot be read, or belongs to one pair."""
    for name in OF_ONE_PAIR:
        if getattr(options, name) is not None:
            raise BadInputError(f"--{name.replace('_', '-')} is of one pair; name topics in {options.rig}, or leave --rig out")
    description = as_given(read_rig(options.rig), options.extrinsic)
    given = {name: value for name in ("clock", "incomplete") if (value := getattr(options, name))}
    rig = open_rig(path, description, **given)
    return check_rig(RigMeasurer(rig, description, options.config, options.frames or FRAMES, progress), options.tolerance)


def as_row(found: RigCheck) -> dict[str, Any]:
    """The verdict with the errors of the worst pair, as of `CheckResult.to_dict`, for a fleet's table. Without an estimate, since
    histories are of one extrinsic. BadInputError where no camera was checked."""
    checks = [pair.check for pair in found.pairs if pair.check is not None]
    if not checks:
        reasons = "; ".join(p.reason for p in found.pairs) or "no camera shares a view with a LiDAR"
        raise BadInputError(f"{found.source}: {reasons}")
    worst = min(checks, key=lambda check: (FAIL, INCONCLUSIVE, PASS).index(check.verdict))
    return worst.to_dict() | {"verdict": found.verdict.value, "reason": found.reason, "T_estimated": None, "covariance": None}


def check_rig(measurer: RigMeasurer, tolerance: Tolerance) -> RigCheck:
    """Check the extrinsics that are the measurer's priors. Deterministic. A pair whose frames cannot be read is inconclusive."""
    known = measurer.solution([])
    between: dict[tuple[str, str], Measurement] = {}  # of every pair that with an edge, or the first
    for m in measurer.between_lidars():
        if m.edge is not None or (m.target, m.source) not in between:
            between[m.target, m.source] = m
    pairs = [_by_edge(known, m, tolerance) for m in between.values()]
    listed = measurer.camera_pairs(known)
    for k, (camera, lidar) in enumerate(listed):
        measurer.progress(f"{camera} with {lidar}", k / len(listed))
        edge, kind = None, "check"
        try:
            frames = measurer.frames_of(camera, lidar)
            checker = Checker(frames[0].camera, measurer.config_of(camera), scans=measurer.shared[lidar])
            found = checker.check(frames, known.between(camera, lidar)[0], tolerance)
        except CalibrationError as error:
            pairs.append(PairCheck(camera, lidar, kind, unknown(), str(error)))
            continue
        if found.T_estimated is not None and found.covariance_with_intrinsics is not None:
            offset, samples = (found.time_offset_s, found.time_offset_sigma_s), found.frames_used
            edge = Edge(camera, lidar, found.T_estimated, found.covariance_with_intrinsics, kind, *offset, samples=samples)
        judgement = Judgement(*(getattr(found, part.name) for part in fields(Judgement)))
        pairs.append(PairCheck(camera, lidar, kind, judgement, found.reason, edge, found, frames[len(frames) // 2]))
    joined = {pair.target for pair in pairs if pair.edge is not None}
    for camera in (name for name in measurer.description.cameras if name not in joined):
        pairs += [_by_edge(known, m, tolerance) for m in measurer.by_motion(camera, known)]
    return judged(known, measurer.description, pairs, tolerance, measurer.config.motion.time_offset_s, measurer.rig.name)


def judged(
    known: RigSolution,
    description: RigDescription,
    pairs: Sequence[PairCheck],
    tolerance: Tolerance,
    clock_s: float = 0.0,
    source: str = "",
) -> RigCheck:
    """What the checks of pairs say of the sensors. known: the rig as given. clock_s: offset of the clocks as configured, s."""
    edges = [pair.trusted for pair in pairs if pair.trusted is not None]
    # Priors as wide as they may be: what is checked must not speak for itself.
    wide = {n: (T, prior_covariance(T, MAX_SIGMA_DEG, MAX_SIGMA_M)) for n, T in known.poses.items() if n != known.reference}
    solution = solve(edges, wide, known.reference)
    mounts = [p.trusted for p in pairs if p.trusted is not None and p.cause in (None, Cause.TIME_OFFSET)]
    off = any(p.edge in mounts and p.judgement.p_within <= 1 - CONFIDENCE for p in pairs)
    clocks = any(p.cause is Cause.TIME_OFFSET for p in pairs)
    found = blame(claimed(known.poses, known.reference, tolerance, mounts if clocks else (), clock_s), mounts, off, clocks)
    # What the others are judged against: the reference, or, if that is off, the one that is known best to it.
    known_best = sorted(solution.columns, key=lambda name: float(np.trace(solution.marginal(name))))
    right = [name for name in (solution.reference, *known_best) if name not in found.displaced]
    anchor = right[0] if right else solution.reference
    causes = _causes(pairs, found)
    sensors = {
        s.name: _sensor(s.name, anchor, known, solution, pairs, tolerance, causes.get(s.name) or found.off.get(s.name, ""))
        for s in description.sensors
        if s.name != anchor
    }
    agree = [name for name, own in sensors.items() if own.verdict is PASS]
    told = f"and {', '.join(agree)} agree with it" if agree else "and none agrees with it"
    wrong = causes.get(anchor) or found.off.get(anchor, "")
    stands = FAIL if wrong else PASS if agree else INCONCLUSIVE
    told = wrong or f"the others are judged against it, {told}"
    sensors[anchor] = PairCheck(anchor, anchor, "", replace(unknown(), verdict=stands), told)
    notes = [f"the loop {', '.join(loop.sensors)} does not close: {loop.size[0]:.2f} deg, {100 * loop.size[1]:.1f} cm"
             for loop in solution.loops if not loop.closes]  # fmt: skip
    notes += [f"{e.name} contradicts the other pairs and is left out" for e in solution.rejected]
    notes += [f"{e.name} may be wrong: it cannot be told which of several pairs is" for e in solution.doubted]
    ordered = {s.name: sensors[s.name] for s in description.sensors}
    verdict, reason = _verdict(ordered, pairs, found, tolerance)
    return RigCheck(verdict, reason, tolerance, known.poses, ordered, pairs, solution, found, source, notes, description.cameras)


def _by_edge(known: RigSolution, m: Measurement, tolerance: Tolerance) -> PairCheck:
    if m.edge is None:
        return PairCheck(m.target, m.source, m.kind, unknown(), m.reason)
    judgement = judge(known.between(m.target, m.source)[0], m.edge.T, m.edge.covariance, tolerance)
    return PairCheck(m.target, m.source, m.kind, judgement, judgement.sizes, m.edge)


def _causes(pairs: Sequence[PairCheck], found: Blame) -> dict[str, str]:
    """By sensor, what else than its mount is wrong: points in another frame are the LiDAR's, the rest is the camera's, but for
    clocks that the graph tells."""
    out: dict[str, str] = {}
    for pair in pairs:
        finding = next((f for f in pair.check.causes if f.cause is pair.cause), None) if pair.check and pair.cause else None
        if finding is None or (finding.cause is Cause.TIME_OFFSET and {pair.target, pair.source} & found.off.keys()):
            continue
        out.setdefault(pair.source if finding.cause is Cause.CLOUD_FRAME else pair.target, finding.message)
    return out


def _sensor(
    name: str,
    anchor: str,
    known: RigSolution,
    solution: RigSolution,
    pairs: Sequence[PairCheck],
    tolerance: Tolerance,
    wrong: str,
) -> PairCheck:
    """A sensor against the anchor. wrong: what it is known to be, "" = nothing."""
    own = [pair for pair in pairs if name in (pair.target, pair.source)]
    if len(own) == 1 and anchor in (own[0].target, own[0].source):
        judgement, reason = own[0].judgement, own[0].reason
    elif any(pair.trusted is not None for pair in own):
        judgement = judge(known.between(name, anchor)[0], *solution.between(name, anchor), tolerance)
        reason = judgement.sizes
    else:
        judgement, reason = unknown(), "; ".join(pair.reason for pair in own) or f"no pair joins it to the others; {MORE_FRAMES}"
    return PairCheck(name, anchor, "", replace(judgement, verdict=FAIL) if wrong else judgement, wrong or reason)


def _verdict(
    sensors: Mapping[str, PairCheck], pairs: Sequence[PairCheck], found: Blame, tolerance: Tolerance
) -> tuple[CheckVerdict, str]:
    failed = {name: own for name, own in sensors.items() if own.verdict is FAIL}
    if failed:
        told = [own.reason if own.reason in found.off.values() else f"{name}: {own.reason}" for name, own in failed.items()]
        return FAIL, "; ".join(dict.fromkeys([*told, *found.doubts]))
    against = [f"{p.target} with {p.source}" for p in pairs if p.verdict is FAIL]
    if against:
        return INCONCLUSIVE, f"{', '.join(against)} alone would fail, but the other pairs contradict it; {MORE_FRAMES}"
    untold = [name for name, own in sensors.items() if own.verdict is INCONCLUSIVE]
    if untold:
        return INCONCLUSIVE, f"the scenes do not tell to within {tolerance} whether {', '.join(untold)} is right; {MORE_FRAMES}"
    return PASS, f"all {len(sensors)} sensors are right to within {tolerance}"
