"""Nodes beside another one are served from its timer, on its thread."""

from __future__ import annotations

import threading

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger
from waiting import until

from calib_ros.ros.executor import Beside

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]


def test_timers_and_services_of_all_nodes_are_served() -> None:
    rclpy.init()
    executor, threads = SingleThreadedExecutor(), list[int]()
    main, left, right = (rclpy.create_node(name) for name in ("main", "left", "right"))
    beside = Beside(main)
    beside.spin_ready()  # of no nodes
    executor.add_node(main)
    for node in (left, right):
        beside.add_node(node)
        node.create_timer(0.02, lambda: threads.append(threading.get_ident()))
    until(lambda: len(threads) >= 6, "timers", turn=executor.spin_once)
    assert set(threads) == {threading.get_ident()}
    left.create_service(Trigger, "ask", lambda _, answer: answer)
    asked = right.create_client(Trigger, "ask").call_async(Trigger.Request())
    until(asked.done, "an answer", turn=executor.spin_once)
    assert beside.shutdown(timeout_sec=1.0)
    assert executor.shutdown(timeout_sec=1.0)
    for node in (main, left, right):
        node.destroy_node()
    rclpy.try_shutdown()
