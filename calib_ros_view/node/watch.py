"""A client that watches one node and calls its services, for pages that show it. It survives the node's restart."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any

import cv2
import rclpy
from action_msgs.msg import GoalStatus
from calib_ros_msgs.action import Calibrate
from calib_ros_msgs.msg import Extrinsic as ExtrinsicMsg
from calib_ros_msgs.srv import Check, GetExtrinsic, GetKeyframes
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.messages import decode_image
from calib_ros.ros.client import result_from_message
from calib_ros.ros.conversions import advice_of
from calib_ros.ros.dds import use_large_message_profile
from calib_ros_view.session.live import BAD, GOOD, NEUTRAL, Diagnosis, LiveHistory, NodeState, Presence

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
CALIBRATE, RESET, SAVE, CAPTURE, CHECK, GET_EXTRINSIC, KEYFRAMES = (
    "calibrate", "reset", "save", "capture", "check", "get_extrinsic", "keyframes"
)  # fmt: skip
# Service -> type, and s without an answer, or a sign of progress, after which it is taken for lost: a search or a check of 20
# keyframes takes 20 s on a busy machine. ~/calibrate is an action here, which tells how far it is and can be stopped.
SERVICES: dict[str, tuple[Any, float]] = {
    CALIBRATE: (Calibrate, 120.0),
    RESET: (Trigger, 10.0),
    SAVE: (Trigger, 10.0),
    CAPTURE: (Trigger, 60.0),
    CHECK: (Check, 180.0),
    GET_EXTRINSIC: (GetExtrinsic, 10.0),
    KEYFRAMES: (GetKeyframes, 15.0),
}
QUIET = (GET_EXTRINSIC, KEYFRAMES)  # what pages ask by themselves is no event
NOT_TAKEN = "the node takes no requests now: it is not active, or about to end"
STOPPED = "stopped before the estimate was done"
TOO_LATE = "~/calibrate could not be stopped any more: its estimate is done"
OVERLAY_WIDTH, OVERLAY_QUALITY = 1600, 82  # px at most; of the JPEG


@dataclass(frozen=True)
class Answer:
    """What a service has said. response: its message, None without an answer."""

    success: bool
    message: str
    response: Any = None
    seconds: float = 0.0


@dataclass(frozen=True)
class Overlay:
    """The newest ~/overlay. at: s since the epoch. number: rises with every picture."""

    jpeg: bytes = b""
    at: float = 0.0
    number: int = 0


@dataclass(eq=False)
class _Call:
    """future: of the client, once request or goal is sent. handle: of a goal that was taken. stage, share: how far it is, 0..1.
    to_stop: as soon as it is taken."""

    name: str
    answer: Future[Answer]
    began: float
    deadline: float
    future: Any = None
    handle: Any = None
    stage: str = ""
    share: float = 0.0
    to_stop: bool = False


class Watch:
    """Subscribes to one node on a thread of its own. Use as a context manager; everything but `history` is thread-safe, which is
    to be read under `lock`.

    node_name: fully qualified, as /calib_ros. The overlay is subscribed to only between look() and leave(), since the node draws
    it only for subscribers. Answers that a page does not wait for any more become events of the history all the same.
    """

    def __init__(self, node_name: str) -> None:
        self.name = "/" + node_name.strip("/")
        if self.name == "/" or not all(part.isidentifier() for part in self.name.strip("/").split("/")):
            raise BadInputError(f"--node {node_name} is no name of a ROS node; write it as /calib_ros or /left/calib_ros")
        use_large_message_profile()
        self.lock = threading.RLock()
        self.history = LiveHistory()
        self.overlay = Overlay()
        self.answers: dict[str, tuple[float, Answer]] = {}  # the newest of each service, and when it came
        self._context = Context()
        rclpy.init(context=self._context)
        self.domain_id: int = self._context.get_domain_id()
        self._node = rclpy.create_node(f"calib_ros_view_{time.time_ns() % 10**6}", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        node = self._node
        node.create_subscription(ExtrinsicMsg, f"{self.name}/extrinsic", self._on_extrinsic, LATCHED)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._clients_of = {
            name: node.create_client(kind, f"{self.name}/{name}") for name, (kind, _) in SERVICES.items() if name != CALIBRATE
        }
        self._calibrate: ActionClient[Any, Any, Any] = ActionClient(node, Calibrate, f"{self.name}/{CALIBRATE}")
        node.create_timer(0.25, self._every_quarter)
        self._overlay_subscription: Any = None
        self._lookers: set[int] = set()
        self._ids = itertools.count(1)
        self._calls: list[_Call] = []
        self._jobs: list[Callable[[], None]] = []
        self._closed = False
        self._thread = threading.Thread(target=self._spin, name="calib_watch", daemon=True)
        self._thread.start()

    def __enter__(self) -> Watch:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the thread and leave ROS; calls under way are answered that the viewer ends."""
        with self.lock:
            if self._closed:
                return
            self._closed = True
            calls, self._calls = self._calls, []
        for call in calls:
            call.answer.set_result(Answer(False, "the viewer ends; the node goes on with what it was asked for"))
        self._executor.shutdown(timeout_sec=1.0)
        rclpy.try_shutdown(context=self._context)
        self._thread.join(5.0)
        with suppress(Exception):  # the context is gone, and with it what the node held
            self._node.destroy_node()

    # ---- pages --------------------------------------------------------------------------------------------------------

    def look(self) -> int:
        """Somebody looks at the overlay; returns what leave() needs."""
        with self.lock:
            looker = next(self._ids)
            self._lookers.add(looker)
            return looker

    def leave(self, looker: int) -> None:
        """That one does not look any more; more than once does no harm."""
        with self.lock:
            self._lookers.discard(looker)

    @property
    def busy(self) -> frozenset[str]:
        """Services that are being called."""
        with self.lock:
            return frozenset(call.name for call in self._calls)

    @property
    def progress(self) -> tuple[str, float] | None:
        """Stage of the calibration under way and the share of it that is done, 0..1; None if none is."""
        with self.lock:
            return next(((call.stage, call.share) for call in self._calls if call.name == CALIBRATE), None)

    def stop(self) -> bool:
        """Ask the node to stop the calibration that was asked for here; False if none is under way."""
        with self.lock:
            found = [call for call in self._calls if call.name == CALIBRATE]
            if found:
                self._jobs.append(lambda: self._stop(found[0]))
        self._executor.wake()
        return bool(found)

    def nodes_seen(self) -> list[str]:
        """Fully qualified names of other nodes in this domain, sorted."""
        try:
            found = self._node.get_node_names_and_namespaces()
        except Exception:  # closed meanwhile
            return []
        names = {f"{space.rstrip('/')}/{name}" for name, space in found}
        return sorted(name for name in names if not name.startswith("/calib_ros_view_") and not name.startswith("/_"))

    def call(self, name: str, request: Any = None) -> Future[Answer]:
        """Call a service of SERVICES. The answer always comes, and is never an exception: a node that is gone, or says nothing in
        time, is one too. A service that is being called already is not called again."""
        answer: Future[Answer] = Future()
        with self.lock:
            running = [call for call in self._calls if call.name == name]
            if running and name in QUIET and not self._closed:
                return running[0].answer
            if running or self._closed:
                why = "the viewer ends" if self._closed else f"~/{name} is being called already; wait for it"
                answer.set_result(Answer(False, why))
                return answer
            now = time.monotonic()
            call = _Call(name, answer, now, now + SERVICES[name][1])
            self._calls.append(call)
            self._jobs.append(lambda: self._begin(call, request))
        if name not in QUIET:
            self._note(f"~/{name} called", NEUTRAL)
        self._executor.wake()
        return answer

    def keyframes(self, count: int = 0, width: int = 0) -> Future[Answer]:
        """Ask for pictures of the newest `count` keyframes (0 = all), at most `width` px wide (0 = 320)."""
        return self.call(KEYFRAMES, GetKeyframes.Request(max_keyframes=count, max_width=width))

    def on_its_thread(self, do: Callable[[Node], None]) -> None:
        """Do something with the watch's own ROS node, on the thread that serves it."""
        with self.lock:
            self._jobs.append(lambda: do(self._node))
        self._executor.wake()

    # ---- the executor's thread ----------------------------------------------------------------------------------------

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            while not self._closed and self._context.ok():
                try:
                    self._executor.spin_once(timeout_sec=0.25)
                    self._work()
                except ExternalShutdownException:
                    raise
                except Exception as error:  # a page that silently stands still would be worse
                    if self._context.ok():
                        self._note(f"unexpected {type(error).__name__}: {error}", BAD)

    def _work(self) -> None:
        with self.lock:
            jobs, self._jobs = self._jobs, []
            wanted = bool(self._lookers) and not self._closed
        for job in jobs:
            job()
        if wanted and self._overlay_subscription is None:
            self._overlay_subscription = self._node.create_subscription(Image, f"{self.name}/overlay", self._on_overlay, 1)
        elif not wanted and self._overlay_subscription is not None:
            self._node.destroy_subscription(self._overlay_subscription)
            self._overlay_subscription = None

    @contextmanager
    def _answering(self, call: _Call) -> Iterator[None]:
        """Whatever is raised is the answer."""
        try:
            yield
        except Exception as error:
            self._finish(call, Answer(False, f"{self.name}/{call.name} failed: {error}"))

    def _begin(self, call: _Call, request: Any) -> None:
        with self._answering(call):
            if not self._is_there(call.name):
                where = f"{self.name}/{call.name}"
                self._finish(call, Answer(False, f"{where} is not there: the node is gone, not started or not configured"))
            elif call.name == CALIBRATE:
                call.future = self._calibrate.send_goal_async(
                    Calibrate.Goal(), feedback_callback=lambda fed: self._feed(call, fed)
                )
                call.future.add_done_callback(lambda sent: self._taken(call, sent))
            else:
                client = self._clients_of[call.name]
                call.future = client.call_async(SERVICES[call.name][0].Request() if request is None else request)
                call.future.add_done_callback(lambda done: self._answered(call, done))

    def _answered(self, call: _Call, future: Any) -> None:
        with self._answering(call):
            response = future.result()
            self._finish(call, Answer(bool(response.success), str(response.message), response))

    def _is_there(self, name: str) -> bool:
        return bool(self._calibrate.server_is_ready() if name == CALIBRATE else self._clients_of[name].service_is_ready())

    def _feed(self, call: _Call, message: Any) -> None:
        with self.lock:
            call.stage, call.share = str(message.feedback.stage), float(message.feedback.progress)
            call.deadline = time.monotonic() + SERVICES[CALIBRATE][1]

    def _taken(self, call: _Call, future: Any) -> None:
        with self._answering(call):
            handle = future.result()
            if not handle.accepted:
                self._finish(call, Answer(False, NOT_TAKEN))
                return
            call.handle = handle
            handle.get_result_async().add_done_callback(lambda done: self._ended(call, done))
            if call.to_stop:
                self._stop(call)

    def _ended(self, call: _Call, future: Any) -> None:
        with self._answering(call):
            answer = future.result()
            stopped = answer.status == GoalStatus.STATUS_CANCELED
            message = STOPPED if stopped else str(answer.result.message)
            self._finish(call, Answer(bool(answer.result.success), message), NEUTRAL if stopped else None)

    def _stop(self, call: _Call) -> None:
        def asked(future: Any) -> None:
            # It may have ended meanwhile: then its outcome says so.
            if future.exception() is None and not future.result().goals_canceling:
                self._note(TOO_LATE, NEUTRAL)

        call.to_stop = True
        if call.handle is not None:
            call.handle.cancel_goal_async().add_done_callback(asked)

    def _finish(self, call: _Call, answer: Answer, level: str | None = None) -> None:
        with self.lock:
            if call not in self._calls:
                return  # late, or the viewer ends
            self._calls.remove(call)
        answer = replace(answer, seconds=time.monotonic() - call.began)
        if call.name not in QUIET:
            with self.lock:
                self.answers.pop(call.name, None)
                self.answers[call.name] = time.time(), answer  # the newest comes last
            self._note(f"~/{call.name}: {answer.message}", level or (GOOD if answer.success else BAD))
        call.answer.set_result(answer)

    def _every_quarter(self) -> None:
        now = time.monotonic()
        with self.lock:
            self.history.tick(time.time())
            gone, restarted = self.history.presence is Presence.GONE, time.monotonic() - time.time() + self.history.restarted
            calls = list(self._calls)
        for call in calls:
            where, waited = f"{self.name}/{call.name}", now - call.began
            if now > call.deadline:
                self._drop(call, f"{where} did not answer within {waited:.0f} s; its answer is not waited for any more")
            elif call.began < restarted:
                self._drop(call, f"the node was started anew while {where} was under way; call it again")
            elif call.future is not None and gone and not self._is_there(call.name):
                self._drop(call, f"the node went away while {where} was under way; call it again once it is back")

    def _drop(self, call: _Call, message: str) -> None:
        if call.future is not None and call.name != CALIBRATE:
            self._clients_of[call.name].remove_pending_request(call.future)
        self._finish(call, Answer(False, message))

    def _note(self, text: str, level: str) -> None:
        with self.lock:
            self.history.note(time.time(), text, level)

    def _on_extrinsic(self, message: ExtrinsicMsg) -> None:
        try:
            result = result_from_message(message)
        except CalibrationError as error:
            self._note(f"an extrinsic that cannot be read: {error}", BAD)
            return
        age = message.data_age.sec + 1e-9 * message.data_age.nanosec
        age = age if age >= 0 else float("nan")
        state = NodeState(result, float(message.drift), bool(message.usable), age, str(advice_of(message)))
        with self.lock:
            self.history.add_extrinsic(time.time(), state)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        name = self.name.lstrip("/")
        found = {status.name: status for status in message.status}
        status = found.get(f"{name}: extrinsic")
        if status is None:
            return
        check = found.get(f"{name}: check")
        level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
        values = {pair.key: pair.value for pair in status.values}
        diagnosis = Diagnosis(level, status.message, values, check.message if check is not None else "never run")
        with self.lock:
            self.history.add_diagnosis(time.time(), diagnosis)

    def _on_overlay(self, message: Image) -> None:
        try:
            picture: Any = decode_image(message)
        except CalibrationError as error:
            self._note(f"an overlay that cannot be read: {error}", BAD)
            return
        scale = OVERLAY_WIDTH / picture.shape[1]
        if scale < 1:
            picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, OVERLAY_QUALITY])[1].tobytes()
        with self.lock:
            self.overlay = Overlay(jpeg, time.time(), self.overlay.number + 1)
