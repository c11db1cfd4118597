"""The node with a rig of two cameras and a LiDAR, or two, over real DDS: one solution, a dead driver, knocks, wrong files."""

from __future__ import annotations

import threading
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.time import Time
from rig_peer import RigPeer, again, describe, measured, poses
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from waiting import pause, until

from calib_ros import se3
from calib_ros.config import OnlineConfig
from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.export import FORMER
from calib_ros.lidar.edges import edge_points
from calib_ros.lidar.ego_motion import MISSING, estimate_motion
from calib_ros.messages import decode_cloud
from calib_ros.online import common
from calib_ros.online.common import Common
from calib_ros.online.pacing import Work
from calib_ros.registration import features
from calib_ros.rig.report import load
from calib_ros.ros import conversions
from calib_ros.ros.conversions import matrix_from_transform
from calib_ros.ros.dds import LATCHED
from calib_ros.ros.diagnostics import Health
from calib_ros.ros.inputs import UNSEEN_SCANS, PairInputs
from calib_ros.ros.node import CalibLifecycleNode, Calibration
from calib_ros.ros.rig_lidars import LidarsOfRig
from calib_ros_synthetic.rig import SyntheticRig

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
LEFT, RIGHT, TOP = "back_left", "back_right", "lidar_top"
SECONDS, TWO_S, PAUSE_S = 3.0, 4.0, 1.0  # of the drive, and before it begins again: too long for a motion from scan to scan
SETTINGS = {"seed": 3, "frames": 4, "width": 320, "clocks": 0.0, "speed": 4.0}


@pytest.fixture(scope="module")
def rig(rendered_once) -> SyntheticRig:
    return SyntheticRig("six_cameras_one_lidar", **SETTINGS)


@pytest.fixture(scope="module")
def driven(rig, tmp_path_factory, ros_in_this_process) -> Iterator[Any]:
    """A peer whose node has found both cameras; what was driven; how often what was computed."""
    items, counts = measured(rig, (LEFT, RIGHT), SECONDS), Counter[str]()

    def counted(what: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any) -> Any:
            counts[what] += 1
            return function(*given)

        return call

    file = describe(rig, (LEFT, RIGHT), tmp_path_factory.mktemp("rig") / "rig.yaml")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(conversions, "decode_cloud", counted("clouds", decode_cloud))
        patch.setattr(common, "estimate_motion", counted("motions", estimate_motion))
        patch.setattr(features, "edge_points", counted("scans", edge_points))
        with RigPeer(rig, (LEFT, RIGHT), file, publish_tf=True) as peer:
            peer.drive(items)
            yield SimpleNamespace(peer=peer, items=items, counts=counts, at=SECONDS)


def is_near(rig: SyntheticRig, peer: RigPeer, names: Any = (LEFT, RIGHT), D: Any = None) -> bool:
    errors = [se3.error(rig.reference(n) if D is None else D(n), T) for n, T in poses(peer.rigs[-1]) if n in names]
    return all(deg < 0.5 and m < 0.15 for deg, m in errors)


def test_one_solution_of_all_pairs_and_each_with_topics_of_its_own(rig, driven) -> None:
    peer = driven.peer
    peer.until(lambda: peer.usable() == {TOP, LEFT, RIGHT}, "all sensors")
    assert is_near(rig, peer), [se3.error(rig.reference(n), T) for n, T in poses(peer.rigs[-1])]
    message = peer.rigs[-1]
    assert (message.reference, message.header.frame_id, list(message.moved), list(message.rejected)) == (TOP, TOP, [], [])
    assert message.text == "3 of 3 sensors usable"
    assert [s.transform.child_frame_id for s in message.sensors] == [TOP, rig.frame_id(LEFT), rig.frame_id(RIGHT)]
    assert all(s.covariance[0] > 0 for s in message.sensors if s.name != TOP)
    for camera in (LEFT, RIGHT):
        newest = peer.extrinsics[camera][-1]
        assert (newest.transform.header.frame_id, newest.usable) == (rig.frame_id(camera), True)
    peer.until(lambda: "calib_ros: rig" in peer.statuses and peer.statuses["calib_ros: rig"].level == DiagnosticStatus.OK)
    assert {f"calib_ros/{c}/{TOP}: extrinsic" for c in (LEFT, RIGHT)} <= peer.statuses.keys()


