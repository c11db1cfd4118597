"""~/calibrate, a search and estimate now: a service that answers when it is done, and an action that tells how far it is."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import Future as Promise
from typing import Any

from calib_ros_msgs.action import Calibrate
from calib_ros_msgs.msg import Extrinsic as ExtrinsicMsg
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_srvs.srv import Trigger

from calib_ros.online.pipeline import Pipeline
from calib_ros.registration.progress import Callback
from calib_ros.result import CONVERGED, TENTATIVE, Extrinsic
from calib_ros.ros.answers import after_answers, done
from calib_ros.ros.diagnostics import Health

FEEDBACK_PERIOD_S = 0.1  # as often as a person can follow; a search reports some hundred times a second


class CalibrateServers:
    """Service and action. Requests of both over the same keyframes share one estimate, which ends when all are cancelled.

    message: makes the message of an extrinsic, of the current one without an argument.
    """

    def __init__(
        self, node: Node, pipeline: Pipeline, message: Callable[[Extrinsic | None], ExtrinsicMsg], health: Health
    ) -> None:
        self._node, self._pipeline, self._message, self._health = node, pipeline, message, health
        self._promises: dict[bytes, Promise[Extrinsic]] = {}  # of the goals under way, by their ids
        # A callback that awaits blocks its group: in the node's own group it would block all others until it is done. Requests
        # for an estimate share one, and must not wait for each other.
        self._service = node.create_service(Trigger, "~/calibrate", self._answer, callback_group=ReentrantCallbackGroup())
        self._action = ActionServer(
            node,
            Calibrate,
            "~/calibrate",
            self._execute,
            callback_group=ReentrantCallbackGroup(),
            goal_callback=lambda _: GoalResponse.REJECT if pipeline.paused else GoalResponse.ACCEPT,
            handle_accepted_callback=self._begin,
            cancel_callback=self._cancel,
        )

    def destroy(self) -> None:
        """To be called when no estimate is under way; answers that are made already are sent before."""
        after_answers(self._node, self._destroy)

    def _destroy(self) -> None:
        self._node.destroy_service(self._service)
        self._action.destroy()

    async def _answer(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        estimate = await done(self._node, self._pipeline.request_estimate())
        response.success, response.message = _outcome(estimate)
        return response

    def _begin(self, goal: ServerGoalHandle) -> None:
        self._promises[bytes(goal.goal_id.uuid)] = self._pipeline.request_estimate(self._feedback(goal))
        goal.execute()

    def _cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        promise = self._promises.get(bytes(goal.goal_id.uuid))
        return CancelResponse.ACCEPT if promise is not None and promise.cancel() else CancelResponse.REJECT

    async def _execute(self, goal: ServerGoalHandle) -> Calibrate.Result:
        key = bytes(goal.goal_id.uuid)
        estimate = await done(self._node, self._promises[key])
        del self._promises[key]
        result = Calibrate.Result()
        if estimate.cancelled():
            result.message, result.extrinsic = "cancelled", self._message(None)
            goal.canceled()
            return result
        result.success, result.message = _outcome(estimate)
        result.extrinsic = self._message(None if estimate.exception() else estimate.result())
        if result.success:
            goal.succeed()
        else:
            goal.abort()
        return result

    def _feedback(self, goal: ServerGoalHandle) -> Callback:
        """Progress of an estimate as feedback of a goal, on the thread of estimates."""
        last = float("-inf")

        def tell(stage: str, share: float) -> None:
            nonlocal last
            if time.monotonic() - last < FEEDBACK_PERIOD_S:
                return
            last = time.monotonic()
            try:
                goal.publish_feedback(Calibrate.Feedback(stage=stage, progress=min(max(float(share), 0.0), 1.0)))
            except Exception as error:  # it must not end the estimate, which others may share
                if self._node.context.ok():  # else the node is about to end
                    self._health.unexpected(error)

        return tell


def _outcome(estimate: Promise[Any]) -> tuple[bool, str]:
    """Whether an estimate was accepted, and what came of it, for a person."""
    error = estimate.exception()
    if error is not None:
        return False, str(error) or "stopped"
    result = estimate.result().result
    figures = f"{result.frames_used} keyframes, score {result.score:.3f}" if math.isfinite(result.score) else ""
    message = ". ".join(filter(None, [figures, result.reason]))
    return result.status in (CONVERGED, TENTATIVE), f"{result.status}: {message}"
