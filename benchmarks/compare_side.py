"""One side of a comparison: runs trials by the calib_ros that PYTHONPATH names, of whichever version, by its public names alone.

    python benchmarks/compare_side.py STORE PART OF

STORE: a folder that `compare` has filled. Prints a JSON line for each of its trials whose number is PART modulo OF.
"""

# ruff: noqa: E402
from __future__ import annotations

import sys

del sys.path[0]  # this folder: its modules are not those of the side

import json
import pickle
import time
import traceback
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib_ros import Calibrator, Camera, Config, Frame, PointCloud, Recalibrator, SearchBox, se3

NANOSECONDS = 1_000_000_000


def known(kind: type[Any], values: dict[str, Any]) -> Any:
    """A dataclass from the values of another version of it."""
    return kind(**{field.name: values[field.name] for field in fields(kind) if field.name in values})


def frame_of(values: dict[str, Any]) -> Frame:
    """A frame as `compare_sets.values_of` stores it."""
    parts = {"cloud": known(PointCloud, values["cloud"]), "camera": known(Camera, values["camera"])}
    return known(Frame, values | parts)  # type: ignore[no-any-return]


def estimated(trial: dict[str, Any], frames: list[Frame]) -> dict[str, Any]:
    """An estimate from a start."""
    calibrator = Calibrator(frames[0].camera, Config.from_dict(trial["config"]))
    began = time.process_time()
    result = calibrator.calibrate(frames, np.array(trial["start"]), SearchBox(*trial["box"]))
    return ended(result, time.process_time() - began)


def driven(trial: dict[str, Any], frames: list[Frame]) -> dict[str, Any]:
    """A drive, lap after lap, before whose frame `knock_at` the LiDAR is displaced. noticed_s: after it, until the extrinsic is
    not called converged; alarm: whether it was not before that, once it had been."""
    recalibrator = Recalibrator(frames[0].camera, np.array(trial["start"]), Config.from_dict(trial["config"]))
    rng, knock_at = np.random.default_rng(trial["seed"]), trial["knock_at"]
    T, knock = np.array(trial["truth"]), np.array(trial["knock"])
    moved = se3.inverse(knock @ T) @ T
    was_right, alarm, noticed_s, began = False, False, None, time.process_time()
    period = frames[1].stamp - frames[0].stamp
    for k in range(trial["length"]):
        frame = frames[k % len(frames)]
        shift = k * period - frame.stamp
        late = round(rng.normal(0.0, trial["jitter_s"]) * NANOSECONDS)
        cloud_stamp = None if frame.cloud_stamp is None else frame.cloud_stamp + shift
        frame = replace(frame, stamp=frame.stamp + shift + late, cloud_stamp=cloud_stamp)
        if k >= knock_at:
            xyz = (frame.cloud.xyz @ moved[:3, :3].T + moved[:3, 3]).astype(np.float32)
            frame = replace(frame, cloud=replace(frame.cloud, xyz=xyz))
        if recalibrator.wants(frame.stamp):
            recalibrator.ingest(frame)
        if recalibrator.ready():
            recalibrator.estimate()
        converged = recalibrator.current.result.status == "converged"
        was_right |= converged
        if was_right and not converged and k < knock_at:
            alarm = True
        if noticed_s is None and not converged and k >= knock_at:
            noticed_s = (k - knock_at) * period / NANOSECONDS
    cpu_s = time.process_time() - began
    return ended(recalibrator.current.result, cpu_s) | {"noticed_s": noticed_s, "alarm": alarm, "settled": was_right}


def ended(result: Any, cpu_s: float) -> dict[str, Any]:
    """What is told of an estimate."""
    C = None if result.covariance is None else result.covariance.tolist()
    return {"T": result.T_camera_lidar.tolist(), "covariance": C, "status": result.status, "cpu_s": cpu_s}


def main(store: Path, part: int, of: int) -> None:
    cv2.setNumThreads(1)
    trials = json.loads((store / "trials.json").read_text())
    opened, frames = "", []
    for number in range(part, len(trials), of):
        trial = trials[number]
        if trial["source"] != opened:
            opened, frames = trial["source"], [frame_of(one) for one in pickle.loads((store / trial["source"]).read_bytes())]
        own = [frames[k] for k in trial["frames"]]
        if trial["scans_of"]:
            others = [frame_of(one) for one in pickle.loads((store / trial["scans_of"]).read_bytes())]
            clouds = [others[k % len(others)].cloud for k in trial["frames"]]
            own = [replace(f, cloud=cloud, twist=None, compensated=True) for f, cloud in zip(own, clouds, strict=True)]
        try:
            answer = driven(trial, own) if trial["length"] else estimated(trial, own)
        except Exception as error:  # a version may not know such sensors: a trial that it fails
            traceback.print_exc()
            answer = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer | {"number": number}), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
