"""Studies of one shape: sources x variants x trials -> a record each -> a table.

    python -m benchmarks.studies NAME [SOURCE ...] [--kitti FOLDER] [--trials N] [--cases N] [--variants NAME ...] [--csv FILE]
        [--workers N] [--config YAML] [--plot PNG]

registration  the table by which every change is judged: success and accuracy over random starts, on KITTI (--kitti) and a
              synthetic drive; SOURCE: names of its rows
ablation      some of its rows with one part of the method switched off at a time
vehicles      is what is accepted right, and what is right accepted: single frames and sets of SOURCE, of --soft, whose reference
              is known to 0.9 deg / 25 cm only, and of the synthetic --rigs
vehicle_parts the same with one part of the method switched off at a time
monitor_hours hours of quiet driving and knocks, driving and standing: SOURCE of 10 Hz, or six synthetic rigs, lap after lap
chance        images with scans of another place, and mirrored ones: are they accepted as rarely as p values say? SOURCE, --rigs
sensitivity   the cases of vehicles with each constant of the acceptance test and the covariance 30 % less and more
covariance    normalised errors squared of estimates from subsets of frames of SOURCE, or synthetic drives and KITTI
classes       single KITTI frames from 5 deg / 0.3 m per axis, with and without the classes of the package's networks
first_guess   first guesses from classes: sets of 1, 5 and 10 KITTI frames, the LiDAR turned by any yaw within 45 deg and moved
              by up to 1 m per axis
centroids     first guesses from centroids, not registered: ten frames of synthetic drives and --kitti, any yaw
class_weights KITTI frames whose points have classes by the shape of clusters; weights of edges of vegetation and ground
masks         the KITTI frame with masks of Segment Anything; their share in the edge maps
time_offset   image stamps altered; SOURCE with consecutive frames, `standing:SOURCE` as if the vehicle stood
stamping      weaving synthetic rigs without times of points; how the driver stamps its scans is to be found
motion_guess  windows of synthetic drives with a camera of any yaw; the first guess from motion, and the registration from there
optimisers    SOURCE@POSITIONS; where the optimisers of eq. 3.12 and of the fast form end from 1 deg / 0.1 m
checks        is what is wrong with a recording named rightly: every cause that a check knows, injected into SOURCE, or all rigs
contract      is anything that is wrong ever called usable: SOURCE played to the recalibrator with a fault of a vehicle at a time
intrinsics    are right intrinsics ever refused, and wrong ones ever accepted: single frames and sets of SOURCE, or all rigs
refined       are wrong intrinsics corrected, and is the extrinsic then as good as with right ones: sets of SOURCE, or three rigs

--trials: starts of a case, or how many drives. Differences are paired with the first variant; their 95 % intervals are those of a
bootstrap over cases. The same command goes on with a study that was interrupted where its --csv ends.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks import (
    study_acceptance,
    study_centroids,
    study_checks,
    study_contract,
    study_hours,
    study_intrinsics,
    study_registration,
)
from benchmarks.records import append_records, read_records
from benchmarks.sources import Listed, frames_of, late
from benchmarks.study_registration import DRIVE, ODOMETRY, SCENES, spread
from benchmarks.study_runner import CLASSES_OFF, RIGHT, Case, End, Estimate, FeaturesOf, Record, Study, Variant, run, table
from calib_ros import se3
from calib_ros.config import SemanticsConfig
from calib_ros.datasets import open_dataset
from calib_ros.datasets.positions import frame_positions
from calib_ros.datasets.source import WithMotion
from calib_ros.errors import BadInputError, CalibrationError, TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.classes import MASKS, FrameSemantics
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.initial_guess import nominal
from calib_ros.registration.motion_guess.guess import motion_guess
from calib_ros.registration.nuisance.stamping import convention
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import Result, Stamping
from calib_ros_semantics.models.geometric_classes import cluster_classes
from calib_ros_semantics.models.onnx_model import Deadline
from calib_ros_semantics.models.segmentation import load_model
from calib_ros_synthetic.drive import SyntheticDrive

Matrix = NDArray[np.float64]


def uniform(rng: np.random.Generator, truth: Matrix, deg: float, m: float) -> Matrix:
    """A start (4, 4) within deg and m per axis."""
    return se3.perturb(truth, rng.uniform(-deg, deg, 3), rng.uniform(-m, m, 3))


def drives(args: argparse.Namespace) -> list[tuple[str, list[Frame]]]:
    """Both KITTI drives."""
    if args.kitti is None:
        raise BadInputError("this study needs --kitti FOLDER")
    return [(Path(name).name, frames_of(str(args.kitti / name))) for name in (DRIVE, ODOMETRY)]


# ------------------------------------------------------------------------------------------------ classes and masks


def single_frames(args: argparse.Namespace) -> Iterator[Case]:
    for _, frames in drives(args):
        yield from (Case("single frames", [frame], k) for k, frame in enumerate(frames))


def with_classes(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """As the product does: without classes first, where its settings say so."""
    box, start = SearchBox(5.0, 0.3), uniform(np.random.default_rng((case.number, trial)), case.truth, 5.0, 0.3)
    own = features()
    if calibrator.classes_in_doubt_only:
        plain = [f.plain or f for f in own]
        return end(case, calibrator.estimate_in_doubt(plain, lambda: (own, ()), start, box))
    return end(case, calibrator.estimate(own, start, box))


def end(case: Case, result: Result, said: str = "") -> End:
    return End.at(result.T_camera_lidar, case.truth @ se3.inverse(case.lidar), result.status, said, result)


def guessed_sets(args: argparse.Namespace) -> Iterator[Case]:
    both = drives(args)
    for count in (1, 5, 10):
        for trial in range(args.trials or 20):
            _, frames = both[trial % len(both)]
            rng = np.random.default_rng((count, trial))
            chosen = np.sort(rng.choice(len(frames), min(count, len(frames)), replace=False))
            yaw, shift = np.deg2rad(rng.uniform(-45, 45)), rng.uniform(-1, 1, 3)
            A = se3.exp(np.array([0, 0, yaw, 0, 0, 0]))
            A[:3, 3] = shift
            yield Case(f"{count} frame{'s' if count > 1 else ''}", [frames[k] for k in chosen], trial, A)


def first_guess(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """Nothing is known of the mount; the points are as a LiDAR whose frame is moved would have them."""

    def at(xyz: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(xyz @ case.lidar[:3, :3].T + case.lidar[:3, 3], np.float32)

    own = []
    for f in features():
        assert isinstance(f, FrameFeatures)
        view = f.view and replace(f.view, xyz=at(f.view.xyz))
        own.append(replace(f, points=replace(f.points, xyz=at(f.points.xyz)), view=view, plain=None))
    return end(case, calibrator.guess(own))


def by_shape(args: argparse.Namespace) -> Iterator[Case]:
    for name, frames in drives(args):
        for k, position in enumerate(spread(10, len(frames))):
            frame = frames[position]
            yield Case(name, [frame], k, semantics=[FrameSemantics(None, None, cluster_classes(frame.cloud))])


def masked(args: argparse.Namespace) -> Iterator[Case]:
    frame = drives(args)[1][1][0]
    edges = load_model(MASKS, str(args.kitti / "sam_masks"), SemanticsConfig())(frame, Deadline(60))
    yield Case("odometry 00, 000000", [frame], semantics=[FrameSemantics(edges)])


def searched(box: SearchBox, starts: int) -> Estimate:
    """From `starts` starts of every case, drawn one after the other."""

    def estimate(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
        start = uniform(np.random.default_rng(case.number * starts + trial), case.truth, *box.reach)
        return end(case, calibrator.estimate(features(), start, box))

    return estimate


# ------------------------------------------------------------------------------------------------ clocks and motion


def consecutive(args: argparse.Namespace) -> Iterator[Case]:
    """Frames of a source; as if the vehicle stood: points where they are at the image's moment."""
    for text in args.sources:
        name = text.removeprefix("standing:")
        frames = frames_of(name)
        if text != name:
            frames = [replace(frame, twist=np.zeros(6), compensated=True) for frame in frames]
        yield Case(Path(text).name, frames)


