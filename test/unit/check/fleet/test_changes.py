"""Change points of an extrinsic: the stated rate of false alarms, the power, outliers, and scatter beyond the covariances."""

from __future__ import annotations

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.registration.initial_guess import nominal
from calib_ros_check.fleet.changes import Extrinsics, change_penalty, extrinsics, scatter, segments

SIGMA = np.r_[np.deg2rad([0.05] * 3), [0.01] * 3]
TURN = np.deg2rad([0.3, 0, 0, 0, 0, 0])  # 0.3 deg about x
EXPECTED = 60  # false alarms


def sequence(rng: np.random.Generator, n: int, factors: np.ndarray | None = None, scatter: float = 0.0) -> Extrinsics:
    """Estimates of a constant extrinsic whose standard deviations are SIGMA times `factors` (n,), and who scatter by `scatter`
    times SIGMA more."""
    sigma = SIGMA * np.ones((n, 1)) if factors is None else SIGMA * factors[:, None]
    values = rng.standard_normal((n, 6)) * sigma + scatter * SIGMA * rng.standard_normal((n, 6))
    return Extrinsics(values, np.array([np.diag(own**2) for own in sigma]))


@pytest.fixture
def simulated_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a change must gain, of sequences that are known alike."""
    made: dict[tuple[object, ...], float] = {}

    def once(covariances: np.ndarray, *given: float) -> float:
        key = covariances.tobytes(), given
        made[key] = made.get(key) or change_penalty(covariances, *given)
        return made[key]

    monkeypatch.setattr("calib_ros_check.fleet.changes.change_penalty", once)


@pytest.mark.parametrize(("n", "spread"), [(2, 0.0), (2, 1.0), (6, 0.0), (6, 1.0), pytest.param(40, 1.0, marks=pytest.mark.slow)])
def test_false_alarms_come_at_the_stated_rate(n: int, spread: float) -> None:
    """Within what chance allows for the number of changes, 2.6 sigma, for covariances that are alike and very different."""
    rng = np.random.default_rng(n)
    per_sequence = 0.24 if n < 24 else 0.48  # long sequences take longer
    rate, sequences = per_sequence / n, round(EXPECTED / per_sequence)
    found = 0
    for k in range(sequences):
        factors = np.exp(spread * rng.standard_normal(n)) if spread else None
        found += len(segments(sequence(rng, n, factors), rate, seed=k).changes)
    assert abs(found - EXPECTED) < 2.6 * 1.2 * np.sqrt(EXPECTED), f"{found} changes where {EXPECTED} are stated"


@pytest.mark.usefixtures("simulated_once")
@pytest.mark.parametrize("first", [1, 6, 11])
def test_a_change_is_found_where_it_was(first: int) -> None:
    """0.3 deg where an estimate is known to 0.05 deg, also in the first and the last recording."""
    hits = places = 0
    for k in range(40):
        own = sequence(np.random.default_rng(k), 12)
        own.values[first:] += TURN
        found = segments(own)
        hits += len(found.changes) > 0
        places += found.changes == ((first - 1, first),)
    single = first in (1, 11)  # told by one recording alone: 5.7 sigma
    assert hits >= (30 if single else 39)
    assert places >= (29 if single else 38)


@pytest.mark.usefixtures("simulated_once")
def test_size_and_covariance_of_a_change() -> None:
    step = np.r_[np.deg2rad([0.5, -0.4, 0.2]), [0.06, -0.02, 0.08]]
    normalized = []
    for k in range(60):
        own = sequence(np.random.default_rng(k), 12)
        own.values[5:] += step
        found = segments(own)
        if len(found.changes) > 1:
            continue  # a false alarm beside it
        off = found.means[1] - found.means[0] - step
        covariance = found.covariances.sum(axis=0)
        normalized.append(off @ np.linalg.solve(covariance, off))
    assert len(normalized) > 56
    assert np.mean(normalized) == pytest.approx(6, abs=1.4)  # chi^2 with six degrees of freedom
    assert np.sqrt(np.diag(covariance)) == pytest.approx(SIGMA * np.sqrt(1 / 5 + 1 / 7))


def test_several_changes_and_there_and_back() -> None:
    own = sequence(np.random.default_rng(3), 30)
    own.values[8:] += TURN
    own.values[15:22, 3] += 0.08
    found = segments(own)
    assert found.changes == ((7, 8), (14, 15), (21, 22))
    assert found.labels.tolist() == [0] * 8 + [1] * 7 + [2] * 7 + [3] * 8
    assert found.outliers == ()


@pytest.mark.parametrize("size", [8.0, 20.0, 1000.0])
def test_a_single_wrong_recording_is_an_outlier(size: float) -> None:
    """Anywhere but at the ends, where it is a change that is not confirmed yet; also beside a change."""
    for k, place in enumerate([1, 5, 10]):
        own = sequence(np.random.default_rng(k), 12)
        own.values[place] += size * SIGMA
        found = segments(own, seed=k)
        assert (found.outliers, found.changes) == ((place,), ())
        assert np.abs(found.means[0]).max() < 4 * SIGMA.max()
    own = sequence(np.random.default_rng(0), 12)
    own.values[-1] += size * SIGMA
    assert segments(own).changes == ((10, 11),)
    own = sequence(np.random.default_rng(0), 20)
    own.values[6:] += TURN
    own.values[[3, 12]] += size * SIGMA
    found = segments(own)
    assert found.outliers == (3, 12)
    assert found.changes == ((5, 6),)
    assert found.labels[[3, 12]].tolist() == [0, 1]


def test_recordings_that_tell_little_neither_raise_nor_hide_an_alarm() -> None:
    factors = np.ones(14)
    factors[[0, 6, 7, 13]] = 200.0  # 10 deg
    own = sequence(np.random.default_rng(0), 14, factors)
    assert segments(own).changes == ()
    own.values[8:] += TURN
    found = segments(own)
    ((before, after),) = found.changes
    assert 5 <= before < after <= 8
    assert found.means[1, 0] - found.means[0, 0] == pytest.approx(TURN[0], abs=4 * SIGMA[0])


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_short_sequences(n: int) -> None:
    found = segments(sequence(np.random.default_rng(0), n))
    assert (len(found.labels), found.changes, found.outliers) == (n, (), ())
    assert found.means.shape == (min(n, 1), 6)
    own = sequence(np.random.default_rng(0), n)
    own.values[-1:] += 100 * SIGMA
    assert len(segments(own).changes) == (n > 1)


def test_the_same_sequence_gives_the_same_answer() -> None:
    own = sequence(np.random.default_rng(0), 20)
    assert change_penalty(own.covariances, 0.001) == change_penalty(own.covariances, 0.001)
    # More recordings have more divisions, of which the best reaches more by chance; their own rate is the same.
    assert change_penalty(own.covariances[:4], 0.001) < change_penalty(own.covariances, 0.001 / 5)


# --- scatter beyond the covariances


@pytest.mark.parametrize("vehicles", [2, 12])
def test_scatter_is_found_in_spite_of_changes_and_outliers(vehicles: int) -> None:
    found = []
    for k in range(40):
        rng = np.random.default_rng(k)
        own = [sequence(rng, 12, scatter=2.0) for _ in range(vehicles)]
        own[0].values[4:] += 50 * SIGMA
        own[1].values[7] += 300 * SIGMA
        found.append(np.sqrt(scatter(own)) / SIGMA)
    assert np.median(found, axis=0) == pytest.approx(2.0, abs=0.4 if vehicles > 2 else 0.8)  # of 22 differences, 3 are off


def test_scatter_is_small_where_the_covariances_explain_all() -> None:
    found = [np.sqrt(scatter([sequence(np.random.default_rng(100 * k + i), 12) for i in range(5)])) for k in range(40)]
    assert np.median(found, axis=0).max() < 0.4 * SIGMA.max()
    assert scatter([]).tolist() == scatter([sequence(np.random.default_rng(0), 1)]).tolist() == [0.0] * 6


def test_false_alarms_with_scatter_that_is_estimated() -> None:
    """A fleet of five vehicles with twelve recordings each, whose estimates scatter twice as much as their covariances say."""
    found = 0
    for k in range(25):
        own = [sequence(np.random.default_rng(10 * k + i), 12, scatter=2.0) for i in range(5)]
        found += sum(len(segments(one.with_scatter(scatter(own)), 0.01, seed=i).changes) for i, one in enumerate(own))
    assert found < 2 * 0.01 * 25 * 60  # 15 are stated; the scatter is known from 165 differences per group of axes
    without = sum(len(segments(sequence(np.random.default_rng(k), 12, scatter=2.0), 0.01).changes) for k in range(20))
    assert without > 100


# --- from transforms


def test_values_are_those_of_a_check_and_their_covariances_hold() -> None:
    """Rotation vector and shift in the camera's axes; the covariance of the shift knows the lever of the left twist."""
    T = nominal()
    T[:3, 3] = [0.3, -0.5, 1.5]
    rng = np.random.default_rng(0)
    A = rng.standard_normal((6, 6))
    C = 1e-6 * A @ A.T
    drawn = [se3.exp(rng.multivariate_normal(np.zeros(6), C)) @ T for _ in range(3000)]
    own = extrinsics(drawn, [C] * len(drawn))
    empirical = np.cov(own.values.T)
    assert np.abs(empirical - own.covariances.mean(axis=0)).max() < 0.1 * np.abs(empirical).max()
    moved = T.copy()
    moved[:3, 3] += [0.1, 0, 0]
    values = extrinsics([T, T, moved], [C] * 3).values
    assert values[2] - values[0] == pytest.approx([0, 0, 0, 0.1, 0, 0])
