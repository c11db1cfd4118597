"""The recalibrator over time, on a small synthetic drive: frames in, the current extrinsic out."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scenes import QUICK_SEARCH, RenderedDrive

from calib_ros import se3
from calib_ros.config import Config, ImageConfig, MonitorConfig, OnlineConfig, TrackerConfig, update
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.intrinsics import FOCAL
from calib_ros.online.monitor import Assessment, Verdict
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.calibrator import Calibrator
from calib_ros.result import BLINDED, CONVERGED, INITIAL, MOVED, REFUSED, SUSPECT, Cause, Extrinsic, Result

FRAMES = 4
# A small search is enough for these tests.
CONFIG = Config(
    search=replace(QUICK_SEARCH, rotation_deg=2.0, translation_m=0.15),
    online=OnlineConfig(min_keyframes=2, buffer_size=FRAMES, rest_period_s=0.0),
    tracker=TrackerConfig(confirmations=0),
)


@pytest.fixture(scope="module")
def drive() -> list[Frame]:
    source = RenderedDrive(seed=1, frames=FRAMES, rings=64, width=480, height=180, speed=0, stride=30)
    return [source[k] for k in range(FRAMES)]


@pytest.fixture(scope="module")
def truth(drive) -> np.ndarray:
    return drive[0].reference


@pytest.fixture
def start(truth) -> np.ndarray:
    return se3.perturb(truth, [0.8, -0.7, 0.9], [0.05, -0.06, 0.07])


def near(T: np.ndarray, truth: np.ndarray, deg: float = 0.2, m: float = 0.04) -> bool:
    return se3.rotation_error_deg(truth, T) < deg and se3.translation_error_m(truth, T) < m


def taken_in(drive: list[Frame], start: np.ndarray | Result, config: Config = CONFIG) -> Recalibrator:
    recalibrator = Recalibrator(drive[0].camera, start, config, "cam", "velo")
    assert [recalibrator.ingest(f) for f in drive] == [True] * len(drive)
    return recalibrator


def showing_nothing(frame: Frame) -> Frame:
    """Nothing returns from the camera's field of view."""
    return replace(frame, cloud=frame.cloud.select(np.flatnonzero(frame.cloud.xyz[:, 0] < -1)))


def black(frame: Frame) -> Frame:
    return replace(frame, image=np.zeros_like(frame.image))


