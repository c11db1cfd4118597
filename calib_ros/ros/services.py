"""The services that answer at once, and ~/capture."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from typing import Any

from calib_ros_msgs.msg import Extrinsic as ExtrinsicMsg
from calib_ros_msgs.srv import GetExtrinsic
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from std_srvs.srv import Trigger

from calib_ros.errors import CalibrationError
from calib_ros.online.pipeline import Pipeline
from calib_ros.result import Extrinsic, Result
from calib_ros.ros.answers import after_answers, done
from calib_ros.ros.capture import Capture
from calib_ros.ros.diagnostics import Health
from calib_ros.ros.initial_extrinsic import InitialExtrinsic
from calib_ros.ros.publishers import ExtrinsicPublisher


class Services:
    """~/get_extrinsic, ~/reset, ~/save and ~/capture.

    save: writes a result to the state file. publisher: of ~/extrinsic. files: writes captures. events: for these. reset: forgets
    what was found.
    """

    def __init__(
        self,
        node: Node,
        pipeline: Pipeline,
        initial: InitialExtrinsic,
        capture: Capture,
        save: Callable[[Result], tuple[bool, str]],
        publisher: ExtrinsicPublisher,
        health: Health,
        files: Executor,
        events: Callable[[], str],
        reset: Callable[[], None],
    ) -> None:
        self._health = health
        self._node, self._pipeline, self._initial, self._recorder = node, pipeline, initial, capture
        self._write, self._publisher, self._files, self._events, self._forget = save, publisher, files, events, reset
        self._services = [
            node.create_service(GetExtrinsic, "~/get_extrinsic", self._safe(self._get_extrinsic)),
            # A callback that awaits blocks its group: in the node's own group it would block all others until it is done.
            node.create_service(Trigger, "~/capture", self._capture, callback_group=MutuallyExclusiveCallbackGroup()),
            node.create_service(Trigger, "~/reset", self._safe(self._reset)),
            node.create_service(Trigger, "~/save", self._safe(self._save)),
        ]

    def message(self, extrinsic: Extrinsic | None = None) -> ExtrinsicMsg:
        """The message of an extrinsic as of now; None = of the current one, the initial one before any."""
        recalibrator = self._pipeline.recalibrator
        if extrinsic is None and recalibrator is not None:
            extrinsic = recalibrator.current
        if extrinsic is None:
            return self._publisher.message(Extrinsic(self._initial.before_messages()), 0)
        return self._publisher.message(extrinsic)

    def _safe(self, answer: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Whatever an answer raises becomes its message: it would end the node."""

        def answered(request: Any, response: Any) -> Any:
            try:
                return answer(request, response)
            except CalibrationError as error:
                response.success, response.message = False, str(error)
            except Exception as error:
                response.success, response.message = False, self._health.unexpected(error)
            return response

        return answered

    def destroy(self) -> None:
        """Answers that are made already are sent before."""
        after_answers(self._node, self._destroy)

    def _destroy(self) -> None:
        for service in self._services:
            self._node.destroy_service(service)

    def _get_extrinsic(self, request: GetExtrinsic.Request, response: GetExtrinsic.Response) -> GetExtrinsic.Response:
        recalibrator = self._pipeline.recalibrator
        if recalibrator is None:
            response.extrinsic = self.message()
            response.message = "no pair of image and cloud with a CameraInfo yet; this is the initial extrinsic"
            return response
        extrinsic = recalibrator.current
        result = extrinsic.result
        response.extrinsic = self.message(extrinsic)
        response.success = response.extrinsic.usable
        last_good = self._publisher.last_good()
        if last_good is not None:
            response.last_good_known, response.last_good = True, last_good
        more = recalibrator.config.online.min_keyframes - len(recalibrator.buffer)
        waiting = f"waiting for {more} more keyframes" if more > 0 else "no estimate yet"
        made = f"estimated from {result.frames_used} keyframes"
        response.message = response.extrinsic.reason or (made if response.success else waiting)
        return response

    async def _capture(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        written = await done(self._node, self._files.submit(self._recorder.write, self._pipeline, self._events()))
        error = written.exception()
        if error is None:
            response.success, response.message = True, str(written.result())
        elif isinstance(error, CalibrationError):
            response.message = str(error)
        else:
            response.message = self._health.unexpected(error)
        return response

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._forget()
        response.success, response.message = True, "keyframes forgotten, back to the initial extrinsic"
        return response

    def _save(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        recalibrator = self._pipeline.recalibrator
        last_good = recalibrator.tracker.last_good if recalibrator is not None else None
        if recalibrator is None or last_good is None:
            response.message = "nothing to save: no estimate has been accepted yet"
        elif recalibrator.tracker.lost:
            response.message = "nothing saved: the calibration has moved; wait until it is found again, or call ~/calibrate"
        elif recalibrator.tracker.tentative:
            response.message = f"nothing saved: {recalibrator.current.result.reason}"
        else:
            response.success, response.message = self._write(last_good)
        return response
