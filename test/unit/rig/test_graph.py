"""The graph of a rig: its estimate, its covariance, loops, wrong edges and what rests on the prior; and which sensor moved."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from graphs import RIGS, SIGMA, Pairs, edges, priors, rig

from calib_ros import se3
from calib_ros.errors import BadInputError
from calib_ros.rig.graph import PRIOR, Edge, RigSolution, solve
from calib_ros.rig.moved import CLOCK, MOVED, NOTHING, RigHypothesis, hypotheses, verdict


def errors(solution: RigSolution, poses: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([se3.log(poses[n] @ se3.inverse(solution.poses[n])) for n in solution.columns])


@pytest.mark.parametrize("name", RIGS)
def test_the_joint_covariance_is_that_of_the_errors(name: str) -> None:
    poses, pairs = RIGS[name]
    rng, n, runs = np.random.default_rng(1), 6 * (len(poses) - 1), 60
    nees = []
    for _ in range(runs):
        solution = solve(edges(poses, pairs, rng), priors(poses, rng), "l0")
        assert not solution.rejected
        assert not solution.doubted
        e = errors(solution, poses)
        nees.append(e @ np.linalg.solve(solution.covariance, e) / n)
    assert np.mean(nees) == pytest.approx(1, abs=4 * np.sqrt(2 / n / runs))


def test_loops_make_poses_better_than_pairs_alone() -> None:
    poses, pairs = RIGS["loops"]
    rng, alone, whole = np.random.default_rng(2), [], []
    for _ in range(40):
        measured = edges(poses, pairs, rng)
        solution = solve(measured, priors(poses, rng), "l0")
        pair = next(e for e in measured if (e.target, e.source) == ("c0", "l0"))
        alone.append(np.square(se3.log(se3.inverse(pair.T) @ se3.inverse(poses["c0"])) / SIGMA).mean())
        whole.append(np.square(se3.log(solution.poses["c0"] @ se3.inverse(poses["c0"])) / SIGMA).mean())
    assert np.mean(whole) < 0.85 * np.mean(alone)


def test_estimate_does_not_depend_on_the_reference() -> None:
    poses, pairs = RIGS["loops"]
    rng = np.random.default_rng(3)
    measured = edges(poses, pairs, rng)
    weak = priors(poses, rng, 40, 5)
    by_l1 = {n: (se3.inverse(poses["l1"]) @ T, C) for n, (T, C) in weak.items() if n != "l1"}
    by_l1["l0"] = se3.inverse(weak["l1"][0]), weak["l1"][1]
    one, other = solve(measured, weak, "l0"), solve(measured, by_l1, "l1")
    np.testing.assert_allclose(one.between("c0", "c1")[0], other.between("c0", "c1")[0], atol=1e-4)
    np.testing.assert_allclose(one.between("c0", "c1")[1], other.between("c0", "c1")[1], rtol=0.02, atol=1e-7)


def test_a_wrong_edge_is_found_and_left_out() -> None:
    poses = rig(3, 2)
    pairs = [(a, b) for k, a in enumerate(poses) for b in list(poses)[:k] if not a.startswith("c") or not b.startswith("c")]
    rng = np.random.default_rng(4)
    for k in range(len(pairs)):
        measured = edges(poses, pairs, rng)
        measured[k] = replace(measured[k], T=se3.exp(np.r_[0.02, 0, 0, 0, 0.1, 0]) @ measured[k].T)
        solution = solve(measured, priors(poses, rng), "l0")
        assert [e.name for e in solution.rejected] == [measured[k].name]
        assert len(solution.edges) == len(pairs) - 1
        assert np.abs(errors(solution, poses).reshape(-1, 6) / SIGMA).max() < 6
        assert any(not loop.closes for loop in solution.loops)


def test_which_edge_of_a_single_loop_is_wrong_is_not_claimed() -> None:
    poses, pairs = rig(2, 1), [("l0", "l1"), ("c0", "l0"), ("c0", "l1")]
    rng = np.random.default_rng(5)
    measured = edges(poses, pairs, rng)
    measured[1] = replace(measured[1], T=se3.exp(np.r_[0.02, 0, 0, 0, 0.1, 0]) @ measured[1].T)
    solution = solve(measured, priors(poses, rng), "l0")
    assert not solution.rejected
    assert {e.name for e in solution.doubted} == {e.name for e in measured}
    e = errors(solution, poses)
    assert e @ np.linalg.solve(solution.covariance, e) / len(e) < 3  # believed less, by enough
    (loop,) = solution.loops
    assert not loop.closes
    assert loop.size[0] == pytest.approx(np.rad2deg(0.02), rel=0.3)


def test_contradictions_apart_from_each_other_are_all_told() -> None:
    """Two cameras of one LiDAR, each with an edge that contradicts its prior."""
    poses, rng = rig(1, 4), np.random.default_rng(8)
    measured = edges(poses, [(f"c{k}", "l0") for k in range(4)], rng)
    for k in (0, 2):
        measured[k] = replace(measured[k], T=se3.exp(np.r_[0.2 - 0.05 * k, 0, 0, 0, 0, 0]) @ measured[k].T)
    known = {name: (T, 1e-4 * C) for name, (T, C) in priors(poses, rng).items()}
    solution = solve(measured, {n: (poses[n], C) for n, (_, C) in known.items()}, "l0")
    assert {e.source if e.kind == PRIOR else e.target for e in (*solution.doubted, *solution.rejected)} == {"c0", "c2"}


def test_many_equal_contradictions_end() -> None:
    """Priors of another frame than the reference: every camera's edge and prior contradict each other by as much."""
    poses, rng = rig(1, 12), np.random.default_rng(9)
    measured = edges(poses, [(f"c{k}", "l0") for k in range(12)], rng)
    off = se3.exp(np.r_[0.0, 0.0, 0.0, 1.0, 0.0, 0.5])
    known = {name: (off @ poses[name], 1e-2 * C) for name, (_, C) in priors(poses, rng).items()}
    assert solve(measured, known, "l0").doubted


