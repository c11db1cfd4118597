"""What other nodes rely on: usable or not, at a steady rate, and said when the data or the node end."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from paths import ROOT
from rclpy.executors import SingleThreadedExecutor
from rclpy.time import Time
from ros_peer import Peer, start_parameters
from vehicle import QUICK

from calib_ros import se3
from calib_ros.datasets.synthetic.drive import SyntheticDrive
from calib_ros.frame import NANOSECONDS, Frame

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
AGE_S, PERIOD_S = 1.0, 0.1
FAST = {**QUICK, "max_data_age_s": AGE_S, "publish_period_s": PERIOD_S, "initial_from_tf": False}


def near(reference: np.ndarray) -> np.ndarray:
    return se3.perturb(reference, [1.2, -1.0, 0.8], [0.08, -0.05, 0.06])


def seconds(duration: Any) -> float:
    return float(duration.sec + duration.nanosec / NANOSECONDS)


def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("use_extrinsic", ROOT / "docs/examples/use_extrinsic.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_an_extrinsic_is_usable_only_while_data_come(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(**start_parameters(near(drive.reference)), **FAST) as peer:
        peer.publish(street[0])
        peer.until(lambda: len(peer.extrinsics) >= 3, what="the same extrinsic again and again")
        assert not any(msg.usable for msg in peer.extrinsics)
        assert peer.extrinsics[-1].estimated_at.sec == 0

        for frame in street[1:5]:
            peer.publish(frame)
        msg = peer.until(lambda: peer.extrinsics[-1] if peer.extrinsics[-1].usable else None, what="a usable extrinsic")
        assert msg.status == "converged"
        ahead = Time.from_msg(msg.valid_until).nanoseconds - peer.node.get_clock().now().nanoseconds
        assert -NANOSECONDS < ahead < NANOSECONDS
        assert 0 <= seconds(msg.data_age) < AGE_S
        assert Time.from_msg(msg.estimated_at).nanoseconds in [frame.stamp for frame in street]

        # Nothing comes any more.
        msg = peer.until(lambda: None if peer.extrinsics[-1].usable else peer.extrinsics[-1], what="that it is too old")
        assert "no usable pair of image and cloud" in msg.reason
        assert Time.from_msg(msg.valid_until).nanoseconds == 0
        assert seconds(msg.data_age) > AGE_S
        answer = peer.get_extrinsic()
        assert not answer.success
        assert "no usable pair of image and cloud" in answer.message
        assert answer.last_good_known
        assert not answer.last_good.usable
        assert seconds(answer.last_good.data_age) > AGE_S
        assert answer.last_good.transform == answer.extrinsic.transform

        peer.publish(street[5])
        peer.until(lambda: peer.extrinsics[-1].usable, what="that data come again")


def test_a_restored_extrinsic_is_used_when_keyframes_confirm_it(
    street: list[Frame], drive: SyntheticDrive, tmp_path: Path
) -> None:
    state = tmp_path / "state.json"
    with Peer(**start_parameters(near(drive.reference)), **FAST, state_file=str(state)) as peer:
        for frame in street[:5]:
            peer.publish(frame)
        estimated = peer.get_extrinsic().extrinsic.estimated_at
    assert json.loads(state.read_text())["provenance"]["sensor_stamp_ns"] == Time.from_msg(estimated).nanoseconds
    with Peer(**FAST, state_file=str(state), online__mode="manual") as peer:
        peer.publish(street[0])
        first = peer.until(lambda: peer.extrinsics and peer.extrinsics[0], what="the restored extrinsic")
        assert (first.status, first.usable, first.estimated_at) == ("initial", False, estimated)
        assert first.transform.header.stamp == estimated
        for frame in street[5:9]:
            peer.publish(frame)
        peer.until(lambda: peer.extrinsics[-1].usable, what="that keyframes confirm it")
        assert peer.extrinsics[-1].estimated_at == estimated


def test_example_consumer_stops_using_the_extrinsic_of_a_node_that_has_ended(
    street: list[Frame], drive: SyntheticDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = example()
    monkeypatch.setattr(module, "SILENCE", module.Duration(seconds=3 * PERIOD_S))
    with Peer(**start_parameters(near(drive.reference)), **{**FAST, "max_data_age_s": 60.0}) as peer:
        user = module.ExtrinsicUser(context=peer.context, cli_args=["--ros-args", "-r", "extrinsic:=/calib_ros/extrinsic"])
        executor = SingleThreadedExecutor(context=peer.context)
        executor.add_node(user)
        assert user.usable() is None

        def used() -> Any:
            executor.spin_once(timeout_sec=0.02)
            return user.usable()

        for frame in street[:5]:
            peer.publish(frame)
        transform = peer.until(used, what="that the consumer uses the extrinsic")
        assert transform == peer.get_extrinsic().extrinsic.transform.transform
        peer.node.pipeline.stop()
        peer._executors[0][0].shutdown(timeout_sec=1.0)
        peer.until(lambda: used() is None, what="that the consumer stops using it")
        executor.shutdown()
        user.destroy_node()
