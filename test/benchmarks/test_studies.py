"""What studies, the cost of a node and the speed of stages count, and that a study which was interrupted goes on."""

from __future__ import annotations

import argparse
import struct
import sys
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import bench
from benchmarks.node_cost import GAP_NS, STAMP, Recorded, Sample, laps, problems, row
from benchmarks.records import append_records, read_records
from benchmarks.study_registration import accuracy_table, bound
from benchmarks.study_runner import Case, End, Record, Study, Variant, run
from calib_ros import se3
from calib_ros.config import Config
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.lidar.edges import UPWARD, upward_parts
from calib_ros.lidar.range_image import range_image
from calib_ros.online.pacing import Work
from calib_ros.registration.features import FeatureExtractor
from calib_ros.result import RefusalCode, Result
from calib_ros_synthetic.drive import SyntheticDrive

RECORD = Record("KITTI", "none", 0, 0, True, 0.1, 2.0, "converged", 0.5, "a, b", nees=2.0, disagreement=0.5)


@pytest.fixture(scope="module")
def frame() -> Frame:
    return SyntheticDrive(3, frames=1, rings=16, width=160, height=96)[0]


@pytest.fixture
def args() -> argparse.Namespace:
    return argparse.Namespace(variants=None, cases=None, trials=None, config=None, workers=1)


def test_records_come_back_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "records.csv"
    records = [RECORD, replace(RECORD, variant="", deg=1e-17, said="")]
    append_records(path, records[:1])
    append_records(path, records[1:])
    assert read_records(path, Record) == records
    assert read_records(tmp_path / "none.csv", Record) == []


