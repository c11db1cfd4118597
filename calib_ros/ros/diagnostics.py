"""The node's health: problems, estimates and callback times, as log lines and once a second on /diagnostics."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from calib_ros import se3
from calib_ros.config.options import has_room
from calib_ros.config.sensors import REFINE
from calib_ros.errors import defect, raised_at
from calib_ros.extensions import NodeService
from calib_ros.intrinsics import ASPECT, CENTRE, FOCAL, RADIAL, RefinedCamera
from calib_ros.online.events import ExtrinsicUpdated, Problem, QuietLog
from calib_ros.online.pacing import KEYFRAME_EVERY_S, LoadCounts, Work
from calib_ros.online.pairing import PairingHealth
from calib_ros.online.pipeline import Pipeline
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.result import BLINDED, CONVERGED, INITIAL, INSUFFICIENT, MOVED, REFUSED, SUSPECT, TENTATIVE, Extrinsic
from calib_ros.ros.conversions import STARVED

OK, WARN, ERROR, STALE = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR, DiagnosticStatus.STALE
SILENCE_S = 5.0  # a topic without messages for this long is reported
# Where more of the pairs are dropped, of so many at least, keyframes and the test for blind sensors come late.
DROPPED_SHARE, MIN_PAIRS = 0.5, 10
# Of the time in which a thread has work to do: one that computes for less of it waits for a core, or for other threads.
COMPUTING_SHARE = 0.7
LOAD_WINDOW_S = 30.0  # loads are those of the last so many seconds: a search or a burst of keyframes shows, but does not alarm
# Within these: keyframes that were left out since the motion is unknown, and the share of those taken beyond the budget.
MANY_LEFT_OUT, FORCED_SHARE, MIN_KEYFRAMES = 3, 0.5, 3
ERROR_SHOWN_S = 10.0  # a problem sets the level for this long
CHANGED = 0.5  # a share of messages that are missing is told again where it differs by more of itself
# What an operator has to do for each status of the extrinsic; the others need nothing.
LEVELS = {MOVED: ERROR, BLINDED: ERROR, SUSPECT: WARN, REFUSED: WARN, INSUFFICIENT: WARN}


class Health(NodeService):
    """Collects what happens to the node, for log and diagnostics. Thread-safe, since every field is replaced whole.

    log: of problems. last_error: the newest of them, and when it came by time.monotonic(). extrinsic: its newest state.
    estimated_at: when the last estimate was accepted, by the same clock. losses: topics whose messages get lost at present, each
    with one line for a person. silence: why nothing comes on `image` and `points`, where nothing does.
    """

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self.log = QuietLog()
        self.errors, self.last_error = 0, ("", -1e9)
        self.extrinsic: Extrinsic | None = None
        self.estimated_at: float | None = None
        self.losses: dict[str, str] = {}
        self._missing: dict[str, float] = {}  # as told last
        self.silence: dict[str, str] = {}
        self.callback_ms: deque[float] = deque(maxlen=2000)

    def error(self, text: str, kind: str) -> None:
        """A problem, in one line. kind: what counts as the same in the log, whatever figures the text gives."""
        self.errors += 1
        self.last_error = (text, time.monotonic())
        self.log.add(kind, text, lambda line: self._logger.warning(line))  # rclpy takes one level per place that logs

    def missing(self, kind: str, share: float, text: str) -> None:
        """A share of messages that is missing now: an `error` where it begins or has changed by half, a `note` where it is 0."""
        told = self._missing.get(kind, 0.0)
        if share != told and abs(share - told) >= CHANGED * told:
            self._missing[kind] = share
            (self.error if share else self.note)(text, kind)

    def note(self, text: str, kind: str) -> None:
        """Something that is well again, in one line."""
        self.log.add(kind, text, lambda line: self._logger.info(line))

    def unexpected(self, error: BaseException) -> str:
        """A defect of ours: says where it is and what to do, and returns that line."""
        line = defect(error)
        self.error(line, raised_at(error))
        return line

    def check(self) -> None:
        """See `QuietLog`."""
        self.log.catch_up()

    def add(self, event: Any) -> None:
        """Log what the pipeline tells a person."""
        if isinstance(event, Problem):
            (self.note if event.solved else self.error)(event.message, event.kind)
        if not isinstance(event, ExtrinsicUpdated):
            return
        before, extrinsic = self.extrinsic, event.extrinsic
        self.extrinsic, result = extrinsic, extrinsic.result
        accepted = extrinsic.accepted > 0 and (before is None or extrinsic.accepted != before.accepted)
        if accepted:
            self.estimated_at = time.monotonic()
        if result.status in (CONVERGED, TENTATIVE, INSUFFICIENT) and accepted:  # insufficient: some axes not observable yet
            offset_s, sigma_s = result.time_offset_s or 0.0, result.time_offset_sigma_s or 0.0  # told where it is beyond doubt
            deg, m = se3.error((before or extrinsic).result.T_camera_lidar, result.T_camera_lidar)
            self._logger.info(
                f"extrinsic from {result.frames_used} keyframes: score {result.score:.3f}, "
                f"moved {deg:.2f} deg, {100 * m:.1f} cm, drift {extrinsic.normalised_innovation:.2f}, {result.elapsed_s:.1f} s"
                + (f", time offset {1000 * offset_s:+.0f} ms" if abs(offset_s) > 3 * sigma_s else "")
                + (f"; {result.reason}" if result.status != CONVERGED else "")
            )
        elif result.status == INITIAL or (result.status == CONVERGED and not extrinsic.accepted):
            start = f"initial extrinsic {result.lidar_frame} -> {result.camera_frame}"
            self.note(f"{start}: {result.reason or 'from the saved state'}", "initial extrinsic")
        elif result.status in (REFUSED, INSUFFICIENT):
            kind = result.status if result.refusal is None else result.refusal.value
            self.error(f"estimate {result.status}: {result.reason}", f"estimate {kind}")
        elif result.status in (SUSPECT, MOVED):  # of blinded sensors the pipeline tells
            self.error(f"extrinsic {_level(extrinsic)[1]}", result.status)

    @contextmanager
    def guard(self) -> Iterator[None]:
        """Context of a callback: takes its time. What it raises is logged and goes no further: it would end the node."""
        start = time.perf_counter()
        try:
            yield
        except Exception as error:
            self.unexpected(error)
        self.callback_ms.append(1e3 * (time.perf_counter() - start))


class _Sample(NamedTuple):
    """What has been counted by one moment, by time.monotonic(). intake_s: in which there was a pair to look at. left_out:
    keyframes, for their unknown motion. load: CPU time."""

    at: float
    images: int
    clouds: int
    pairs: int
    dropped: int
    intake_s: float
    estimates_s: float
    left_out: int
    load: LoadCounts

    @classmethod
    def of(cls, pipeline: Pipeline) -> _Sample:
        counts, recalibrator = pipeline.pairing.synchronizer.counts, pipeline.recalibrator
        came = counts.images, counts.clouds, counts.pairs, pipeline.dropped_pairs
        left_out = recalibrator.motion.left_out if recalibrator else 0
        return cls(time.monotonic(), *came, *pipeline.busy_seconds(), left_out, pipeline.load.counts())

    def seconds_since(self, before: _Sample, work: Work) -> float:
        """CPU time."""
        return self.load.seconds.get(work, 0.0) - before.load.seconds.get(work, 0.0)


class Diagnostics(NodeService):
    """The status of a pair on /diagnostics, the first of them; rates and loads are those of the last check(). more: gives further
    values, by name."""

    def __init__(self, name: str, health: Health, pipeline: Pipeline, more: Callable[[], dict[str, str]] = lambda: {}) -> None:
        self._name, self._health, self._pipeline, self._more = name.lstrip("/"), health, pipeline, more
        self.start()

    def start(self) -> None:
        """Rates count from now."""
        self._pairing = PairingHealth(self._pipeline.pairing.synchronizer)
        self._samples = deque([_Sample.of(self._pipeline)], maxlen=int(LOAD_WINDOW_S) + 1)
        self._unpaired = ""  # what is said of messages without partner

    def check(self) -> None:
        """Rates and loads count from the calls before."""
        self._unpaired = self._pairing.check()
        self._health.missing("unpaired", self._pairing.share, self._unpaired or "images and clouds find their partners again")
        self._samples.append(_Sample.of(self._pipeline))

    def _window(self) -> tuple[_Sample, _Sample]:
        """First and last sample of the last SILENCE_S."""
        return self._samples[-min(len(self._samples), int(SILENCE_S) + 1)], self._samples[-1]

    def status(self) -> DiagnosticStatus:
        """As of now."""
        level, text = self._summary()
        values = {**self._flow(), **self._extrinsic(), **self._more()}
        values |= {
            "callback 99th percentile, ms": f"{np.percentile(list(self._health.callback_ms) or [0.0], 99):.2f}",
            "errors": str(self._health.errors),
            "last error": self._health.last_error[0],
        }
        return status_message(f"{self._name}: extrinsic", level, text, values)

    def _flow(self) -> dict[str, str]:
        pipeline, counts = self._pipeline, self._pipeline.pairing.synchronizer.counts
        recalibrator, gate = pipeline.recalibrator, pipeline.speed_gate
        first, last = self._window()
        before, span = self._samples[max(len(self._samples) - 2, 0)], max(last.at - first.at, 1e-3)
        took = max(last.at - before.at, 1e-3)
        intake, estimates = (last.intake_s - before.intake_s) / took, (last.estimates_s - before.estimates_s) / took
        settled = counts.pairs + counts.unpaired_images
        return {
            "images per s": f"{(last.images - first.images) / span:.1f}",
            "clouds per s": f"{(last.clouds - first.clouds) / span:.1f}",
            "pairs per s": f"{(last.pairs - first.pairs) / span:.1f}",
            "images": str(counts.images),
            "clouds": str(counts.clouds),
            "pairs": str(counts.pairs),
            "share of images paired": f"{counts.pairs / settled:.2f}" if settled else "none",
            "unpaired images": str(counts.unpaired_images),
            "unpaired clouds": str(counts.unpaired_clouds),
            **self._pairing.describe(),
            "stamps jumped back": str(counts.jumps_back),
            "pairs dropped by a busy worker": str(pipeline.dropped_pairs),
            "pairs left out at rest": str(pipeline.rested_pairs),
            "keyframes in the buffer": str(len(recalibrator.keyframes) if recalibrator else 0),
            "keyframes so far": str(recalibrator.keyframes.seen if recalibrator else 0),
            "frames too fast for a keyframe": str(gate.rejected),
            "the newest of them": gate.last_rejection or "none",
            "motion from scans": _motion(recalibrator),
            "keyframes left out, motion unknown": str(recalibrator.motion.left_out if recalibrator else 0),
            "semantics": recalibrator.describe_semantics() if recalibrator else "none yet",
            "worker load": f"{intake + estimates:.2f}",
            "estimate load": f"{estimates:.2f}",
            **self._budget(),
        }

    def _budget(self) -> dict[str, str]:
        """CPU time of the last LOAD_WINDOW_S as shares of a core, and what online.max_load did to keyframes so far."""
        first, last = self._samples[0], self._samples[-1]
        span, counts = max(last.at - first.at, 1e-3), last.load
        shares = {work: last.seconds_since(first, work) / span for work in Work}
        return {
            "CPU, share of a core": f"{sum(shares.values()):.2f} of {self._pipeline.config.online.max_load:g}",
            **{f"CPU for {work.value}": f"{share:.3f}" for work, share in shares.items()},
            "frames that waited for online.max_load": str(counts.postponed),
            "keyframes beyond online.max_load": str(counts.forced),
        }

    def _extrinsic(self) -> dict[str, str]:
        recalibrator, estimated_at = self._pipeline.recalibrator, self._health.estimated_at
        # With the monitor's last assessment, which is not published while the extrinsic is right.
        state = self._health.extrinsic if recalibrator is None else recalibrator.current
        if state is None:
            unknown = ("age of the last estimate, s", "status", "cause", "drift")
            return {"estimates accepted": "0", **dict.fromkeys(unknown, "none")}
        result = state.result
        values = {
            "estimates accepted": str(state.accepted),
            "age of the last estimate, s": "none" if estimated_at is None else f"{time.monotonic() - estimated_at:.1f}",
            "status": result.status,
            "cause": "none" if result.cause is None else result.cause.value,
            "score": f"{result.score:.3f}",
            "drift": f"{state.normalised_innovation:.2f}",
            "sigma of rotation, deg": "unknown",
            "sigma of translation, m": "unknown",
            "time offset, ms": "unknown",
            "monitor": state.monitor_message or "none",
            "monitor p-value": "unknown" if math.isnan(state.p_value) else f"{state.p_value:.3g}",
        }
        if result.covariance is not None:
            sigma = np.sqrt(np.diag(result.covariance))
            values["sigma of rotation, deg"] = f"{np.rad2deg(sigma[:3].max()):.3f}"
            values["sigma of translation, m"] = f"{sigma[3:].max():.4f}"
        if result.time_offset_s is not None and result.time_offset_sigma_s is not None:
            values["time offset, ms"] = f"{1000 * result.time_offset_s:.1f} +- {1000 * result.time_offset_sigma_s:.1f}"
        if recalibrator is not None:
            advice = recalibrator.advice(state)
            values |= {"advice": advice.text or "none", "progress, %": f"{100 * advice.progress:.0f}"}
        if recalibrator is not None and recalibrator.config.camera.intrinsics == REFINE:
            values |= refined_values(recalibrator.refined_camera)
        return values

    def _summary(self) -> tuple[bytes, str]:
        """Level and message, worst first: an unreliable extrinsic, silent topics, its lesser problems, messages that get lost or
        find no partner, the newest problem, too little time, too few keyframes."""
        level, text = _level(self._health.extrinsic)
        if level == ERROR:
            return level, text
        if (silent := self._silence()) is not None:
            return silent
        told = *self._health.losses.values(), self._unpaired, self._pipeline.pairing.clocks.describe()
        input_problems = list(filter(None, told))
        if level == WARN or input_problems:
            return WARN, "; ".join([text, *input_problems])
        problem, at = self._health.last_error
        if time.monotonic() - at < ERROR_SHOWN_S:
            return WARN, problem
        first, last = self._window()
        pairs, dropped = last.pairs - first.pairs, last.dropped - first.dropped
        if pairs >= MIN_PAIRS and dropped > DROPPED_SHARE * pairs:
            lost = f"{dropped / pairs:.0%} of the pairs are dropped before they are looked at"
            return WARN, f"{text}; {lost}: {self._why_dropped()}"
        limits = self._limits()
        return (WARN, f"{text}; {limits}") if limits else (level, text)

    def _why_dropped(self) -> str:
        """Cause and advice: the thread that looks at pairs computes itself, or waits to be let."""
        first, last, config = self._samples[0], self._samples[-1], self._pipeline.config
        worked = sum(last.seconds_since(first, work) for work in (Work.INTAKE, Work.KEYFRAMES))
        cures = ["lower online.max_load"] if has_room(config.online, "max_load", up=False) else []
        if worked < COMPUTING_SHARE * (last.intake_s - first.intake_s):
            return f"the node gets too little CPU time; {', or '.join(['give it a core', *cures])}"
        if has_room(config.image, "max_width", up=False):
            cures.append("lower image.max_width")
        if has_room(config.online, "keyframe_spacing_s", up=True):
            cures.append("raise online.keyframe_spacing_s")
        return f"keyframes take all the time; {', or '.join(cures) or 'lower the rate of images and clouds'}"

    def _limits(self) -> str:
        """What has kept keyframes away for long, and what to do; "" if nothing has."""
        first, last = self._samples[0], self._samples[-1]
        if last.left_out - first.left_out >= MANY_LEFT_OUT:
            return (
                f"{last.left_out - first.left_out} keyframes of the last {last.at - first.at:.0f} s left out, since the vehicle "
                f"moves and nobody knows how (motion from scans: {_motion(self._pipeline.recalibrator)}); see that no clouds get "
                "lost, or state the velocity"
            )
        keyframes, forced = last.load.keyframes - first.load.keyframes, last.load.forced - first.load.forced
        if keyframes >= MIN_KEYFRAMES and forced > FORCED_SHARE * keyframes:
            online = self._pipeline.config.online
            return (
                f"online.max_load = {online.max_load:g} does not even allow for a keyframe in {KEYFRAME_EVERY_S:g} s, and what "
                f"has changed is noticed late; {'raise it, or ' if has_room(online, 'max_load', up=True) else ''}lower the rate "
                "of images and clouds"
            )
        return ""

    def _silence(self) -> tuple[bytes, str] | None:
        first, last = self._window()
        if last.at - first.at <= SILENCE_S - 1.5:
            return None
        silent = last.images == first.images, last.clouds == first.clouds
        missing = [topic for topic, is_silent in zip(("image", "points"), silent, strict=True) if is_silent]
        if missing and self._health.losses:  # none of its messages arrives whole
            return WARN, "; ".join(self._health.losses.values())
        if missing:
            return STALE, "; ".join(self._health.silence.get(topic, f"no messages on {topic}") for topic in missing)
        if self._pipeline.data_age_s > SILENCE_S and self._pipeline.starved(SILENCE_S):
            return WARN, STARVED
        if last.pairs > first.pairs:
            return None
        if self._pairing.waiting:
            return OK, "waiting for the next pair"
        text = f"images and clouds arrive, but none belong together: {self._pairing.cause()}"
        if not self._unpaired:  # which is told already
            self._health.error(text, "unpaired")
        return WARN, text


def status_message(name: str, level: bytes, text: str, values: Mapping[str, str]) -> DiagnosticStatus:
    """A status of /diagnostics."""
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    return DiagnosticStatus(level=level, name=name, message=text, values=pairs)


def refined_values(refined: RefinedCamera | None) -> dict[str, str]:
    """What the keyframes tell of the intrinsics, with standard deviations; the published extrinsic is that of the stated ones."""
    titles = {FOCAL: "focal length, px", ASPECT: "fy against fx, share", RADIAL: "k1"}
    titles |= {name: f"principal point {axis}, px" for name, axis in zip(CENTRE, "xy", strict=True)}
    values = {f"refined {title}": "unknown" for title in titles.values()}
    if refined is None:
        return values
    K = refined.camera.K
    for name, change in refined.changes.items():
        value, digits, scale = {
            FOCAL: (K[0, 0], 1, K[0, 0] / (1 + change.value)),  # a share of the stated one
            ASPECT: (change.value, 4, 1.0),
            RADIAL: (np.r_[refined.camera.D, 0.0][0], 4, 1.0),
        }.get(name) or (K[CENTRE.index(name), 2], 1, 1.0)
        seen = "" if change.observable else ", hardly shown"
        values[f"refined {titles[name]}"] = f"{value:.{digits}f} +- {scale * change.sigma:.{digits}f}{seen}"
    return values


def _level(extrinsic: Extrinsic | None) -> tuple[bytes, str]:
    if extrinsic is None or extrinsic.result.status == INITIAL:
        return OK, "collecting keyframes"
    status = extrinsic.result.status
    level = LEVELS.get(status, OK)
    if level == OK:
        return OK, f"{status}: {extrinsic.result.reason}" if status == TENTATIVE else status
    return level, ": ".join(filter(None, [status, extrinsic.result.reason or extrinsic.monitor_message]))


def _motion(recalibrator: Recalibrator | None) -> str:
    """The newest estimate of the vehicle's motion from scans, or why there is none."""
    if recalibrator is None:
        return "none yet"
    last = recalibrator.motion.last
    if recalibrator.motion.missing:
        return recalibrator.motion.missing
    if last is None:
        return "none needed so far"
    if last.twist is None:
        return f"failed: {last.reason}"
    return f"{np.linalg.norm(last.twist[3:]):.1f} m/s, {np.rad2deg(np.linalg.norm(last.twist[:3])):.1f} deg/s"
