"""A rig while it drives, without messages: what its pairs say, and what follows for its sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from graphs import RIGS, SIGMA, edges, priors

from calib_ros import se3
from calib_ros.config import RefineConfig
from calib_ros.result import CONVERGED, MOVED, SUSPECT, TENTATIVE, Extrinsic, Result
from calib_ros.rig.description import CAMERA, LIDAR, RigDescription, Sensor
from calib_ros.rig.live import UNCHECKED, LiveRig, PairState, RigState


class Simulated:
    """A rig of graphs.RIGS whose pairs say what the test wants."""

    def __init__(self, name: str) -> None:
        self.poses, pairs = RIGS[name]
        self.pairs = [p for p in pairs if p[0].startswith("c")]
        sensors = tuple(Sensor(n, LIDAR if n.startswith("l") else CAMERA) for n in self.poses)
        self.rig, self.rng = LiveRig(RigDescription(sensors, "l0"), RefineConfig()), np.random.default_rng(0)
        self.priors = priors(self.poses, self.rng)
        self.states = {pair: self.measured(pair) for pair in self.pairs}

    def measured(self, pair: tuple[str, str], status: str = CONVERGED) -> PairState:
        """An estimate of where the sensors are now."""
        (edge,) = edges(self.poses, [pair], self.rng)
        result = Result(edge.T, status, "" if status == CONVERGED else f"{status}!", covariance=np.diag(SIGMA**2))
        return PairState(*pair, Extrinsic(result, accepted=1, usable=status == CONVERGED), status == CONVERGED)

    def knock(self, names: Sequence[str], deg: float = 1.0, m: float = 0.05) -> None:
        """Sensors are displaced as one, and no pair has noticed yet."""
        centre = np.mean([self.poses[n][:3, 3] for n in names], axis=0)
        about = se3.from_parts(np.eye(3), centre)
        D = about @ se3.exp(np.r_[0, 0, np.deg2rad(deg), m, 0, 0]) @ se3.inverse(about)
        self.poses = {n: D @ T if n in names else T for n, T in self.poses.items()}

    def affected(self, names: Sequence[str]) -> list[tuple[str, str]]:
        return [p for p in self.pairs if (p[0] in names) != (p[1] in names)]

    def say(self, pairs: Sequence[tuple[str, str]], status: str, anew: bool = False) -> RigState:
        """These pairs change their status; anew: with an estimate of now."""
        for pair in pairs:
            state = self.states[pair]
            if anew:
                self.states[pair] = self.measured(pair, status)
                continue
            result = replace(state.extrinsic.result, status=status, reason=f"{status}!")
            self.states[pair] = replace(state, extrinsic=replace(state.extrinsic, result=result), usable=status == CONVERGED)
        return self.update()

    def update(self) -> RigState:
        return self.rig.update(list(self.states.values()), self.priors)


def usable(state: RigState) -> set[str]:
    return {sensor.name for sensor in state.sensors if sensor.usable}


def by_name(state: RigState, name: str):
    return next(sensor for sensor in state.sensors if sensor.name == name)


@pytest.mark.parametrize(
    ("rig", "names", "lost"),
    [("ring", ["c2"], ["c2"]), ("ring", ["c1", "c2"], ["c1", "c2"]), ("loops", ["l1"], ["l1", "c2"])],
    ids=["camera", "bracket", "lidar"],
)
def test_what_moved_is_named_at_once_and_with_its_size_when_it_is_found_again(rig, names, lost) -> None:
    """And nothing else stops being usable, but for a camera that only the displaced LiDAR joins."""
    own = Simulated(rig)
    everyone = set(own.poses)
    assert usable(own.update()) == everyone
    own.knock(names)
    affected = own.affected(names)
    own.say(affected, SUSPECT)
    state = own.say(affected, MOVED)
    assert set(names) <= set(state.moved) <= set(lost)
    assert "by how much is being estimated" in state.text
    assert usable(state) == everyone - set(lost)
    state = own.say(affected, TENTATIVE, anew=True)
    assert state.moved == tuple(names)
    assert state.text.startswith(f"{names[0]} moved by" if len(names) == 1 else f"the bracket of {', '.join(names)} moved by")
    assert usable(state) == everyone - set(lost)
    state = own.say(affected, CONVERGED, anew=True)
    assert state.moved == ()
    assert usable(state) == everyone
    deg, m = by_name(state, names[0]).moved
    assert (deg, m) == (pytest.approx(1.0, abs=0.2), pytest.approx(0.05, abs=0.03))
    for name in names:
        assert se3.error(own.poses[name], by_name(state, name).T)[0] < 0.2
    assert max(s.moved[0] for s in state.sensors if s.name not in names) == 0


def test_a_second_knock_is_told_apart_from_the_first() -> None:
    own = Simulated("ring")
    own.update()
    for name in ("c1", "c4"):
        own.knock([name])
        own.say(own.affected([name]), MOVED)
        assert own.say(own.affected([name]), TENTATIVE, anew=True).moved == (name,)
        assert f"{name} moved by" in own.say(own.affected([name]), CONVERGED, anew=True).text


def test_a_camera_and_a_lidar_alone_cannot_be_told_apart() -> None:
    own = Simulated("stereo")
    own.pairs, own.states = own.pairs[:1], {own.pairs[0]: own.states[own.pairs[0]]}
    own.update()
    own.knock(["c0"])
    assert own.say(own.pairs, MOVED).moved == ("c0", "l0")
    assert "cannot tell between" in own.say(own.pairs, TENTATIVE, anew=True).text


def test_a_silent_sensor_is_named_and_the_others_stay() -> None:
    own = Simulated("ring")
    before = own.update()
    pair = ("c3", "l0")
    own.states[pair] = replace(own.states[pair], usable=False, unchecked="nothing comes from c3 on /c3/image")
    state = own.update()
    assert usable(state) == usable(before) - {"c3"}
    assert (by_name(state, "c3").status, by_name(state, "c3").reason) == (UNCHECKED, "nothing comes from c3 on /c3/image")
    np.testing.assert_array_equal(by_name(state, "c1").T, by_name(before, "c1").T)
    assert state.moved == ()


def test_a_pair_that_contradicts_a_loop_is_left_out_and_told() -> None:
    own = Simulated("loops")
    own.states["c1", "l1"] = own.measured(("c1", "l1"))
    wrong = own.states["c0", "l1"].extrinsic.result
    T = se3.exp(np.r_[0, np.deg2rad(3), 0, 0, 0, 0]) @ wrong.T_camera_lidar
    own.states["c0", "l1"] = PairState("c0", "l1", Extrinsic(replace(wrong, T_camera_lidar=T), accepted=1, usable=True), True)
    state = own.update()
    told = {e.name for e in (*state.solution.rejected, *state.solution.doubted)}
    assert "c0-l1 (registration)" in told
    assert "does not close" in str(state)


def test_before_anything_is_measured_the_rig_is_where_the_priors_say() -> None:
    own = Simulated("ring")
    state = own.rig.update([PairState(*pair) for pair in own.pairs], own.priors)
    assert usable(state) == set()
    np.testing.assert_allclose(by_name(state, "c0").T, own.priors["c0"][0])
    assert (by_name(state, "c0").status, by_name(state, "c0").reason) == ("initial", "c0 with l0: initial")
    assert own.rig.update(list(own.states.values())[:1], {"c0": own.priors["c0"]}).solution.poses.keys() == {"l0", "c0"}
