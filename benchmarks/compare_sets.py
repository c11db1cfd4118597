"""The sets of a comparison: frames, and starts from which both sides estimate. All are drawn by seeds, and none by either side.

A set is spent once a threshold was chosen by it (column `sets` of docs/figures/constants.csv): it shows that something has become
worse, but no longer how good it is elsewhere.
"""

from __future__ import annotations

import csv
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.study_registration import DRIVE, EXACT_SENSORS, ODOMETRY, bound, spread
from benchmarks.study_runner import CLASSES_OFF, frames_of
from calib_ros import se3
from calib_ros.config import Config, update
from calib_ros.frame import Frame
from calib_ros.registration.features import FeatureExtractor
from calib_ros_synthetic.rigs import PAIRS

Matrix = NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[1]
CONSTANTS = ROOT / "docs" / "figures" / "constants.csv"
SINGLE, SEVERAL = (5.0, 0.3), (10.0, 0.5)  # deg, m per axis that a start is off, of one frame and of several
SET, MOST_SINGLE = 5, 8  # frames of a set of a recording, and single ones of it at most
BESIDE_DEG, BESIDE_M = 0.3, 0.03  # per axis that a drive's start is off
# Loops of 5 s at 5 Hz; the displacement comes when the extrinsic has been steady for a while.
ONLINE_RIGS = (
    *("hdl64e_kitti", "hdl32e_front", "pandar40p_roof", "vlp32c_roof", "os1_128_windshield", "pandar64_roof"),
    *("vls128_wide", "hdl32e_side", "os1_64_wide", "hdl64e_waymo"),
)
ONLINE_FRAMES, KNOCK_AT, AFTER = 25, 150, 40
KNOCK_DEG, KNOCK_M, JITTER_S = 1.5, 0.15, 0.004


@dataclass(frozen=True)
class PairedTrial:
    """What both sides do. set, source: its names. frames: positions in the source; all that count for its cluster. start, truth,
    knock: (4, 4). box: deg, m, what the search covers. scans_of: another source, whose scans do not belong to the images. length:
    frames of a drive, 0 = one estimate. bound: least standard deviation of rotation, rad, and translation, m; None = unknown."""

    set: str
    source: str
    frames: list[int]
    start: list[list[float]]
    truth: list[list[float]]
    config: dict[str, Any]
    box: tuple[float, float] = SINGLE
    seed: int = 0
    scans_of: str = ""
    length: int = 0
    knock_at: int = 0
    knock: list[list[float]] = field(default_factory=lambda: np.eye(4).tolist())
    jitter_s: float = JITTER_S
    bound: tuple[float, float] | None = None

    @property
    def cluster(self) -> tuple[str, tuple[int, ...]]:
        """Trials on the same frames are not independent."""
        return self.source, tuple(self.frames)


class Recording(NamedTuple):
    """text: as `open_dataset` takes it. number: in its set, which seeds the starts."""

    set: str
    text: str
    number: int


def rigs(name: str) -> list[Recording]:
    """Seeds that no study uses."""
    scenes = ("street", "park", "street", "trees", "car_park")
    return [
        Recording(name, f"synthetic:rig={rig},scene={scenes[k % 5]},seed={7000 + k},frames=4,stride=13", k)
        for k, rig in enumerate(PAIRS)
    ]


def drives(name: str) -> list[Recording]:
    return [
        Recording(name, f"synthetic:rig={rig},seed={7100 + k},frames={ONLINE_FRAMES},stride=2,width=480", k)
        for k, rig in enumerate(ONLINE_RIGS)
    ]


def kitti(name: str) -> list[Recording]:
    root = os.environ.get("KITTI_ROOT", "")
    return [Recording(name, str(Path(root) / one), k) for k, one in enumerate((DRIVE, ODOMETRY))] if root else []


def vehicles(name: str) -> list[Recording]:
    """Every folder in $VEHICLES_ROOT."""
    root = os.environ.get("VEHICLES_ROOT", "")
    folders = sorted(one for one in Path(root).iterdir() if one.is_dir()) if root else []
    return [Recording(name, str(one), k) for k, one in enumerate(folders)]


