"""The executor of a node that others spin along with: what it costs to wait for a message does not grow with them.

rclpy asks every entity of every node before and after each wait: with the nodes of six pairs, whose services and timers hardly
ever have anything to do, that took more time than the messages.
"""

from __future__ import annotations

import time
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

BESIDE_S = 0.2  # how late services and timers of the other nodes may be
MOST = 50  # of their callbacks in a row


class _Counting(SingleThreadedExecutor):
    """ran: whether the last spin_once() had anything to do."""

    ran = False

    def wait_for_ready_callbacks(self, *args: Any, **kwargs: Any) -> Any:
        self.ran = False
        found = super().wait_for_ready_callbacks(*args, **kwargs)  # raises where there is nothing
        self.ran = True
        return found


class MainExecutor(SingleThreadedExecutor):
    """Spins the first node that is added as any executor does, and further ones now and then, on the same thread."""

    def __init__(self) -> None:
        super().__init__()
        self._beside = _Counting()
        self._spun_at = 0.0

    def add_node(self, node: Node) -> bool:
        """See `rclpy.executors.Executor`."""
        return super().add_node(node) if not self.get_nodes() else self._beside.add_node(node)

    def remove_node(self, node: Node) -> None:
        """See `rclpy.executors.Executor`."""
        super().remove_node(node)
        self._beside.remove_node(node)

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """See `rclpy.executors.Executor`."""
        if not self._beside.get_nodes():
            super().spin_once(timeout_sec)
            return
        super().spin_once(BESIDE_S if timeout_sec is None else min(timeout_sec, BESIDE_S))
        if time.monotonic() - self._spun_at >= BESIDE_S:
            for _ in range(MOST):
                self._beside.spin_once(timeout_sec=0)
                if not self._beside.ran:
                    break
            self._spun_at = time.monotonic()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """See `rclpy.executors.Executor`."""
        return all([self._beside.shutdown(timeout_sec=timeout_sec), super().shutdown(timeout_sec=timeout_sec)])
