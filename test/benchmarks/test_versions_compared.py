"""A comparison of two versions: what it counts, what it calls worse, and that each side is the version that it should be."""

from __future__ import annotations

import csv
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from paths import ROOT

from benchmarks import compare
from benchmarks.compare import IDENTICAL, Outcome, both_sides, imported_from, lines_of, outcome, side, verdict_of
from benchmarks.compare_sets import SETS, PairedTrial, Recording, estimates, laps, prepared, spent_sets
from calib_ros import se3
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros_evaluation.compare import BETTER, SAME, WORSE
from calib_ros_synthetic.drive import SyntheticDrive

TRUTH = se3.exp([0.1, -1.2, 1.0, 0.2, 0.3, 0.4])
SMALL = "synthetic:seed=3,frames=4,rings=16,width=160,height=96,stride=10"
SAME_IN_BOTH = Outcome(1.0, 0.0, 1.0, 1.0, 2.0, 3.0)


def trial(set_: str = "rigs", number: int = 0, **changed: Any) -> PairedTrial:
    own = PairedTrial(set_, f"drive {number}", [0], TRUTH.tolist(), TRUTH.tolist(), {}, bound=(0.001, 0.01))
    return replace(own, **changed)


def answer(twist: list[float], status: str = "converged", sigma: float = 0.002) -> dict[str, Any]:
    C = np.diag([sigma] * 3 + [10 * sigma] * 3) ** 2
    return {"T": (se3.exp(twist) @ TRUTH).tolist(), "covariance": C.tolist(), "status": status, "cpu_s": 2.0}


def test_an_estimate_is_counted_in_bounds_and_standard_deviations() -> None:
    found = outcome(trial(), answer([0.002, 0, 0, 0, 0, 0]))
    assert (found.success, found.accepted_wrong, found.cpu_s) == (1.0, 0.0, 2.0)
    assert found.rotation == pytest.approx(2.0)
    assert found.nees_off == pytest.approx(5.348, abs=0.001)  # of a square of 1, from the median of chi squared
    assert np.isnan(outcome(trial("kitti"), answer([0.002, 0, 0, 0, 0, 0])).nees_off)  # its truth is an estimate, too


@pytest.mark.parametrize(
    ("own", "answered", "success", "wrong"),
    [
        (trial(), answer([0.02, 0, 0, 0, 0, 0]), 0.0, 1.0),
        (trial(), answer([0.002, 0, 0, 0, 0, 0], "refused"), 0.0, 0.0),
        (trial(), {"error": "no such lens"}, 0.0, 0.0),
        (trial("decoys"), answer([0.0] * 6), None, 1.0),
        (trial("decoys"), {"error": "no such lens"}, None, 0.0),
    ],
)
def test_right_is_accepted_and_near(own: PairedTrial, answered: dict[str, Any], success: float | None, wrong: float) -> None:
    found = outcome(own, answered)
    assert found.accepted_wrong == wrong
    assert np.isnan(found.success) if success is None else found.success == success


def test_a_drive_succeeds_where_the_displacement_alone_is_told() -> None:
    knock = se3.exp([0, 0, 0, 0, 0, 0.15])
    own = trial("online", length=10, knock_at=5, knock=knock.tolist())
    told = answer([0.0] * 6, "suspect") | {"settled": True, "alarm": False, "noticed_s": 1.0}
    assert outcome(own, told).success == 1.0
    assert not any(outcome(own, told | change).success for change in ({"noticed_s": 9.0}, {"noticed_s": None}, {"alarm": True}))
    unseen = outcome(own, told | {"status": "converged", "noticed_s": None})
    assert (unseen.success, unseen.accepted_wrong) == (0.0, 1.0)  # it still says where the LiDAR was


def judged(b: Outcome, changed: int = 40) -> dict[str, str]:
    """Verdict by column, of 40 trials, in as many of which B is b."""
    trials = [trial(number=k) for k in range(40)]
    lines = lines_of(trials, [SAME_IN_BOTH] * 40, [b] * changed + [SAME_IN_BOTH] * (40 - changed))
    return {line.measure.column: line.verdict for line in lines}


def test_worse_and_better_are_told_apart_from_chance() -> None:
    same = SAME_IN_BOTH
    assert set(judged(same).values()) == {IDENTICAL}
    assert judged(same._replace(success=0.0), changed=12)["success"] == WORSE
    assert judged(same._replace(success=0.0), changed=3)["success"] == SAME  # p = 2 / 2^3
    assert judged(same._replace(accepted_wrong=1.0), changed=12)["accepted_wrong"] == WORSE
    assert judged(same._replace(rotation=0.9, nees_off=2.5)) == {
        **dict.fromkeys(("success", "accepted_wrong", "translation", "cpu_s"), IDENTICAL),
        **{"rotation": BETTER, "nees_off": WORSE},
    }