def test_each_cloud_is_decoded_once_and_each_scan_aligned_once(driven) -> None:
    clouds = sum(name == TOP for _, name, _ in driven.items)
    assert 0 < driven.counts["clouds"] <= clouds
    first, second = (driven.peer.pair(c).pipeline for c in (LEFT, RIGHT))
    assert 0 < driven.counts["motions"] <= clouds
    assert driven.counts["scans"] < first.recalibrator.keyframes.seen + second.recalibrator.keyframes.seen
    assert first.load._purse is second.load._purse
    adaptive = [driven.peer.pair(c).sensors.adaptive for c in (LEFT, RIGHT)]
    assert [[own.tells for own in of_pair] for of_pair in adaptive] == [[True, True, True], [True, False, True]]  # losses once


def test_tf_is_one_tree_from_the_reference(rig, driven) -> None:
    got = []
    driven.peer.peer.create_subscription(TFMessage, "/tf_static", got.append, LATCHED)
    driven.peer.until(lambda: got, "/tf_static")
    tree = [(t.header.frame_id, t.child_frame_id) for t in got[-1].transforms]
    assert tree == [(TOP, rig.frame_id(name)) for name in (LEFT, RIGHT)]


def doubted(peer: RigPeer, since: int, *names: str) -> list[str]:
    """What was said against some sensors."""
    said = [peer.sensor(name, rig) for rig in peer.rigs[since:] for name in names]
    return sorted({f"{own.name}: {own.status}: {own.reason}" for own in said if not own.usable})


def test_a_dead_driver_is_named_and_the_other_pair_stays(driven) -> None:
    peer = driven.peer
    peer.change(max_data_age_s=3.0, online__mode="manual")
    assert peer.pair(RIGHT).parameters["max_data_age_s"] == 3.0
    before = len(peer.rigs)
    driven.at = 0.0
    while peer.sensor(LEFT).status != "unchecked":  # lap after lap: the LiDAR must not fall silent, too
        driven.at += SECONDS + PAUSE_S
        for item in again(driven.items, driven.at):
            peer.drive([item], without=[LEFT])
            pause()
            if peer.sensor(LEFT).status == "unchecked":
                break
    left = peer.until(lambda: peer.sensor(LEFT).status == "unchecked" and peer.sensor(LEFT))
    assert left.reason == f"nothing comes from {LEFT} on /{LEFT}/image"
    peer.until(lambda: LEFT in peer.extrinsics[LEFT][-1].reason, "the reason of the pair")
    assert doubted(peer, before, TOP, RIGHT) == []
    driven.at += SECONDS + PAUSE_S
    peer.drive(again(driven.items, driven.at)[:12])
    peer.until(lambda: peer.usable() == {TOP, LEFT, RIGHT}, "that it is used again")
    peer.change(max_data_age_s=3600.0, online__mode="continuous")