@pytest.mark.parametrize("cut", [1, 5, 30, 10_000])
def test_a_file_whose_writer_was_killed_is_gone_on_with(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "records.csv"
    append_records(path, [RECORD, replace(RECORD, trial=1)])
    path.write_bytes(path.read_bytes()[: -min(cut, path.stat().st_size)])
    left = [] if cut > 1000 else [RECORD]
    assert read_records(path, Record) == left
    append_records(path, [replace(RECORD, trial=2)])
    assert read_records(path, Record) == [*left, replace(RECORD, trial=2)]


def test_successes_and_refusals_are_counted() -> None:
    ends = {0: (0.1, 2.0, "converged"), 1: (0.6, 2.0, "converged"), 2: (0.1, 11.0, "refused"), 3: (0.2, 3.0, "refused")}
    records = [replace(RECORD, case=k, deg=deg, cm=cm, status=s, right=k in (0, 3)) for k, (deg, cm, s) in ends.items()]
    assert accuracy_table(records).splitlines()[2] == "| KITTI | 2 of 4 | 0.150, 0.48 | 2.5, 8.6 | 1 | 2 | 0.50 |"


def test_what_is_done_is_not_done_again_and_variants_change_frames(frame: Frame, args: argparse.Namespace) -> None:
    seen: list[tuple[int, int]] = []
    limits = 0.5, 10.0

    def cases(args: argparse.Namespace) -> Iterator[Case]:
        yield Case("street", [frame], limits=limits)

    def estimate(calibrator: object, case: Case, features: object, trial: int) -> End:
        seen.append((trial, case.frames[0].stamp - frame.stamp))
        return End.at(se3.perturb(case.truth, [0.2, 0, 0], [0, 0, 0.03]), case.truth)

    later = Variant(frame=lambda frame: replace(frame, stamp=frame.stamp + 5))
    study = Study(cases, estimate, accuracy_table, {"": Variant(), "later": later}, trials=2)
    records = list(run(study, args, []))
    assert seen == [(0, 0), (1, 0), (0, 5), (1, 5)]
    assert [(round(r.deg, 6), r.status) for r in records] == [(0.2, "converged")] * 4
    assert all(r.right for r in records)
    moved = se3.perturb(frame.reference, [0.2, 0, 0], [0, 0, 0.03])
    assert records[0].cm == pytest.approx(100 * se3.translation_error_m(frame.reference, moved))
    assert [(r.variant, r.trial) for r in run(study, args, records[:3])] == [("later", 1)]
    args.workers = 2
    assert [(r.variant, r.trial) for r in run(study, args, records[:3])] == [("later", 1)]
    limits = 0.1, 10.0
    assert not any(r.right for r in run(study, args, []))


def test_a_trial_that_fails_is_told_and_the_others_go_on(
    frame: Frame, args: argparse.Namespace, capsys: pytest.CaptureFixture[str]
) -> None:
    cases = [Case("nameless", [replace(frame, reference=None)]), Case("street", [frame])]
    study = Study(lambda args: cases, lambda calibrator, case, features, trial: End.at(case.truth, case.truth), accuracy_table)
    assert [(r.group, r.case, r.deg) for r in run(study, args, [])] == [("street", 1, 0.0)]
    assert "nameless knows no extrinsic" in capsys.readouterr().err


def test_an_estimate_is_recorded_with_what_it_says_of_itself(frame: Frame, args: argparse.Namespace) -> None:
    T = se3.exp([0.01, 0, 0, 0, 0, 0.02]) @ frame.reference
    covariance = np.diag([0.01, 0.01, 0.01, 0.02, 0.02, 0.02]) ** 2
    result = Result(T, "refused", "in doubt", covariance=covariance, refusal=RefusalCode.NOT_SIGNIFICANT)
    study = Study(
        lambda args: [Case("street", [frame])], lambda *_: End.at(T, frame.reference, "refused", result=result), accuracy_table
    )
    (record,) = run(study, args, [])
    assert record.nees == pytest.approx(2.0)
    assert record.refusal == "not_significant"
    assert not record.accepted


def test_the_bound_is_that_of_least_squares_over_the_edge_points_in_view() -> None:
    """With numerical derivatives of the camera's own projection."""
    frame = SyntheticDrive(3, frames=1, rings=32, width=320, height=96)[0]
    config, T = Config(), frame.reference
    own = FeatureExtractor(frame.camera, config)(frame)
    step = range_image(frame.cloud, config.lidar).azimuth_step
    points, camera = own.points, own.camera
    parts = upward_parts(points.ring_spacing)

    def seen(xi: Any) -> Any:
        return camera.project(se3.transform(se3.exp(xi) @ T, points.xyz.astype(float)))

    _, inside = seen(np.zeros(6))
    slopes = np.stack([(seen(1e-6 * one)[0] - seen(-1e-6 * one)[0]) / 2e-6 for one in np.eye(6)], axis=2)
    information = np.zeros((6, 6))
    for k in np.flatnonzero(inside):
        up = points.kind[k] in UPWARD
        pixels = camera.K[int(up), int(up)] * np.linalg.norm(points.xyz[k]) / se3.transform(T, points.xyz[k])[2]
        width = pixels * (points.ring_spacing * np.sqrt(parts) if up else step)
        information += np.outer(slopes[k, int(up)], slopes[k, int(up)]) * 12 / (width**2 + 1)
    once = bound([own], [frame], T, config)
    np.testing.assert_allclose(once, np.linalg.inv(information), rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(bound([own, own], [frame, frame], T, config), once / 2)


# --- the cost of a node ---------------------------------------------------------------------------------------------------


def sample(second: int, mb: float = 500.0, accepted: int = 1) -> Sample:
    counts = {"keyframes so far": second, "estimates accepted": accepted, "pairs": 10 * second, "worker load": 0.5}
    values = {name: str(value) for name, value in counts.items()} | {f"CPU for {work.value}": "0.1" for work in Work}
    values |= {"status": "converged" if second >= 30 else "initial", "callback 99th percentile, ms": "4.0"}
    values["pairs dropped by a busy worker"] = str(second)
    return Sample(second, second, [0.25 * second, 0.05 * second], [mb, 80.0], [values])


def test_laps_go_on_in_time_with_their_stamps_written_over() -> None:
    messages = [Recorded("/a", 7 * NANOSECONDS + k, bytearray(b"\0\1\0\0" + bytes(8))) for k in (0, 5)]
    played = [(at, *struct.unpack_from("<iI", message.data, STAMP)) for at, message in islice(laps(messages), 4)]
    stamps = [seconds * NANOSECONDS + rest for _, seconds, rest in played]
    assert stamps == [messages[0].stamp + offset for offset in (0, 5, 5 + GAP_NS, 10 + GAP_NS)]
    assert [at for at, *_ in played] == [(stamp - stamps[0]) / NANOSECONDS for stamp in stamps]


def test_a_row_has_shares_of_a_core_and_rates_of_what_came_after_the_settling() -> None:
    cells = [cell.strip() for cell in row("drive", [sample(k) for k in range(121)], 60).strip("|").split("|")]
    assert cells[:2] == ["drive", "0.25 0.25 0.25"]
    assert cells[3:] == ["60, 0", "10%", "30 s", "4.0", "500, 500", "0.050, 80"]


def test_a_soak_names_leaks_lost_answers_and_tracebacks() -> None:
    answered: Future[Any] = Future()
    answered.set_result(None)
    assert problems([sample(k) for k in range(601)], [answered], "") == []
    found = problems([sample(k, 500 + k, accepted=0) for k in range(601)], [Future()], "Traceback")
    assert [problem.split()[0] for problem in found] == ["memory", "1", "no", "the"]


# --- the speed of stages --------------------------------------------------------------------------------------------------


def test_figures_are_printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    source = "synthetic:frames=2,width=320,height=160,rings=16"
    monkeypatch.setattr(sys, "argv", ["bench", source, "--runs", "1", "--only", "imports", "features"])
    assert bench.main() == 0
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if "CPU s" in line]
    assert [row[0] for row in rows] == ["| imports", "| features of a frame"]
    assert all(float(row[2].split()[1]) > 0 for row in rows)
