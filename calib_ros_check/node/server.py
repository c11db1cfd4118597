"""~/check: is the extrinsic right? A typed service, and the outcome of the last check as a status on /diagnostics."""

from __future__ import annotations

import time
from concurrent.futures import Future

import numpy as np
from calib_ros_msgs.msg import CauseFinding as CauseFindingMsg
from calib_ros_msgs.msg import Deviation as DeviationMsg
from calib_ros_msgs.srv import Check
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.extensions import NodeService
from calib_ros.online.pipeline import Pipeline
from calib_ros.ros.conversions import covariance_for_ros, matrix_from_transform, time_message, transform_message
from calib_ros.ros.diagnostics import ERROR, OK, WARN, Health
from calib_ros.ros.parts import after_answers, done
from calib_ros_check.node.requests import CheckOutcome, CheckRequest, request_check
from calib_ros_check.outcome import CauseState, CheckVerdict, Deviation, Tolerance
from calib_ros_check.tolerance import unknown

VERDICTS = {verdict: getattr(Check.Response, verdict.name) for verdict in CheckVerdict}
STATES = {state: getattr(CauseFindingMsg, state.name) for state in CauseState}
LEVELS = {CheckVerdict.PASS: OK, CheckVerdict.INCONCLUSIVE: WARN, CheckVerdict.FAIL: ERROR}


class CheckServer(NodeService):
    """The service, and what /diagnostics says of checks. To be used on the executor's thread."""

    def __init__(self, node: Node, pipeline: Pipeline, health: Health) -> None:
        self._node, self._pipeline, self._health = node, pipeline, health
        self._name = node.get_fully_qualified_name().lstrip("/")
        self._last: CheckOutcome | None = None
        self._made = 0
        # A callback that awaits blocks its group, and further requests are to be refused or to share a check meanwhile.
        self._service = node.create_service(Check, "~/check", self._answer, callback_group=ReentrantCallbackGroup())

    def _note(self, check: Future[CheckOutcome]) -> None:
        """A check is done, for all who share it; on any thread."""
        if check.cancelled() or check.exception() is not None or (outcome := check.result()) is self._last:
            return
        self._last, self._made = outcome, self._made + 1
        of = "current extrinsic" if outcome.of_current else "extrinsic of the request"
        self._node.get_logger().info(f"check of the {of}: {outcome.result.verdict.value}: {outcome.result.reason}")

    def status(self) -> DiagnosticStatus:
        """The last check: its verdict sets the level as long as it is about the current extrinsic."""
        status = DiagnosticStatus(level=OK, name=f"{self._name}: check", message="never run")
        values = {"checks so far": str(self._made), "verdict": "none", "age of the last check, s": "none", "cause": "none"}
        last = self._last
        if last is not None:
            # One that failed and was mended since has moved by more than the tolerance; one that passed and goes on has not.
            result, recalibrator = last.result, self._pipeline.recalibrator
            holds = recalibrator is not None and result.tolerance.covers(
                result.T_checked, recalibrator.current.result.T_camera_lidar
            )
            status.message = f"{result.verdict.value}: {result.reason}"
            if holds:
                status.level = LEVELS[result.verdict]
            else:
                status.message = f"the last check was of another extrinsic than the current one; {status.message}"
            values |= {
                "verdict": result.verdict.value,
                "age of the last check, s": f"{time.monotonic() - last.made_at:.0f}",
                "cause": "none" if result.cause is None else result.cause.value,
                "of the current extrinsic": "yes" if holds else "no",
                "tolerance": f"{result.tolerance.deg:g} deg, {result.tolerance.m:g} m",
                "keyframes": f"{result.frames_used} of {len(result.frame_names)}",
                "CPU, s": f"{result.cpu_s:.1f}",
            }
            for axis in (result.rotation, result.translation, *result.axes):
                unit = "deg" if axis.name.startswith("r") else "m"
                values[f"{axis.name}, {unit}"] = f"{axis.error:.3f} ({axis.low:.3f} to {axis.high:.3f}), {axis.verdict.value}"
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        return status

    def destroy(self) -> None:
        """To be called when no check is under way; answers that are made already are sent before."""
        after_answers(self._node, lambda: self._node.destroy_service(self._service))

    async def _answer(self, request: Check.Request, response: Check.Response) -> Check.Response:
        nothing = unknown()
        response.rotation, response.translation = deviation_message(nothing.rotation), deviation_message(nothing.translation)
        response.p_within, response.covariance = nothing.p_within, covariance_for_ros(None)
        response.covariance_with_intrinsics = covariance_for_ros(None)
        try:
            asked = request_check(self._pipeline, check_request(request))
            asked.add_done_callback(self._note)
            checked = await done(self._node, asked)
            fill_response(response, checked.result())
        except CalibrationError as error:
            response.success, response.message = False, str(error)
        except Exception as error:  # it would end the node
            response.success, response.message = False, self._health.unexpected(error)
        return response


