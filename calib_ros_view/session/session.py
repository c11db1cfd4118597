"""What one server shows: the frames of a source, the extrinsic that is being moved, its history, and what runs on it.

All browsers see the same session. It changes only through its methods, which may be called from any thread; `version` counts the
changes, so that a page knows when to draw anew.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix
from calib_ros.config import Config
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.export import export
from calib_ros.frame import Frame
from calib_ros.registration.features import FrameFeatures, at_time_offset
from calib_ros.registration.progress import SILENT, Progress
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import INITIAL, TENTATIVE, Result
from calib_ros_check.checker import Checker, CheckInputs
from calib_ros_check.outcome import CheckResult, Tolerance
from calib_ros_view.session.numbers import FrameScores, moved, offsets
from calib_ros_view.session.picture import FramePicture

MOST_FRAMES = 40  # whose clouds and pictures are held
MOST_UNDO = 200
MOST_TIME_OFFSET_S = 0.2
MOST = np.repeat([180.0, 10_000.0], 3)  # deg, cm; how far from the start an extrinsic is moved
BY_HAND = "set by hand"
SEARCH_DEG, SEARCH_M = 10.0, 0.5  # half widths of "search around here"
REFINE, SEARCH, CHECK = "refine", "search", "check"


@dataclass(frozen=True, eq=False)
class SessionState:
    """An extrinsic T (4, 4) with what else a step of the history holds. what: how it came about. result: of the estimate that it
    is, None if it was set by hand."""

    T: Matrix
    time_offset_s: float = 0.0
    left_out: frozenset[int] = frozenset()
    what: str = "start"
    result: Result | None = None


class Session:
    """Frames and the extrinsic that is looked at.

    frames: of one camera, in order; at most MOST_FRAMES. source: that they are of, for its names. start: T_camera_lidar (4, 4) at
    first, and what pictures are compared with. out: where `save` writes. progress: of the edges of all frames. Raises
    BadInputError for no frames, too many, or none that can be used.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        source: Source,
        start: Matrix,
        config: Config | None = None,
        out: Path | None = None,
        progress: Progress = SILENT,
    ) -> None:
        if len(frames) > MOST_FRAMES:
            raise BadInputError(f"{len(frames)} frames are too many to look at; choose up to {MOST_FRAMES} with --frames")
        self.frames, self.name = tuple(frames), source.name
        self.camera_frame, self.lidar_frame = source.camera_frame, source.lidar_frame
        self.reference = source.reference
        self.config = config or Config()
        self.scores = FrameScores(frames, frames[0].camera if frames else source.camera, self.config, progress)
        self.camera = frames[0].camera
        self.start = se3.as_transform(start, "the initial extrinsic")
        self.out = out
        self._lock = threading.RLock()
        self._models = threading.Lock()
        self._undo: deque[SessionState] = deque(maxlen=MOST_UNDO)
        self._redo: deque[SessionState] = deque()
        self.state = SessionState(self.start)  # it never changes, another takes its place
        self._pictures: dict[int, FramePicture] = {}
        self._drag: str | None = None
        self.version = 0

    @property
    def offsets(self) -> Matrix:
        """From the start, (6,) deg and cm; see `motion.offsets`."""
        return offsets(self.start, self.state.T)

    @property
    def can_step(self) -> tuple[bool, bool]:
        """Whether there is a step to go back to, and one that was undone."""
        return bool(self._undo), bool(self._redo)

    def move_to(self, values: Matrix, drag: str | None = None) -> None:
        """Set the six numbers (6,), deg and cm from the start. drag: name of the movement that goes on; all of one are one step
        of the history. BadInputError if they are not finite, or farther than MOST."""
        values = np.asarray(values, float)
        if values.shape != (6,) or not (np.abs(values) <= MOST).all():
            raise BadInputError(f"an extrinsic is moved by six numbers, up to {MOST[0]:g} deg and {MOST[3]:g} cm from the start")
        self._set(replace(self.state, T=moved(self.start, values), what=BY_HAND, result=None), drag)

    def set_time_offset(self, seconds: float, drag: str | None = None) -> None:
        """Take all points as measured `seconds` later."""
        if not abs(seconds) <= MOST_TIME_OFFSET_S:
            raise BadInputError(f"a time offset of {seconds:g} s is out of range +-{MOST_TIME_OFFSET_S:g} s")
        self._set(replace(self.state, time_offset_s=float(seconds), what=BY_HAND, result=None), drag)

    def take(self, result: Result, what: str) -> SessionState:
        """Take the extrinsic of an estimate; returns the state that it makes."""
        with self._lock:  # what was left out meanwhile stays so
            return self._set(replace(self.state, T=result.T_camera_lidar, what=what, result=result))

    def restart(self) -> None:
        """Back to the start, as a step of its own."""
        self._set(replace(self.state, T=self.start, time_offset_s=0.0, what="start", result=None))

    def leave_out(self, frame: int, left: bool) -> None:
        """Leave a frame out, or take it back in. BadInputError if it is the last one, or there is no such frame."""
        if not 0 <= frame < len(self.frames):
            raise BadInputError(f"there is no frame {frame}; there are {len(self.frames)}")
        with self._lock:
            out = self.state.left_out | {frame} if left else self.state.left_out - {frame}
            if len(out) == len(self.frames):
                raise BadInputError("at least one frame has to stay in")
            self._set(replace(self.state, left_out=frozenset(out)))

    def undo(self) -> None:
        """One step back, if there is one."""
        self._step(self._undo, self._redo)

    def redo(self) -> None:
        """One undone step forward, if there is one."""
        self._step(self._redo, self._undo)

    def _step(self, here: deque[SessionState], back: deque[SessionState]) -> None:
        with self._lock:
            if here:
                back.append(self.state)
                self.state, self._drag = here.pop(), None
                self.version += 1

    def _set(self, state: SessionState, drag: str | None = None) -> SessionState:
        with self._lock:
            if drag is None or drag != self._drag:
                self._undo.append(self.state)
            self._drag = drag
            self._redo.clear()
            self.state = state
            self.version += 1
        return state

    def picture(self, frame: int) -> FramePicture:
        """What draws a frame, with its LiDAR edges."""
        with self._lock:
            if frame not in self._pictures:
                self._pictures[frame] = self._drawer(frame)
            return self._pictures[frame]

    def picture_by(self, frame: int, coloring: str) -> FramePicture:
        """The same for points that are coloured so, classes by the configured models. BadInputError if they have not what that
        takes, and no model finds it."""
        if not (missing := self.picture(frame).missing(coloring)):
            return self.picture(frame)
        if coloring != "class":
            raise BadInputError(f"the points of this frame have no {missing} to be coloured by; choose another colouring")
        with self._models:  # one at a time
            if self.picture(frame).missing(coloring):
                found = self.scores.calibrator.segmentation(self.frames[frame])
                if found.labels is None:
                    why = "; ".join(found.problems) or "no model is configured that finds them"
                    raise BadInputError(f"the points of this frame have no classes: {why}")
                drawer = self._drawer(frame, found.labels)
                with self._lock:
                    self._pictures[frame] = drawer
            return self.picture(frame)

    def _drawer(self, frame: int, labels: NDArray[np.uint8] | None = None) -> FramePicture:
        own = self.scores.features_of(frame)
        return FramePicture(self.frames[frame], None if own is None else own.points, labels)

    def shown_at(self, frame: int, state: SessionState) -> Matrix:
        """T (4, 4) at which the points of a frame are drawn: the extrinsic, and the vehicle's motion during the time offset."""
        twist = self.frames[frame].twist
        return state.T if twist is None or not state.time_offset_s else state.T @ se3.exp(twist * state.time_offset_s)

    def features(self, state: SessionState) -> list[FrameFeatures]:
        """Features of the frames that count, at the time offset."""
        found = (self.scores.features_of(k) for k in range(len(self.frames)) if k not in state.left_out)
        return [at_time_offset(own, state.time_offset_s) if state.time_offset_s else own for own in found if own is not None]

    def result(self) -> Result:
        """The present extrinsic as a result: that of the estimate, or one that says that it was set by hand."""
        state = self.state
        made = state.result
        if made is None:
            status, reason = (INITIAL, "as it was given") if state.what == "start" else (TENTATIVE, BY_HAND)
            made = Result(state.T, status, reason, frames_used=len(self.frames) - len(state.left_out))
        offset = made.time_offset_s if made.time_offset_s is not None else state.time_offset_s or None
        return replace(
            made, T_camera_lidar=state.T, time_offset_s=offset, camera_frame=self.camera_frame, lidar_frame=self.lidar_frame
        )

    def save(self) -> Path:
        """Write the result, atomically, to the file that was named at the start. BadInputError if none was."""
        if self.out is None:
            raise BadInputError("no file to save to; start with --out FILE")
        self.result().save(self.out)
        return self.out

    def export(self, form: str) -> str:
        """The present extrinsic in a format of other tools; see `calib_ros.export`."""
        own = self.result()
        names = {"camera_frame": own.camera_frame or "camera_optical_frame", "lidar_frame": own.lidar_frame or "lidar"}
        return export(own, form, camera=self.camera, **names)


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


class SessionJobs:
    """Runs work on a session in a thread of its own. A browser that is closed does not end it; what it finds is a step of the
    history, so that nothing is lost."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self.current: SessionJob | None = None

    def start(self, name: str) -> SessionJob:
        """Begin refine, search or check. BadInputError if something runs already, or there is no such work."""
        if name not in (REFINE, SEARCH, CHECK):
            raise BadInputError(f"'{name}' is not known; choose one of {REFINE}, {SEARCH}, {CHECK}")
        with self._lock:
            if self.current is not None and self.current.running:
                raise BadInputError("something runs already; wait for it, or stop it")
            job = self.current = SessionJob(name)
            self._thread = threading.Thread(target=self._run, args=(job,), name=f"view {name}", daemon=True)
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

    def _run(self, job: SessionJob) -> None:
        try:
            (self._check if job.name == CHECK else self._estimate)(job, self._session.state)
        except StoppedError:
            job.message = "stopped; nothing has changed"
        except CalibrationError as error:
            job.failed, job.message = True, str(error)
        except Exception as error:  # the page goes on; whoever looks has to see it
            job.failed, job.message = True, f"failed, {type(error).__name__}: {error}"
        finally:
            job.running = False

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