def test_files_are_written_once_all_sensors_are_usable_and_a_wrong_one_is_refused(rig, driven, tmp_path) -> None:
    peer, frames = driven.peer, [rig.frame_id(name) for name in (TOP, LEFT, RIGHT)]
    result, urdf, kit, chain = (tmp_path / name for name in ("rig.json", "car.urdf", "kit.yaml", "camchain.yaml"))
    joints = [f'<joint name="{c}" type="fixed"><parent link="{TOP}"/><child link="{c}"/></joint>' for c in frames[1:]]
    urdf.write_text(f'<robot name="car">{"".join(joints)}</robot>')
    kit.write_text(f"{TOP}:\n  imu: {{x: 1}}  # by hand\n  {frames[1]}: {{x: 0, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}}\n")
    before, wrong = kit.read_text(), tmp_path / "other.urdf"
    wrong.write_text('<robot name="car"><joint name="a" type="fixed"><parent link="b"/><child link="c"/></joint></robot>')
    refused = peer.node.set_parameters_atomically([Parameter("export.on_converged", value=[str(wrong)])])
    assert f"{wrong} has no joint between the sensors" in refused.reason
    peer.change(export__on_converged=[str(path) for path in (result, urdf, kit, chain)])
    peer.until(lambda: "camera back_left: Kalibr has no plumb_bob lens" in peer.calibration.health.last_error[0], "the last file")
    solution = load(result)
    known = dict(poses(peer.rigs[-1]))
    for name, T in solution.poses.items():
        np.testing.assert_allclose(T, known[name], atol=1e-6)
    origins = {j.get("name"): [float(v) for v in j.find("origin").get("xyz").split()] for j in ET.parse(urdf).getroot()}
    for name, frame in ((LEFT, frames[1]), (RIGHT, frames[2])):
        np.testing.assert_allclose(origins[frame], solution.poses[name][:3, 3], atol=1e-9)
    entries = yaml.safe_load(kit.read_text())[TOP]
    np.testing.assert_allclose([entries[frames[1]][k] for k in "xyz"], solution.poses[LEFT][:3, 3], atol=1e-9)
    assert "imu: {x: 1}  # by hand" in kit.read_text()
    assert Path(f"{kit}{FORMER}").read_text() == before
    assert not chain.exists()

    peer.trigger("reset")
    peer.until(lambda: peer.rigs[-1].text.startswith("0 of 3"), "the reset")
    later = tmp_path / "later.json"
    peer.change(export__on_converged=[str(later)])
    peer.calibration.files.submit(int).result()  # files are written one after the other
    assert not later.exists()
    driven.at += SECONDS + PAUSE_S
    peer.drive(again(driven.items, driven.at))
    peer.until(later.exists, "all sensors again")
    for deg, m in (se3.error(rig.reference(name), T) for name, T in load(later).poses.items()):
        assert deg < 0.5
        assert m < 0.15
    peer.change(export__on_converged=[])


@pytest.mark.slow
def test_a_knocked_camera_is_named_with_its_size_and_found_again(rig, driven) -> None:
    peer = driven.peer
    knocked = SyntheticRig("six_cameras_one_lidar", **SETTINGS, knock=LEFT, knock_at=0.0, knock_deg=2.0, knock_m=0.08)
    pictures = ((stamp, LEFT, value) for stamp, value in knocked.pictures(LEFT))
    items = [next(pictures) if item[1] == LEFT else item for item in driven.items]
    driven.at += SECONDS + PAUSE_S
    before = len(peer.rigs)
    peer.drive(again(items, driven.at))
    for _ in range(3):
        driven.at += SECONDS + PAUSE_S
        if peer.usable() == {TOP, LEFT, RIGHT} and peer.sensor(LEFT).moved_deg:
            break
        peer.drive(again(items, driven.at))
    peer.until(lambda: peer.usable() == {TOP, LEFT, RIGHT}, "that it is found again")
    assert [LEFT] in [list(rig.moved) for rig in peer.rigs[before:]]
    assert doubted(peer, before, RIGHT) == []
    left = peer.sensor(LEFT)
    assert (left.moved_deg, left.moved_m) == (pytest.approx(2.0, abs=0.5), pytest.approx(0.08, abs=0.08))
    assert f"{LEFT} moved by" in peer.rigs[-1].text
    stamp = driven.items[-1][0]
    assert is_near(rig, peer, (LEFT,), lambda name: knocked.reference_at(name, stamp))


@pytest.fixture(scope="module")
def two(tmp_path_factory, ros_in_this_process) -> Iterator[Any]:
    """A peer whose node has a camera with one of two LiDARs, and what was driven; the other one has no camera."""
    rig = SyntheticRig("two_lidars_three_cameras", **SETTINGS | {"frames": 5})
    items, file = measured(rig, ("front",), TWO_S, 2, 5.0), tmp_path_factory.mktemp("two") / "rig.yaml"
    describe(rig, ("front",), file, 2, pairs=[["front", "lidar_left"], ["lidar_right", "lidar_left"]])
    with RigPeer(rig, ("front",), file, 2) as peer:
        peer.drive(items)
        yield SimpleNamespace(peer=peer, items=items, rig=rig, at=0.0)