def check_request(request: Check.Request) -> CheckRequest:
    """calib_ros_msgs/Check.Request -> what is to be checked. BadInputError for values that make no sense."""
    usual = Tolerance()
    tolerance = Tolerance(
        usual.deg if request.tolerance_deg == 0 else request.tolerance_deg,
        usual.m if request.tolerance_m == 0 else request.tolerance_m,
    )
    T = matrix_from_transform(request.extrinsic) if request.extrinsic_given else None
    t, q = request.extrinsic.translation, request.extrinsic.rotation
    # Where nobody has set it, it is the identity, or all zero.
    if T is None and (any((t.x, t.y, t.z, q.x, q.y, q.z)) or q.w not in (0.0, 1.0)):
        raise BadInputError(
            "the request has an extrinsic, but extrinsic_given is false; set it to true, or leave the extrinsic out"
        )
    return CheckRequest(tolerance, T, int(request.max_keyframes))


def fill_response(response: Check.Response, outcome: CheckOutcome) -> None:
    """What a check has found, as the fields of calib_ros_msgs/Check.Response."""
    result = outcome.result
    frames = (result.camera_frame, result.lidar_frame, result.data_stamp)
    response.success, response.message = True, f"{result.verdict.value}: {result.reason}"
    response.verdict = VERDICTS[result.verdict]
    response.p_within = float(result.p_within)
    response.rotation, response.translation = deviation_message(result.rotation), deviation_message(result.translation)
    response.axes = [deviation_message(axis) for axis in result.axes]
    for own in result.causes:
        if own.cause is result.cause:
            response.cause, response.cause_message = own.cause.value, own.message
        values = {"value_names": list(own.values), "values": np.array(list(own.values.values()), float)}
        response.causes.append(CauseFindingMsg(cause=own.cause.value, state=STATES[own.state], message=own.message, **values))
    response.checked = transform_message(result.T_checked, *frames)
    response.tolerance_deg, response.tolerance_m = result.tolerance.deg, result.tolerance.m
    if result.T_estimated is not None:
        response.estimate_known, response.estimated = True, transform_message(result.T_estimated, *frames)
    response.covariance = covariance_for_ros(result.covariance)
    response.covariance_with_intrinsics = covariance_for_ros(result.covariance_with_intrinsics)
    response.keyframes_used, response.keyframes = result.frames_used, len(result.frame_names)
    response.stamp, response.notes = time_message(result.data_stamp), list(result.notes)
    response.elapsed, response.cpu = result.elapsed_s, result.cpu_s


def deviation_message(deviation: Deviation) -> DeviationMsg:
    """Deviation -> calib_ros_msgs/Deviation."""
    numbers = {name: float(getattr(deviation, name)) for name in ("error", "low", "high")}
    return DeviationMsg(name=deviation.name, verdict=VERDICTS[deviation.verdict], words=deviation.words, **numbers)
