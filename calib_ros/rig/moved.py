"""Which sensor moved: what could have happened to a rig since its last solution, by how well it explains new edges.

What has moved is known only against the rest: a displacement of some sensors, rigidly together, is the same to a graph of
relative poses as one of all the others. The smaller part is named. Models are compared by their evidence, in which an unknown
displacement pays for its freedom (MacKay 1992, of which the Bayesian information criterion is the limit).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
import scipy

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix
from calib_ros.rig.description import prior_covariance
from calib_ros.rig.graph import SIGNIFICANCE, SURE, Edge, RigSolution, predicted

NOTHING, MOVED, CLOCK = "nothing", "moved", "clock"
# Standard deviations of what happens to sensors: a knock that leaves them on the vehicle, and a clock of another frame.
KNOCK_DEG, KNOCK_M, JUMP_S = 3.0, 0.1, 0.05
CHANGED = 0.05  # probability, before anything is seen, that something has changed
MOST = 12  # sensors; the ways to divide more of them are too many to compare


@dataclass(frozen=True, eq=False)
class RigHypothesis:
    """Something that may have happened.

    kind: nothing, moved or clock. sensors: that moved together, or whose clock jumped. displacement: (6,) left twist of theirs in
    the frame of the reference, rad and m, or (1,) of the clock, s, positive = later than before; with its covariance.
    posterior: probability among all hypotheses. p_value: of edges that fit as badly, were it so. others: sensors of which the
    opposite is the same to the graph.
    """

    kind: str
    sensors: tuple[str, ...]
    displacement: Matrix
    covariance: Matrix
    posterior: float
    p_value: float
    size: tuple[float, float]
    others: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.kind == NOTHING:
            return "nothing has changed"
        who = self.sensors[0] if len(self.sensors) == 1 else f"the bracket of {', '.join(self.sensors)}"
        if self.kind == CLOCK:
            return f"the clock of {who} jumped by {1000 * self.displacement[0]:+.0f} ms"
        return f"{who} moved by {self.size[0]:.2f} deg and {100 * self.size[1]:.1f} cm"


def hypotheses(before: RigSolution, edges: Sequence[Edge]) -> list[RigHypothesis]:
    """What may have happened between a solution and new edges, most probable first: nothing; any sensors of the rig moving
    rigidly together; the clock of a sensor jumping. Deterministic."""
    model = _Model(before, edges)
    names = sorted(model.seen)
    Candidate = tuple[str, tuple[str, ...], Matrix, Matrix, float]  # with B, the prior covariance of x, and log prior
    found: list[Candidate] = [(NOTHING, (), np.zeros((len(model.y), 0)), np.zeros((0, 0)), np.log(1 - CHANGED))]
    clocks = bool(model.offsets) or any(edge.twist is not None for edge in edges)  # whether a jump of one would show
    for m in range(1, len(names) // 2 + 1):
        # Parts of equal size halve, and each pair of halves is named by both.
        groups = combinations(names, m) if len(names) <= MOST or m == 1 else ()
        # Every number of sensors is as likely as the next lower one divided by their number: what moves is mostly one sensor.
        prior = np.log(CHANGED * (0.5 if clocks else 1.0) * 0.5 ** (m - 1) / comb(len(names), m))
        for group in groups:
            knock = prior_covariance(se3.from_parts(np.eye(3), model.centre(group)), KNOCK_DEG, KNOCK_M)
            found.append((MOVED, group, model.moved(group), knock, prior))
    if clocks:
        prior = np.log(CHANGED * 0.5 / len(names))
        found += [(CLOCK, (name,), model.jumped(name), np.array([[JUMP_S**2]]), prior) for name in names]
    evidences = [model.evidence(B, D) for _, _, B, D, _ in found]
    logs = np.array([e[0] + prior for e, (*_, prior) in zip(evidences, found, strict=True)])
    posterior = np.exp(logs - scipy.special.logsumexp(logs))
    out = []
    for (kind, group, _, _, _), (_, x, C, p), probability in zip(found, evidences, posterior, strict=True):
        others = tuple(n for n in names if n not in group) if kind == MOVED else ()
        size = model.size(group, x) if kind == MOVED else (0.0, 0.0)
        out.append(RigHypothesis(kind, group, x, C, float(probability), p, size, others))
    return sorted(out, key=lambda h: (-round(h.posterior, 9), len(h.sensors), h.sensors))


def verdict(found: Sequence[RigHypothesis]) -> tuple[tuple[RigHypothesis, ...], str]:
    """The hypotheses that one cannot tell apart, one if the data tell, and a line for people."""
    likely: list[RigHypothesis] = []
    for hypothesis in found:
        likely.append(hypothesis)
        if sum(h.posterior for h in likely) > SURE:
            break
    text = str(likely[0])
    # A usual knock would turn these by less than three standard deviations of what the new edges tell.
    hidden = [h for h in found if h.kind == MOVED and np.rad2deg(np.sqrt(np.diag(h.covariance)[:3].max())) > KNOCK_DEG / 3]
    if len(likely) > 1:
        text = f"cannot tell between: {'; '.join(map(str, likely))}"
    elif likely[0].kind == MOVED:
        text += f" against {', '.join(likely[0].others)}"
    elif likely[0].kind == NOTHING and hidden:
        groups = "; ".join(" with ".join(h.sensors) for h in hidden)
        text += f", as far as it shows: the new edges would hardly show that these moved against the others: {groups}"
    if likely[0].p_value < SIGNIFICANCE:
        text += "; even this explains the new edges badly: more than one thing has changed, or an edge is wrong"
    return tuple(likely), text


class _Model:
    """New edges as a linear model: what they differ from the solution by (n,) = errors + B x, x what happened."""

    def __init__(self, before: RigSolution, edges: Sequence[Edge]) -> None:
        self.before, self.edges = before, edges
        self.seen = {name for edge in edges for name in (edge.target, edge.source)}
        known = {(e.target, e.source): e for e in before.edges}
        at = [predicted(before.poses, before.columns, edge.target, edge.source) for edge in edges]
        rows = [se3.log(edge.T @ se3.inverse(P)) for edge, (P, _) in zip(edges, at, strict=True)]
        A, noise = [np.zeros((0, 6 * len(before.columns))), *(J for _, J in at)], [edge.covariance for edge in edges]
        self.offsets: list[tuple[Edge, int]] = []  # edges whose clocks are known, with their rows
        for edge in edges:
            old = known.get((edge.target, edge.source))
            offsets = [] if old is None else [e.time_offset_s for e in (edge, old) if e.time_offset_s is not None]
            sigmas = [] if old is None else [e.time_sigma_s for e in (edge, old) if e.time_sigma_s is not None]
            if len(offsets) == len(sigmas) == 2:
                self.offsets.append((edge, 6 * len(edges) + len(self.offsets)))
                rows.append(np.array([offsets[0] - offsets[1]]))
                A.append(np.zeros((1, A[0].shape[1])))
                noise.append(np.array([[sigmas[0] ** 2 + sigmas[1] ** 2]]))
        self.y, whole, covariance = np.concatenate([np.zeros(0), *rows]), np.concatenate(A), np.zeros((0, 0))
        for block in noise:
            apart = np.zeros((len(covariance), len(block)))
            covariance = np.block([[covariance, apart], [apart.T, block]])
        self._root = np.linalg.inv(np.linalg.cholesky(covariance + whole @ before.covariance @ whole.T))

    def moved(self, group: Sequence[str]) -> Matrix:
        """B (n, 6) of a group that moves rigidly by a left twist in the reference's frame."""
        B = np.zeros((len(self.y), 6))
        for k, edge in enumerate(self.edges):
            sign = (edge.source in group) - (edge.target in group)
            if sign:
                B[6 * k : 6 * k + 6] = sign * se3.adjoint(se3.inverse(self.before.poses[edge.target]))
        return B

    def jumped(self, name: str) -> Matrix:
        """B (n, 1) of a clock that is later by a second: known offsets follow, and elsewhere the transform takes it."""
        B = np.zeros((len(self.y), 1))
        known = {id(edge): row for edge, row in self.offsets}
        for k, edge in enumerate(self.edges):
            sign = (edge.source == name) - (edge.target == name)
            if sign and id(edge) in known:
                B[known[id(edge)]] = sign
            elif sign and edge.twist is not None:
                B[6 * k : 6 * k + 6, 0] = sign * se3.adjoint(edge.T) @ edge.twist
        return B

    def centre(self, group: Sequence[str]) -> Matrix:
        """Middle (3,) of a group, m in the reference's frame."""
        return np.asarray(np.mean([self.before.poses[name][:3, 3] for name in group], axis=0))

    def evidence(self, B: Matrix, prior: Matrix) -> tuple[float, Matrix, Covariance, float]:
        """Log-likelihood of y with x ~ N(0, prior) integrated out; the mean and covariance of x; and the p-value of the
        residual at the best x."""
        y, G = self._root @ self.y, self._root @ B
        information = G.T @ G + np.linalg.inv(prior)
        C = np.linalg.inv(information)
        x = C @ G.T @ y
        residual = y - G @ x
        cost = float(residual @ residual + x @ np.linalg.solve(prior, x))
        log_det = np.linalg.slogdet(information)[1] + np.linalg.slogdet(prior)[1]
        log_det -= 2 * np.linalg.slogdet(self._root)[1]
        freedom = len(y) - int(np.linalg.matrix_rank(G)) if B.size else len(y)
        p = float(scipy.special.chdtrc(freedom, float(residual @ residual))) if freedom else 1.0
        return -0.5 * (cost + log_det + len(y) * np.log(2 * np.pi)), x, C, p

    def size(self, group: Sequence[str], x: Matrix) -> tuple[float, float]:
        """deg and m of a displacement, at the middle of the group: its left twist turns about the reference."""
        centre = self.centre(group)
        at = se3.transform(se3.exp(x), centre[None])[0] - centre
        return float(np.rad2deg(np.linalg.norm(x[:3]))), float(np.linalg.norm(at))
