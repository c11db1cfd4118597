"""Answers of services, also those that take long, on an executor of one thread: it goes on with everything else meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future as Promise
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.service import Service
from rclpy.task import Future

from calib_ros.errors import CalibrationError
from calib_ros.ros.diagnostics import Health

# Of the executor: in the first one coroutines whose promise is done return, in the second one what they left to do is done.
ROUNDS = 2


def serve(
    kind: Any, name: str, node: Node, health: Health, answer: Callable[[Any, Any], Any], group: CallbackGroup | None = None
) -> Service:
    """A service. answer: fills the response to a request; what it raises becomes the message, since it would end the node. One
    that awaits blocks its group: in the node's own group it would block all others until it is done."""

    async def answered(request: Any, response: Any) -> Any:
        try:
            if (awaited := answer(request, response)) is not None:
                await awaited
        except CalibrationError as error:
            response.success, response.message = False, str(error)
        except Exception as error:
            response.success, response.message = False, health.unexpected(error)
        return response

    return node.create_service(kind, name, answered, callback_group=group)


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
