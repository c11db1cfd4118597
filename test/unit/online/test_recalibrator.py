"""The recalibrator over time, on a small synthetic drive: frames in, the current extrinsic out."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
from scenes import QUICK_SEARCH, RenderedDrive

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config, ImageConfig, LidarConfig, MonitorConfig, OnlineConfig, TrackerConfig, update
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.online.monitor import Assessment, Verdict
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.registration.calibrator import Calibrator
from calib_ros.result import BLINDED, CONVERGED, INITIAL, INSUFFICIENT, MOVED, REFUSED, SUSPECT, Extrinsic, Result

FRAMES = 4
# A small search is enough for these tests.
CONFIG = Config(
    search=replace(QUICK_SEARCH, rotation_deg=2.0, translation_m=0.15),
    online=OnlineConfig(min_keyframes=2, buffer_size=FRAMES, rest_period_s=0.0, rest_spacing_s=0.0),
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


def near(T: np.ndarray, truth: np.ndarray) -> bool:
    return se3.rotation_error_deg(truth, T) < 0.2 and se3.translation_error_m(truth, T) < 0.04


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


def empty(frame: Frame) -> Frame:
    return replace(frame, cloud=PointCloud(np.zeros((0, 3), np.float32)))


# --- the way of an extrinsic ----------------------------------------------------------------------------------------------


def test_initial_state_without_keyframes(drive, start):
    recalibrator = Recalibrator(drive[0].camera, start, CONFIG, "cam", "velo")
    first = recalibrator.current
    assert (first.result.status, first.accepted, first.normalised_innovation) == (INITIAL, 0, 0)
    assert np.array_equal(first.result.T_camera_lidar, start)
    assert (first.result.camera_frame, first.result.lidar_frame) == ("cam", "velo")
    assert not recalibrator.ready()
    assert recalibrator.newest() is None
    extrinsic = recalibrator.estimate()
    assert extrinsic.result.status == INSUFFICIENT
    assert "no keyframe yet" in extrinsic.result.reason
    assert np.array_equal(extrinsic.result.T_camera_lidar, start)


def test_on_an_empty_road_the_extrinsic_stays_and_nothing_is_estimated(drive, start, truth):
    config = update(CONFIG, {"online": {"buffer_size": 2 * FRAMES}})
    recalibrator = taken_in(drive, start, config)
    recalibrator.estimate()
    again = [replace(f, stamp=f.stamp + 50 * NANOSECONDS, cloud_stamp=None) for f in drive]
    assert [recalibrator.ingest(f) for f in again] == [True] * FRAMES  # tells the monitor what is usual here
    found = recalibrator.estimate()
    assert found.result.status == CONVERGED
    later = [replace(showing_nothing(f), stamp=f.stamp + 100 * NANOSECONDS, cloud_stamp=None) for f in drive]
    assert [recalibrator.ingest(f) for f in later[:1]] == [True]
    assert not recalibrator.ready()  # nothing new that tells anything
    extrinsic = recalibrator.estimate()  # on request, of the others
    assert extrinsic.result.frames_used == 2 * FRAMES - 1
    assert near(extrinsic.result.T_camera_lidar, truth)
    for f in later * 2:  # until nothing else is left in the buffer
        recalibrator.ingest(replace(f, stamp=recalibrator.buffer[-1].stamp + 2 * NANOSECONDS))
    assert len(recalibrator.buffer) == 2 * FRAMES
    assert not recalibrator.ready()
    assert recalibrator.current.result.status == CONVERGED
    assert near(recalibrator.current.result.T_camera_lidar, truth)


def test_estimates_converge_to_the_truth_and_settle(drive, start, truth):
    recalibrator = taken_in(drive, start)
    assert recalibrator.ready()
    extrinsic = recalibrator.estimate()
    assert extrinsic.result.status == CONVERGED, extrinsic.result.reason
    assert near(extrinsic.result.T_camera_lidar, truth)
    assert (extrinsic.result.camera_frame, extrinsic.result.lidar_frame) == ("cam", "velo")
    assert (extrinsic.accepted, extrinsic.result.frames_used) == (1, FRAMES)
    assert extrinsic.normalised_innovation > 3  # 1.4 deg and 10 cm off
    assert not recalibrator.ready()  # nothing new since
    assert not recalibrator.tracker.settled
    again = recalibrator.estimate()
    assert again.accepted == 2
    assert again.normalised_innovation < 1
    assert recalibrator.tracker.settled
    assert near(again.result.T_camera_lidar, truth)
    refined = recalibrator.estimate()
    assert refined.result.converged, refined.result.reason
    assert near(refined.result.T_camera_lidar, truth)
    assert refined.normalised_innovation < 0.5


def test_search_runs_until_settled_and_then_only_on_demand(drive, start):
    recalibrator = taken_in(drive[:2], start)
    stages: list[set[str]] = []

    def estimate(**options) -> None:
        seen: set[str] = set()
        recalibrator.estimate(lambda stage, share: seen.add(stage), **options)
        stages.append(seen)

    estimate()
    estimate()
    assert recalibrator.tracker.settled
    estimate()
    estimate(force_search=True)
    assert stages == [{"search"}, {"search"}, set(), {"search"}]


def test_estimate_waits_for_min_keyframes(drive, start):
    recalibrator = Recalibrator(drive[0].camera, start, replace(CONFIG, online=replace(CONFIG.online, min_keyframes=3)))
    ready = []
    for frame in drive:
        recalibrator.ingest(frame)
        ready.append(recalibrator.ready())
    assert ready == [False, False, True, True]
    assert not recalibrator.ingest(replace(drive[-1], stamp=drive[-1].stamp + NANOSECONDS // 10))  # the same picture
    assert recalibrator.keyframes_seen == len(recalibrator.buffer) == FRAMES
    assert recalibrator.newest().name == drive[-1].name


def test_the_buffer_is_bounded_and_keeps_the_newest(drive, start):
    recalibrator = taken_in(drive, start, replace(CONFIG, online=replace(CONFIG.online, buffer_size=2)))
    assert [f.stamp for f in recalibrator.buffer] == [f.stamp for f in drive[-2:]]
    assert recalibrator.keyframes_seen == FRAMES


def test_saved_result_is_the_initial_extrinsic(drive, truth):
    saved = Result(truth, CONVERGED, score=0.9, frames_used=12)
    recalibrator = Recalibrator(drive[0].camera, saved, CONFIG, "cam", "velo")
    assert recalibrator.current.result.status == INITIAL  # until it is tested
    assert recalibrator.current.accepted == 0
    assert recalibrator.current.result.lidar_frame == "velo"
    assert recalibrator.tracker.last_good.frames_used == 12


def test_the_same_frames_give_the_same_bits(drive, start):
    first, second = (taken_in(drive[:2], start).estimate().result for _ in range(2))
    assert first.T_camera_lidar.tobytes() == second.T_camera_lidar.tobytes()
    assert first.score == second.score


# --- what goes wrong ------------------------------------------------------------------------------------------------------


def test_refused_estimate_keeps_last_good_extrinsic(drive, start, truth):
    """Images that show something, but not what the scans see. Unguarded, so that the estimate alone has to tell."""
    recalibrator = taken_in(drive, start, replace(CONFIG, monitor=MonitorConfig(enabled=False)))
    good = recalibrator.estimate()
    for k, frame in enumerate(drive):
        assert recalibrator.ingest(blocks(frame, k))
    for force in (False, True):
        extrinsic = recalibrator.estimate(force_search=force)
        assert extrinsic.result.status == REFUSED
        assert extrinsic.result.reason
        assert extrinsic.accepted == 1
        assert np.array_equal(extrinsic.result.T_camera_lidar, good.result.T_camera_lidar)
    assert near(recalibrator.tracker.last_good.T_camera_lidar, truth)
    # And it recovers when there is something to see again.
    for frame in drive:
        recalibrator.selector.reset()
        recalibrator.ingest(frame)
    assert recalibrator.estimate().result.converged


def test_covered_lens_is_reported_and_makes_no_keyframes(drive, start, truth):
    recalibrator = taken_in(drive, start)
    for _ in range(2):
        good = recalibrator.estimate()
    assert recalibrator.ingest(black(drive[0])) is False
    assert recalibrator.current is good  # one bad image is passed over
    for frame in drive[1:]:
        assert recalibrator.ingest(black(frame)) is False
        told = recalibrator.current.result
        assert told.status == BLINDED
        assert "covered lens" in told.reason
        assert np.array_equal(told.T_camera_lidar, good.result.T_camera_lidar)
    assert recalibrator.keyframes_seen == FRAMES
    assert not recalibrator.ready()
    # Who asks gets an estimate over what was seen before; it still shows nothing now.
    assert recalibrator.estimate(force_search=True).result.status == BLINDED
    assert near(recalibrator.current.result.T_camera_lidar, truth)
    recalibrator.selector.reset()
    assert recalibrator.ingest(drive[0])
    assert recalibrator.current.result.status == CONVERGED
    # A scanner that shows nothing, likewise; and it is an error as well.
    for k in range(2):
        assert recalibrator.current.result.status == CONVERGED, k
        with pytest.raises(TooFewFeaturesError):
            recalibrator.ingest(empty(drive[1]))
    assert "the LiDAR shows nothing" in recalibrator.current.result.reason
    recalibrator.selector.reset()
    assert recalibrator.ingest(drive[1])
    assert recalibrator.current.result.status == CONVERGED


def test_unusable_frame_raises_and_the_next_one_is_accepted(drive, start):
    recalibrator = Recalibrator(drive[0].camera, start, CONFIG)
    with pytest.raises(TooFewFeaturesError, match="usable points"):
        recalibrator.ingest(empty(drive[0]))
    assert len(recalibrator.buffer) == 0
    # The same picture, now with a scan: still wanted.
    assert recalibrator.ingest(replace(drive[0], stamp=drive[0].stamp + NANOSECONDS // 10))
    other = replace(drive[1], camera=Camera(drive[1].camera.K * np.array([[1.1], [1.1], [1]]), 480, 180))
    with pytest.raises(BadInputError, match="another camera calibration"):
        recalibrator.ingest(other)
    assert recalibrator.ingest(drive[1])
    assert [f.name for f in recalibrator.buffer] == [drive[0].name, drive[1].name]


def test_cancelled_estimate_changes_nothing(drive, start):
    recalibrator = taken_in(drive, start)

    class Stop(Exception):
        pass

    def progress(stage: str, share: float) -> None:
        raise Stop

    before = recalibrator.current
    with pytest.raises(Stop):
        recalibrator.estimate(progress)
    assert recalibrator.current is before
    assert recalibrator.estimate().result.converged


# --- a camera that moves --------------------------------------------------------------------------------------------------

BEFORE, AFTER = 7, 6
GUARDED = replace(
    CONFIG,
    search=replace(CONFIG.search, rotation_deg=3.0),
    online=replace(CONFIG.online, min_keyframes=3, buffer_size=8),
)


@pytest.fixture(scope="module")
def displaced() -> list[Frame]:
    """A drive on which the camera is displaced by 2 deg / 5 cm."""
    source = RenderedDrive(seed=1, frames=BEFORE + AFTER, rings=64, width=480, height=180, speed=0, stride=30)
    moved = se3.perturb(source.reference, [0.8, 1.6, 0.8], [0.03, -0.03, 0.03])
    return [source[k] for k in range(BEFORE)] + [source.moved(k, moved) for k in range(BEFORE, BEFORE + AFTER)]


def driven(recalibrator: Recalibrator, frames: list[Frame]) -> list[tuple[Extrinsic, Extrinsic]]:
    """What is told after every keyframe, and after the estimate that it led to."""
    out = []
    for frame in frames:
        assert recalibrator.ingest(frame)
        told = recalibrator.current
        out.append((told, recalibrator.estimate() if recalibrator.ready() else told))
    return out


def wrong(extrinsic: Extrinsic, frame: Frame) -> bool:
    T = extrinsic.result.T_camera_lidar
    return se3.rotation_error_deg(frame.reference, T) > 0.5 or se3.translation_error_m(frame.reference, T) > 0.1


def start_of(displaced: list[Frame]) -> np.ndarray:
    return se3.perturb(displaced[0].reference, [0.5, -0.4, 0.5], [0.03, -0.04, 0.05])


def test_mount_displacement_is_reported_at_once_and_the_new_extrinsic_found(displaced):
    recalibrator = Recalibrator(displaced[0].camera, start_of(displaced), GUARDED, "cam", "velo")
    told = driven(recalibrator, displaced)
    good = recalibrator.tracker.last_good
    for pair, frame in zip(told, displaced, strict=True):
        for extrinsic in pair:
            assert not (extrinsic.result.status == CONVERGED and wrong(extrinsic, frame))
    statuses = [after.result.status for _, after in told]
    assert statuses[2:BEFORE] == [CONVERGED] * (BEFORE - 2)  # no alarm without a reason
    assert statuses[BEFORE] == SUSPECT
    assert MOVED in statuses[BEFORE : BEFORE + 3]
    assert statuses[-1] == CONVERGED
    assert set(statuses[BEFORE:]) == {SUSPECT, MOVED, CONVERGED}
    last = told[-1][1].result
    assert se3.rotation_error_deg(displaced[-1].reference, last.T_camera_lidar) < 0.2
    assert se3.translation_error_m(displaced[-1].reference, last.T_camera_lidar) < 0.04
    assert last is good
    assert all(f.stamp >= displaced[BEFORE].stamp for f in recalibrator.buffer)


@pytest.mark.slow
def test_same_drive_with_mount_displacement_gives_the_same_bits(displaced):
    told, again = (
        driven(Recalibrator(displaced[0].camera, start_of(displaced), GUARDED, "cam", "velo"), displaced) for _ in range(2)
    )
    assert [b.result.T_camera_lidar.tobytes() for _, b in again] == [b.result.T_camera_lidar.tobytes() for _, b in told]
    assert [b.p_value for b, _ in again] == pytest.approx([b.p_value for b, _ in told], abs=0, nan_ok=True)


@pytest.mark.slow
def test_outdated_saved_extrinsic_is_detected(displaced):
    """Somebody bent the mount overnight."""
    saved = Result(displaced[0].reference, CONVERGED, covariance=np.diag([1e-7] * 3 + [1e-4] * 3), camera_frame="cam")
    after = displaced[BEFORE:]
    recalibrator = Recalibrator(after[0].camera, saved, GUARDED, "cam", "velo")
    told = driven(recalibrator, after)
    statuses = [extrinsic.result.status for _, extrinsic in told]
    assert SUSPECT in statuses[:3]
    assert statuses[-1] == CONVERGED
    assert not wrong(told[-1][1], after[-1])


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


@pytest.mark.parametrize("how", ["reset", pytest.param("asked", marks=pytest.mark.slow)])
def test_suspicion_of_the_old_extrinsic_does_not_reach_the_new_one(displaced, how, monkeypatch):
    """While the monitor looks at the old one, and at the next keyframe."""
    saved = Result(displaced[0].reference, CONVERGED, camera_frame="cam", lidar_frame="velo")
    recalibrator = settled_at(displaced, saved)
    look = recalibrator.monitor.check

    def interrupted(*arguments) -> Assessment:
        found = look(*arguments)
        monkeypatch.undo()
        other = threading.Thread(target=recalibrator.reset if how == "reset" else ask)  # as from a service callback
        other.start()
        other.join(60)
        return found

    def ask() -> None:
        recalibrator.tracker.apply(Assessment(Verdict.SUSPECT, "doubtful", 1e-4, 1))
        recalibrator.estimate(force_search=True)

    monkeypatch.setattr(recalibrator.monitor, "check", interrupted)
    recalibrator.ingest(displaced[BEFORE])  # suspect, if nobody replaced the extrinsic
    assert recalibrator.current.result.status == (INITIAL if how == "reset" else CONVERGED)
    assert recalibrator.ingest(displaced[5])
    assert recalibrator.current.result.status == CONVERGED  # one right keyframe does, none has to confirm it


@pytest.mark.slow
def test_use_from_three_threads_at_once(drive, start, truth):
    """Intake, estimates, and somebody who resets and configures: nothing breaks, and then it works as ever."""
    recalibrator = Recalibrator(drive[0].camera, start, CONFIG, "cam", "velo")
    errors: list[Exception] = []
    done = threading.Event()

    def monitored(work) -> threading.Thread:
        def run() -> None:
            try:
                work()
            except Exception as error:  # reported below
                errors.append(error)

        thread = threading.Thread(target=run)
        thread.start()
        return thread

    def feed() -> None:
        for k in range(16):
            recalibrator.selector.reset()
            frame = drive[k % FRAMES] if k % 7 else black(drive[k % FRAMES])
            recalibrator.ingest(replace(frame, stamp=drive[-1].stamp + k * NANOSECONDS, cloud_stamp=None))
        done.set()

    def estimate() -> None:
        while not done.is_set():
            recalibrator.estimate()

    def meddle() -> None:
        changes = [
            {"monitor": {"enabled": False}},
            {"online": {"buffer_size": 2}},
            {"image": {"max_width": 320}},
            {"refine": {"objective": "thesis"}},
            {},
        ]
        for k in range(1000):
            if done.wait(0.15):
                return
            if k % 3 == 2:
                recalibrator.reset()
            else:
                recalibrator.configure(update(CONFIG, changes[k % len(changes)]))

    for thread in [monitored(work) for work in (feed, estimate, meddle)]:
        thread.join(120)
        assert not thread.is_alive()
    assert errors == []
    recalibrator.configure(CONFIG)
    recalibrator.reset()
    for frame in drive:
        assert recalibrator.ingest(frame)
    for _ in range(2):
        extrinsic = recalibrator.estimate()
    assert extrinsic.result.status == CONVERGED, extrinsic.result.reason
    assert near(extrinsic.result.T_camera_lidar, truth)


# --- reset and configure --------------------------------------------------------------------------------------------------


def test_reset_drops_keyframes_and_estimates(drive, start):
    recalibrator = taken_in([drive[0], drive[-1]], start)
    recalibrator.estimate()
    recalibrator.reset()
    assert len(recalibrator.buffer) == 0
    assert not recalibrator.ready()
    assert recalibrator.current.result.status == INITIAL
    assert np.array_equal(recalibrator.current.result.T_camera_lidar, start)
    assert recalibrator.ingest(drive[-1])  # the scene of the last keyframe is new again


@pytest.mark.parametrize("interruption", ["reset", "configure"])
def test_running_estimate_is_discarded_after(drive, start, interruption):
    recalibrator = taken_in(drive[:2], start)
    before = recalibrator.current
    done = []

    def progress(stage: str, share: float) -> None:
        if not done:
            done.append(stage)
            other = threading.Thread(target=interrupt)  # as from a service callback
            other.start()
            other.join(10)
            assert not other.is_alive()

    def interrupt() -> None:
        if interruption == "reset":
            recalibrator.reset()
        else:
            recalibrator.configure(replace(CONFIG, image=ImageConfig(max_width=320)))

    extrinsic = recalibrator.estimate(progress)
    assert done == ["search"]
    assert extrinsic.result.status == INITIAL
    assert np.array_equal(recalibrator.current.result.T_camera_lidar, before.result.T_camera_lidar)
    assert recalibrator.current.accepted == 0


@pytest.mark.parametrize("interruption", ["reset", "configure"])
def test_features_in_extraction_are_dropped_after(drive, start, interruption, monkeypatch):
    recalibrator = taken_in(drive[:1], start)
    extract = recalibrator.calibrator.extract

    def interrupted(frame: Frame):
        features = extract(frame)
        if interruption == "reset":
            recalibrator.reset()
        else:
            recalibrator.configure(replace(CONFIG, image=ImageConfig(max_width=320)))
        return features

    monkeypatch.setattr(recalibrator.calibrator, "extract", interrupted)
    recalibrator.ingest(drive[1])
    assert len(recalibrator.buffer) == 0
    assert not recalibrator.ready()
    assert recalibrator.ingest(drive[1]) or interruption == "reset"


def test_configure_keeps_keyframes_whose_features_stay_the_same(drive, start):
    recalibrator = taken_in(drive, start)
    recalibrator.estimate()
    recalibrator.configure(update(CONFIG, {"search": {"seed": 5}, "refine": {"max_p_value": 0.02}, "online": {"buffer_size": 3}}))
    assert [f.name for f in recalibrator.buffer] == [f.name for f in drive[-3:]]
    assert recalibrator.calibrator.config.search.seed == 5
    assert recalibrator.current.accepted == 1
    recalibrator.configure(update(recalibrator.config, {"online": {"similarity_threshold": 0.5, "buffer_size": 10}}))
    assert recalibrator.selector.config.similarity_threshold == 0.5
    assert recalibrator.buffer.maxlen == 10


@pytest.mark.parametrize(
    "change", [{"image": {"max_width": 320}}, {"lidar": {"max_range": 30.0}}, {"score": {"weight_reflectivity": 0.2}}]
)
def test_configure_drops_keyframes_whose_features_change(drive, start, change):
    recalibrator = taken_in([drive[0], drive[-1]], start)
    recalibrator.estimate()
    recalibrator.configure(update(CONFIG, change))
    assert len(recalibrator.buffer) == 0
    assert not recalibrator.ready()
    assert recalibrator.current.accepted == 1  # the extrinsic stays
    # Even a standing vehicle's scene is taken in again, with the new constants.
    assert recalibrator.ingest(drive[-1])
    fresh = Calibrator(drive[0].camera, update(CONFIG, change)).extract(drive[-1])
    assert np.array_equal(recalibrator.buffer[0].points.xyz, fresh.points.xyz)
    assert all(np.array_equal(a.maps, b.maps) for a, b in zip(recalibrator.buffer[0].levels, fresh.levels, strict=True))


def test_ingest_during_an_estimate(drive, start, truth):
    """Frames keep coming while estimates run: nothing is lost, nothing breaks."""
    recalibrator = taken_in(drive, start)
    errors = []

    def feed() -> None:
        try:
            for k in range(8):
                recalibrator.selector.reset()
                recalibrator.ingest(replace(drive[k % FRAMES], stamp=drive[-1].stamp + k * NANOSECONDS, cloud_stamp=None))
        except Exception as error:  # reported below
            errors.append(error)

    thread = threading.Thread(target=feed)
    thread.start()
    results = [recalibrator.estimate().result for _ in range(3)]
    thread.join(30)
    assert errors == []
    assert recalibrator.keyframes_seen == FRAMES + 8
    assert len(recalibrator.buffer) == FRAMES
    assert all(r.frames_used == FRAMES for r in results)
    assert near(recalibrator.current.result.T_camera_lidar, truth)


def test_lidar_constants_reach_the_features(drive, start):
    near_only = taken_in(drive[:1], start, replace(CONFIG, lidar=LidarConfig(max_range=15.0)))
    assert np.linalg.norm(near_only.buffer[0].points.xyz, axis=1).max() < 15.3
    assert np.linalg.norm(taken_in(drive[:1], start).buffer[0].points.xyz, axis=1).max() > 40