def test_two_lidars_are_registered_to_each_other(two) -> None:
    peer, all_three = two.peer, {"lidar_left", "lidar_right", "front"}
    peer.until(lambda: peer.usable() == all_three, "all sensors")
    (edge,) = [own for own in peer.rigs[-1].edges if own.kind == "scans"]
    assert (edge.target, edge.source) == ("lidar_right", "lidar_left")
    assert (edge.status, edge.reason, edge.usable) == ("converged", "", True)
    truth = two.rig.reference("lidar_right")
    told = se3.inverse(matrix_from_transform(edge.transform))
    for T in (told, dict(poses(peer.rigs[-1]))["lidar_right"]):
        deg, m = se3.error(truth, T)
        assert deg < 0.1
        assert m < 0.03
    assert 0 < edge.covariance[0] < 0.02**2
    assert Time.from_msg(peer.sensor("lidar_right").transform.header.stamp).nanoseconds > two.items[0][0]
    values = {v.key: v.value for v in peer.until(lambda: peer.statuses.get("calib_ros: rig")).values}
    assert values["lidar_right with lidar_left"] == "converged"
    assert edge.rotation_deg < 0.1
    load = peer.calibration.graph.lidars[0].load
    assert load._purse is peer.pair("front").pipeline.load._purse
    assert load.counts().seconds[Work.ESTIMATES] > 0


def test_without_the_library_lidars_keep_their_priors_and_one_line_says_so(two, monkeypatch) -> None:
    """Of scans of the node that has it and goes on beside this."""
    own = two.peer.calibration.graph.lidars[0]

    def missing(*_: Any) -> None:
        raise MissingDependencyError(MISSING)

    common, health = Common(OnlineConfig()), Health(two.peer.node.get_logger())
    monkeypatch.setattr(common, "scans", lambda _: SimpleNamespace(motion=missing))
    alone = LidarsOfRig(own._own, own.names, {}, own._decoded, common, own._start)
    alone._health = health
    scans = {name: list(recent) for name, recent in own._recent.items()}
    for name in own.names:
        alone._recent[name].extend(scans[name])
    for name, recent in scans.items():
        for stamp, message in recent * 2:
            alone._add(name, stamp, message)
            assert alone.worker.wait_idle(240)
    line = f"lidar_right and lidar_left are not registered to each other, their priors are used: {MISSING}"
    assert (health.errors, health.last_error[0]) == (1, line)
    assert (alone.state().status, alone.state().edge()) == ("initial", None)
    assert MISSING in alone.state().reason
    assert alone.worker.stop()


def test_a_reset_forgets_what_the_lidars_told_of_each_other(two) -> None:
    """Of a pair, the registrations of its LiDAR; of the rig, everything. Last, since the node then knows nothing."""
    peer = two.peer
    (own,) = peer.calibration.graph.lidars
    before = own.pair

    def forgets(name: str) -> None:
        assert own.pair.extrinsic.accepted
        peer.trigger(name)
        assert (own.pair is before, own.pair.extrinsic.accepted) == (False, 0)
        peer.until(lambda: peer.sensor("front").status != "converged" and not peer.usable(), "that nothing is known")
        np.testing.assert_allclose(own._start(), se3.inverse(two.rig.prior("lidar_right")), atol=1e-6)

    forgets("front/lidar_left/reset")
    two.at += TWO_S + PAUSE_S
    for item in again(two.items, two.at):
        peer.drive([item])
        if len(peer.usable()) == 3:
            break
    peer.until(lambda: len(peer.usable()) == 3, "all sensors")
    forgets("reset")


@pytest.mark.parametrize("given", [True, False])
def test_a_pair_that_shares_no_view_by_its_priors_is_left_out_unless_it_is_listed(rig, given) -> None:
    """Of the front camera, the points behind the vehicle."""
    cloud, camera, told = rig.scans(TOP)[0][1], rig.camera("front"), []
    behind = replace(cloud, xyz=cloud.xyz * np.float32([-1, -1, 1])).select(cloud.xyz[:, 0] > 0)
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    pair = PairInputs(None, lambda _: image, lambda _: behind, None, "front", TOP)
    pair.T, pair.unseen = se3.inverse(rig.reference("front")), None if given else told.append
    message = SimpleNamespace(header=Header())
    if given:
        assert pair.frame(message, message, camera).image is image
        return
    for _ in range(UNSEEN_SCANS):
        assert not told
        with pytest.raises(BadInputError, match="front and lidar_top share no view by their priors"):
            pair.frame(message, message, camera)
    assert len(told) == 1
    pair.cloud = lambda _: cloud
    assert pair.frame(message, message, camera).image is image  # the scans before were parts


