"""How the node is: rates, losses, last error, load; as log lines and as /diagnostics."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from calib_ros.online.pipeline import OnlinePipeline
from calib_ros.online.tracker import Extrinsic
from calib_ros.result import CONVERGED, INITIAL

REPEAT_S = 10.0  # the same complaint is logged at most this often
SILENCE_S = 5.0  # a topic without messages for this long is reported
ERROR_SHOWN_S = 10.0  # an error colours the diagnostics for this long


class Health:
    """Collects what happens; thread-safe, since every field is replaced whole."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._logged: dict[str, float] = {}
        self._last_error = ("", -1e9)
        self._extrinsic: Extrinsic | None = None
        self._estimated_at: float | None = None
        self._callback_ms: deque[float] = deque(maxlen=2000)
        self._counts: deque[tuple[float, int, int, int]] = deque(maxlen=int(SILENCE_S) + 1)
        self._busy = (time.monotonic(), 0.0)
        self.errors = 0

    def error(self, text: str) -> None:
        """One line for a person; repeated ones are logged once in REPEAT_S."""
        now = time.monotonic()
        self.errors += 1
        self._last_error = (text, now)
        if now - self._logged.get(text, -1e9) >= REPEAT_S:
            if len(self._logged) > 100:  # texts may hold numbers that never repeat
                self._logged.clear()
            self._logged[text] = now
            self._logger.warning(text)

    def estimated(self, extrinsic: Extrinsic) -> None:
        """A new state of the extrinsic."""
        self._extrinsic = extrinsic
        result = extrinsic.result
        if result.status == CONVERGED and extrinsic.accepted:
            self._estimated_at = time.monotonic()
            self._logger.info(
                f"extrinsic from {result.frames_used} keyframes: score {result.score:.3f}, "
                f"drift {extrinsic.drift:.2f}, {result.elapsed_s:.1f} s"
            )
        elif result.status == INITIAL or (result.status == CONVERGED and not extrinsic.accepted):
            self._logger.info(
                f"initial extrinsic {result.lidar_frame} -> {result.camera_frame}: {result.reason or 'from the saved state'}"
            )
        else:
            self.error(f"estimate {result.status}: {result.reason}")

    def timed(self, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """The callback, with its time kept."""

        def run(msg: Any) -> None:
            start = time.perf_counter()
            callback(msg)
            self._callback_ms.append(1e3 * (time.perf_counter() - start))

        return run

    def message(self, pipeline: OnlinePipeline, name: str, stamp: Any) -> DiagnosticArray:
        """The state as /diagnostics."""
        now = time.monotonic()
        counts = pipeline.pairer.counts
        self._counts.append((now, counts.images, counts.clouds, counts.pairs))
        since, images, clouds, pairs = self._counts[0]
        new_images, new_clouds, new_pairs = counts.images - images, counts.clouds - clouds, counts.pairs - pairs
        level, text = self._verdict(pipeline, now, now - since, new_images, new_clouds, new_pairs)
        span = max(now - since, 1e-3)
        busy = sum(pipeline.busy_seconds())
        load = (busy - self._busy[1]) / max(now - self._busy[0], 1e-3)
        self._busy = (now, busy)
        recalibrator = pipeline.recalibrator
        times = np.array(self._callback_ms) if self._callback_ms else np.zeros(1)
        values = {
            "images per s": f"{new_images / span:.1f}",
            "clouds per s": f"{new_clouds / span:.1f}",
            "pairs per s": f"{new_pairs / span:.1f}",
            "images": counts.images,
            "clouds": counts.clouds,
            "pairs": counts.pairs,
            "unpaired images": counts.unpaired_images,
            "unpaired clouds": counts.unpaired_clouds,
            "pairs dropped by a busy worker": pipeline.dropped_pairs,
            "keyframes in the buffer": len(recalibrator.buffer) if recalibrator else 0,
            "keyframes so far": recalibrator.keyframes_seen if recalibrator else 0,
            "estimates accepted": self._extrinsic.accepted if self._extrinsic else 0,
            "age of the last estimate, s": f"{now - self._estimated_at:.1f}" if self._estimated_at is not None else "none",
            "score": f"{self._extrinsic.result.score:.3f}" if self._extrinsic else "none",
            "drift": f"{self._extrinsic.drift:.2f}" if self._extrinsic else "none",
            "worker load": f"{load:.2f}",
            "callback 99th percentile, ms": f"{np.percentile(times, 99):.2f}",
            "errors": self.errors,
            "last error": self._last_error[0],
        }
        status = DiagnosticStatus(level=level, name=f"{name.lstrip('/')}: extrinsic", message=text, hardware_id="")
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = stamp
        return message

    def _verdict(
        self, pipeline: OnlinePipeline, now: float, watched: float, images: int, clouds: int, pairs: int
    ) -> tuple[bytes, str]:
        if watched > SILENCE_S - 1.5:
            missing = [topic for topic, count in (("image", images), ("points", clouds)) if count == 0]
            if missing:
                return (
                    DiagnosticStatus.STALE,
                    f"no messages on {' and '.join(missing)}; check the remapping and the publisher's QoS",
                )
            if pairs == 0:
                gap = pipeline.pairer.nearest_gap_s()
                tolerance = pipeline.config.online.pair_tolerance_s
                if gap is not None and gap <= tolerance:  # a pair that is not final yet
                    return DiagnosticStatus.OK, "waiting for the next pair"
                self.error(
                    f"images and clouds arrive, but their stamps are never within {tolerance:g} s"
                    + (f" (nearest {gap:.3f} s)" if gap is not None else "")
                    + "; synchronise the clocks or raise online.pair_tolerance_s"
                )
        text, at = self._last_error
        if now - at < ERROR_SHOWN_S:
            return DiagnosticStatus.WARN, text
        if self._extrinsic is None or self._extrinsic.result.status == INITIAL:
            return DiagnosticStatus.OK, "collecting keyframes"
        return DiagnosticStatus.OK, self._extrinsic.result.status
