"""The graph of a rig: measured transforms between its sensors and what was believed before, in one estimate with a covariance.

A least-squares problem on the tangent space of all poses at once (Dellaert and Kaess 2017). A wrong edge is found by what it
costs in the loops through it, tested by chi^2, and told.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.errors import BadInputError

SIGNIFICANCE = 1e-3  # of all tests of a solution together: one good rig in a thousand is said to have a wrong edge
SURE = 0.95  # posterior probability at which one of several is named
ITERATIONS, STEP = 50, 1e-9  # of Gauss and Newton, which take about five; rad and m
NOTHING_SAID = 1e6  # times its covariance, a factor says nothing
PRIOR = "prior"
TOLD = 0.5  # of the information about a direction; what is told less by the edges rests on the prior


@dataclass(frozen=True, eq=False)
class Edge:
    """A measured transform between two sensors.

    T: T_target_source (4, 4). covariance: (6, 6) of a left twist, in the target's frame, rad and m. kind: for people, how it was
    measured. time_offset_s, time_sigma_s: of the source's clock against the target's, positive = the source measured later than
    stamped; None = unknown. twist: (6,) mean velocity of the source, rad/s and m/s in its own frame, by which a clock that is off
    moves T; None = unknown. samples: frames in it.
    """

    target: str
    source: str
    T: Transform
    covariance: Covariance
    kind: str = ""
    time_offset_s: float | None = None
    time_sigma_s: float | None = None
    twist: Matrix | None = None
    samples: int = 0

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.target}-{self.source}" + (f" ({self.kind})" if self.kind else "")


@dataclass(frozen=True, eq=False)
class Loop:
    """A closed chain of edges. sensors: along it. residual: (6,) twist of the transforms around it, rad and m. p_value: of so
    much disagreement or more, were all edges as good as their covariances. closes: it is not significant."""

    sensors: tuple[str, ...]
    residual: Matrix
    p_value: float
    closes: bool

    @property
    def size(self) -> tuple[float, float]:
        """deg, m."""
        return float(np.rad2deg(np.linalg.norm(self.residual[:3]))), float(np.linalg.norm(self.residual[3:]))


@dataclass(frozen=True, eq=False)
class RigSolution:
    """Where the sensors of a rig are.

    poses: T_reference_sensor (4, 4) by name, the reference among them. covariance: (6 m, 6 m) of left twists of the m others in
    the order of `poses`, rad and m. edges: that were used; rejected: that contradict the others; doubted: one of these is wrong,
    it cannot be told which, and all count less. open: for sensors, left twists (k, 6) along which their pose rests on the prior,
    turns in rad and shifts in m of one standard deviation. prior: (T, covariance) by name.
    """

    reference: str
    poses: Mapping[str, Transform]
    covariance: Matrix
    edges: tuple[Edge, ...]
    rejected: tuple[Edge, ...] = ()
    doubted: tuple[Edge, ...] = ()
    loops: tuple[Loop, ...] = ()
    open: Mapping[str, Matrix] = field(default_factory=dict)
    prior: Mapping[str, tuple[Transform, Covariance]] = field(default_factory=dict)

    @cached_property
    def columns(self) -> dict[str, slice]:
        """Where the twist of a sensor is in the covariance; none of the reference."""
        others = [name for name in self.poses if name != self.reference]
        return {name: slice(6 * k, 6 * k + 6) for k, name in enumerate(others)}

    def marginal(self, name: str) -> Covariance:
        """(6, 6) of a sensor's pose; 0 of the reference."""
        return self.covariance[self.columns[name], self.columns[name]] if name in self.columns else np.zeros((6, 6))

    def between(self, target: str, source: str) -> tuple[Transform, Covariance]:
        """T_target_source (4, 4) and its covariance (6, 6) by the whole rig."""
        P, A = predicted(self.poses, self.columns, target, source)
        return P, A @ self.covariance @ A.T


def at_sensor(T: Transform, covariance: Covariance) -> Covariance:
    """Covariance (6, 6) of the turn and place of a sensor, rad and m in the reference's axes, from that of the left twist of its
    pose T (4, 4)."""
    J = se3.parts_jacobian(T)
    return np.asarray(J @ covariance @ J.T)


def worst_sigmas(covariance: Covariance) -> tuple[float, float]:
    """Standard deviations along the worst directions of a covariance (6, 6), rotation first, in rad and m: deg and m."""
    turn, shift = (float(np.sqrt(max(np.linalg.eigvalsh(block)[-1], 0))) for block in (covariance[:3, :3], covariance[3:, 3:]))
    return float(np.rad2deg(turn)), shift