def estimates(recording: Recording, frames: Sequence[Frame], number: int, before: Recording | None) -> Iterator[PairedTrial]:
    """Sets of frames and single ones, which share none."""
    is_synthetic = recording.text.startswith("synthetic")
    size = 3 if is_synthetic else SET
    one_camera = all(frame.camera == frames[0].camera for frame in frames)
    sets = max(1, len(frames) // (2 * size)) if len(frames) >= size and one_camera else 0
    together = spread(sets * size, len(frames)) if sets else []
    alone = [k for k in range(len(frames)) if k not in together]
    chosen = [together[k::sets] for k in range(sets)] + [[alone[k]] for k in spread(min(MOST_SINGLE, len(alone)), len(alone))]
    for positions in chosen:
        yield one_estimate(recording, frames, positions, number, SEVERAL if len(positions) > 1 else SINGLE)


def decoys(recording: Recording, frames: Sequence[Frame], number: int, before: Recording | None) -> Iterator[PairedTrial]:
    """Images with scans of the drive before: no extrinsic is right."""
    if before is not None:
        trial = one_estimate(recording, frames, [0, 1], number, SINGLE)
        yield replace(trial, scans_of=file_of(before), bound=None)


def one_estimate(
    recording: Recording, frames: Sequence[Frame], positions: list[int], number: int, box: tuple[float, float]
) -> PairedTrial:
    own = [frames[k] for k in positions]
    truth = own[0].reference
    assert truth is not None
    rng = np.random.default_rng([number, recording.number, *positions])
    start = se3.perturb(truth, rng.uniform(-box[0], box[0], 3), rng.uniform(-box[1], box[1], 3))
    exact = EXACT_SENSORS if recording.text.startswith("synthetic") else {}
    config = {**CLASSES_OFF, **exact}
    about = recording.set, file_of(recording), positions, start.tolist(), truth.tolist(), config, box
    return PairedTrial(*about, bound=bound_of(own, truth, config))


def bound_of(frames: Sequence[Frame], truth: Matrix, config: dict[str, Any]) -> tuple[float, float] | None:
    """See PairedTrial. None for lenses that are unrolled onto a sphere."""
    full = update(Config(), config)
    extract = FeatureExtractor(frames[0].camera, full)
    if extract.camera.is_sphere:
        return None
    C = bound([extract(frame) for frame in frames], frames, truth, full)
    return float(np.sqrt(np.trace(C[:3, :3]))), float(np.sqrt(np.trace(C[3:, 3:])))


def laps(recording: Recording, frames: Sequence[Frame], number: int, before: Recording | None) -> Iterator[PairedTrial]:
    """A drive from beside the truth; every other one ends with a displaced LiDAR."""
    truth = frames[0].reference
    assert truth is not None
    rng = np.random.default_rng([number, recording.number, 1])
    start = se3.perturb(truth, rng.uniform(-BESIDE_DEG, BESIDE_DEG, 3), rng.uniform(-BESIDE_M, BESIDE_M, 3))
    turn, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    is_turned = (number + recording.number) % 2
    knock = se3.perturb(np.eye(4), KNOCK_DEG * is_turned * turn, KNOCK_M * (1 - is_turned) * shift)
    config = {**CLASSES_OFF, "search": {"rotation_deg": 0.0, "translation_m": 0.0}}
    yield PairedTrial(
        *(recording.set, file_of(recording), list(range(len(frames))), start.tolist(), truth.tolist(), config),
        seed=number,
        length=KNOCK_AT + AFTER,
        knock_at=KNOCK_AT,
        knock=knock.tolist(),
    )


@dataclass(frozen=True)
class TrialSet:
    """recordings: of a set by its name; none where their data are missing. make: the trials of a recording with a number, beside
    the recording before it. exact: whether the truth is known well enough to compare covariances with errors."""

    about: str
    recordings: Callable[[str], list[Recording]]
    make: Callable[[Recording, Sequence[Frame], int, Recording | None], Iterator[PairedTrial]]
    exact: bool = True
    nothing_right: bool = False


SETS = {
    "rigs": TrialSet("every synthetic rig, sets of 3 frames and single ones", rigs, estimates),
    "decoys": TrialSet("their images with scans of another drive", rigs, decoys, nothing_right=True),
    "online": TrialSet(
        "synthetic drives of 38 s by the recalibrator; the LiDAR is displaced after 30 s", drives, laps, exact=False
    ),
    "kitti": TrialSet("KITTI drive 0005 and odometry 00, sets of 5 frames and single ones", kitti, estimates, exact=False),
    "vehicles": TrialSet("recordings of other vehicles, likewise", vehicles, estimates, exact=False),
}


def spent_sets(table: Path = CONSTANTS) -> dict[str, list[str]]:
    """Sets by which constants were chosen: name -> those constants."""
    spent: dict[str, list[str]] = {}
    with table.open(newline="") as file:
        for row in csv.DictReader(file):
            for name in row["sets"].split():
                spent.setdefault(name, []).append(row["constant"])
    return spent


def file_of(recording: Recording) -> str:
    """Name of its frames in the store; sets may share them."""
    return "".join(c if c.isalnum() else "_" for c in recording.text)[-100:] + ".pickle"


def prepared(text: str, uses: Sequence[tuple[Recording, Recording | None]], numbers: int, store: Path) -> list[PairedTrial]:
    """The trials of the sets that use the frames of a text, each with the recording before it there; the frames are written to
    the store for both sides."""
    frames = frames_of(text)
    (store / file_of(uses[0][0])).write_bytes(pickle.dumps([values_of(frame) for frame in frames]))
    return [t for own, before in uses for n in range(numbers) for t in SETS[own.set].make(own, frames, n, before)]


def values_of(frame: Frame) -> dict[str, Any]:
    """A frame as plain values and arrays, which any version can read."""
    flat = {f.name: getattr(frame, f.name) for f in fields(frame)}
    return flat | {name: {f.name: getattr(flat[name], f.name) for f in fields(flat[name])} for name in ("cloud", "camera")}
