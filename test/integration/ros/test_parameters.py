"""Parameters over real DDS: described, refused in one line, renamed, and changed while data flow."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import cv2
import numpy as np
import pytest
import rclpy
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.context import Context
from rclpy.parameter import Parameter
from ros_peer import Peer, camera_info_message
from vehicle import vehicle_fixture  # noqa: F401  # a fixture

from calib_ros.config import SearchConfig, preset, stages, update
from calib_ros.errors import CalibrationError, ConfigError
from calib_ros.online import recalibrator as recalibrator_module
from calib_ros.ros import parameters
from calib_ros.ros.node import CalibNode
from calib_ros.ros.parameters import LIVE, SETTINGS

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]


def test_misspelt_names_are_answered_with_the_nearest():
    declared = ["search.rotation_deg", "online.buffer_size", "publish_tf", "use_sim_time"]
    given = [
        *("serch.rotation_deg", "online.bufer_size", "publish_tf", "use_sim_time", "zzz", "start_type_description_service"),
        "qos_overrides./image.subscription.depth",
    ]
    assert parameters.misspelt(dict.fromkeys(given, 1), declared) == [
        "parameter 'online.bufer_size' is unknown and has no effect; did you mean 'online.buffer_size'?",
        "parameter 'serch.rotation_deg' is unknown and has no effect; did you mean 'search.rotation_deg'?",
        "parameter 'zzz' is unknown and has no effect; config/calib_ros.yaml lists all there are",
    ]
    assert parameters.misspelt({"search.distinct": 80}, []) == ["search.distinct has no effect any more; remove it"]


def test_misspelt_and_removed_names_are_logged_once_at_the_start(capfd):
    removed = {"search__distinct": 20, "lidar__jump_min": 0.3, "score__sigma": [16.0, 8.0, 4.0, 2.0, 1.2], "capture__keep": 3}
    with Peer(serch__rotation_deg=5.0, use_sim_time=False, online__buffer_size=9, **removed) as peer:
        assert peer.calibration.parameters.config.search.starts == SearchConfig().starts
        assert peer.set(tracker__drift_deg=0.3) == "tracker.drift_deg has no effect any more; remove it"
        assert not any(map(peer.node.has_parameter, ("capture.keep", "search.distinct")))
    lines = capfd.readouterr().err.splitlines()
    assert ["did you mean 'search.rotation_deg'?" in line for line in lines if "is unknown" in line] == [True]
    (line,) = [line for line in lines if "have no effect any more; remove them" in line]
    assert all(name in line for name in ("lidar.jump_min", "score.sigma", "capture.keep"))


def test_a_preset_holds_where_no_parameter_says_otherwise(capfd):
    with Peer(preset="thesis", thesis__operator="canny", use_sim_time=False) as peer:
        config = peer.calibration.parameters.config
        whole = update(preset("thesis"), {"thesis": {"operator": "canny"}})
        assert (config.refine, config.others, config.initial) == (whole.refine, whole.others, whole.initial)
        assert peer.node.get_parameter("refine.objective").value == "thesis"
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "the preset thesis is changed by the parameters" in line]
    assert line.endswith(", thesis.operator")  # beside those that every test of the node sets
    with pytest.raises(ConfigError, match="there is no preset 'thesys'; there are thesis, thesis-literal"):
        Peer(preset="thesys")


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"search__rotation_deg": -5.0}, "search.rotation_deg"),
        ({"initial_quaternion_xyzw": [0.0, 1.0]}, "quaternion"),
        ({"initial_translation_m": [0.0], "initial_quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}, "initial_translation_m"),
        ({"image_transport": "theora"}, "image_transport"),
        ({"overlay_period_s": -1}, "overlay_period_s"),
        ({"consumers": ["planner 0.5"]}, "'planner 0.5' must be NAME DEG M"),
        ({"consumers": [1, 2]}, "consumers = 1 must be of type str"),
        ({"constraints__sigma_m": [1.0, 2.0]}, "constraints.sigma_m"),
    ],
)
def test_bad_parameters_at_the_start(wrong, text):
    with pytest.raises(CalibrationError, match=text):
        Peer(**wrong)


def test_a_node_that_could_not_be_made_can_be_stopped():
    node, context = CalibNode.__new__(CalibNode), Context()
    rclpy.init(context=context)
    with pytest.raises(CalibrationError, match="image_transport"):
        CalibNode.__init__(node, context=context, parameter_overrides=[Parameter("image_transport", value="theora")])
    assert node.stop()
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_every_parameter_describes_its_meaning_and_range(vehicle):
    defaults = {name: setting.default for name, setting in SETTINGS.items()}
    defaults |= {f"{stage}.{f.name}": f.default for stage, cls in stages().items() for f in dataclasses.fields(cls)}
    client = vehicle.peer.peer.create_client(DescribeParameters, "/calib_ros/describe_parameters")
    found = vehicle.peer.call(client, DescribeParameters.Request(names=list(defaults))).descriptors
    assert [d.name for d in found] == list(defaults)
    for d in found:
        assert d.description
        ranged = d.floating_point_range or d.integer_range or d.additional_constraints
        assert ranged or isinstance(defaults[d.name], (bool, str)) or defaults[d.name] == () or d.name.startswith("initial_")
        assert d.read_only == (d.name in SETTINGS and d.name not in LIVE)


GOOD_VALUES: list[tuple[str, Any]] = [
    ("search.rotation_deg", 7),  # a whole number where a fraction may stand
    ("online.buffer_size", 9),
    ("image.max_width", 800),
    ("score.weight_reflectivity", 0.5),
    ("constraints.sigma_m", [0.1, 0.1, 0.2]),
    ("publish_tf", True),
    ("overlay_period_s", 0.07),
    ("reliability", "reliable"),
    ("online.mode", "manual"),
    ("refine.optimizer", "nelder_mead"),
    ("search.starts", 512),
]
BAD_VALUES: list[tuple[str, Any, str]] = [
    ("search.rotation_deg", -5.0, "search.rotation_deg"),
    ("search.rotation_deg", "wide", "must be of type float"),
    ("search.rotation_deg", float("nan"), "search.rotation_deg"),
    ("search.starts", 2**40, "search.starts"),
    ("search.starts", "many", "parameter type"),
    ("refine.optimizer", "magic", "refine.optimizer"),
    ("constraints.sigma_m", [1.0], "constraints.sigma_m"),
    ("online.min_keyframes", 150, "online.min_keyframes"),
    ("camera_frame", "other", "camera_frame"),
    ("tf_parent", "map", "tf_child must name its child"),
    ("serch.starts", 1, "did you mean 'search.starts'?"),
]


def test_rapid_changes_while_data_flow(vehicle, monkeypatch):
    """Every one is answered, good and bad by turns, and what holds is what was taken. No message is lost, and what is heavy is
    made once per keyframe at most."""
    peer, made = vehicle.peer, []
    client = peer.peer.create_client(SetParameters, "/calib_ros/set_parameters")
    before = {name: peer.node.get_parameter(name) for name, _ in GOOD_VALUES}
    original = recalibrator_module.Calibrator
    monkeypatch.setattr(
        recalibrator_module, "Calibrator", lambda *given, **named: made.append(given) or original(*given, **named)
    )
    counts, frames = peer.pipeline.pairing.synchronizer.counts, len(GOOD_VALUES)
    pairs, unpaired = counts.pairs, counts.unpaired_images

    def change(name: str, value: Any) -> Any:
        parameter = (value if isinstance(value, Parameter) else Parameter(name, value=value)).to_parameter_msg()
        return peer.call(client, SetParameters.Request(parameters=[parameter])).results[0]

    def held(name: str) -> Any:
        assert peer.pipeline.config == peer.calibration.parameters.config
        return peer.calibration.parameters.to_dict().get(name)

    for (name, value), (bad, wrong, text) in zip(GOOD_VALUES, BAD_VALUES, strict=True):
        for good in (value, before[name], value):
            answer = change(name, good)
            assert answer.successful, (name, answer.reason)
        assert held(name) == value
        kept = held(bad)
        refused = change(bad, wrong)
        assert not refused.successful, (bad, wrong)
        assert text in refused.reason
        assert held(bad) == kept
        peer.publish(vehicle.frame(1.0), settle=False)
    assert not change("search.starts", Parameter("search.starts", Parameter.Type.NOT_SET)).successful
    peer.until(lambda: peer.peer.count_publishers("/tf_static") == 1, "the publisher of TF")
    peer.until(lambda: counts.pairs == pairs + frames, "all pairs")
    peer.settle()
    vehicle.assert_kept()
    assert counts.unpaired_images == unpaired
    assert len(made) <= frames + 1
    for name, parameter in before.items():
        assert change(name, parameter).successful
        assert np.all(np.array(held(name)) == np.array(peer.node.get_parameter(name).value))
    peer.until(lambda: peer.peer.count_publishers("/tf_static") == 0, "the end of TF")
    vehicle.assert_recovers()
    vehicle.assert_kept()


def test_a_mask_that_cannot_be_used_is_refused_at_run_time_and_nothing_is_lost(vehicle, tmp_path):
    peer, frame = vehicle.peer, vehicle.frame()
    client = peer.peer.create_client(SetParameters, "/calib_ros/set_parameters")
    height, width = frame.image.shape[:2]
    pictures = {
        "no.png": (None, "No such file"),
        "text.png": (b"text", "no complete PNG"),
        "small.png": (np.full((9, 9), 255, np.uint8), f"is 9x9, the camera's image is {width}x{height}"),
        "black.png": (np.zeros((height, width), np.uint8), "leave 0.0 % of the image"),
    }
    for name, (content, text) in pictures.items():
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content if isinstance(content, bytes) else cv2.imencode(".png", content)[1].tobytes())
        wrong = Parameter("image.mask", value=str(path)).to_parameter_msg()
        answer = peer.call(client, SetParameters.Request(parameters=[wrong])).results[0]
        assert not answer.successful, name
        assert text in answer.reason
        assert "\n" not in answer.reason
    assert peer.pipeline.config.image.mask == ""
    vehicle.assert_kept()


def test_settings_take_effect_at_run_time(vehicle, tmp_path):
    peer, state = vehicle.peer, tmp_path / "state.json"
    recalibrator = peer.recalibrator
    peer.change(online__buffer_size=7)
    assert recalibrator.keyframes.features.maxlen == 7
    peer.change(state_file=str(state))  # from the next accepted estimate on
    vehicle.assert_recovers()
    assert json.loads(state.read_text())["status"] == "converged"

    # Rectified images: another camera, without a new CameraInfo.
    camera, message = peer.pipeline.camera, camera_info_message(vehicle.frame())
    message.p[0] *= 1.05
    peer.info_pub.publish(message)
    peer.change(image_is_rectified=True)
    peer.until(lambda: peer.pipeline.camera != camera)
    assert peer.pipeline.camera.K[0, 0] == pytest.approx(1.05 * camera.K[0, 0])
    peer.change(image_is_rectified=False)
    peer.until(lambda: peer.pipeline.camera == camera)
    assert peer.get_extrinsic().last_good_known  # the extrinsic stays through both, to be tested again
    vehicle.assert_recovers()
