"""Which sensor moved: graphs of three rigs before and after something has happened to them."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from graphs import RIGS, Pairs, edges, priors

from calib_ros import se3
from calib_ros.rig.graph import Edge, RigSolution, solve
from calib_ros.rig.moved import CLOCK, MOVED, NOTHING, RigHypothesis, hypotheses, verdict

VELOCITY = np.array([0.01, 0.02, 0.3, 8.0, 0.5, 0.1])  # rad/s, m/s


def solved(name: str, seed: int) -> tuple[dict[str, np.ndarray], Pairs, np.random.Generator, RigSolution]:
    """A rig's poses and pairs, what errors come from, and its solution before anything happens."""
    (poses, pairs), rng = RIGS[name], np.random.default_rng(seed)
    return poses, pairs, rng, solve(edges(poses, pairs, rng), priors(poses, rng), "l0")


def is_right(found: RigHypothesis, group: tuple[str, ...]) -> bool:
    """The group has moved, or all the others, which is the same to a graph."""
    return found.kind == (MOVED if group else NOTHING) and set(group) in (set(found.sensors), set(found.others))


def test_two_hundred_displacements_are_told_by_name() -> None:
    """None, single sensors and brackets, by 1 deg and 5 cm; never a wrong name, and at most one in twenty undecided."""
    rng, right, undecided, wrong = np.random.default_rng(0), 0, [], []
    for k in range(200):
        name = list(RIGS)[k % 3]
        poses, pairs = RIGS[name]
        before = solve(edges(poses, pairs, rng), priors(poses, rng), "l0")
        group = tuple(rng.choice(list(poses), rng.integers(0, min(len(poses), 4)), replace=False).tolist())
        axis, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        centre = np.mean([poses[n][:3, 3] for n in group], axis=0) if group else np.zeros(3)
        about = se3.from_parts(np.eye(3), centre)
        D = about @ se3.exp(np.r_[np.deg2rad(1) * axis, 0.05 * shift]) @ se3.inverse(about)
        after = {n: D @ T if n in group else T for n, T in poses.items()}
        likely, text = verdict(hypotheses(before, edges(after, pairs, rng)))
        if any(is_right(h, group) for h in likely):
            right, undecided = right + (len(likely) == 1), undecided + ([text] if len(likely) > 1 else [])
        elif len(group) < len(poses):
            wrong.append((name, group, text))
    assert wrong == []
    assert right >= 190, undecided


def test_size_and_displacement_are_those_of_the_knock() -> None:
    poses, pairs, rng, before = solved("ring", 1)
    about = se3.from_parts(np.eye(3), poses["c2"][:3, 3])
    D = about @ se3.exp(np.r_[0, np.deg2rad(1.5), 0, 0.08, 0, 0]) @ se3.inverse(about)
    best, text = verdict(hypotheses(before, edges(poses | {"c2": D @ poses["c2"]}, pairs, rng)))
    assert best[0].size == (pytest.approx(1.5, abs=0.3), pytest.approx(0.08, abs=0.05))
    error = best[0].displacement - se3.log(D)
    assert error @ np.linalg.solve(best[0].covariance, error) < 25
    assert text.startswith("c2 moved by 1.")
    assert "against c0, c1, c3, c4, c5, l0" in text


def test_one_camera_and_one_lidar_cannot_be_told_apart() -> None:
    poses = {"l0": np.eye(4), "c0": RIGS["ring"][0]["c0"]}
    rng = np.random.default_rng(2)
    before = solve(edges(poses, [("c0", "l0")], rng), priors(poses, rng), "l0")
    moved = poses | {"c0": se3.exp(np.r_[0.03, 0, 0, 0.05, 0, 0]) @ poses["c0"]}
    likely, text = verdict(hypotheses(before, edges(moved, [("c0", "l0")], rng)))
    assert {h.sensors for h in likely} == {("c0",), ("l0",)}
    assert text.startswith("cannot tell between: ")
    assert min(h.posterior for h in likely) > 0.3  # each would have turned about another place