def test_a_wrong_prior_does_not_cost_the_edges_that_contradict_it() -> None:
    poses, pairs = RIGS["loops"]
    rng = np.random.default_rng(6)
    known = priors(poses, rng)
    known["c0"] = se3.exp(np.r_[0.6, 0, 0, 0, 0, 0]) @ known["c0"][0], known["c0"][1]
    solution = solve(edges(poses, pairs, rng), known, "l0")
    assert [(e.source, e.kind) for e in solution.rejected] == [("c0", PRIOR)]
    assert np.abs(errors(solution, poses).reshape(-1, 6) / SIGMA).max() < 6


def test_what_no_edge_tells_rests_on_the_prior() -> None:
    """A camera joined by its rotation alone, another by nothing."""
    poses = rig(1, 3)
    rng = np.random.default_rng(7)
    measured = edges(poses, [("c0", "l0")], rng)
    turns = np.r_[SIGMA[:3], np.full(3, 10.0)]
    measured += edges(poses, [("c1", "l0")], rng, turns)
    solution = solve(measured, priors(poses, rng), "l0")
    assert set(solution.open) == {"c1", "c2"}
    assert solution.open["c2"].shape == (6, 6)
    assert solution.open["c1"].shape == (3, 6)
    J = se3.parts_jacobian(solution.poses["c1"])
    assert np.abs((solution.open["c1"] @ J.T)[:, :3]).max() < 0.01  # places, not turns
    C = J @ solution.marginal("c1") @ J.T
    np.testing.assert_allclose(np.sqrt(np.diag(C))[3:], 0.2, rtol=0.05)


def test_priors_of_two_sensors_joined_by_an_edge_are_no_measurement() -> None:
    """Together they tell twice as much as one alone of where both are."""
    poses, rng = rig(1, 2), np.random.default_rng(9)
    solution = solve(edges(poses, [("c0", "c1")], rng), priors(poses, rng), "l0")
    assert solution.open["c0"].shape == solution.open["c1"].shape == (6, 6)


def test_an_edge_of_an_unknown_sensor_is_named() -> None:
    with pytest.raises(BadInputError, match="edge c9-l0: c9 has no prior; the rig has l0"):
        solve([Edge("c9", "l0", np.eye(4), np.eye(6))], {}, "l0")


def test_the_same_input_gives_the_same_bits() -> None:
    poses, pairs = RIGS["loops"]
    rngs = [np.random.default_rng(8) for _ in range(2)]
    one, other = (solve(edges(poses, pairs, rng), priors(poses, rng), "l0") for rng in rngs)
    assert all((one.poses[n] == other.poses[n]).all() for n in poses)


# --- which sensor moved ---------------------------------------------------------------------------------------------------


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
