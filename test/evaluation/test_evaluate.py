"""`calib-ros evaluate` on the command line, and the results of its experiments."""

from __future__ import annotations

import csv
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.cli import main
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame, PointCloud, SemanticClass
from calib_ros.result import Result
from calib_ros_evaluation.commands import sources_in
from calib_ros_evaluation.experiments.plan import EXPERIMENTS, FULL, QUICK, Plan, groups, jobs
from calib_ros_evaluation.experiments.setup import (
    Setup,
    SourceGoneError,
    SourceSpec,
    SourceSummary,
    WorkerCache,
    code_fingerprint,
    inspect_sources,
    labels,
    shared_out,
    spread,
    worker_cache,
)
from calib_ros_evaluation.experiments.trial import classes_of_points, run_jobs
from calib_ros_evaluation.methods.own import NAMES
from calib_ros_evaluation.protocols.definitions import NAMES as PROTOCOL_NAMES
from calib_ros_evaluation.protocols.trials import COLUMNS as PERTURBED
from calib_ros_evaluation.report.page import sections
from calib_ros_evaluation.results import TWIST_AXES, collect_results, job
from calib_ros_thesis.features import importance

pytestmark = pytest.mark.usefixtures("rendered_once")
DRIVE = "synthetic:seed=5,frames=3,rings=32,width=400,height=150"
TINY = replace(
    QUICK, curve_frames=1, curve_samples=5, single_frames=1, size_frames=1, sizes=((0.5, 0.05),), counts=(2,), cost_frames=1
)
TIMES = {"cpu_s", "features_cpu_s"}


def setup(source: str = DRIVE) -> Setup:
    return Setup((SourceSpec("drive", source),), Config())


