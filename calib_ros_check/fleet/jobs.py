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
from dataclasses import asdict, replace
from pathlib import Path

from calib_ros.config import SemanticsConfig
from calib_ros.datasets.nuscenes import split_scene
from calib_ros.errors import CalibrationError, MissingDependencyError
from calib_ros.result import VERSION
from calib_ros.rig.description import read_rig
from calib_ros_check.fleet.recordings import Recording
from calib_ros_check.jobs.pool import Answer
from calib_ros_check.recording import REFERENCE, TF, CheckOptions, check_source
from calib_ros_check.rig.check import as_given, as_row, check_recording

# What an error comes from: the recording, which stays as it is until its files change, or anything else, which is tried again.
INPUT, OTHER = "input", "other"


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


def run_checks(options: CheckOptions, jobs: Sequence[Recording]) -> list[Answer]:
    """Check recordings: `result` as of `CheckResult.to_dict`, or `error` and where it comes from; `cpu_s`, `bytes_read` and
    `peak_bytes` of the process, 0 where the system does not tell.

    Raises MissingDependencyError and ImportError only: no recording would fare better.
    """
    answers = []
    for job in jobs:
        with contextlib.suppress(OSError):  # no Linux, or forbidden: the peak is then that of all jobs until now
            Path("/proc/self/clear_refs").write_text("5")
        cpu, read = time.process_time(), _bytes_read()
        answer = _checked(job, replace(options, camera=job.camera or options.camera, frames=job.frames or options.frames))
        used = {"cpu_s": round(time.process_time() - cpu, 3), "bytes_read": _bytes_read() - read, "peak_bytes": _peak()}
        answers.append(answer | used)
    return answers


def lost(jobs: Sequence[Recording], how: str) -> list[Answer]:
    """Answers of recordings whose workers ended."""
    advice = "out of memory? use fewer --workers, or give them more"
    return [{"error": f"the check of {job.path} did not end: {how}; {advice}", "from": OTHER} for job in jobs]


def _checked(job: Recording, options: CheckOptions) -> Answer:
    try:
        if options.rig:
            return {"result": as_row(check_recording(job.path, options))}
        return {"result": check_source(job.path, options).result.to_dict()}
    except (MissingDependencyError, ImportError):
        raise
    except CalibrationError as error:
        if job.fingerprint and not Path(split_scene(job.path)[0]).exists():
            return {"error": f"{job.path} is not there on {socket.gethostname()}; mount it on all workers", "from": OTHER}
        return {"error": str(error), "from": INPUT}
    except Exception as error:
        return {"error": f"{type(error).__name__}: {' '.join(str(error).split())}", "from": OTHER}


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
