"""What parts of the interface of a node have in common, and answers of services.

Also those that take long, on an executor of one thread: it goes on with everything else meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future as Promise
from functools import partial
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.task import Future

from calib_ros.errors import CalibrationError
from calib_ros.extensions import NodeService
from calib_ros.online.pipeline import Pipeline
from calib_ros.ros.diagnostics import Health
from calib_ros.ros.distributions import PublisherEventCallbacks
from calib_ros.ros.parameters import Parameters

# Of the executor: in the first one coroutines whose promise is done return, in the second one what they left to do is done.
ROUNDS = 2
NO_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)  # which rclpy would ask at every wake


class NodePart(NodeService):
    """A part of the interface of a node: `own`, a `Calibration`, which imports all its parts. What it publishes and serves ends
    with it."""

    def __init__(self, own: Any) -> None:
        self._own = own
        self._node: Node = own.node
        self._health: Health = own.health
        self._publishers: list[Publisher] = []
        self._ends: list[Callable[[], object]] = []  # of services

    @property
    def _parameters(self) -> Parameters:
        """As they are now."""
        given: Parameters = self._own.parameters
        return given

    @property
    def _pipeline(self) -> Pipeline:
        """Of a pair."""
        pipeline: Pipeline = self._own.pipeline
        return pipeline

    def _create_publisher(self, kind: Any, topic: str, qos: QoSProfile | int) -> Publisher:
        self._publishers.append(self._node.create_publisher(kind, topic, qos, event_callbacks=NO_EVENTS))
        return self._publishers[-1]

    def _serve(self, kind: Any, name: str, answer: Callable[[Any, Any], Any], group: CallbackGroup | None = None) -> None:
        """A service. answer: fills the response to a request; what it raises becomes the message, since it would end the node.
        One that awaits blocks its group: in the node's own group it would block all others until it is done."""

        async def answered(request: Any, response: Any) -> Any:
            try:
                if (awaited := answer(request, response)) is not None:
                    await awaited
            except CalibrationError as error:
                response.success, response.message = False, str(error)
            except Exception as error:
                response.success, response.message = False, self._health.unexpected(error)
            return response

        service = self._node.create_service(kind, name, answered, callback_group=group)
        self._ends.append(partial(self._node.destroy_service, service))

    def destroy(self) -> None:
        """To be called when no estimate is under way; answers that are made already are sent before."""
        for publisher in self._publishers:
            self._node.destroy_publisher(publisher)
        if self._ends:
            after_answers(self._node, lambda: [end() for end in self._ends])


def done(node: Node, promise: Promise[Any]) -> Future:
    """An awaitable of the promise itself, once it is done on whatever thread."""
    executor = node.executor
    awaitable: Future = Future(executor=executor)

    def finish(kept: Promise[Any]) -> None:
        awaitable.set_result(kept)
        executor.wake()  # it resumes waiting coroutines only when something else wakes it

    promise.add_done_callback(finish)
    return awaitable


def after_answers(node: Node, action: Callable[[], object]) -> None:
    """Call `action` when answers that wait for no promise any more are sent: without its service an answer ends the executor."""
    executor = node.executor
    if executor is None:
        action()
        return

    def later(rounds: int) -> None:  # no coroutine: one that the process ends before would be complained of
        if rounds:
            executor.create_task(later, rounds - 1)
        else:
            action()

    executor.create_task(later, ROUNDS)
