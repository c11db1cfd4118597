"""A goal of ~/calibrate from its sending to its outcome, for clients that show how far it is and may stop it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from calib_ros_msgs.action import Calibrate
from rclpy.action import ActionClient

NOT_TAKEN = "the node takes no requests now: it is not active, or about to end"
STOPPED = "stopped before the estimate was done"
TOO_LATE = "~/calibrate could not be stopped any more: its estimate is done"


class Goal:
    """One goal. Everything but stop() runs on the executor's thread, and stop() is to be called there too.

    on_progress: called with the stage and the share of it that is done, 0..1. on_outcome: once, with success, a message for a
    person and whether the goal was stopped; not at all if the node goes away. on_trouble: with a line when stopping fails.
    """

    def __init__(
        self,
        client: ActionClient[Any, Any, Any],
        on_progress: Callable[[str, float], None],
        on_outcome: Callable[[bool, str, bool], None],
        on_trouble: Callable[[str], None],
    ) -> None:
        self._on_progress, self._on_outcome, self._on_trouble = on_progress, on_outcome, on_trouble
        self._handle: Any = None
        self._to_stop = False
        client.send_goal_async(Calibrate.Goal(), feedback_callback=self._fed).add_done_callback(self._answered)

    def stop(self) -> None:
        """Ask the node to stop; as soon as it has taken the goal, if it has not yet."""
        self._to_stop = True
        if self._handle is not None:
            self._handle.cancel_goal_async().add_done_callback(self._asked_to_stop)

    def _fed(self, message: Any) -> None:
        self._on_progress(str(message.feedback.stage), float(message.feedback.progress))

    def _answered(self, future: Any) -> None:
        try:
            handle = future.result()
        except Exception as error:
            self._on_outcome(False, f"~/calibrate failed: {error}", False)
            return
        if not handle.accepted:
            self._on_outcome(False, NOT_TAKEN, False)
            return
        self._handle = handle
        handle.get_result_async().add_done_callback(self._ended)
        if self._to_stop:
            self.stop()

    def _asked_to_stop(self, future: Any) -> None:
        # It may have ended meanwhile: then its outcome says so.
        if future.exception() is None and not future.result().goals_canceling:
            self._on_trouble(TOO_LATE)

    def _ended(self, future: Any) -> None:
        try:
            answer = future.result()
        except Exception as error:
            self._on_outcome(False, f"~/calibrate failed: {error}", False)
            return
        stopped = answer.status == GoalStatus.STATUS_CANCELED
        self._on_outcome(bool(answer.result.success), STOPPED if stopped else str(answer.result.message), stopped)