def blocks(frame: Frame, seed: int) -> Frame:
    """An image full of edges that no scan sees."""
    rows, columns = (-(-n // 12) for n in frame.image.shape[:2])
    noise = np.random.default_rng(seed).integers(0, 256, (rows, columns, 3)).astype(np.uint8)
    image = np.kron(noise, np.ones((12, 12, 1), np.uint8))
    return replace(frame, image=image[: frame.image.shape[0], : frame.image.shape[1]].copy())


def later(frame: Frame, seconds: float) -> Frame:
    return replace(frame, stamp=frame.stamp + round(seconds * NANOSECONDS), cloud_stamp=None)


# --- the way of an extrinsic ----------------------------------------------------------------------------------------------


def test_on_an_empty_road_the_extrinsic_stays_and_nothing_is_estimated(drive, start, truth):
    recalibrator = taken_in(drive, start, update(CONFIG, {"online": {"buffer_size": 2 * FRAMES}}))
    recalibrator.estimate()
    assert [recalibrator.ingest(later(f, 50)) for f in drive] == [True] * FRAMES  # tells the monitor what is usual here
    assert recalibrator.estimate().result.status == CONVERGED
    nothing = [later(showing_nothing(f), 100) for f in drive]
    assert recalibrator.ingest(nothing[0])
    assert not recalibrator.ready()  # nothing new that tells anything
    extrinsic = recalibrator.estimate()  # on request, of the others
    assert extrinsic.result.frames_used == 2 * FRAMES - 1
    assert near(extrinsic.result.T_camera_lidar, truth)
    for f in nothing * 2:  # until nothing else is left in the buffer
        recalibrator.ingest(replace(f, stamp=recalibrator.keyframes.features[-1].stamp + 2 * NANOSECONDS))
    assert (len(recalibrator.keyframes), recalibrator.ready()) == (2 * FRAMES, False)
    assert recalibrator.current.result.status == CONVERGED
    assert near(recalibrator.current.result.T_camera_lidar, truth)


def test_estimates_search_until_they_settle_at_the_truth_and_then_only_on_demand(drive, start, truth):
    recalibrator = taken_in(drive, start)
    assert recalibrator.ready()
    for settled, force, stages, innovation in (
        (False, False, {"search"}, (3, np.inf)),  # 1.4 deg and 10 cm off
        (True, False, {"search"}, (0, 1)),
        (True, False, set(), (0, 0.5)),
        (True, True, {"search"}, (0, 1)),
    ):
        seen: set[str] = set()
        accepted = recalibrator.current.accepted
        extrinsic = recalibrator.estimate(lambda stage, share, seen=seen: seen.add(stage), force_search=force)
        assert extrinsic.result.status == CONVERGED, extrinsic.result.reason
        assert near(extrinsic.result.T_camera_lidar, truth)
        assert (extrinsic.result.camera_frame, extrinsic.result.lidar_frame) == ("cam", "velo")
        assert (extrinsic.accepted, extrinsic.result.frames_used) == (accepted + 1, FRAMES)
        assert innovation[0] <= extrinsic.normalised_innovation < innovation[1]
        assert (recalibrator.tracker.settled, seen) == (settled, stages)
        assert not recalibrator.ready()  # nothing new since


def test_estimate_waits_for_min_keyframes_and_the_buffer_keeps_the_newest(drive, start):
    recalibrator = Recalibrator(drive[0].camera, start, update(CONFIG, {"online": {"min_keyframes": 3, "buffer_size": 3}}))
    ready = []
    for frame in drive:
        recalibrator.ingest(frame)
        ready.append(recalibrator.ready())
    assert ready == [False, False, True, True]
    assert not recalibrator.ingest(later(drive[-1], 0.1))  # the same picture
    assert recalibrator.keyframes.seen == FRAMES
    assert [f.stamp for f in recalibrator.keyframes.features] == [f.stamp for f in drive[-3:]]
    assert recalibrator.newest().name == drive[-1].name


# --- what goes wrong ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_where_three_estimates_in_a_row_match_nothing_what_was_mixed_up_is_told(drive, truth, monkeypatch):
    upside_down = [replace(frame, image=np.ascontiguousarray(frame.image[::-1, ::-1])) for frame in drive]
    recalibrator, asked = taken_in(upside_down, truth), []
    explained = recalibrator.calibrator.explained
    monkeypatch.setattr(recalibrator.calibrator, "explained", lambda *given, **more: asked.append(1) or explained(*given, **more))
    told = [recalibrator.estimate().result.cause for _ in range(4)]
    assert (told, len(asked)) == ([None, None, Cause.ROTATED_IMAGE, Cause.ROTATED_IMAGE], 1)
    assert recalibrator.advice().text == Cause.ROTATED_IMAGE.advice


def test_refused_estimate_keeps_last_good_extrinsic(drive, start, truth):
    """Images that show something, but not what the scans see. Unguarded, so that the estimate alone has to tell."""
    recalibrator = taken_in(drive, start, replace(CONFIG, monitor=MonitorConfig(enabled=False)))
    good = recalibrator.estimate()
    for k, frame in enumerate(drive):
        assert recalibrator.ingest(blocks(frame, k))
    for force in (False, True):
        extrinsic = recalibrator.estimate(force_search=force)
        assert (extrinsic.result.status, extrinsic.accepted) == (REFUSED, 1)
        assert np.array_equal(extrinsic.result.T_camera_lidar, good.result.T_camera_lidar)
    assert near(recalibrator.tracker.last_good.T_camera_lidar, truth)
    # And it recovers when there is something to see again.
    for frame in drive:
        recalibrator.selector.reset()
        recalibrator.ingest(frame)
    assert recalibrator.estimate().result.converged


def test_blind_sensors_are_reported_and_make_no_keyframes(drive, start, truth):
    recalibrator = taken_in(drive, start)
    for _ in range(2):
        good = recalibrator.estimate()
    assert not recalibrator.ingest(black(drive[0]))
    assert recalibrator.current is good  # one bad image is passed over
    for frame in drive[1:]:
        assert not recalibrator.ingest(black(frame))
        assert recalibrator.current.result.status == BLINDED
        assert np.array_equal(recalibrator.current.result.T_camera_lidar, good.result.T_camera_lidar)
    assert (recalibrator.keyframes.seen, recalibrator.ready()) == (FRAMES, False)
    # Who asks gets an estimate over what was seen before; it still shows nothing now.
    assert recalibrator.estimate(force_search=True).result.status == BLINDED
    assert near(recalibrator.current.result.T_camera_lidar, truth)

    def seen_again(frame: Frame) -> None:
        recalibrator.selector.reset()
        assert recalibrator.ingest(frame)
        assert recalibrator.current.result.status == CONVERGED

    seen_again(drive[0])
    for status in (CONVERGED, BLINDED):  # a scanner that shows nothing, likewise; and it is an error as well
        with pytest.raises(TooFewFeaturesError):
            recalibrator.ingest(replace(drive[1], cloud=PointCloud(np.zeros((0, 3), np.float32))))
        assert recalibrator.current.result.status == status
    seen_again(drive[1])


# --- a camera that moves --------------------------------------------------------------------------------------------------

BEFORE, AFTER = 7, 6
GUARDED = replace(
    CONFIG, search=replace(CONFIG.search, rotation_deg=3.0), online=replace(CONFIG.online, min_keyframes=3, buffer_size=8)
)


@pytest.fixture(scope="module")
def displaced() -> list[Frame]:
    """A drive on which the camera is displaced by 2 deg / 5 cm."""
    source = RenderedDrive(seed=1, frames=BEFORE + AFTER, rings=64, width=480, height=180, speed=0, stride=30)
    moved = se3.perturb(source.reference, [0.9, 1.5, -0.9], [0.03, -0.03, 0.02])
    return [source[k] for k in range(BEFORE)] + [source.moved(k, moved) for k in range(BEFORE, BEFORE + AFTER)]


def driven(recalibrator: Recalibrator, frames: list[Frame]) -> list[tuple[Extrinsic, Extrinsic]]:
    """What is told after every keyframe, and after the estimate that it led to."""
    out = []
    for frame in frames:
        assert recalibrator.ingest(frame)
        told = recalibrator.current
        out.append((told, recalibrator.estimate() if recalibrator.ready() else told))
    return out


def test_mount_displacement_is_reported_at_once_and_the_new_extrinsic_found(displaced):
    start = se3.perturb(displaced[0].reference, [0.5, -0.4, 0.5], [0.03, -0.04, 0.05])
    recalibrator = Recalibrator(displaced[0].camera, start, GUARDED, "cam", "velo")
    told = driven(recalibrator, displaced)
    good = recalibrator.tracker.last_good
    for pair, frame in zip(told, displaced, strict=True):
        for extrinsic in pair:
            assert extrinsic.result.status != CONVERGED or near(extrinsic.result.T_camera_lidar, frame.reference, 0.5, 0.1)
    statuses = [after.result.status for _, after in told]
    assert statuses[2:BEFORE] == [CONVERGED] * (BEFORE - 2)  # no alarm without a reason
    assert statuses[BEFORE] == SUSPECT
    assert MOVED in statuses[BEFORE : BEFORE + 3]
    assert statuses[-1] == CONVERGED
    assert set(statuses[BEFORE:]) == {SUSPECT, MOVED, CONVERGED}
    last = told[-1][1].result
    assert near(last.T_camera_lidar, displaced[-1].reference)
    assert last is good
    assert all(f.stamp >= displaced[BEFORE].stamp for f in recalibrator.keyframes.features)


def settled_at(frames: list[Frame], initial: np.ndarray | Result) -> Recalibrator:
    refined = update(GUARDED, {"search": {"rotation_deg": 0.0, "translation_m": 0.0}})  # the start is right
    recalibrator = Recalibrator(frames[0].camera, initial, refined, "cam", "velo")
    driven(recalibrator, frames[:5])
    assert recalibrator.tracker.settled
    return recalibrator


def test_frames_of_a_rejected_estimate_still_count_as_new(displaced, monkeypatch):
    recalibrator = settled_at(displaced, displaced[0].reference)
    shares, update = [], recalibrator.tracker.update

    def watched(estimate: Result, share_new: float = 1.0, *rest, **more) -> Extrinsic:
        shares.append(share_new)
        return update(estimate, share_new, *rest, **more)

    monkeypatch.setattr(recalibrator.tracker, "update", watched)
    assert recalibrator.ingest(displaced[5])
    recalibrator.tracker.apply(Assessment(Verdict.SUSPECT, "doubtful", 1e-4, 1))
    recalibrator.estimate()  # not taken in
    recalibrator.tracker.apply(Assessment(Verdict.CONSISTENT, "right", 0.5))
    assert recalibrator.ingest(displaced[6])
    recalibrator.estimate()
    recalibrator.estimate()
    assert shares == pytest.approx([1 / 6, 2 / 7, 0])


def test_disabled_monitor_ends_suspicion(displaced):
    recalibrator = settled_at(displaced, Result(displaced[0].reference, CONVERGED))
    recalibrator.ingest(displaced[BEFORE])
    assert recalibrator.current.result.status == SUSPECT
    assert not recalibrator.ready()
    recalibrator.configure(replace(GUARDED, monitor=MonitorConfig(enabled=False)))
    assert recalibrator.current.result.status == CONVERGED
    assert recalibrator.ready()


def test_suspicion_of_the_old_extrinsic_does_not_reach_the_new_one(displaced, monkeypatch):
    """While the monitor looks at the old one, and at the next keyframe."""
    recalibrator = settled_at(displaced, Result(displaced[0].reference, CONVERGED, camera_frame="cam", lidar_frame="velo"))
    look = recalibrator.monitor.check

    def interrupted(*arguments, **named) -> Assessment:
        found = look(*arguments, **named)
        monkeypatch.undo()
        with ThreadPoolExecutor(1) as pool:  # as from a service callback
            pool.submit(recalibrator.reset).result(60)
        return found

    monkeypatch.setattr(recalibrator.monitor, "check", interrupted)
    recalibrator.ingest(displaced[BEFORE])  # suspect, if nobody replaced the extrinsic
    assert recalibrator.current.result.status == INITIAL
    assert recalibrator.ingest(displaced[5])
    assert recalibrator.current.result.status == CONVERGED  # one right keyframe does, none has to confirm it


# --- reset and configure --------------------------------------------------------------------------------------------------


def resize(recalibrator: Recalibrator) -> None:
    recalibrator.configure(replace(CONFIG, image=ImageConfig(max_width=320)))


interrupting = pytest.mark.parametrize("interrupt", [Recalibrator.reset, resize])


@interrupting
def test_running_estimate_is_discarded_after(drive, start, interrupt):
    recalibrator, done = taken_in(drive[:2], start), []

    def progress(stage: str, share: float) -> None:
        if not done:
            done.append(stage)
            with ThreadPoolExecutor(1) as pool:  # as from a service callback
                pool.submit(interrupt, recalibrator).result(10)

    extrinsic = recalibrator.estimate(progress)
    assert done == ["search"]
    assert (extrinsic.result.status, recalibrator.current.accepted) == (INITIAL, 0)
    assert np.array_equal(recalibrator.current.result.T_camera_lidar, start)


@interrupting
def test_features_in_extraction_are_dropped_after(drive, start, interrupt, monkeypatch):
    recalibrator = taken_in(drive[:1], start)
    extract = recalibrator.calibrator.extract

    def interrupted(frame: Frame):
        features = extract(frame)
        interrupt(recalibrator)
        return features

    monkeypatch.setattr(recalibrator.calibrator, "extract", interrupted)
    recalibrator.ingest(drive[1])
    assert (len(recalibrator.keyframes), recalibrator.ready()) == (0, False)
    monkeypatch.undo()
    assert recalibrator.ingest(drive[1])


def test_configure_keeps_keyframes_whose_features_stay_the_same(drive, start):
    recalibrator = taken_in(drive, start)
    recalibrator.estimate()
    changes = {"search": {"seed": 5}, "refine": {"max_p_value": 0.02}, "online": {"buffer_size": 3}}
    recalibrator.configure(update(CONFIG, changes))
    assert [f.name for f in recalibrator.keyframes.features] == [f.name for f in drive[-3:]]
    assert (recalibrator.calibrator.config.search.seed, recalibrator.current.accepted) == (5, 1)
    recalibrator.configure(update(recalibrator.config, {"online": {"similarity_threshold": 0.5, "buffer_size": 10}}))
    assert (recalibrator.selector.config.similarity_threshold, recalibrator.keyframes.features.maxlen) == (0.5, 10)


@pytest.mark.parametrize(
    "change", [{"image": {"max_width": 320}}, {"lidar": {"min_range": 3.0}}, {"score": {"weight_reflectivity": 0.2}}]
)
def test_configure_drops_keyframes_whose_features_change(drive, start, change):
    recalibrator = taken_in([drive[0], drive[-1]], start)
    recalibrator.estimate()
    recalibrator.configure(update(CONFIG, change))
    assert len(recalibrator.keyframes) == 0
    assert not recalibrator.ready()
    assert recalibrator.current.accepted == 1  # the extrinsic stays
    # Even a standing vehicle's scene is taken in again, with the new constants.
    assert recalibrator.ingest(drive[-1])
    fresh = Calibrator(drive[0].camera, update(CONFIG, change)).extract(drive[-1])
    oldest = recalibrator.keyframes.features[0]
    assert np.array_equal(oldest.points.xyz, fresh.points.xyz)
    assert all(np.array_equal(a.maps, b.maps) for a, b in zip(oldest.levels, fresh.levels, strict=True))


# ---- refined intrinsics -------------------------------------------------------------------------------------------------

REFINE = update(CONFIG, {"camera": {"intrinsics": "refine"}})


def test_refined_intrinsics_are_told_and_the_extrinsic_stays_that_of_the_stated_ones(drive, start):
    stated, refining = taken_in(drive, start), taken_in(drive, start, REFINE)
    before, after = stated.estimate().result, refining.estimate().result
    assert after.converged
    assert np.array_equal(before.T_camera_lidar, after.T_camera_lidar)
    assert np.array_equal(before.covariance, after.covariance)
    assert stated.refined_camera is None
    change = refining.refined_camera.changes[FOCAL]
    assert abs(change.value) < 3 * change.sigma < 0.02
