"""The services. Long work runs on another thread: the executor goes on with everything else meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future as Promise
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from calib_ros_msgs.srv import GetExtrinsic
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from calib_ros.errors import CalibrationError
from calib_ros.online.pipeline import Pipeline
from calib_ros.result import CONVERGED, TENTATIVE, Extrinsic, Result
from calib_ros.ros.bags import Capture
from calib_ros.ros.conversions import extrinsic_message
from calib_ros.ros.diagnostics import Health
from calib_ros.ros.initial_extrinsic import InitialExtrinsic, SaveOutcome
from calib_ros.ros.publishers import ExtrinsicPublisher


class Services:
    """~/get_extrinsic, ~/calibrate, ~/reset, ~/save and ~/capture.

    save: writes a result to the state file. publisher: of ~/extrinsic.
    """

    def __init__(
        self,
        node: Node,
        pipeline: Pipeline,
        initial: InitialExtrinsic,
        capture: Capture,
        save: Callable[[Result], SaveOutcome],
        publisher: ExtrinsicPublisher,
        health: Health,
    ) -> None:
        self._health = health
        self._node, self._pipeline, self._initial, self._recorder = node, pipeline, initial, capture
        self._write, self._publisher = save, publisher
        self._aside = ThreadPoolExecutor(max_workers=1, thread_name_prefix="calib_capture")
        node.create_service(GetExtrinsic, "~/get_extrinsic", self._safe(self._get_extrinsic))
        # A callback that awaits blocks its group: in the node's own group it would block all others until it is done. Requests
        # for an estimate share one, and must not wait for each other.
        node.create_service(Trigger, "~/calibrate", self._calibrate, callback_group=ReentrantCallbackGroup())
        node.create_service(Trigger, "~/capture", self._capture, callback_group=MutuallyExclusiveCallbackGroup())
        node.create_service(Trigger, "~/reset", self._safe(self._reset))
        node.create_service(Trigger, "~/save", self._safe(self._save))

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

    def stop(self) -> None:
        """Wait for a capture under way."""
        self._aside.shutdown(wait=True, cancel_futures=True)

    def _get_extrinsic(self, request: GetExtrinsic.Request, response: GetExtrinsic.Response) -> GetExtrinsic.Response:
        recalibrator = self._pipeline.recalibrator
        if recalibrator is None:
            response.extrinsic = extrinsic_message(Extrinsic(self._initial.before_messages()), 0)
            response.message = "no pair of image and cloud with a CameraInfo yet; this is the initial extrinsic"
            return response
        extrinsic = recalibrator.current
        result = extrinsic.result
        response.extrinsic = self._publisher.message(extrinsic)
        response.success = response.extrinsic.usable
        last_good = self._publisher.last_good()
        if last_good is not None:
            response.last_good_known, response.last_good = True, last_good
        wanted = max(recalibrator.config.online.min_keyframes, 1)
        response.message = response.extrinsic.reason or (
            f"estimated from {result.frames_used} keyframes"
            if response.success
            else f"{len(recalibrator.buffer)} of {wanted} keyframes"
        )
        return response

    async def _calibrate(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        estimate = await self._done(self._pipeline.request_estimate())
        error = estimate.exception()
        if error is not None:
            response.message = str(error) or "stopped"
            return response
        result = estimate.result().result
        response.success = result.status in (CONVERGED, TENTATIVE)
        response.message = f"{result.status}: {result.frames_used} keyframes, score {result.score:.3f}. {result.reason}".strip()
        return response

    async def _capture(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        written = await self._done(self._aside.submit(self._recorder.write, self._pipeline))
        error = written.exception()
        if error is None:
            response.success, response.message = True, str(written.result())
        elif isinstance(error, CalibrationError):
            response.message = str(error)
        else:
            response.message = self._health.unexpected(error)
        return response

    def _done(self, promise: Promise[Any]) -> Future:
        """An awaitable of the promise itself, once it is done on whatever thread."""
        executor = self._node.executor
        done: Future = Future(executor=executor)

        def finish(kept: Promise[Any]) -> None:
            done.set_result(kept)
            executor.wake()  # it resumes waiting coroutines only when something else wakes it

        promise.add_done_callback(finish)
        return done

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._pipeline.reset()
        self._recorder.clear()
        response.success, response.message = True, "keyframes forgotten, back to the initial extrinsic"
        return response

    def _save(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        recalibrator = self._pipeline.recalibrator
        last_good = recalibrator.tracker.last_good if recalibrator is not None else None
        if last_good is None:
            response.message = "nothing to save: no estimate has been accepted yet"
            return response
        if recalibrator is not None and recalibrator.tracker.lost:
            response.message = "nothing saved: the calibration has moved; wait until it is found again, or call ~/calibrate"
            return response
        if recalibrator is not None and recalibrator.tracker.tentative:
            response.message = f"nothing saved: {recalibrator.current.result.reason}"
            return response
        outcome = self._write(last_good)
        response.success, response.message = outcome.saved, outcome.message
        return response
