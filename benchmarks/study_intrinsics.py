"""Are right intrinsics ever refused, and wrong ones ever accepted? And, on request, corrected, and is the extrinsic then as good
as with right ones? Single frames and sets, searched from up to 2 deg / 15 cm."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarks.records import markdown
from benchmarks.sources import frames_of, with_intrinsics
from benchmarks.study_runner import CLASSES_OFF, Case, End, FeaturesOf, Record, Study, Variant
from calib_ros import se3
from calib_ros.config import CameraConfig
from calib_ros.frame import Frame
from calib_ros.intrinsics import CENTRE, FOCAL, NAMES, RADIAL, change_between, changed
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.nuisance.refinement import lens_parameters
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import CONVERGED, RefusalCode
from calib_ros_synthetic.rigs import RIGS

BOX = SearchBox(2.5, 0.2)
START_DEG, START_M = 2.0, 0.15
SINGLES, SIZES, SETS = 6, (2, 3, 5, 10), 3  # single frames, and frames of how many sets each
SIZE_NAMES = ((1, "1"), (3, "2-3"), (10, "5-10"))


def start_of(case: Case, trial: int) -> NDArray[np.float64]:
    """Half the largest start error or more beside the truth, (4, 4)."""
    rng = np.random.default_rng([case.number, trial])
    turn, shift = (v / np.linalg.norm(v) * rng.uniform(0.5, 1.0) for v in rng.normal(size=(2, 3)))
    return se3.perturb(case.truth, START_DEG * turn, START_M * shift)


def off_centre(frame: Frame, across: float, down: float) -> Frame:
    """The principal point given wrongly, in shares of the image width."""
    return with_intrinsics(frame, centre_px=(across * frame.camera.width, down * frame.camera.width))


VARIANTS = {
    "as given": Variant(CLASSES_OFF),
    "focal +3 %": Variant(CLASSES_OFF, partial(with_intrinsics, focal=0.03)),
    "focal -3 %": Variant(CLASSES_OFF, partial(with_intrinsics, focal=-0.03)),
    "focal +5 %": Variant(CLASSES_OFF, partial(with_intrinsics, focal=0.05)),
    "centre 2 % across": Variant(CLASSES_OFF, partial(off_centre, across=0.02, down=0.0)),
    "centre 2 % down": Variant(CLASSES_OFF, partial(off_centre, across=0.0, down=0.02)),
}


def sets(args: argparse.Namespace) -> Iterator[Case]:
    """Of the sources; without any, of the synthetic rigs."""
    for number, name in enumerate(args.sources or [f"synthetic:rig={rig},frames=10" for rig in RIGS]):
        frames, rng = frames_of(name), np.random.default_rng(number)
        chosen = [[k] for k in range(min(len(frames), SINGLES))]
        for size in SIZES:
            if size <= len(frames):
                draws = 1 if size == len(frames) else SETS
                chosen += [sorted(rng.choice(len(frames), size, replace=False)) for _ in range(draws)]
        for k, own in enumerate(chosen):
            yield Case(name, [frames[i] for i in own], 1000 * number + k, source=name)


def searched(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """By a calibrator of the intrinsics that are claimed."""
    claimed = Calibrator(case.frames[0].camera, calibrator.config)
    result = claimed.estimate([claimed.extract(frame) for frame in case.frames], start_of(case, trial), BOX)
    T = result.T_camera_lidar if result.optimum is None else result.optimum
    told = result.intrinsics.get("focal_length_share")
    said = f"{told.value:.5f} {told.sigma:.5f}" if told is not None else ""
    return End.at(T, case.truth, result.status, said, result)


def table(records: Sequence[Record]) -> str:
    """A line per variant and size of the sets, of all sources."""
    rows = []
    for variant in dict.fromkeys(r.variant for r in records):
        least = 0
        for most, name in SIZE_NAMES:
            own = [r for r in records if r.variant == variant and least < r.frames <= most]
            least = most
            if own:
                accepted = [r for r in own if r.status == CONVERGED]
                named = sum(r.refusal == RefusalCode.WRONG_INTRINSICS.value for r in own)
                wrong = sum(not r.right for r in accepted)
                rows.append([variant, name, len(own), len(accepted), wrong, named, len(own) - len(accepted) - named])
    head = "intrinsics, frames, sets, accepted, of them beyond 0.5 deg or 10 cm, wrong_intrinsics, refused otherwise"
    return markdown(head.split(", "), rows)


# ------------------------------------------------------------------------------------------------ corrected

REFINED_RIGS = ("hdl32e_front", "pandar64_roof", "os1_128_windshield")
REFINED_FRAMES, REFINED_SETS = 5, 2  # of a source, besides the set of all of its frames
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
REFINED_VARIANTS = {
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


def refined_sets(args: argparse.Namespace) -> Iterator[Case]:
    """All frames of a source, and some of them; of the synthetic rigs without any source."""
    for number, name in enumerate(args.sources or [f"synthetic:rig={rig},frames=10" for rig in REFINED_RIGS]):
        frames, rng = frames_of(name), np.random.default_rng(number)
        chosen = [np.arange(len(frames))[:10]]
        if len(frames) > REFINED_FRAMES:
            chosen += [np.sort(rng.choice(len(frames), REFINED_FRAMES, replace=False)) for _ in range(REFINED_SETS)]
        for k, own in enumerate(chosen):
            yield Case(name, [frames[i] for i in own], 1000 * number + k, source=name)


def calibrated(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """By a calibrator of the intrinsics that are claimed. said: of every refined one, its error in standard deviations."""
    right = calibrator.extract.source_camera
    claimed = Calibrator(case.frames[0].camera, calibrator.config)
    result = claimed.calibrate(case.frames, start_of(case, trial), BOX)
    T, said, refined = result.T_camera_lidar if result.optimum is None else result.optimum, "", result.refined_camera
    if refined is not None:
        off = {name: change_between(right, refined.camera, name) for name in refined.changes}
        said = " ".join(f"{name}={off[name]:.6f}/{own.sigma:.6f}" for name, own in refined.changes.items())
    return End.at(T, case.truth, result.status, said, result)


def _deviations(record: Record) -> dict[str, float]:
    told = dict(part.split("=") for part in record.said.split())
    return {name: abs(float(value.split("/")[0])) / float(value.split("/")[1]) for name, value in told.items()}


def refined_table(records: Sequence[Record]) -> str:
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


STUDIES = {
    "intrinsics": Study(sets, searched, VARIANTS, table=table),
    "refined": Study(refined_sets, calibrated, REFINED_VARIANTS, table=refined_table),
}