def near_start(calibrator: Calibrator, case: Case, features: FeaturesOf, number: int) -> Result:
    off = np.random.default_rng([number, 7]).uniform(-1, 1, 6) * ([np.deg2rad(2.0)] * 3 + [0.2] * 3)
    return calibrator.estimate(features(), se3.exp(off) @ case.truth, SearchBox(5.0, 0.5))


def found_offset(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    result = near_start(calibrator, case, features, trial)
    if result.time_offset_s is None or result.time_offset_sigma_s is None:
        return end(case, result)
    return end(case, result, f"{1000 * result.time_offset_s:.3f} {1000 * result.time_offset_sigma_s:.3f}")


def offset_errors(records: Sequence[Record]) -> str:
    reported = np.array([[*map(float, r.said.split()), float(r.variant.split()[0])] for r in records if r.said]).reshape(-1, 3)
    if not len(reported):
        return "not observable"
    error = np.abs(reported[:, 0] - reported[:, 2])
    inliers = (error <= 2 * reported[:, 1]).sum()
    return f"error {np.median(error):.1f}, largest {error.max():.1f} ms; {inliers} of {len(reported)} within 2 sigma"


SPINNING = ("vlp32c_roof", "os1_128_windshield", "hdl64e_kitti", "pandar64_roof", "os1_64_robot", "vls128_wide", "os1_64_wide")


def untimed(args: argparse.Namespace) -> Iterator[Case]:
    for number in range(args.trials or 40):
        rng = np.random.default_rng([number, 20])
        stamp_at, spin = str(rng.choice(["start", "middle", "end"])), ("clockwise", "counterclockwise")[rng.choice([0, 1])]
        drive = SyntheticDrive(number, 8, rig=SPINNING[number % len(SPINNING)], ride="weaving", stamp_at=stamp_at, spin=spin)
        frames = [replace(f, cloud=replace(f.cloud, time=None)) for f in (drive[k] for k in range(len(drive)))]
        yield Case("weaving rigs", frames, number, said=f"{spin} {stamp_at}")


def found_stamping(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    result = near_start(calibrator, case, features, case.number)
    found, _ = convention(result.stamping or Stamping("clockwise", 0.0), result.time_offset_s or 0.0, 0.1)
    right = result.converged and f"{found.spin} {found.stamp_at}" == case.said
    return end(case, result, "right" if right else "wrong")


YAWS = (0.0, 180.0, 90.0, -60.0)  # deg; the next mount has a random one
WINDOW_RIGS = (
    ("vlp32c_roof", "hdl32e_side", "os1_64_robot", "os1_128_windshield", "mid360_90"),
    ("hdl32e_front", "vlp32c_roof", "vls128_wide", "os1_128_fisheye", "os1_64_portrait"),
)


def windows(args: argparse.Namespace) -> Iterator[Case]:
    """5 s at 5 Hz of a drive of its own each: of every ten, five generic scanners with a camera of any yaw, five rigs. The
    velocities that the drive knows are taken away."""
    for seed in range(900, 900 + (args.trials or 40)):
        kind, ten = seed % 10, seed // 10
        scene = ("street", "street", "trees", "park")[ten % 4]
        if kind >= 5:
            drive = SyntheticDrive(seed, 26, stride=2, scene=scene, rig=WINDOW_RIGS[ten % 2][kind - 5])
        else:
            rng = np.random.default_rng([seed, 78])
            yaw = YAWS[kind] if kind < len(YAWS) else float(rng.uniform(-180, 180))
            T = se3.perturb(nominal(yaw), rng.uniform(-4, 4, 3), np.zeros(3))
            T[:3, 3] = -T[:3, :3] @ rng.uniform(-1, 1, 3)
            rings = int(rng.choice([16, 32, 64]))
            drive = SyntheticDrive(seed, 26, rings, width=640, height=240, stride=2, scene=scene, T_camera_lidar=T)
        yield Case("windows of 5 s", [replace(drive[k], twist=None) for k in range(len(drive))], seed)


def from_motion(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """said: error of the guess, deg. Every fourth frame is registered."""
    try:
        guess = motion_guess(case.frames, calibrator.extract)
    except TooFewFeaturesError:
        return End.at(np.eye(4), case.truth, "no guess")
    moving = WithMotion(Listed("window", case.frames), calibrator.config.motion)
    result = calibrator.calibrate([moving[k] for k in range(0, len(case.frames), 4)], "motion", consecutive=case.frames)
    return end(case, result, f"{se3.rotation_error_deg(case.truth, guess.hypotheses[0]):.3f}")


def guess_errors(records: Sequence[Record]) -> str:
    errors = np.array([float(r.said) if r.said else np.inf for r in records])
    return f"guesses within 3 deg: {(errors <= 3).sum()} of {len(records)}, median {np.median(errors):.2f} deg"


# ------------------------------------------------------------------------------------------------ eq. 3.12


def scenes(args: argparse.Namespace) -> Iterator[Case]:
    """The first three scenes alone, then those of each source together."""
    groups = []
    for text in args.sources:
        name, _, positions = text.partition("@")
        source = open_dataset(name)
        groups.append((Path(name).name, [source[k] for k in frame_positions(positions or "all", len(source))]))
    singles = [(f"{name}, {frame.name} alone", [frame]) for name, frames in groups for frame in frames]
    several = [(f"{name}, {len(frames[:3])} scenes", frames[:3]) for name, frames in groups if len(frames) > 1]
    yield from (Case(name, frames) for name, frames in [*singles[:3], *several])


def optimised(calibrator: Calibrator, case: Case, features: FeaturesOf, trial: int) -> End:
    """Where the optimiser ends, judged good or not: what a gate makes of it is another question."""
    rng = np.random.default_rng(0)
    start = [uniform(rng, case.truth, 1.0, 0.1) for _ in range(trial + 1)][-1]
    own, _config = features(), calibrator.config
    return End.at(calibrator.objectives(own, start, start).optimise(start), case.truth)


def thesis(optimizer: str, **own: Any) -> Variant:
    return Variant({"refine": {"objective": "thesis", "optimizer": optimizer}, "thesis": own})


STUDIES: dict[str, Study] = {
    **study_registration.STUDIES,
    **study_acceptance.STUDIES,
    "monitor_hours": study_hours.STUDY,
    "classes": Study(
        single_frames,
        with_classes,
        {
            "none": Variant({"semantics": {"segmentation": "none"}}),
            "default": Variant(),
        },
        trials=2,
    ),
    "first_guess": Study(guessed_sets, first_guess, limits=RIGHT),
    "centroids": study_centroids.STUDY,
    "class_weights": Study(
        by_shape,
        searched(SearchBox(5, 0.3, 2), 2),
        {f"{w:g}": Variant(replaced={"calib_ros.registration.classes.LIGHT_WEIGHT": w}) for w in (1.0, 0.5, 0.2)},
        trials=2,
    ),
    "masks": Study(
        masked,
        searched(SearchBox(3, 0.2, 2), 20),
        {
            f"{share:g}": Variant(replaced={"calib_ros.registration.features.EDGE_SHARE": share})
            for share in (0.0, 0.25, 0.5, 0.75, 1.0)
        },
        trials=20,
    ),
    "time_offset": Study(
        consecutive,
        found_offset,
        {f"{ms:+d} ms": Variant(CLASSES_OFF, partial(late, seconds=ms / 1000)) for ms in (0, -100, -60, -30, 30, 60, 100)},
        trials=3,
        remark=offset_errors,
    ),
    "stamping": Study(
        untimed,
        found_stamping,
        {"": Variant(CLASSES_OFF)},
        remark=lambda records: f"named rightly: {sum(r.said == 'right' for r in records)}",
    ),
    "motion_guess": Study(windows, from_motion, limits=RIGHT, remark=guess_errors),
    "optimisers": Study(
        scenes,
        optimised,
        {
            "eq. 3.12, Nelder-Mead": thesis("nelder_mead"),
            "eq. 3.12, Barzilai-Borwein": thesis("barzilai_borwein"),
            "edges attached, Levenberg-Marquardt": thesis("auto", dense_edges="once_per_level"),
            "fast form": Variant(),
        },
        trials=10,
    ),
    "checks": study_checks.STUDY,
    "contract": study_contract.STUDY,
    **study_intrinsics.STUDIES,
}


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", choices=list(STUDIES))
    parser.add_argument("sources", nargs="*", help="as for calib-ros")
    parser.add_argument("--soft", nargs="*", default=[], help="more sources, whose reference is less exact")
    parser.add_argument("--rigs", nargs="*", choices=SCENES, metavar="SCENE", help="the synthetic rigs, in these scenes or all")
    parser.add_argument("--kitti", type=Path, help="folder of the KITTI recordings")
    parser.add_argument("--trials", type=int)
    parser.add_argument("--cases", type=int, help="only so many of the first")
    parser.add_argument("--variants", nargs="+", metavar="NAME")
    parser.add_argument("--config", help="YAML")
    parser.add_argument("--csv", type=Path, help="add every trial; go on with a study that was interrupted")
    parser.add_argument("--plot", type=Path, help="of covariance")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, metavar="N", help="processes (default one per core)")
    args = parser.parse_args()
    study = STUDIES[args.study]
    if unknown := set(args.variants or ()) - set(study.variants):
        parser.error(f"no variant {', '.join(sorted(unknown))}; there are {', '.join(study.variants)}")
    if args.plot and study.plot is None:
        parser.error(f"{args.study} has no plot")
    cv2.setNumThreads(1)  # before any work: a forked worker would wait for ever for threads that only its parent has
    records = read_records(args.csv, Record)
    try:
        for record in run(study, args, records):
            records.append(record)
            append_records(args.csv, [record])
    except CalibrationError as error:
        parser.error(str(error))
    print(table(study, records))
    if args.plot and study.plot is not None:
        study.plot(records, args.plot)
    return 0


if __name__ == "__main__":
    sys.exit(main())
