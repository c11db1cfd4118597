"""What the small studies count, and that one which was interrupted goes on."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.records import append_records, read_records
from benchmarks.study_registration import accuracy_table, bound
from benchmarks.study_runner import Case, End, Record, Study, Variant, run
from calib_ros import se3
from calib_ros.config import Config
from calib_ros.lidar.edges import UPWARD, upward_parts
from calib_ros.lidar.range_image import range_image
from calib_ros.registration.features import FeatureExtractor
from calib_ros.result import RefusalCode, Result
from calib_ros_synthetic.drive import SyntheticDrive

RECORD = Record("KITTI", "none", 0, 0, True, 0.1, 2.0, "converged", 0.5, "a, b", nees=2.0, disagreement=0.5)


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


def test_what_is_done_is_not_done_again_and_variants_change_frames() -> None:
    frame = SyntheticDrive(3, frames=1, rings=16, width=160, height=96)[0]
    seen: list[tuple[int, int]] = []
    limits = 0.5, 10.0

    def cases(args: argparse.Namespace) -> Iterator[Case]:
        yield Case("street", [frame], limits=limits)

    def estimate(calibrator: object, case: Case, features: object, trial: int) -> End:
        seen.append((trial, case.frames[0].stamp - frame.stamp))
        return End.at(se3.perturb(case.truth, [0.2, 0, 0], [0, 0, 0.03]), case.truth)

    later = Variant(frame=lambda frame: replace(frame, stamp=frame.stamp + 5))
    study = Study(cases, estimate, accuracy_table, {"": Variant(), "later": later}, trials=2)
    args = argparse.Namespace(variants=None, cases=None, trials=None, config=None, workers=1)
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


def test_a_trial_that_fails_is_told_and_the_others_go_on(capsys: pytest.CaptureFixture[str]) -> None:
    frame = SyntheticDrive(3, frames=1, rings=16, width=160, height=96)[0]
    cases = [Case("nameless", [replace(frame, reference=None)]), Case("street", [frame])]
    study = Study(lambda args: cases, lambda calibrator, case, features, trial: End.at(case.truth, case.truth), accuracy_table)
    args = argparse.Namespace(variants=None, cases=None, trials=None, config=None, workers=1)
    assert [(r.group, r.case, r.deg) for r in run(study, args, [])] == [("street", 1, 0.0)]
    assert "nameless knows no extrinsic" in capsys.readouterr().err


def test_an_estimate_is_recorded_with_what_it_says_of_itself() -> None:
    frame = SyntheticDrive(3, frames=1, rings=16, width=160, height=96)[0]
    T = se3.exp([0.01, 0, 0, 0, 0, 0.02]) @ frame.reference
    covariance = np.diag([0.01, 0.01, 0.01, 0.02, 0.02, 0.02]) ** 2
    result = Result(T, "refused", "in doubt", covariance=covariance, refusal=RefusalCode.NOT_SIGNIFICANT)
    study = Study(
        lambda args: [Case("street", [frame])], lambda *_: End.at(T, frame.reference, "refused", result=result), accuracy_table
    )
    args = argparse.Namespace(variants=None, cases=None, trials=None, config=None, workers=1)
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