def test_a_cpu_time_counts_from_what_runs_of_one_version_differ_by() -> None:
    same = SAME_IN_BOTH
    assert [judged(same._replace(cpu_s=3 * factor))["cpu_s"] for factor in (1.04, 1.1, 0.8)] == [SAME, WORSE, BETTER]


def test_trials_of_the_same_frames_are_one_piece_of_evidence() -> None:
    a, b = Outcome(1.0, cpu_s=1.0), Outcome(0.0, cpu_s=1.0)
    apart = lines_of([trial(number=k) for k in range(12)], [a] * 12, [b] * 12)
    together = lines_of([trial(number=k % 3, seed=k) for k in range(12)], [a] * 12, [b] * 12)
    assert [lines[0].verdict for lines in (apart, together)] == [WORSE, SAME]
    assert together[0].p == pytest.approx(0.25)
    assert verdict_of(apart) == "B against A is worse: success of rigs."
    assert verdict_of(together) == "No difference between A and B is shown."


def test_sets_that_chose_a_constant_are_known_as_spent() -> None:
    spent = spent_sets()
    assert spent.keys() <= SETS.keys()
    assert "rigs" not in spent
    assert {"CONSISTENT_Z", "RECOVERING"} <= set(spent["kitti"])
    with (ROOT / "docs/figures/constants.csv").open(newline="") as file:
        assert all(row["sets"] for row in csv.DictReader(file) if "KITTI" in row["what it is, and where it comes from"])


def test_sets_of_a_recording_share_no_frames_and_starts_are_drawn_by_number() -> None:
    drive = SyntheticDrive(3, 4, rings=16, width=160, height=96, stride=10)
    frames, recording = [drive[k] for k in range(4)], Recording("rigs", SMALL, 5)
    first, second = (list(estimates(recording, frames, number, None)) for number in (0, 1))
    used = [k for one in first for k in one.frames]
    assert sorted(used) == sorted(set(used)) == [0, 1, 2, 3]
    assert [one.frames for one in second] == [one.frames for one in first]
    starts = [np.array(one.start) for one in (*first, *second)]
    assert all(se3.rotation_error_deg(frames[0].reference, T) > 0.1 for T in starts)
    assert len({T.tobytes() for T in starts}) == 4
    turned, shifted = (next(laps(Recording("online", SMALL, k), frames, 0, None)) for k in (1, 0))
    knocks = [se3.log(np.array(one.knock)) for one in (turned, shifted)]
    sizes = [(np.rad2deg(np.linalg.norm(x[:3])), np.linalg.norm(x[3:])) for x in knocks]
    np.testing.assert_allclose(sizes, [(1.5, 0.0), (0.0, 0.15)], atol=1e-9)


def test_an_unknown_commit_is_refused() -> None:
    with pytest.raises(BadInputError, match="no commit"):
        side("no-such-branch")


def test_each_side_runs_its_own_tree(tmp_path: Path) -> None:
    """B is a copy of this tree whose estimates are turned by 2 deg."""
    tree = tmp_path / "changed"
    for path in (*ROOT.glob("calib_ros*/"), *(ROOT / name for name in ("setup.py", "setup.cfg", "README.md", "resource"))):
        if path.is_dir() and not path.name.endswith(".egg-info"):
            shutil.copytree(path, tree / path.name, ignore=shutil.ignore_patterns("__pycache__"))
        elif path.is_file():
            shutil.copy(path, tree / path.name)
    with pytest.raises(CalibrationError, match="is not what would be compared"):
        imported_from(tree)  # no entry points of its own yet
    command = [sys.executable, "setup.py", "-q", "egg_info"]
    subprocess.run(command, cwd=tree, check=True, capture_output=True, env=compare.environment(tree))
    imported_from(tree)
    with (tree / "calib_ros/registration/calibrator.py").open("a") as file:
        file.write(
            "\n_own = Calibrator.calibrate\n"
            "def _turned(self, *given):\n"
            "    found = _own(self, *given)\n"
            "    return replace(found, T_camera_lidar=se3.exp([0.035, 0, 0, 0, 0, 0]) @ found.T_camera_lidar)\n"
            "Calibrator.calibrate = _turned\n"
        )
    recording = Recording("rigs", SMALL.replace("rings=16,width=160,height=96", "rings=32,width=320,height=128"), 0)
    trials = prepared(recording.text, [(recording, None)], 1, tmp_path)[:1]
    a, b = both_sides([ROOT, tree], trials, tmp_path, 1)
    np.testing.assert_allclose(np.array(b[0]["T"]), se3.exp([0.035, 0, 0, 0, 0, 0]) @ np.array(a[0]["T"]), atol=1e-12)
    assert a[0]["status"] == b[0]["status"] == "converged"
    assert [outcome(trials[0], own[0]).success for own in (a, b)] == [1.0, 0.0]
    assert outcome(trials[0], b[0]).accepted_wrong == 1.0
