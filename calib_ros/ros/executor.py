"""Timers, and nodes that spin along with another one: what it costs to wait for a message must not grow with them.

rclpy asks every entity of every node before and after each wait: with the nodes of six pairs, whose services and timers hardly
ever have anything to do, that took more time than the messages.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.timer import Timer

MOST = 50  # callbacks in a row
SPIN_S = 0.2  # between two looks at these nodes: how late their services may answer


def every(node: Node, seconds: float, call: Callable[[], None]) -> Timer:
    """A timer of steady time: a simulated clock that stands still must not silence the node."""
    return node.create_timer(seconds, call, clock=Clock(clock_type=ClockType.STEADY_TIME))


class Beside(SingleThreadedExecutor):
    """Spun every SPIN_S, from a timer of the node that its nodes belong to and on the same thread."""

    _found = False

    def __init__(self, node: Node) -> None:
        super().__init__(context=node.context)
        self._node, self._timer = node, every(node, SPIN_S, self.spin_ready)

    def destroy(self) -> None:
        """End, and destroy its nodes."""
        self._node.destroy_timer(self._timer)
        nodes = self.get_nodes()
        self.shutdown(timeout_sec=SPIN_S)
        for own in nodes:
            own.destroy_node()

    def wait_for_ready_callbacks(self, *args: Any, **kwargs: Any) -> Any:
        """See `rclpy.executors.Executor`."""
        self._found = False
        ready = super().wait_for_ready_callbacks(*args, **kwargs)  # raises where there is nothing
        self._found = True
        return ready

    def spin_ready(self) -> None:
        """Do what is due by now."""
        for _ in range(MOST if self.get_nodes() else 0):
            self.spin_once(timeout_sec=0)
            if not self._found:
                break
