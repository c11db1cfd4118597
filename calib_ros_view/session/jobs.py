"""Long work on a session, one at a time, with progress, which can be stopped: refine, search, check."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_check.checker import Checker, CheckInputs
from calib_ros_check.outcome import CheckResult, Tolerance
from calib_ros_view.session.session import Session, SessionState

SEARCH_DEG, SEARCH_M = 10.0, 0.5  # half widths of "search around here"
REFINE, SEARCH, CHECK = "refine", "search", "check"


class StoppedError(Exception):
    """Somebody stopped the work."""


@dataclass
class SessionJob:
    """Work that runs, or ended.

    share: 0..1 of its stage. message: how it ended; failed: that it did not do what was asked. state: that the message is about,
    None if it is about none.
    """

    name: str
    stage: str = ""
    share: float = 0.0
    running: bool = True
    failed: bool = False
    message: str = ""
    started: float = field(default_factory=time.monotonic)
    check: CheckResult | None = None
    state: SessionState | None = None
    stopped: threading.Event = field(default_factory=threading.Event)  # set: it ends at its next step

    def title(self, now: SessionState) -> str:
        """Its name, and whether what it says is of another state than the present one."""
        return self.name if self.state is None or self.state is now else f"earlier {self.name}"

    def watch(self, stage: str, share: float) -> None:
        """Progress of the work; raises StoppedError when it is to end."""
        self.stage, self.share = stage, share
        if self.stopped.is_set():
            raise StoppedError


_Work = Callable[[SessionJob, SessionState], None]


class SessionJobs:
    """Runs work on a session in a thread of its own. A browser that is closed does not end it; what it finds is a step of the
    history, so that nothing is lost."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self.current: SessionJob | None = None

    @property
    def busy(self) -> bool:
        """Whether something runs."""
        return self.current is not None and self.current.running

    def start(self, name: str) -> SessionJob:
        """Begin refine, search or check. BadInputError if something runs already, or there is no such work."""
        work: dict[str, _Work] = {REFINE: self._estimate, SEARCH: self._estimate, CHECK: self._check}
        if name not in work:
            raise BadInputError(f"'{name}' is not known; choose one of {', '.join(work)}")
        with self._lock:
            if self.busy:
                raise BadInputError("something runs already; wait for it, or stop it")
            job = self.current = SessionJob(name)
            self._thread = threading.Thread(target=self._run, args=(job, work[name]), name=f"view {name}", daemon=True)
            self._thread.start()
        return job

    def stop(self) -> None:
        """Stop what runs."""
        if self.current is not None:
            self.current.stopped.set()

    def close(self, timeout_s: float = 10.0) -> None:
        """Stop what runs and wait for its end."""
        self.stop()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _run(self, job: SessionJob, work: _Work) -> None:
        try:
            work(job, self._session.state)
        except StoppedError:
            job.message = "stopped; nothing has changed"
        except CalibrationError as error:
            job.failed, job.message = True, str(error)
        except Exception as error:  # the page goes on; whoever looks has to see it
            job.failed, job.message = True, f"failed, {type(error).__name__}: {error}"
        finally:
            job.running = False
            self._session.touch()

    def _estimate(self, job: SessionJob, state: SessionState) -> None:
        box = SearchBox(SEARCH_DEG, SEARCH_M) if job.name == SEARCH else None
        features = self._session.features(state)
        result = self._session.scores.calibrator.estimate(features, state.T, box, job.watch)
        job.watch(job.stage, 1.0)
        if result.converged:
            job.message = f"accepted; {result.reason}" if result.reason else "accepted"
            job.state = self._session.take(result, "refined" if box is None else "searched")
        else:
            job.failed, job.message = True, f"{result.status}: {result.reason}"

    def _check(self, job: SessionJob, state: SessionState) -> None:
        inputs = CheckInputs(state.T, Tolerance(), progress=job.watch)
        found = Checker(self._session.camera, self._session.config).check_features(self._session.features(state), inputs)
        job.check, job.state, job.message = found, state, f"{found.verdict.value}: {found.reason}"
