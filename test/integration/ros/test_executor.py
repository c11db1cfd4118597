"""Nodes beside the first one are spun as well, and the first one is not asked to wait for them."""

from __future__ import annotations

import pytest
import rclpy
from std_srvs.srv import Trigger
from waiting import until

from calib_ros.ros.executor import MainExecutor

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]


def test_timers_and_services_of_all_nodes_are_served() -> None:
    rclpy.init()
    executor, nodes, ticks = MainExecutor(), [rclpy.create_node(name) for name in ("main", "left", "right")], [0, 0, 0]

    def tick(k: int) -> None:
        ticks[k] += 1

    for k, node in enumerate(nodes):
        assert executor.add_node(node)
        node.create_timer(0.05, lambda k=k: tick(k))
    assert [node.executor is executor for node in nodes] == [True, False, False]
    until(lambda: min(ticks) >= 3, "timers", turn=lambda: executor.spin_once(timeout_sec=0.1))
    assert ticks[0] > ticks[1]  # as often as it is due, and at most five times a second
    nodes[1].create_service(Trigger, "ask", lambda _, answer: answer)
    client = nodes[2].create_client(Trigger, "ask")
    asked = client.call_async(Trigger.Request())
    until(asked.done, "an answer", turn=executor.spin_once)
    executor.remove_node(nodes[2])
    before = ticks[2]
    until(lambda: ticks[1] > before + 3, "the others", turn=executor.spin_once)
    assert ticks[2] == before
    assert executor.shutdown(timeout_sec=1.0)
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown()
