"""A client of one node, which it may survive: a ROS context and thread of its own, and the calls of the node's services."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from calib_ros_msgs.action import Calibrate
from calib_ros_msgs.srv import Check, GetExtrinsic, GetKeyframes
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from std_srvs.srv import Trigger

from calib_ros.errors import BadInputError
from calib_ros.ros.dds import use_large_message_profile
from calib_ros_check.rig.shown import BAD, GOOD, NEUTRAL
from calib_ros_view.session.live import LiveHistory

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


@dataclass(frozen=True)
class Answer:
    """What a service has said. response: its message, None without an answer."""

    success: bool
    message: str
    response: Any = None
    seconds: float = 0.0


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


class NodeClient:
    """Calls the services of one node, on a thread of its own. Use as a context manager; everything but `history`, which is to be
    read under `lock`, is thread-safe. node_name: fully qualified, as /calib_ros. Answers that nobody waits for any more are
    events of the history all the same."""

    def __init__(self, node_name: str) -> None:
        self.name = "/" + node_name.strip("/")
        if self.name == "/" or not all(part.isidentifier() for part in self.name.strip("/").split("/")):
            raise BadInputError(f"--node {node_name} is no name of a ROS node; write it as /calib_ros or /left/calib_ros")
        use_large_message_profile()
        self.lock, self.history = threading.RLock(), LiveHistory()
        self.answers: dict[str, tuple[float, Answer]] = {}  # the newest of each service, and when it came
        self._context = Context()
        rclpy.init(context=self._context)
        self.domain_id: int = self._context.get_domain_id()
        self._node = node = rclpy.create_node(f"calib_ros_view_{time.time_ns() % 10**6}", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        self._clients_of = {
            name: node.create_client(kind, f"{self.name}/{name}") for name, (kind, _) in SERVICES.items() if name != CALIBRATE
        }
        self._calibrate: ActionClient[Any, Any, Any] = ActionClient(node, Calibrate, f"{self.name}/{CALIBRATE}")
        node.create_timer(0.25, self._every_quarter)
        self._calls: list[_Call] = []
        self._jobs: list[Callable[[], None]] = []
        self._closed = False
        self.listen()
        self._thread = threading.Thread(target=self._spin, name="calib_watch", daemon=True)
        self._thread.start()

    def listen(self) -> None:
        """Subscribe to what is to be heard, before the thread begins."""

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
            self.note(f"~/{name} called", NEUTRAL)
        self._executor.wake()
        return answer

    def keyframes(self, count: int = 0, width: int = 0) -> Future[Answer]:
        """Ask for pictures of the newest `count` keyframes (0 = all), at most `width` px wide (0 = 320)."""
        return self.call(KEYFRAMES, GetKeyframes.Request(max_keyframes=count, max_width=width))

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            while not self._closed and self._context.ok():
                try:
                    self._executor.spin_once(timeout_sec=0.25)
                    with self.lock:
                        jobs, self._jobs = self._jobs, []
                    for job in jobs:
                        job()
                except ExternalShutdownException:
                    raise
                except Exception as error:  # a page that silently stands still would be worse
                    if self._context.ok():
                        self.note(f"unexpected {type(error).__name__}: {error}", BAD)

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
                self.note(TOO_LATE, NEUTRAL)

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
            self.note(f"~/{call.name}: {answer.message}", level or (GOOD if answer.success else BAD))
        call.answer.set_result(answer)

    def _every_quarter(self) -> None:
        now = time.monotonic()
        with self.lock:
            self.history.tick(time.time())
            gone, restarted = self.history.gone, time.monotonic() - time.time() + self.history.restarted
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

    def note(self, text: str, level: str) -> None:
        """An event of the history."""
        with self.lock:
            self.history.note(time.time(), text, level)
