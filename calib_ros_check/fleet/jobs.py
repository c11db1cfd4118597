"""The check of one recording as a job: its answer, whatever happens, and what it costs."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import resource
import socket
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from calib_ros.config import SemanticsConfig
from calib_ros.datasets.nuscenes import split_scene
from calib_ros.errors import CalibrationError, MissingDependencyError
from calib_ros.result import VERSION
from calib_ros.rig.description import read_rig
from calib_ros_check.jobs.journal import Answer
from calib_ros_check.recording import REFERENCE, TF, CheckOptions, check_source
from calib_ros_check.rig.check import as_given, as_row, check_recording

# What an error comes from: the recording, which stays as it is until its files change, or anything else, which is tried again.
INPUT, OTHER = "input", "other"


@dataclass(frozen=True)
class CheckJob:
    """path: the recording. fingerprint: of its files. options: of the check, see `options_key`. camera, frames: instead of those
    of the options, where they differ between recordings."""

    path: str
    fingerprint: str
    options: str
    camera: str = ""
    frames: str = ""

    @property
    def key(self) -> str:
        """Other for a recording that has changed, and for other options."""
        own = f"|{self.camera}|{self.frames}" if self.camera or self.frames else ""
        return f"{self.path}|{self.fingerprint}|{self.options}{own}"

    def of(self, options: CheckOptions) -> CheckOptions:
        """Options with what is the job's own."""
        return replace(options, camera=self.camera or options.camera, frames=self.frames or options.frames)


def _weights(config: SemanticsConfig) -> list[str | None]:
    """Fingerprints of the models' weights; none where no package brings models."""
    try:
        from calib_ros_semantics.models.segmentation import SegmentationModels
        from calib_ros_semantics.models.weight_sets import weights_of
    except ImportError:
        return []
    found = [model.weights for model in SegmentationModels(config).models]
    found.append(weights_of(Path(config.segment_anything_decoder)))
    return [None if own is None else own.sha256 for own in found]


def options_key(options: CheckOptions) -> str:
    """The same for options, and files that they name, that give the same answers. BadInputError if the extrinsic is a file that
    cannot be read."""
    content = asdict(options)
    semantics = options.config.semantics
    content["weights"] = _weights(semantics)
    if options.rig:
        description = as_given(read_rig(options.rig), options.extrinsic)
        content["rig"] = repr((description.sensors, description.reference, description.pairs))
    elif options.extrinsic not in (REFERENCE, TF):
        from calib_ros import result

        content["extrinsic"] = result.load(options.extrinsic).T_camera_lidar.tolist()
    text = json.dumps({"version": VERSION, **content}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def run_checks(options: CheckOptions, jobs: Sequence[CheckJob]) -> list[Answer]:
    """Check recordings: `result` as of `CheckResult.to_dict`, or `error` and where it comes from; `cpu_s`, `bytes_read` and
    `peak_bytes` of the process.

    Raises MissingDependencyError and ImportError only: no recording would fare better.
    """
    return [_checked(job, job.of(options)) for job in jobs]


def lost(jobs: Sequence[CheckJob], how: str) -> list[Answer]:
    """Answers of recordings whose workers ended."""
    advice = "out of memory? use fewer --workers, or give them more"
    return [{"error": f"the check of {job.path} did not end: {how}; {advice}", "from": OTHER} for job in jobs]


def _checked(job: CheckJob, options: CheckOptions) -> Answer:
    usage = Usage()
    answer: Answer
    try:
        found = as_row(check_recording(job.path, options)) if options.rig else check_source(job.path, options).result.to_dict()
        answer = {"result": found}
    except (MissingDependencyError, ImportError):
        raise
    except CalibrationError as error:
        if job.fingerprint and not Path(split_scene(job.path)[0]).exists():
            answer = {"error": f"{job.path} is not there on {socket.gethostname()}; mount it on all workers", "from": OTHER}
        else:
            answer = {"error": str(error), "from": INPUT}
    except Exception as error:
        answer = {"error": f"{type(error).__name__}: {' '.join(str(error).split())}", "from": OTHER}
    return answer | usage.since()


class Usage:
    """What the process has used since this object was made."""

    def __init__(self) -> None:
        with contextlib.suppress(OSError):  # no Linux, or forbidden: the peak is then that of all jobs until now
            Path("/proc/self/clear_refs").write_text("5")
        self._cpu, self._bytes = time.process_time(), _bytes_read()

    def since(self) -> dict[str, float | int]:
        """cpu_s, bytes_read, peak_bytes of memory; 0 where the system does not tell."""
        used = {"cpu_s": round(time.process_time() - self._cpu, 3), "bytes_read": _bytes_read() - self._bytes}
        return used | {"peak_bytes": _peak()}


def _bytes_read() -> int:
    """By this process since its start, from files and pipes, be they in memory or not."""
    try:
        fields = dict(line.split(":") for line in Path("/proc/self/io").read_text().splitlines())
        return int(fields["rchar"])
    except (OSError, KeyError, ValueError):  # no Linux, or hidden in a container
        return 0


def _peak() -> int:
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1024 if os.uname().sysname == "Linux" else 1)
