"""A rig while it drives: from what its pairs say of themselves to one solution, what of it to rely on, and which sensor moved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from calib_ros.arrays import Covariance, Transform
from calib_ros.config import RefineConfig
from calib_ros.result import CONVERGED, INITIAL, INSUFFICIENT, MOVED, REFUSED, SUSPECT, TENTATIVE, Extrinsic, LensEffect
from calib_ros.rig.description import RigDescription
from calib_ros.rig.edges import Measurement, apart
from calib_ros.rig.graph import PRIOR, Edge, RigSolution, joined_to, solve
from calib_ros.rig.moved import MOVED as KNOCKED
from calib_ros.rig.moved import hypotheses, verdict
from calib_ros.rig.report import RigReport

UNCHECKED = "unchecked"  # status of a sensor whose pairs get no data
KIND = "registration"
Pair = tuple[str, str]  # camera and LiDAR, or two LiDARs: target, source


@dataclass(frozen=True, eq=False)
class PairState:
    """What a pair says of itself. extrinsic: None before its first messages; of two LiDARs, T_target_source. usable: to be relied
    on now. unchecked: why it is not looked at any more, naming the silent sensor; "" = it is. kind: of the edge."""

    target: str
    source: str
    extrinsic: Extrinsic | None = None
    usable: bool = False
    unchecked: str = ""
    kind: str = KIND

    @property
    def pair(self) -> Pair:
        """Target, source."""
        return self.target, self.source

    @property
    def status(self) -> str:
        """Of the extrinsic."""
        return INITIAL if self.extrinsic is None else self.extrinsic.result.status

    @property
    def reason(self) -> str:
        """Why not to rely on it, for a person."""
        own = "" if self.extrinsic is None else self.extrinsic.result.reason
        return self.unchecked or f"{self.target} with {self.source}: {own or self.status}"

    def edge(self, of_camera: LensEffect | None = None) -> Edge | None:
        """What it has measured; None while it has not, or what it had does not hold any more. of_camera: what the lens does to
        another pair of its camera, from which this one is known as far as it does the same here."""
        extrinsic = self.extrinsic
        if extrinsic is None or self.status in (INITIAL, MOVED) or not (extrinsic.accepted or extrinsic.usable):
            return None
        r = extrinsic.result
        C = r.covariance
        if C is None:
            return None
        if of_camera is not None and r.lens_effect is not None:
            C = C + apart(r.lens_effect, of_camera)
        offset = (r.time_offset_s, r.time_offset_sigma_s)
        return Edge(*self.pair, r.T_camera_lidar, C, self.kind, *offset, samples=r.frames_used)


@dataclass(frozen=True, eq=False)
class SensorState:
    """T: T_reference_sensor (4, 4). covariance: (6, 6) of its left twist. moved: deg and m of its last displacement."""

    name: str
    T: Transform
    covariance: Covariance
    status: str
    reason: str = ""
    usable: bool = False
    moved: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class RigState:
    """report: on the solution, without the names of frames and intrinsics. moved: sensors that have been displaced and are not
    found again. text: what is known of the last displacement. pairs: what it follows from."""

    report: RigReport
    sensors: tuple[SensorState, ...]
    moved: tuple[str, ...] = ()
    text: str = ""
    pairs: tuple[PairState, ...] = ()

    @property
    def solution(self) -> RigSolution:
        """Where the sensors are."""
        return self.report.solution

    def __str__(self) -> str:
        used = [s.name for s in self.sensors if s.usable]
        out = f"{len(used)} of {len(self.sensors)} sensors usable"
        parts = [out, self.text, *(f"{e.name} contradicts the others" for e in self.solution.rejected)]
        parts += [f"loop {', '.join(loop.sensors)} does not close" for loop in self.solution.loops if not loop.closes]
        return "; ".join(filter(None, parts))


class LiveRig:
    """Solves the graph from the newest extrinsics of the pairs, and compares with the solution from before where one has moved.

    limits: what every sensor has to be known to. Not thread-safe.
    """

    def __init__(self, description: RigDescription, limits: RefineConfig) -> None:
        self._description, self._limits = description, limits
        self._before: RigSolution | None = None  # the newest while all pairs agreed with their extrinsics
        self._lost: set[Pair] = set()  # pairs that have moved since
        self._named: tuple[str, ...] = ()  # what has moved, by the edges since
        self._sizes: dict[str, tuple[float, float]] = {}
        self._told = ""

    def update(self, pairs: Sequence[PairState], priors: Mapping[str, tuple[Transform, Covariance]]) -> RigState:
        """The state from what all pairs say. priors: T_reference_sensor and its covariance, of the sensors that have one."""
        reference = self._description.reference
        known = [p for p in pairs if all(name in priors or name == reference for name in p.pair)]
        lenses: dict[str, LensEffect] = {}
        for p in known:
            if p.edge() is not None and p.extrinsic is not None and p.extrinsic.result.lens_effect is not None:
                lenses.setdefault(p.target, p.extrinsic.result.lens_effect)
        edges = {p.pair: e for p in known if (e := p.edge(lenses.get(p.target))) is not None}
        solution = solve(list(edges.values()), priors, reference)
        moved = self._moved(known, edges)
        if not self._lost and not any(p.status == SUSPECT for p in known):
            confirmed = [edges[p.pair] for p in known if p.pair in edges and p.status != TENTATIVE]
            self._before = solution if len(confirmed) == len(edges) else solve(confirmed, priors, reference)
        measured = [Measurement(*p.pair, p.kind, edges.get(p.pair), p.reason) for p in known]
        report = RigReport(self._description, solution, measured, {}, {}, limits=self._limits)
        rejected = {(e.target, e.source) for e in (*solution.rejected, *solution.doubted) if e.kind != PRIOR}
        joined = joined_to(reference, [p.pair for p in known if p.usable and p.pair in edges and p.pair not in rejected])
        sensors = tuple(self._sensor(name, report, joined, moved, known) for name in solution.poses)
        return RigState(report, sensors, moved, self._told, tuple(pairs))

    def _sensor(
        self, name: str, report: RigReport, joined: set[str], moved: Sequence[str], pairs: Sequence[PairState]
    ) -> SensorState:
        (status, reason), own = report.status(name), [p for p in pairs if name in p.pair]
        usable = name in joined and name not in moved
        if usable and status == REFUSED:  # as uncertain as it is, its pairs are to be relied on
            status = INSUFFICIENT
        if name in moved:
            status, reason = MOVED, self._told
        elif not usable and (objecting := [p for p in own if not p.usable]):
            # What a pair says now is nearer to the cause than what the graph lacks for it.
            first = min(objecting, key=lambda p: (not p.unchecked, p.status in (INITIAL, CONVERGED)))
            if first.unchecked or first.status != CONVERGED:
                status, reason = UNCHECKED if first.unchecked else first.status, first.reason
        solution = report.solution
        return SensorState(
            *(name, solution.poses[name], solution.marginal(name), status, reason, usable), self._sizes.get(name, (0.0, 0.0))
        )

    def _moved(self, pairs: Sequence[PairState], edges: Mapping[Pair, Edge]) -> tuple[str, ...]:
        """The sensors that have been displaced and are not found again."""
        lost = {p.pair for p in pairs if p.status == MOVED}
        if lost and not self._lost:
            self._named = ()
        self._lost |= lost
        if not any(p.pair in self._lost and not p.usable for p in pairs):
            if self._lost:  # all have just been found again
                self._compare(pairs, edges)
            self._lost = set()
            return ()
        if self._lost - lost and self._before is not None:
            self._compare(pairs, edges)
        # A sensor that all lost pairs have in common, else all those without a pair that fits.
        fitting = {name for p in pairs if p.usable and p.pair not in self._lost for name in p.pair}
        names = sorted({name for pair in self._lost for name in pair} - fitting)
        who = tuple([name for name in names if all(name in pair for pair in self._lost)] or names)
        if lost and not self._named:
            self._told = f"{' or '.join(who)} moved; by how much is being estimated"
        return self._named or who

    def _compare(self, pairs: Sequence[PairState], edges: Mapping[Pair, Edge]) -> None:
        """Name what moved by the edges since: of pairs that are found again, and of those that have been tested all the time."""
        if self._before is None:  # by how much is not known
            self._told = self._told.partition(";")[0]
            return
        known = self._before.poses.keys()  # TF may have told of further sensors since
        after = [edges[p.pair] for p in pairs if p.pair in edges and (p.usable or p.pair in self._lost) and known >= {*p.pair}]
        if not after:
            return
        likely, self._told = verdict(hypotheses(self._before, after))
        if len(likely) == 1 and likely[0].kind == KNOCKED:
            self._named = likely[0].sensors
            self._sizes |= dict.fromkeys(self._named, likely[0].size)