def rows(folder: Path) -> list[dict[str, str]]:
    """trials.csv without what differs from run to run."""
    with (folder / "trials.csv").open() as file:
        return [{name: value for name, value in row.items() if name not in TIMES} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An evaluation by two workers, by the command line."""
    out = tmp_path_factory.mktemp("evaluation") / "out"
    command = ["evaluate", DRIVE, "--out", str(out), "--quick", "--methods", "levinson,ours", "--workers", "2"]
    assert main.main(command) == 0
    return out


def test_the_folder_holds_report_and_tables(done: Path) -> None:
    page = (done / "report.html").read_text()
    assert "--methods levinson,ours" in page
    assert 'src="data:image/' in page
    assert "levinson" in (done / "report.md").read_text()
    found = rows(done)
    assert {row["experiment"] for row in found} == {"single", "starts", "frames"}
    assert {row["method"] for row in found} == {"levinson", "ours"}


def test_row_holds_start_and_end_of_a_trial(done: Path) -> None:
    row = next(r for r in rows(done) if r["experiment"] == "single" and r["method"] == "ours")
    start, end = (np.array([float(row[f"{name}_{axis}"]) for axis in TWIST_AXES]) for name in ("start", "end"))
    reference = open_dataset(DRIVE)[int(row["frames"])].reference
    T = se3.exp([*np.deg2rad(end[:3]), *end[3:]]) @ reference
    assert se3.rotation_error_deg(reference, T) == pytest.approx(float(row["rotation_deg"]), abs=1e-6)
    assert se3.translation_error_m(reference, T) == pytest.approx(float(row["translation_m"]), abs=1e-9)
    assert int(row["success"]) == (float(row["rotation_deg"]) < 0.5 and float(row["translation_m"]) < 0.1)
    assert np.all(np.abs(start) <= [2, 2, 2, 0.2, 0.2, 0.2])
    assert np.abs(start).max() > 0


def test_all_methods_start_at_the_same_place(done: Path) -> None:
    by_trial: dict[tuple[str, ...], set[str]] = {}
    for row in rows(done):
        key = (row["experiment"], row["scene"], row["frames"], row["start_deg"])
        by_trial.setdefault(key, set()).add(" ".join(row[f"start_{a}"] for a in ("rx_deg", "ry_deg", "tx_m", "tz_m")))
    assert by_trial
    assert all(len(starts) == 1 for starts in by_trial.values())


def test_resumed_evaluation_repeats_nothing(done: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (done / "results.jsonl").read_bytes()
    table = (done / "trials.csv").read_bytes()
    command = ["evaluate", DRIVE, "--out", str(done), "--quick", "--methods", "levinson,ours"]
    assert main.main(command) == 0
    assert (done / "results.jsonl").read_bytes() == before
    assert (done / "trials.csv").read_bytes() == table
    assert "report.html" in capsys.readouterr().out


def test_compare_of_a_table_with_itself(done: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = str(done / "trials.csv")
    assert main.main(["evaluate", "--compare", table, table]) == 0
    verdicts = capsys.readouterr().out.split("\n\n")[1]
    assert "no difference" in verdicts
    assert not any(word in verdicts for word in ("better", "worse"))


def test_every_experiment_of_every_method_answers() -> None:
    """The smallest plan with all of them: nothing fails, everything is reported."""
    planned = jobs(TINY, inspect_sources(setup(), "all"), NAMES, EXPERIMENTS)
    answers = {one.key: answer for group in groups(planned) for one, answer in zip(group, run_jobs(setup(), group), strict=True)}
    results = collect_results(planned, answers, dict.fromkeys(NAMES, ""))
    assert results.failures == []
    assert set(results.trials.method) == set(NAMES)
    assert set(results.trials.status) <= {"done", "refused"}, results.trials.reason
    assert {c.method for c in results.curves} == set(NAMES)
    assert all(abs(c.curves.peaks[1]) < 0.5 for c in results.curves if c.method == "ours")
    assert {method for method, *_ in results.costs} == set(NAMES)
    assert all(memory_mb > 0.1 for *_, memory_mb in results.costs)
    assert {a.method for a in results.averagings} == {"thesis", "ours"}
    assert all(abs(a.shares.sum(axis=1) - 1).max() < 1e-9 and (a.weights >= 0).all() for a in results.averagings)
    (similar,) = results.similarities
    assert np.allclose(np.diag(similar.matrix), 1)
    assert np.allclose(similar.matrix, similar.matrix.T)
    assert list(similar.keyframes) == [0.7, Config().online.similarity_threshold]
    assert {"averaging", "similarity"} < {section.key for section in sections(results)}


def test_weights_by_points_in_the_picture() -> None:
    """A vehicle and a wall of as many points at 10 m: half each. The wall moved before the vehicle hides it."""
    camera = Camera(np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]), 100, 100)
    grid = np.stack(np.meshgrid(np.arange(-2, 2, 0.2), np.arange(-2, 2, 0.2), [10.0]), -1).reshape(-1, 3)
    vehicle, label = grid - [2, 0, 0], np.repeat(np.uint8([SemanticClass.VEHICLE, SemanticClass.BUILDING]), len(grid))
    for other, share in ((grid - [-2.2, 0, 0], 0.5), (0.5 * vehicle, 0.0)):
        frame = Frame(np.zeros((100, 100), np.uint8), PointCloud(np.float32([*vehicle, *other])), camera)
        assert importance(classes_of_points(frame, label, np.eye(4), Config())) == pytest.approx(share, abs=0.05)
    assert importance(classes_of_points(frame, None, np.eye(4), Config())) is None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--quick", ["at least one source"]),
        ("DRIVE --methods ours,magic", ["magic", *NAMES]),
        ("DRIVE --experiments alchemy", ["alchemy", *EXPERIMENTS]),
        ("DRIVE --start-deg 0", ["--start-deg"]),
        ("DRIVE --start-m nan", ["--start-m"]),
        ("DRIVE --repeats 0", ["--repeats"]),
        ("DRIVE --workers 0", ["--workers"]),
        ("DRIVE --seed -1", ["--seed"]),
        ("DRIVE --frames 7", ["--frames"]),
        ("DRIVE --reference nowhere.json", ["nowhere.json"]),
        ("DRIVE --trials 3", ["--trials belongs to --protocol"]),
        ("DRIVE --quick --scheduler tcp://127.0.0.1:9", ["127.0.0.1:9"]),
        ("TMP", ["no KITTI drives, ROS 2 bags or plain folders"]),
        ("TMP/none", ["does not exist"]),
        ("DRIVE --compare a b", ["--compare"]),
        ("--compare TMP/a.csv TMP/b.csv", ["a.csv"]),
        ("DRIVE --protocol nothing", ["no protocol 'nothing'", *PROTOCOL_NAMES]),
        ("DRIVE --protocol borer --frames-per-trial 1,5", ["--frames-per-trial 5", "only 3", "give --frames-per-trial 1"]),
        ("DRIVE --protocol borer --frames-per-trial 0", ["whole numbers of at least 1"]),
        ("DRIVE --protocol borer --trials 0", ["--trials 0: give 1"]),
        ("DRIVE --protocol borer --methods nid", ["leave out --methods"]),
        ("DRIVE --protocol borer --table x.csv", ["--table belongs to --protocol miscalibration"]),
        ("DRIVE --protocol miscalibration", ["--table FILE"]),
        ("DRIVE --protocol miscalibration --table TMP/none.csv", ["cannot read", "none.csv", "--table"]),
        ("DRIVE --protocol miscalibration --table TMP/table.csv", ["no frame 004170", "sequences/00"]),
        ("DRIVE --protocol miscalibration --table TMP/table.csv --trials 3", ["leave out --trials"]),
    ],
)
def test_bad_requests_get_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: str, words: list[str]) -> None:
    (tmp_path / "table.csv").write_text(f"{','.join(PERTURBED)}\npos,004170,0,0,0,0,0,0\n")
    given = arguments.replace("TMP", str(tmp_path)).replace("DRIVE", DRIVE).split()
    try:
        code = main.main(["evaluate", "--out", str(tmp_path / "out"), *given])
    except SystemExit as stopped:  # what the parser refuses
        code = stopped.code
    error = capsys.readouterr().err
    assert code == 2
    assert all(word in error for word in words), error
    assert error.strip().count("\n") == 0


def test_without_pandas_there_are_steps_but_no_tables() -> None:
    code = "import sys; sys.modules['pandas'] = None; import calib_ros_evaluation.steps.page; from calib_ros.cli import main; "
    done = subprocess.run([sys.executable, "-c", f"{code}sys.exit(main.main(['evaluate', 'x']))"], capture_output=True, text=True)
    assert done.returncode == 2
    assert "pip install pandas" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_source_without_reference(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = tmp_path / "bag"
    assert main.main(["convert", DRIVE, str(bag)]) == 0
    # The bag's own /tf_static tells the reference; a result file takes its place.
    reference = open_dataset(DRIVE).reference
    assert reference is not None
    moved = se3.exp([0.01, 0, 0, 0, 0, 0]) @ reference
    Result(moved, "converged", "").save(tmp_path / "moved.json")
    cache = WorkerCache(Setup((SourceSpec("bag", str(bag), reference=tuple(map(tuple, moved.tolist()))),), Config()))
    assert np.allclose(cache.reference("bag", 0), moved)
    command = ["evaluate", str(bag), "--quick", "--methods", "ours", "--experiments", "single", "--workers", "1"]
    assert main.main([*command, "--reference", str(tmp_path / "moved.json"), "--out", str(tmp_path / "out")]) == 0
    found = rows(tmp_path / "out")
    assert all(float(row["rotation_deg"]) > 0.3 for row in found)  # it finds the true one, 0.57 deg from the stated
    capsys.readouterr()


def test_temporarily_missing_source(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What cannot be read is no failure of a method: the run stops, and goes on when the data are back."""
    frames = Setup((SourceSpec("bag", str(tmp_path / "bag")),), Config())
    assert main.main(["convert", DRIVE, str(tmp_path / "bag")]) == 0
    summaries = inspect_sources(frames, "all")
    planned = jobs(TINY, summaries, ("ours",), ("single", "curves"))
    (tmp_path / "bag").rename(tmp_path / "elsewhere")
    with pytest.raises(SourceGoneError, match="does not exist"):
        run_jobs(frames, planned)
    (tmp_path / "elsewhere").rename(tmp_path / "bag")
    worker_cache.cache_clear()
    assert all("error" not in answer for answer in run_jobs(frames, planned))
    capsys.readouterr()


def test_other_data_under_the_same_name_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["evaluate", str(tmp_path / "bag"), "--quick", "--methods", "levinson", "--experiments", "cost"]
    command += ["--out", str(tmp_path / "out"), "--workers", "1"]
    assert main.main(["convert", DRIVE, str(tmp_path / "bag"), "--frames", "0,1"]) == 0
    assert main.main(command) == 0
    assert main.main([*command, "--frames", "0"]) == 0  # fewer of the same are no others
    (tmp_path / "bag").rename(tmp_path / "old")
    assert main.main(["convert", DRIVE, str(tmp_path / "bag"), "--frames", "1,2"]) == 0
    capsys.readouterr()
    assert main.main(command) == 2
    error = capsys.readouterr().err
    assert "bag, or its reference, is another" in error
    assert "--fresh" in error
    assert main.main([*command, "--fresh"]) == 0


def test_a_damaged_answer_is_named() -> None:
    one = job("curves", "ours", "drive", [3])
    with pytest.raises(BadInputError, match=r"curves\|ours\|drive\|3.*--fresh"):
        collect_results([one], {one.key: {}}, {"ours": "Ours"})


def test_results_of_other_code_or_configuration_are_not_reused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["evaluate", DRIVE, "--quick", "--methods", "levinson", "--experiments", "cost", "--workers", "1"]
    command += ["--out", str(tmp_path)]
    assert main.main(command) == 0
    journal = tmp_path / "results.jsonl"
    whole = journal.read_text()
    for name, own in (("code", code_fingerprint()), ("configuration", setup().fingerprint)):
        journal.write_text(whole.replace(own, "0123456789abcdef"))
        capsys.readouterr()
        assert main.main(command) == 2
        error = capsys.readouterr().err
        assert f'{name} was "0123456789abcdef"' in error
        assert "--fresh" in error
        assert error.count("\n") == 1


def test_labels_distinguish_sources() -> None:
    assert labels(["/x/bag1 (2)", "/x/bag1", "/y/bag1"]) == ["bag1 (2)", "bag1", "bag1 (3)"]
    assert labels(["/data/drive_0005_sync", "/data/sequences/00", "/other/sequences/00", "synthetic:seed=3"]) == [
        "drive_0005_sync",
        "sequences/00",
        "sequences/00 (2)",
        "synthetic:seed=3",
    ]


def test_folders_of_several_sources(tmp_path: Path) -> None:
    for name in ("b", "a"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metadata.yaml").write_text("")
    (tmp_path / "c").mkdir()
    for part in ("images", "clouds"):
        (tmp_path / "d" / part).mkdir(parents=True)
    assert sources_in(str(tmp_path)) == [str(tmp_path / "a"), str(tmp_path / "b"), str(tmp_path / "d")]
    assert sources_in(str(tmp_path / "d")) == [str(tmp_path / "d")]
    assert sources_in("synthetic:seed=3") == ["synthetic:seed=3"]
    with pytest.raises(BadInputError, match="no KITTI drives"):
        sources_in(str(tmp_path / "c"))


def test_frames_are_shared_out_evenly() -> None:
    assert spread(range(10), 3) == [0, 4, 9]
    assert spread([5, 6], 3) == [5, 6]
    several = [SourceSummary(label, tuple(range(n)), (tuple(range(n)),), ()) for label, n in (("a", 20), ("b", 2), ("c", 20))]
    chosen = shared_out(several, 12)
    assert [label for label, _ in chosen] == ["a"] * 5 + ["b"] * 2 + ["c"] * 5
    assert len(shared_out(several, 100)) == 42


def test_the_survey_keeps_calibrations_apart(kitti_root: Path) -> None:
    scenes = (
        SourceSpec("object", str(kitti_root / "object/training")),
        SourceSpec("odometry", str(kitti_root / "odometry/sequences/00")),
    )
    one, two = inspect_sources(Setup(scenes, Config()), "all")
    assert len(one.frames) == 3
    assert len(one.groups) > 1
    assert len(two.groups) == 1
    assert len(two.groups[0]) == len(two.frames)


@pytest.mark.parametrize(("plan", "n"), [(QUICK, 12), (FULL, 3), (FULL, 10), (FULL, 12)])
def test_the_plan_has_no_job_twice_and_groups_hold_all(plan: Plan, n: int) -> None:
    summaries = [SourceSummary("a", tuple(range(n)), (tuple(range(n)),), ())]
    planned = jobs(plan, summaries, NAMES, EXPERIMENTS)
    assert len({one.key for one in planned}) == len(planned)
    grouped = groups(planned)
    assert sorted(one.key for group in grouped for one in group) == sorted(one.key for one in planned)
    assert all(len({(one.method, one.frames) for one in group}) == 1 for group in grouped)
