"""The services that answer at once, and ~/calibrate: a service that answers when it is done, and an action."""

from __future__ import annotations

import math
import time
from concurrent.futures import Future as Promise
from typing import Any

from calib_ros_msgs.action import Calibrate
from calib_ros_msgs.msg import Extrinsic as ExtrinsicMsg
from calib_ros_msgs.srv import GetExtrinsic
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from std_srvs.srv import Trigger

from calib_ros.registration.progress import Callback
from calib_ros.result import CONVERGED, TENTATIVE, Extrinsic
from calib_ros.ros.parts import NodePart, done

FEEDBACK_PERIOD_S = 0.1  # as often as a person can follow; a search reports some hundred times a second


class Services(NodePart):
    """~/get_extrinsic, ~/reset, ~/save and ~/calibrate, whose requests over the same keyframes share one estimate, which ends
    when all are cancelled."""

    def __init__(self, own: Any) -> None:
        super().__init__(own)
        self._promises: dict[bytes, Promise[Extrinsic]] = {}  # of the goals under way, by their ids
        group = ReentrantCallbackGroup()  # requests for an estimate share one, and must not wait for each other
        self._serve(GetExtrinsic, "~/get_extrinsic", self._get_extrinsic)
        self._serve(Trigger, "~/reset", self._reset)
        self._serve(Trigger, "~/save", self._save)
        self._serve(Trigger, "~/calibrate", self._calibrate, group)
        action = ActionServer(
            self._node,
            Calibrate,
            "~/calibrate",
            self._execute,
            callback_group=ReentrantCallbackGroup(),
            goal_callback=lambda _: GoalResponse.REJECT if self._pipeline.paused else GoalResponse.ACCEPT,
            handle_accepted_callback=self._begin,
            cancel_callback=self._cancel,
        )
        self._ends.append(action.destroy)

    def _message(self, extrinsic: Extrinsic | None = None) -> ExtrinsicMsg:
        """The message of an extrinsic as of now; None = of the current one, the initial one before any."""
        recalibrator = self._pipeline.recalibrator
        if extrinsic is None and recalibrator is not None:
            extrinsic = recalibrator.current
        if extrinsic is None:
            return self._own.extrinsic.message(Extrinsic(self._own.initial.before_messages()), 0)
        return self._own.extrinsic.message(extrinsic)

    def _get_extrinsic(self, request: GetExtrinsic.Request, response: GetExtrinsic.Response) -> None:
        recalibrator = self._pipeline.recalibrator
        if recalibrator is None:
            response.extrinsic = self._message()
            response.message = "no pair of image and cloud with a CameraInfo yet; this is the initial extrinsic"
            return
        extrinsic = recalibrator.current
        response.extrinsic = self._message(extrinsic)
        response.success = response.extrinsic.usable
        last_good = self._own.extrinsic.last_good()
        if last_good is not None:
            response.last_good_known, response.last_good = True, last_good
        more = recalibrator.config.online.min_keyframes - len(recalibrator.keyframes)
        waiting = f"waiting for {more} more keyframes" if more > 0 else "no estimate yet"
        made = f"estimated from {extrinsic.result.frames_used} keyframes"
        response.message = response.extrinsic.reason or (made if response.success else waiting)

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> None:
        self._own.reset()
        response.success, response.message = True, "keyframes forgotten, back to the initial extrinsic"

    def _save(self, request: Trigger.Request, response: Trigger.Response) -> None:
        recalibrator = self._pipeline.recalibrator
        last_good = recalibrator.tracker.last_good if recalibrator is not None else None
        if recalibrator is None or last_good is None:
            response.message = "nothing to save: no estimate has been accepted yet"
        elif recalibrator.tracker.lost:
            response.message = "nothing saved: the calibration has moved; wait until it is found again, or call ~/calibrate"
        elif recalibrator.tracker.tentative:
            response.message = f"nothing saved: {recalibrator.current.result.reason}"
        else:
            response.success, response.message = self._own.initial.save(last_good)

    async def _calibrate(self, request: Trigger.Request, response: Trigger.Response) -> None:
        response.success, response.message = _outcome(await done(self._node, self._pipeline.request_estimate()))

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
