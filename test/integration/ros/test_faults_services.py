"""Parameters, services and state files under stress, over real DDS in this process. The same node recovers afterwards."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from calib_ros_msgs.srv import GetExtrinsic
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from ros_peer import Peer
from std_srvs.srv import Trigger
from vehicle import QUICK, Vehicle, is_right, vehicle_fixture  # noqa: F401  # fixtures

from calib_ros.frame import Frame
from calib_ros.ros.client import result_from_message
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
GOOD_VALUES: list[tuple[str, Any]] = [
    ("search.rotation_deg", 4.0),
    ("online.buffer_size", 9),
    ("image.max_width", 800),
    ("score.weight_reflectivity", 0.5),
    ("constraints.sigma_m", [0.1, 0.1, 0.2]),
    ("online.pair_queue", 4),
    ("search.translation_m", 0.25),
    ("online.mode", "manual"),
    ("refine.optimizer", "nelder_mead"),
    ("search.starts", 512),
]
BAD_VALUES: list[tuple[str, Any]] = [
    ("search.rotation_deg", -5.0),
    ("search.rotation_deg", float("nan")),
    ("search.starts", 2**40),
    ("search.starts", "many"),
    ("refine.optimizer", "magic"),
    ("constraints.sigma_m", [1.0]),
    ("score.weight_reflectivity", float("inf")),
    ("online.min_keyframes", 150),
    ("camera_frame", "other"),
    ("search.nothing", 1),
]


def test_rapid_parameter_changes(vehicle: Vehicle) -> None:
    """40 changes, good and bad by turns, while data flows: every one is answered, and what holds is what was taken."""
    peer = vehicle.peer
    client = peer.peer.create_client(SetParameters, "/calib_ros/set_parameters")
    before = {name: peer.node.get_parameter(name) for name, _ in GOOD_VALUES}

    def change(name: str, value: Any) -> Any:
        """Over DDS, between two frames."""
        parameter = (value if isinstance(value, Parameter) else Parameter(name, value=value)).to_parameter_msg()
        answer = peer.call(client, SetParameters.Request(parameters=[parameter])).results[0]
        peer.publish(vehicle.frame(1.0), settle=False)
        return answer

    def config(name: str) -> Any:
        stage, _, field = name.partition(".")
        return getattr(getattr(peer.pipeline.config, stage, None), field, None)

    try:
        for k in range(20):
            (good, value), (bad, wrong) = GOOD_VALUES[k % len(GOOD_VALUES)], BAD_VALUES[k % len(BAD_VALUES)]
            answer = change(good, value if k < 10 else before[good])
            assert answer.successful, (good, answer.reason)
            held = config(bad)
            refused = change(bad, wrong)
            assert not refused.successful, (bad, wrong)
            assert refused.reason
            assert config(bad) == held
        assert not change(good, Parameter(good, Parameter.Type.NOT_SET)).successful
        peer.settle()
        vehicle.assert_kept()
    finally:
        for name, parameter in before.items():
            assert change(name, parameter).successful
    for name, parameter in before.items():
        shown = peer.node.get_parameter(name).value
        assert np.all(np.array(shown) == np.array(parameter.value))
        assert np.all(np.array(config(name)) == np.array(shown))
    vehicle.assert_recovers()
    vehicle.assert_kept()


def test_eight_concurrent_clients(vehicle: Vehicle) -> None:
    """Each asks everything in an order of its own, while data flows. Every call is answered, and all tell of one state."""
    peer = vehicle.peer
    nodes = [rclpy.create_node(f"client_{k}", context=peer.context) for k in range(8)]
    for node in nodes:
        peer._executors[1][0].add_node(node)
    answers: list[tuple[str, Any]] = []

    def ask(k: int) -> None:
        rng = np.random.default_rng(k)
        for name in rng.permutation(["get_extrinsic"] * 4 + ["save", "reset", "calibrate", "capture"]):
            kind = GetExtrinsic if name == "get_extrinsic" else Trigger
            answers.append((name, peer.call(nodes[k].create_client(kind, f"/calib_ros/{name}"), kind.Request())))

    threads = [threading.Thread(target=ask, args=(k,)) for k in range(8)]
    try:
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            peer.publish(vehicle.frame(1.0), settle=False)
            time.sleep(0.1)
    finally:
        for thread in threads:
            thread.join()
        for node in nodes:
            peer._executors[1][0].remove_node(node)
            node.destroy_node()
    assert len(answers) == 8 * 8
    start = peer.recalibrator.tracker.initial.T_camera_lidar
    for name, answer in answers:
        if name == "get_extrinsic":
            T = result_from_message(answer.extrinsic).T_camera_lidar
            assert np.allclose(T, start, atol=1e-9) or is_right(vehicle.reference, answer.extrinsic, 1.5)
        else:
            assert answer.message
    assert all(answer.success for name, answer in answers if name == "reset")
    peer.settle()
    current = peer.recalibrator.current
    np.testing.assert_allclose(
        result_from_message(peer.get_extrinsic().extrinsic).T_camera_lidar, current.result.T_camera_lidar, atol=1e-9
    )
    vehicle.assert_recovers()  # after the last reset
    vehicle.forget_published()
    now = peer.get_extrinsic().extrinsic
    peer.until(lambda: peer.extrinsics[-1].transform.transform == now.transform.transform, "the current extrinsic as a message")
    assert peer.trigger("save").success
    saved = json.loads(Path(peer.calibration.parameters["state_file"]).read_text())
    np.testing.assert_allclose(saved["T_camera_lidar"], result_from_message(now).T_camera_lidar, atol=1e-9)


def test_a_state_folder_that_cannot_be_written(vehicle: Vehicle) -> None:
    """A file stands where the folder was: not even root can write there. The node says so, and goes on."""
    peer = vehicle.peer
    state = Path(peer.calibration.parameters["state_file"])
    before, aside = state.read_bytes(), state.parent.with_name("aside")
    state.parent.rename(aside)
    state.parent.write_text("")
    try:
        errors = peer.calibration.health.errors
        vehicle.assert_recovers()  # it tries to save what it found
        assert peer.calibration.health.errors > errors
        assert "cannot write" in peer.last_error()
        refusal = peer.refusal("save")
        assert refusal == peer.last_error()
        assert str(state) in refusal
        peer.change(capture_dir=str(state.parent), capture_frames=1)
        peer.publish(vehicle.frame())
        assert f"{state.parent} cannot be written" in peer.refusal("capture")
    finally:
        state.parent.unlink()
        aside.rename(state.parent)
        peer.change(capture_frames=0)
    assert state.read_bytes() == before
    assert peer.trigger("save").success
    assert os.listdir(state.parent) == [state.name]
    vehicle.assert_recovers()
    vehicle.assert_kept()


@pytest.mark.parametrize(
    ("damage", "parameters"),
    [
        (lambda text: text[: len(text) // 2].encode(), {}),  # TF is waited for: the question comes again with every pair
        (lambda text: b"", {"initial_from_tf": False}),
        (lambda text: b"\x00\xff\xfe" * 300, {"initial_from_tf": False}),
        (lambda text: text.replace("0.0", "NaN", 4).encode(), {"initial_from_tf": False}),
        (lambda text: text.encode().replace(b'"width": 640', b'"width": "wide"'), {"initial_from_tf": False}),
    ],
    ids=["truncated", "empty", "binary", "nan", "camera"],
)
def test_a_damaged_state_file_at_the_start(
    damage: Callable[[str], bytes],
    parameters: dict[str, Any],
    drive: SyntheticDrive,
    street: list[Frame],
    vehicle: Vehicle,
    tmp_path: Path,
) -> None:
    """The node says so once, and starts from the other sources."""
    good = Path(vehicle.peer.calibration.parameters["state_file"]).read_text()
    state = tmp_path / "state.json"
    state.write_bytes(damage(good))
    with Peer(**QUICK, **parameters, state_file=str(state)) as peer:
        early = peer.get_extrinsic()
        assert not early.success
        fresh = Vehicle(peer, street, drive.reference)
        peer.publish_camera(fresh.frame())
        peer.until(lambda: fresh.send(fresh.frame()) or peer.recalibrator)
        assert "state" in peer.last_error()
        assert peer.calibration.health.errors == 1
        first = peer.until(lambda: peer.extrinsics)[0]
        assert first.status == "initial"
        assert "nominal" in first.reason
