"""The session that all browsers see, and the work on it."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
from waiting import LIMIT_S, until

from calib_ros import Config, result, se3
from calib_ros.errors import BadInputError
from calib_ros.frame import PointCloud
from calib_ros_check.outcome import CheckVerdict
from calib_ros_view.session.numbers import curve_plots, ellipse_plots, frame_bars
from calib_ros_view.session.session import CHECK, MOST_UNDO, REFINE, SEARCH, Session, SessionJobs

OFF = np.array([0.0, 1.0, 0, 5.0, 0, 0])


@pytest.fixture
def session(drive, street, tmp_path):
    start = se3.perturb(drive.reference, [0.3, -0.2, 0.2], [0.03, 0.02, -0.04])
    return Session(street[:5], drive, start, out=tmp_path / "extrinsic.json")


def finished(session, name):
    """The job, at its end."""
    job = SessionJobs(session).start(name)
    until(lambda: not job.running, name)
    return job


def test_moves_are_undone_and_done_again(session):
    session.move_to(OFF)
    session.move_to(2 * OFF)
    assert session.offsets == pytest.approx(2 * OFF)
    session.undo()
    assert session.offsets == pytest.approx(OFF)
    session.undo()
    assert (session.state.what, session.can_step[0]) == ("start", False)
    session.undo()
    session.redo()
    session.redo()
    assert session.offsets == pytest.approx(2 * OFF)
    session.undo()
    session.move_to(3 * OFF)
    assert not session.can_step[1]


def test_a_movement_of_a_slider_is_one_step_and_the_history_is_bounded(session):
    for k in range(20):
        session.move_to(0.1 * k * OFF, "slider 1 a")
    session.move_to(OFF, "slider 2 a")
    session.undo()
    assert session.offsets == pytest.approx(1.9 * OFF)
    session.undo()
    assert session.state.what == "start"
    for k in range(2 * MOST_UNDO):
        session.move_to(0.01 * k * OFF)
    count = 0
    while session.can_step[0]:
        session.undo()
        count += 1
    assert count == MOST_UNDO


def test_every_change_is_counted_and_bad_values_change_nothing(session):
    before = session.version
    for values in (np.full(6, np.nan), np.zeros(5), [1, 2, 3, 4, 5, np.inf], [0, 0, 0, 0, 1e300, 0]):
        with pytest.raises(BadInputError, match="six numbers"):
            session.move_to(values)
    with pytest.raises(BadInputError, match="time offset"):
        session.set_time_offset(5.0)
    with pytest.raises(BadInputError, match="no frame 9"):
        session.leave_out(9, True)
    assert session.version == before
    session.move_to(OFF)
    session.set_time_offset(0.01)
    session.leave_out(1, True)
    assert session.version == before + 3


def test_the_last_frame_stays_in(session):
    for k in range(4):
        session.leave_out(k, True)
    with pytest.raises(BadInputError, match="at least one"):
        session.leave_out(4, True)
    assert session.state.left_out == {0, 1, 2, 3}
    assert len(session.features(session.state)) == 1


def test_what_was_set_by_hand_is_saved_as_such(session):
    session.move_to(OFF)
    saved = result.load(session.save())
    assert (saved.status, saved.reason, saved.frames_used) == ("tentative", "set by hand", 5)
    assert np.allclose(saved.T_camera_lidar, session.state.T)
    for form in ("tf", "urdf", "kitti", "autoware"):
        assert len(session.export(form)) > 40


def test_refine_finds_the_right_extrinsic_and_is_a_step_of_the_history(session):
    job = finished(session, REFINE)
    assert (job.failed, session.state.what) == (False, "refined"), job.message
    assert (np.array(se3.error(session.reference, session.state.T)) < (0.15, 0.06)).all()
    saved = result.load(session.save())
    assert (saved.status, saved.covariance is not None) == ("converged", True)
    assert job.title(session.state) == "refine"
    session.undo()
    assert job.title(session.state) == "earlier refine"
    assert se3.error(session.reference, session.state.T)[0] > 0.3
    session.leave_out(0, True)
    session.leave_out(1, True)
    finished(session, REFINE)
    assert session.result().frames_used == 3


def test_work_is_stopped_and_one_at_a_time(session, monkeypatch):
    go_on, features = threading.Event(), session.features

    def held(state):
        assert go_on.wait(LIMIT_S)
        return features(state)

    monkeypatch.setattr(session, "features", held)
    jobs = SessionJobs(session)
    with pytest.raises(BadInputError, match="not known"):
        jobs.start("dance")
    before = session.state
    job = jobs.start(SEARCH)
    with pytest.raises(BadInputError, match="already"):
        jobs.start(REFINE)
    jobs.stop()
    go_on.set()
    until(lambda: not jobs.current.running, "the end")
    assert (job.failed, job.message) == (False, "stopped; nothing has changed")
    assert session.state is before
    jobs.start(REFINE)
    jobs.close()
    assert not jobs.current.running


def test_check_tells_a_verdict(session):
    session.move_to([0, 2.0, 0, 0, 0, 0])
    job = finished(session, CHECK)
    assert (job.check.verdict, job.title(session.state)) == (CheckVerdict.FAIL, "check")
    session.move_to([0, 1.0, 0, 0, 0, 0])
    assert job.title(session.state) == "earlier check"


def test_a_refused_estimate_changes_nothing_and_says_why(session):
    session.move_to([20.0, 25.0, 0, 0, 0, 0])
    before = session.state
    job = finished(session, REFINE)
    assert (job.failed, job.message != "", session.state is before) == (True, True, True)


def test_plots_are_made_of_numbers_only(session):
    state = session.state
    curves, ellipses = curve_plots(session.scores.at(state.T)), ellipse_plots(session.scores.known(state.T))
    bars = frame_bars(np.array([0.2, np.nan, -0.1]), 1)
    assert (curves.count("<svg"), ellipses.count("<polygon"), bars.count("<rect")) == (6, 3, 3)
    assert "nan" not in curves + ellipses + bars


def test_points_that_lack_a_field_are_not_coloured_by_it(drive, street):
    bare = [replace(frame, cloud=PointCloud(frame.cloud.xyz)) for frame in street[:1]]
    own = Session(bare, drive, drive.reference)
    for coloring, missing in (("reflectivity", "intensities"), ("ring", "rings")):
        with pytest.raises(BadInputError, match=f"no {missing}"):
            own.picture_by(0, coloring)
    assert own.picture_by(0, "depth") is own.picture_by(0, "edge kind") is own.picture(0)
    assert Session(street[:1], drive, drive.reference).picture_by(0, "reflectivity").missing("reflectivity") == ""
    plain = Config.from_dict({"semantics": {"segmentation": "none", "image_classes": "", "cloud_classes": ""}})
    with pytest.raises(BadInputError, match="no classes"):
        Session(bare, drive, drive.reference, plain).picture_by(0, "class")