def test_a_managed_node_makes_its_pairs_and_leaves_none_behind(rig, tmp_path) -> None:
    context = Context()
    rclpy.init(context=context)
    file = str(describe(rig, (LEFT, RIGHT), tmp_path / "rig.yaml"))
    node = CalibLifecycleNode(context=context, parameter_overrides=[Parameter("rig_file", value=file)])
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    asking = rclpy.create_node("asking", context=context)
    executor.add_node(asking)
    spin = partial(executor.spin_once, 0.1)

    def alone() -> bool:
        return {n for n, _ in asking.get_node_names_and_namespaces()} == {"calib_ros", "asking"}

    right = Path(file).read_text()
    described = yaml.safe_load(right)
    described["sensors"][RIGHT]["mask"] = file  # no picture, which is found after the first pair has been made
    Path(file).write_text(yaml.safe_dump(described))
    assert node.trigger_configure() != TransitionCallbackReturn.SUCCESS
    until(alone, "the end of the pair that was made", turn=spin)
    assert not any(thread.name.startswith("calib_") and TOP in thread.name for thread in threading.enumerate())
    Path(file).write_text(right)
    for transition in (node.trigger_configure, node.trigger_activate):
        assert transition() == TransitionCallbackReturn.SUCCESS
    for camera in (LEFT, RIGHT):  # whoever spins the node spins its pairs
        client = asking.create_client(Trigger, f"/calib_ros/{camera}/{TOP}/reset")
        until(client.service_is_ready, "the service", turn=spin)
        asked = client.call_async(Trigger.Request())
        until(asked.done, "an answer", turn=spin)
        assert asked.result().success
    for transition in (node.trigger_deactivate, node.trigger_cleanup):
        assert transition() == TransitionCallbackReturn.SUCCESS
    assert node.calibration is None
    until(alone, "their end", turn=spin)
    executor.shutdown()
    asking.destroy_node()
    node.destroy_node()
    rclpy.try_shutdown(context=context)


NO_ENTRY = "reference: a\nsensors: {a: {kind: lidar, frame: a}, b: {kind: camera, frame: b}}"
NOT_JOINED = "reference: a\nsensors: {a: {kind: lidar}, b: {kind: camera}, c: {kind: camera}}\npairs: [[b, a]]"


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ("sensors: 3", "reference is missing"),
        ("reference: a\nsensors: {a: {kind: lidar}, b-1: {kind: camera, prior: tf}}", "sensors.b-1 cannot be part of a topic"),
        ("reference: a\nsensors: {a: {kind: lidar}, b: {kind: lidar}}", "pairs holds no camera"),
        ("reference: a\nsensors: {a: {kind: lidar}, b: {kind: camera, topc: /b}}", "do you mean topic?"),
        # Files that no solution can be written to.
        (NOT_JOINED, "no pairs join c to a; add"),
        (NO_ENTRY, "has no entry between the sensors; name one of a -> b, b -> a"),
    ],
)
def test_a_wrong_rig_file_is_refused_by_what_is_wrong(tmp_path, wrong, named) -> None:
    file, kit = tmp_path / "rig.yaml", tmp_path / "kit.yaml"
    file.write_text(wrong)
    kit.write_text("base_link: {imu: {x: 0}}\n")
    context = Context()
    rclpy.init(context=context)
    given = {"rig_file": str(file), "export.on_converged": [str(kit)]}
    node = CalibLifecycleNode(context=context, parameter_overrides=[Parameter(n, value=v) for n, v in given.items()])
    with pytest.raises(BadInputError) as caught:
        Calibration(node)
    node.destroy_node()
    rclpy.try_shutdown(context=context)
    said = str(caught.value)
    assert said.startswith(str(file)) == (wrong not in (NO_ENTRY, NOT_JOINED))
    assert named in said
    assert "\n" not in said