def test_a_knock_below_the_noise_is_not_named() -> None:
    poses, pairs, rng, before = solved("loops", 3)
    moved = poses | {"c0": se3.exp(np.full(6, 1e-5)) @ poses["c0"]}
    assert hypotheses(before, edges(moved, pairs, rng))[0].kind == NOTHING


@pytest.mark.parametrize("known", [True, False])
def test_a_clock_that_jumped_is_no_displacement(known: bool) -> None:
    """Where edges tell the clocks, by these; else since the transforms moved along the motion by one time, all alike."""
    poses, pairs = RIGS["ring"]
    rng = np.random.default_rng(4)

    def clocked(late: dict[str, float]) -> list[Edge]:
        out = []
        for edge in edges(poses, pairs, rng):
            seconds = late.get(edge.source, 0.0) - late.get(edge.target, 0.0)
            told = replace(edge, twist=VELOCITY)
            if known:
                told = replace(told, time_offset_s=seconds + rng.normal() * 1e-3, time_sigma_s=1e-3)
            else:
                told = replace(told, T=edge.T @ se3.exp(VELOCITY * seconds))
            out.append(told)
        return out

    before = solve(clocked({}), priors(poses, rng), "l0")
    likely, text = verdict(hypotheses(before, clocked({"l0": 0.03})))
    assert [(h.kind, h.sensors) for h in likely] == [(CLOCK, ("l0",))], text
    assert likely[0].displacement[0] == pytest.approx(0.03, abs=0.003)
    likely, text = verdict(hypotheses(before, clocked({"c1": -0.03})))
    assert (likely[0].kind, likely[0].sensors) == (CLOCK, ("c1",)), text
    assert "the clock of c1 jumped by -" in text


def test_two_things_at_once_are_not_taken_for_one() -> None:
    poses, pairs, rng, before = solved("ring", 5)
    turns = {"c0": np.r_[0.03, 0, 0, 0, 0, 0], "c3": np.r_[0, 0, 0.03, 0, 0.1, 0]}
    moved = poses | {n: se3.exp(xi) @ poses[n] for n, xi in turns.items()}
    likely, text = verdict(hypotheses(before, edges(moved, pairs, rng)))
    assert "more than one thing has changed" in text
    assert likely[0].p_value < 1e-3


def test_posteriors_are_of_all_ways_to_divide_the_rig() -> None:
    poses, pairs, rng, before = solved("loops", 6)
    found = hypotheses(before, edges(poses, pairs, rng))
    assert sum(h.posterior for h in found) == pytest.approx(1)
    groups = {frozenset(h.sensors) for h in found if h.kind == MOVED}
    assert groups == {frozenset(c) for m in (1, 2) for c in combinations(poses, m)}


def test_what_the_edges_would_not_show_is_said_where_nothing_seems_to_have_changed() -> None:
    """Two ends of a vehicle that only motion joins, to 1.4 deg and a metre."""
    rng, poses = np.random.default_rng(3), RIGS["ring"][0]
    names = ("l0", "c0", "c1", "c2")
    given, own = {n: poses[n] for n in names}, [("c0", "l0"), ("c1", "c2")]
    coarse = np.diag([np.deg2rad(1.4) ** 2] * 3 + [1.0] * 3)

    def measured() -> list[Edge]:
        return [*edges(given, own, rng), Edge("c2", "l0", se3.inverse(poses["c2"]) @ poses["l0"], coarse, "motion")]

    before = solve(measured(), priors(given, rng), "l0")
    likely, text = verdict(hypotheses(before, measured()))
    assert likely[0].kind == NOTHING
    assert text.startswith("nothing has changed, as far as it shows: ")
    assert text.endswith(": c0 with l0; c1 with c2")
    joined = [*own, ("c2", "l0")]
    before = solve(edges(given, joined, rng), priors(given, rng), "l0")
    assert verdict(hypotheses(before, edges(given, joined, rng)))[1] == "nothing has changed"
