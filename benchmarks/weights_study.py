"""What sets of weights for the image network bring, on the same frames, starts and seeds.

    python -m benchmarks.weights_study --kitti FOLDER --vehicles FOLDER ... --rigs 8
        [--weights none builtin FILE ...] [--starts 3] [--guesses 4] [--csv FILE] [--markdown FILE]

--weights: none = points by shape, no network; builtin = the package's; or ONNX files. Every set is compared with those before it.
--kitti: raw drive 0005 and odometry 00. --vehicles: sources whose reference is soft. --rigs: so many synthetic rigs (of 10),
with seeds that nothing else renders. Rows that are in --csv already are not measured again; what does not depend on weights is
measured once.

single   every frame alone from --starts starts, uniform within 5 deg and 0.3 m per axis, with a search of that size. Edges come
         first, as in the product; where they leave doubt, the estimate is made again with classes.
guess    first guesses from 1, 3 and 5 frames: the LiDAR turned by any yaw within 45 deg and moved by up to 1 m per axis, nothing
         of it known; --guesses of each KITTI drive, one of every other source.

Right is within 0.5 deg and 10 cm of the reference, with a soft one within 0.9 deg and 19 cm. Differences are paired: intervals
(95 %) by a bootstrap over frames or sets, p by McNemar's exact test.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from itertools import combinations, islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest
from tqdm import tqdm

from benchmarks.network_study import DEG, SHIFT_M, YAW_DEG, M, interval, moved
from benchmarks.records import append_records, read_records
from benchmarks.registration_study import DRIVE, ODOMETRY
from benchmarks.vehicle_study import EXACT, EXACT_SENSORS, SCENES, frames_of
from calib_ros import se3
from calib_ros.config import Config, update
from calib_ros.config.semantics import BUILTIN, GEOMETRIC
from calib_ros.frame import Frame
from calib_ros.registration.acceptance.significance import leaves_doubt
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.frames import with_classes
from calib_ros.registration.progress import Progress
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import Result
from calib_ros_semantics.models.segmentation import Segmentation
from calib_ros_semantics.models.weight_sets import file_of, weights_of

Matrix = NDArray[np.float64]
EDGES, NONE = "edges", "none"
SINGLE, GUESS = "single", "guess"
SOFT = (0.9, 19.0)  # deg, cm
COUNTS = (1, 3, 5)  # frames of a first guess
FIRST_SEED = 77_001  # of the rigs' drives; no other study and no training renders drives from here on
RIG_FRAMES = 5
# Of every kind of scanner and camera one; those whose single frames are nearly all refused, as with 16 rings, tell little.
RIGS = (
    "hdl64e_kitti",
    "vlp32c_roof",
    "os1_64_robot",
    "hdl32e_front",
    "pandar64_roof",
    "os1_128_windshield",
    "vls128_roof",
    "hdl64e_waymo",
    "mid360_90",
    "pandar40p_roof",
)
SHORT = 12  # digits of a SHA-256 that name a set of weights in the CSV
ACCEPTED_RIGHT, ACCEPTED_WRONG = "accepted right", "accepted wrong"


@dataclass(frozen=True)
class Place:
    """A source. group: of the tables. soft: whether its reference is."""

    source: str
    group: str
    soft: bool = False
    guesses: int = 1

    @property
    def limits(self) -> tuple[float, float]:
        """Deg and cm within which an estimate is right."""
        return SOFT if self.soft else EXACT


@dataclass(frozen=True)
class Trial:
    """One start from some frames, by their positions in the source."""

    part: str
    frames: tuple[int, ...]
    number: int


@dataclass(frozen=True)
class Row:
    """The end of a trial with a set of weights: EDGES, NONE or the first digits of its SHA-256. deg, cm: error of the estimate,
    or of the optimum that was refused. doubt: whether the edges alone left doubt."""

    weights: str
    group: str
    source: str
    part: str
    frames: str
    trial: int
    verdict: str
    refusal: str
    deg: float
    cm: float
    z_score: float
    doubt: bool
    cpu_s: float

    @property
    def key(self) -> tuple[str, str, str, str, int]:
        """What makes it one of its kind."""
        return self.weights, self.source, self.part, self.frames, self.trial

    @property
    def unit(self) -> str:
        """What trials share that are drawn together by the bootstrap."""
        return f"{self.source} {self.frames}"


class Weights:
    """A set of weights, or none. label: of the tables. key: of the CSV."""

    def __init__(self, given: str) -> None:
        self.label, self.key = given, given
        semantics: dict[str, object] = {"use": "in_doubt", "image_classes": "", "cloud_classes": GEOMETRIC}
        if given == EDGES:
            semantics = {"segmentation": "none"}
        elif given != NONE:
            file = file_of(given)
            own = weights_of(file)
            if own is None:
                raise FileNotFoundError(f"--weights {given}: there is no such file")
            self.label, self.key = file.stem if given != BUILTIN else given, own.sha256[:SHORT]
            semantics["image_classes"] = str(file)
        self.config = update(Config(), {"semantics": semantics})
        self.models = Segmentation(self.config.semantics)

    def calibrator(self, place: Place, frame: Frame) -> Calibrator:
        """For the camera of a frame."""
        synthetic = place.source.startswith("synthetic")
        return Calibrator(frame.camera, update(self.config, EXACT_SENSORS) if synthetic else self.config, self.models)


class Scene:
    """The frames of a place, and their features, made once: without classes, and all of them with the classes of one set."""

    def __init__(self, place: Place) -> None:
        self.place, self.frames = place, frames_of(place.source)
        self.extract = Weights(EDGES).calibrator(place, self.frames[0]).extract
        self._plain: dict[int, FrameFeatures] = {}
        self._seen: tuple[str, dict[int, FrameFeatures]] = ("", {})

    @cached_property
    def truth(self) -> Matrix:
        """The reference."""
        reference = self.frames[0].reference
        assert reference is not None
        return reference

    def plain(self, k: int) -> FrameFeatures:
        """Of a frame, without classes."""
        if k not in self._plain:
            self._plain[k] = self.extract(self.frames[k])
        return self._plain[k]

    def seen(self, k: int, weights: Weights, calibrator: Calibrator) -> FrameFeatures:
        """Of a frame, with classes of all points and pixels."""
        if self._seen[0] != weights.key:
            self._seen = weights.key, {}
        made = self._seen[1]
        if k not in made:
            made[k] = calibrator.extract(self.frames[k], weights.models(self.frames[k]), self.plain(k))
        return made[k]


def places_of(kitti: Path | None, vehicles: Sequence[str], rigs: int, guesses: int) -> Iterator[Place]:
    """All sources."""
    if kitti:
        yield from (Place(str(kitti / drive), "KITTI", guesses=guesses) for drive in (DRIVE, ODOMETRY))
    yield from (Place(source, "other vehicles", soft=True) for source in vehicles)
    for k, rig in enumerate(islice(RIGS, rigs)):
        scene = SCENES[k % len(SCENES)]
        yield Place(f"synthetic:rig={rig},scene={scene},seed={FIRST_SEED + k},frames={RIG_FRAMES}", "synthetic rigs")


def trials_of(place: Place, frames: int, starts: int) -> Iterator[Trial]:
    """All trials of a source with so many frames."""
    yield from (Trial(SINGLE, (k,), start) for k in range(frames) for start in range(starts))
    for count in COUNTS:
        for trial in range(place.guesses if frames >= count else 0):
            chosen = np.random.default_rng([count, trial]).choice(frames, count, replace=False)
            yield Trial(GUESS, tuple(sorted(int(k) for k in chosen)), trial)


def measured(scene: Scene, trial: Trial, sets: Sequence[Weights], done: dict[tuple[str, str, str, str, int], Row]) -> list[Row]:
    """Rows of a trial that are not done yet: of the edges, where it begins with them, and of the sets."""

    def known(key: str) -> Row | None:
        return done.get((key, scene.place.source, trial.part, "+".join(map(str, trial.frames)), trial.number))

    out, edges = [], known(EDGES)
    if trial.part == SINGLE and edges is None:
        edges = row(scene, trial, EDGES, partial(_from_start, scene, trial, Weights(EDGES), alone=True))
        out.append(edges)
    for weights in sets:
        if known(weights.key) is not None:
            continue
        if edges is not None and not edges.doubt:
            out.append(Row(**{**asdict(edges), "weights": weights.key}))
        elif trial.part == SINGLE:
            out.append(row(scene, trial, weights.key, partial(_from_start, scene, trial, weights), doubt=True))
        else:
            out.append(row(scene, trial, weights.key, partial(_from_nothing, scene, trial, weights)))
    return out


def row(scene: Scene, trial: Trial, key: str, run: Callable[[], tuple[Result, Matrix]], doubt: bool | None = None) -> Row:
    """Run a trial and judge its end."""
    started = time.process_time()
    result, truth = run()
    cpu = time.process_time() - started
    T = result.T_camera_lidar if result.optimum is None else result.optimum
    deg, cm = se3.rotation_error_deg(truth, T), 100 * se3.translation_error_m(truth, T)
    right = deg < scene.place.limits[0] and cm < scene.place.limits[1]
    return Row(
        key,
        scene.place.group,
        scene.place.source,
        trial.part,
        "+".join(map(str, trial.frames)),
        trial.number,
        f"{'accepted' if result.converged else 'refused'} {'right' if right else 'wrong'}",
        result.refusal.value if result.refusal else "",
        deg,
        cm,
        result.evidence.z_score if result.evidence else float("nan"),
        leaves_doubt(result) if doubt is None else doubt,
        cpu,
    )


def _from_start(scene: Scene, trial: Trial, weights: Weights, alone: bool = False) -> tuple[Result, Matrix]:
    """The estimate of a single frame from a start near the reference, as the product makes it. alone: by edges."""
    (k,), box = trial.frames, SearchBox(DEG, M)
    rng = np.random.default_rng([k, trial.number])
    T = se3.perturb(scene.truth, rng.uniform(-DEG, DEG, 3), rng.uniform(-M, M, 3))
    calibrator, used = weights.calibrator(scene.place, scene.frames[k]), [(scene.frames[k], scene.plain(k))]
    plain: list[FrameFeatures] = [used[0][1]]
    if alone:
        return calibrator.estimate(plain, T, box), scene.truth
    classified = partial(with_classes, used, calibrator.extract, weights.models, T, box, Progress(None, ""))
    return calibrator.estimate_in_doubt(plain, classified, T, box), scene.truth


def _from_nothing(scene: Scene, trial: Trial, weights: Weights) -> tuple[Result, Matrix]:
    """The first guess from some frames, of a LiDAR that is mounted otherwise."""
    rng = np.random.default_rng([len(trial.frames), trial.number, 1])
    yaw, shift = np.deg2rad(rng.uniform(-YAW_DEG, YAW_DEG)), rng.uniform(-SHIFT_M, SHIFT_M, 3)
    A = se3.exp(np.array([0, 0, yaw, 0, 0, 0]))
    A[:3, 3] = shift
    calibrator = weights.calibrator(scene.place, scene.frames[0])
    seen = [scene.seen(k, weights, calibrator) for k in trial.frames]
    own = [moved(f, A) for f in seen]
    return calibrator.guess(own), scene.truth @ se3.inverse(A)


def tables(rows: Sequence[Row], sets: Sequence[Weights]) -> str:
    """All of it in Markdown: counts by part and group, cases in doubt, and paired differences."""
    label = {EDGES: "edges alone"} | {weights.key: weights.label for weights in sets}
    rows = [r for r in rows if r.weights in label]
    lines = ["| trials | source | weights | trials | accepted right | accepted wrong | refused | CPU s |", "|---" * 8 + "|"]
    for part in _parts(rows):
        for group in [*dict.fromkeys(r.group for r in rows), ""]:
            for key in label:
                own = [r for r in rows if _part(r) == part and r.weights == key and group in (r.group, "")]
                if own:
                    good, bad = (sum(r.verdict == v for r in own) for v in (ACCEPTED_RIGHT, ACCEPTED_WRONG))
                    lines.append(
                        f"| {part} | {group or 'all'} | {label[key]} | {len(own)} | {good} | {bad} | {len(own) - good - bad} | "
                        f"{np.mean([r.cpu_s for r in own]):.1f} |"
                    )
    return "\n".join([*lines, "", *_of_doubt(rows, label), "", *_differences(rows, label)])


def _of_doubt(rows: Sequence[Row], label: dict[str, str]) -> list[str]:
    """What a set made of single frames whose edges left doubt."""
    lines = ["| in doubt | weights | trials | right now | wrong now | right no longer | wrong no longer |", "|---" * 7 + "|"]
    edges = {r.key[1:]: r.verdict for r in rows if r.weights == EDGES and r.doubt}
    for group in [*dict.fromkeys(r.group for r in rows), ""]:
        for key in list(label)[1:]:
            own = [r for r in rows if r.weights == key and group in (r.group, "")]
            pairs = [(edges[r.key[1:]], r.verdict) for r in own if r.key[1:] in edges]
            counts = [
                sum((before == v) == lost and (after == v) != lost for before, after in pairs)
                for lost in (False, True)
                for v in (ACCEPTED_RIGHT, ACCEPTED_WRONG)
            ]
            lines.append(f"| {group or 'all'} | {label[key]} | {len(pairs)} | " + " | ".join(map(str, counts)) + " |")
    return lines


def _differences(rows: Sequence[Row], label: dict[str, str]) -> list[str]:
    """Shares of accepted right and accepted wrong of each set less those of each before it, over all sources."""
    lines = ["| trials | weights | against | accepted right, % | p | accepted wrong, % | p |", "|---" * 7 + "|"]
    for part in _parts(rows):
        for before, after in combinations(label, 2):
            base = {r.key[1:]: r for r in rows if r.weights == before and _part(r) == part}
            own = [r for r in rows if r.weights == after and _part(r) == part and r.key[1:] in base]
            if not own:
                continue
            cells = []
            for verdict in (ACCEPTED_RIGHT, ACCEPTED_WRONG):
                more = np.array([float(r.verdict == verdict) - float(base[r.key[1:]].verdict == verdict) for r in own])
                cells += [interval(100 * more, [r.unit for r in own], np.mean, "+.1f"), f"{mcnemar(more):.2g}"]
            lines.append(f"| {part} | {label[after]} | {label[before]} | " + " | ".join(cells) + " |")
    return lines


def mcnemar(differences: Matrix) -> float:
    """p of as uneven a split of the trials that differ (n,): 1, -1, or 0 where they do not."""
    gained, lost = int((differences > 0).sum()), int((differences < 0).sum())
    return float(binomtest(gained, gained + lost).pvalue) if gained + lost else 1.0


def _part(r: Row) -> str:
    count = len(r.frames.split("+"))
    return "single" if r.part == SINGLE else f"guess, {count} frame{'s' * (count > 1)}"


def _parts(rows: Sequence[Row]) -> list[str]:
    return sorted({_part(r) for r in rows}, key=lambda part: (not part.startswith(SINGLE), part))


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", nargs="+", default=[NONE, BUILTIN], metavar="SET")
    parser.add_argument("--kitti", type=Path, metavar="FOLDER")
    parser.add_argument("--vehicles", nargs="*", default=[], metavar="SOURCE")
    parser.add_argument("--rigs", type=int, default=0, choices=range(len(RIGS) + 1), metavar="N")
    parser.add_argument("--starts", type=int, default=3, help="of every single frame")
    parser.add_argument("--guesses", type=int, default=4, help="of each KITTI drive and number of frames")
    parser.add_argument("--csv", type=Path, help="all trials; read first, and added to")
    parser.add_argument("--markdown", type=Path, help="the tables")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    places = list(places_of(args.kitti, args.vehicles, args.rigs, args.guesses))
    if not places:
        parser.error("give --kitti, --vehicles or --rigs")
    sets = [Weights(given) for given in args.weights]
    rows = read_records(args.csv, Row)
    done = {r.key: r for r in rows}
    for place in tqdm(places, "sources"):
        scene = Scene(place)
        for trial in tqdm(list(trials_of(place, len(scene.frames), args.starts)), Path(place.source).name, leave=False):
            found = measured(scene, trial, sets, done)
            done |= {r.key: r for r in found}
            append_records(args.csv, found)
    text = tables(list(done.values()), sets)
    print(text)
    if args.markdown:
        args.markdown.write_text(text + "\n")


if __name__ == "__main__":
    main()
