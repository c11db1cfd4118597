"""What the launch files make of their arguments."""

from __future__ import annotations

import pytest
from launch_files import started

FLEET = {"respawn": "true", "respawn_delay": "5", "log_level": "debug", "nice": "10"}


def test_a_node_as_usual() -> None:
    (node,) = started("calib.launch.py", image="/front/image_raw")
    assert (node.executable, node.namespace, node.remappings["image"]) == ("calib_node", "", "/front/image_raw")
    assert (node.respawn, node.prefix, node.ros_arguments) == (False, None, ["--log-level", "info"])


@pytest.mark.parametrize("file", ["calib.launch.py", "two_cameras.launch.py"])
def test_arguments_of_a_fleet_reach_every_node(file: str) -> None:
    nodes = started(file, managed="true", **FLEET)
    assert [node.namespace for node in nodes] == (["left", "right"] if file.startswith("two") else [""])
    for node in nodes:
        assert (node.executable, node.respawn, node.respawn_delay) == ("calib_lifecycle_node", True, 5.0)
        assert (node.ros_arguments, node.prefix) == (["--log-level", "debug"], "nice -n 10")


def test_two_nodes_share_a_lidar_and_nothing_else() -> None:
    left, right = started("two_cameras.launch.py", points="/lidar/points", left_image="/front/image_raw", state_dir="/data")
    assert left.remappings["points"] == right.remappings["points"] == "/lidar/points"
    assert (left.remappings["image"], right.remappings["image"]) == ("/front/image_raw", "/right/image_raw")
    assert {"state_file": "/data/left.json"} in left.parameters
    assert {"state_file": "/data/right.json"} in right.parameters


def test_a_word_that_is_no_choice_is_refused() -> None:
    with pytest.raises(AssertionError):
        started("calib.launch.py", respawn="yes")


def test_a_replay_passes_simulated_time_on() -> None:
    (node,) = started("replay.launch.py", bag="drive")
    assert {"use_sim_time": "true"} in node.parameters
