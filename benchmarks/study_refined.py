"""Are wrong intrinsics corrected, and is the extrinsic then as good as with right ones? Searched from up to 2 deg / 15 cm."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.records import markdown
from benchmarks.sources import frames_of
from benchmarks.study_intrinsics import BOX, START_DEG, START_M
from benchmarks.study_runner import CLASSES_OFF, Case, End, FeaturesOf, Record, Study, Variant
from calib_ros import se3
from calib_ros.config import CameraConfig
from calib_ros.frame import Frame
from calib_ros.intrinsics import CENTRE, FOCAL, NAMES, RADIAL, change_between, changed
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.nuisance.refinement import lens_parameters
from calib_ros.result import CONVERGED

RIGS = ("hdl32e_front", "pandar64_roof", "os1_128_windshield")
FRAMES, SETS = 5, 2  # of a source, besides the set of all of its frames
GIVEN = "right, given"
MATCHED = 1.5  # times the error with right intrinsics that are given


def wrong(frame: Frame, focal: float = 0.0, corner: float = 0.0, across: float = 0.0) -> Frame:
    """A picture with a CameraInfo that is wrong: focal length, by a share; distortion, by a share of the corner's radius;
    principal point, by a share of the image width."""
    camera = frame.camera
    radial = lens_parameters(CameraConfig(), camera, camera.rectified())[-1]
    for name, value in ((FOCAL, focal), (RADIAL, corner * radial.unit), (CENTRE[0], across * camera.width)):
        camera = changed(camera, name, value) if value else camera
    return replace(frame, camera=camera)


REFINE = {**CLASSES_OFF, "camera": {"intrinsics": "refine"}}
VARIANTS = {
    GIVEN: Variant(CLASSES_OFF),
    "right": Variant(REFINE),
    "focal +3 %": Variant(REFINE, partial(wrong, focal=0.03)),
    "focal -3 %": Variant(REFINE, partial(wrong, focal=-0.03)),
    "corner +2 %": Variant(REFINE, partial(wrong, corner=0.02)),
    "corner -2 %": Variant(REFINE, partial(wrong, corner=-0.02)),
    "focal +3 %, corner +2 %": Variant(REFINE, partial(wrong, focal=0.03, corner=0.02)),
    "focal -5 %": Variant(REFINE, partial(wrong, focal=-0.05)),
    "centre 2 % across": Variant(REFINE, partial(wrong, across=0.02)),
}


def sets(args: argparse.Namespace) -> Iterator[Case]:
    """All frames of a source, and some of them; of the synthetic rigs without any source."""
    for number, name in enumerate(args.sources or [f"synthetic:rig={rig},frames=10" for rig in RIGS]):
        frames, rng = frames_of(name), np.random.default_rng(number)
        chosen = [np.arange(len(frames))[:10]]
        if len(frames) > FRAMES:
            chosen += [np.sort(rng.choice(len(frames), FRAMES, replace=False)) for _ in range(SETS)]
        for k, own in enumerate(chosen):
            yield Case(name, [frames[i] for i in own], 1000 * number + k, source=name)


def calibrated(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """By a calibrator of the intrinsics that are claimed. said: of every refined one, its error in standard deviations."""
    right = calibrator.extract.source_camera
    claimed = Calibrator(case.frames[0].camera, calibrator.config)
    rng = np.random.default_rng([case.number, trial])
    turn, shift = (v / np.linalg.norm(v) * rng.uniform(0.5, 1.0) for v in rng.normal(size=(2, 3)))
    result = claimed.calibrate(case.frames, se3.perturb(case.truth, START_DEG * turn, START_M * shift), BOX)
    T, said, refined = result.T_camera_lidar if result.optimum is None else result.optimum, "", result.refined_camera
    if refined is not None:
        off = {name: change_between(right, refined.camera, name) for name in refined.changes}
        said = " ".join(f"{name}={off[name]:.6f}/{own.sigma:.6f}" for name, own in refined.changes.items())
    return End.at(T, case.truth, result.status, said, result)


def _deviations(record: Record) -> dict[str, float]:
    told = dict(part.split("=") for part in record.said.split())
    return {name: abs(float(value.split("/")[0])) / float(value.split("/")[1]) for name, value in told.items()}


def table(records: Sequence[Record]) -> str:
    """A line per source and variant."""
    rows = []
    for group in dict.fromkeys(r.group for r in records):
        best = {r.case: r for r in records if r.group == group and r.variant == GIVEN}
        for variant in dict.fromkeys(r.variant for r in records if r.group == group):
            own = [r for r in records if (r.group, r.variant) == (group, variant)]
            used = [r for r in own if r.status == CONVERGED]
            off = [_deviations(r) for r in used if r.said]
            within = [[d[name] for d in off if name in d] for name in NAMES]
            said = [f"{sum(v <= 2 for v in values)} of {len(values)}" if values else "" for values in within]
            pairs = [(r, best[r.case]) for r in used if r.case in best]
            matched = sum(r.deg <= MATCHED * b.deg and r.cm <= MATCHED * b.cm for r, b in pairs)
            errors = f"{np.median([r.deg for r in used]):.3f}, {np.median([r.cm for r in used]):.1f}" if used else ""
            nees = f"{np.median([r.nees for r in used]):.1f}" if used else ""
            rows.append(
                [group, variant, len(own), len(used), *said, errors, matched, nees, f"{np.median([r.cpu_s for r in own]):.1f}"]
            )
    head = (
        "source, intrinsics, sets, accepted, focal length within 2 sigma, cx, cy, k1, median deg; cm,"
        f" within {MATCHED:g} times the error with right ones, normalised error squared, CPU s"
    )
    return markdown([part.replace(";", ",") for part in head.split(", ")], rows)


STUDY = Study(sets, calibrated, VARIANTS, table=table)