def predicted(poses: Mapping[str, Transform], columns: Mapping[str, slice], target: str, source: str) -> tuple[Transform, Matrix]:
    """T_target_source (4, 4) by the poses, and how its left twist (6, n) follows from those of the poses, in the reference's
    frame: T_target' = exp(a) T_target and T_source' = exp(b) T_source give exp(Ad(T_target^-1) (b - a)) T_target_source."""
    inverse = se3.inverse(poses[target])
    A = np.zeros((6, 6 * len(columns)))
    along = se3.adjoint(inverse)
    if source in columns:
        A[:, columns[source]] = along
    if target in columns:
        A[:, columns[target]] = -along
    return inverse @ poses[source], A


def root_information(covariance: Covariance) -> Matrix:
    """W (6, 6) with W^T W = covariance^-1; in units of the axes, along which some are known a million times better."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 1e-18))
    values, vectors = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    return np.asarray((vectors / np.sqrt(np.maximum(values, 1e-12))).T / sigma)


Priors = Mapping[str, tuple[Transform, Covariance]]


def solve(edges: Sequence[Edge], priors: Priors, reference: str) -> RigSolution:
    """The poses of all sensors from edges between them and from priors, robust against wrong ones of either.

    priors: T_reference_sensor (4, 4) and its covariance (6, 6) of every sensor but the reference. BadInputError for an edge of
    another sensor.
    """
    for edge in edges:
        for name in (edge.target, edge.source):
            if name != reference and name not in priors:
                raise BadInputError(f"edge {edge.name}: {name} has no prior; the rig has {', '.join([reference, *priors])}")
    factors = [*edges, *(Edge(reference, name, T, C, PRIOR) for name, (T, C) in priors.items())]
    left_out: list[int] = []
    doubted: list[int] = []
    names = list(priors)
    freedom = 6 * len(edges)  # every edge adds six measurements and no unknown
    while True:
        poses, covariance, cost = _solved(factors, names, reference)
        tried = [k for k in range(len(factors)) if k not in left_out and k not in doubted]
        if not tried or freedom <= 0 or not scipy.special.chdtrc(freedom, cost) <= SIGNIFICANCE:
            break
        drops = np.array([cost - _solved(_scaled(factors, [k], NOTHING_SAID), names, reference)[2] for k in tried])
        # Those of which one is wrong, as far as one is sure.
        order = np.argsort(-drops, kind="stable")
        known = np.cumsum(np.exp(drops[order] / 2 - scipy.special.logsumexp(drops / 2)))
        wrong = [tried[k] for k in order[: int(np.searchsorted(known, SURE)) + 1]]
        if len(wrong) == 1:
            factors, freedom = _scaled(factors, wrong, NOTHING_SAID), freedom - 6
            left_out += wrong
            continue
        # Which of them is wrong cannot be told: all are believed less, by how much too far they are apart (Birge 1932).
        factors = _scaled(factors, wrong, max(cost / freedom, drops.max() / 6))
        doubted += wrong
    used = tuple(f for k, f in enumerate(factors[: len(edges)]) if k not in left_out)
    given = [*edges, *factors[len(edges) :]]
    solution = RigSolution(
        reference, poses, covariance, used, tuple(given[k] for k in left_out), tuple(given[k] for k in doubted), prior=priors
    )
    return replace(solution, loops=closed_loops(edges, reference), open=_open(solution, factors))


def _scaled(factors: Sequence[Edge], which: Sequence[int], scale: float) -> list[Edge]:
    """The same with the covariances of some multiplied."""
    return [replace(f, covariance=scale * f.covariance) if k in which else f for k, f in enumerate(factors)]


def _solved(factors: Sequence[Edge], names: Sequence[str], reference: str) -> tuple[dict[str, Transform], Matrix, float]:
    """The least-squares estimate: poses, their covariance, and chi^2."""
    columns = {name: slice(6 * k, 6 * k + 6) for k, name in enumerate(names)}
    roots = [root_information(f.covariance) for f in factors]
    poses = {reference: np.eye(4)}  # by the most certain factors from there on: nearer than priors to where the estimate ends
    for before, name, edge in _tree(factors, reference):
        poses[name] = poses[before] @ (edge.T if edge.target == before else se3.inverse(edge.T))
    poses = {name: poses[name] for name in (reference, *names)}
    for _ in range(ITERATIONS):
        r, J = _linear(factors, roots, poses, columns)
        step = np.linalg.lstsq(J, r, rcond=None)[0]
        poses = {n: se3.exp(step[columns[n]]) @ T if n in columns else T for n, T in poses.items()}
        if np.abs(step).max() < STEP:
            break
    r, _ = _linear(factors, roots, poses, columns)
    return poses, _covariance(factors, poses, columns), float(r @ r)


def _covariance(factors: Sequence[Edge], poses: Mapping[str, Transform], columns: Mapping[str, slice]) -> Matrix:
    """Of all poses (n, n), by the factors."""
    inverse = np.linalg.pinv(_linear(factors, [root_information(f.covariance) for f in factors], poses, columns)[1], rcond=1e-12)
    return np.asarray(inverse @ inverse.T)


def _linear(
    factors: Sequence[Edge], roots: Sequence[Matrix], poses: Mapping[str, Transform], columns: Mapping[str, slice]
) -> tuple[Matrix, Matrix]:
    """Whitened residuals log(T P^-1) of measured T and predicted P, and how much of them a step of the poses takes away."""
    rs, Js = [], []
    for factor, W in zip(factors, roots, strict=True):
        P, A = predicted(poses, columns, factor.target, factor.source)
        rs.append(W @ se3.log(factor.T @ se3.inverse(P)))
        Js.append(W @ A)
    return np.concatenate(rs), np.concatenate(Js)


def _tree(edges: Sequence[Edge], reference: str) -> list[tuple[str, str, Edge]]:
    """A spanning tree from the reference on: sensor, the next one and the edge between, nearest first."""
    known, found = {reference}, []
    by_certainty = sorted(edges, key=lambda e: float(np.trace(e.covariance)))
    while True:
        reached = set(known)
        for edge in by_certainty:
            for before, after in ((edge.target, edge.source), (edge.source, edge.target)):
                if before in reached and after not in known:
                    known.add(after)
                    found.append((before, after, edge))
        if known == reached:
            return found


def closed_loops(edges: Sequence[Edge], reference: str) -> tuple[Loop, ...]:
    """The independent loops that edges close, one for each outside a spanning tree, with their tests."""
    found: list[Loop] = []
    remaining = {name for edge in edges for name in (edge.target, edge.source)}
    while remaining:
        root = reference if reference in remaining else min(remaining)
        tree = _tree(edges, root)
        up = {after: (before, edge) for before, after, edge in tree}
        own = {root, *up}
        rest = [e for e in edges if e.target in own and all(e is not edge for _, _, edge in tree)]
        found += [_loop(edge, up, len(rest)) for edge in rest]
        remaining -= own
    return tuple(found)


def _loop(edge: Edge, up: Mapping[str, tuple[str, Edge]], tests: int) -> Loop:
    """The loop of an edge and the way of the tree between its ends."""

    def chain(name: str) -> list[tuple[str, Edge]]:
        way = []
        while name in up:
            way.append((name, up[name][1]))
            name = up[name][0]
        return way

    there, back = chain(edge.source), chain(edge.target)
    while there and back and there[-1][1] is back[-1][1]:
        there.pop(), back.pop()
    # From the edge's target to its source, on to where the ways meet, and back to the target.
    steps = [(edge.target, edge)] + there + [(up[name][0], e) for name, e in reversed(back)]
    T, C = np.eye(4), np.zeros((6, 6))
    for at, e in steps:
        if e.target == at:
            step, own = e.T, e.covariance
        else:
            step = se3.inverse(e.T)
            A = se3.adjoint(step)
            own = A @ e.covariance @ A.T
        A = se3.adjoint(T)
        T, C = T @ step, C + A @ own @ A.T
    residual = se3.log(T)
    p = float(scipy.special.chdtrc(6, np.sum((root_information(C) @ residual) ** 2)))
    return Loop(tuple(at for at, _ in steps), residual, p, p > SIGNIFICANCE / tests)


def _open(solution: RigSolution, factors: Sequence[Edge]) -> dict[str, Matrix]:
    """Directions of each sensor's pose of which the edges tell less than the priors do, its own and those of others."""
    priors = [k for k, factor in enumerate(factors) if factor.kind == PRIOR]
    alone = _covariance(_scaled(factors, priors, NOTHING_SAID), solution.poses, solution.columns)
    found = {}
    for name, own in solution.columns.items():
        W = root_information(alone[own, own])
        values, vectors = np.linalg.eigh(W @ solution.marginal(name) @ W.T)
        rest = vectors[:, values < 1 - TOLD] * np.sqrt(values[values < 1 - TOLD])
        if rest.size:
            found[name] = np.linalg.solve(W, rest).T
    return found


def joined_to(reference: str, pairs: Sequence[tuple[str, str]]) -> set[str]:
    """Sensors that pairs join to the reference, itself among them where there is one."""
    joined, before = {reference}, 0
    while len(joined) > before:
        before = len(joined)
        joined |= {name for pair in pairs if joined & set(pair) for name in pair}
    return joined if len(joined) > 1 else set()
