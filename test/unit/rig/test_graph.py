"""The graph of a rig: its estimate, its covariance, loops, wrong edges and what rests on the prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graphs import RIGS, SIGMA, edges, priors, rig

from calib_ros import se3
from calib_ros.errors import BadInputError
from calib_ros.rig.graph import PRIOR, Edge, RigSolution, solve


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
