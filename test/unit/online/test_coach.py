"""The coach: which axes are weak, what shows them, how far it is; and on synthetic rigs whether following it helps."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import RenderedDrive

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config, update
from calib_ros.config.online import MANUAL
from calib_ros.lidar.edges import UPWARD
from calib_ros.online.coach import LYING, STANDING, Advice, Counted, Need, Sight, advise, need, sights
from calib_ros.online.sensor_health import SensorFault
from calib_ros.online.tracker import Confirmations
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import (
    BLINDED,
    CONVERGED,
    INITIAL,
    INSUFFICIENT,
    MOVED,
    REFUSED,
    SUSPECT,
    TENTATIVE,
    Cause,
    RefusalCode,
    Result,
)

CONFIG = Config()  # wanted are 0.25 deg and 5 cm
UPRIGHT = se3.from_parts(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), [0, 0, 0])
ON_ITS_SIDE = se3.from_parts(np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]), [0, 0, 0])
CAMERA = Camera(np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]]), 640, 480)
KNOWN = 0.1  # of what is wanted
CONFIRM = Confirmations(5, 1)


def covariance(**sigma: float) -> np.ndarray:
    """(6, 6) of axes in units of what is wanted, independent of each other."""
    axes = ("pitch", "yaw", "roll", "sideways", "height", "forward")
    wanted = np.repeat([np.deg2rad(0.25), 0.05], 3)
    return np.diag(np.square(wanted * [sigma.get(axis, KNOWN) for axis in axes]))


def at_one_distance(Z: float, rad: float) -> np.ndarray:
    """All edges are Z ahead: a pitch of `rad` and a height of Z times that cannot be told apart."""
    along = np.array([1.0, 0, 0, 0, Z, 0]) * rad
    return covariance() + np.outer(along, along)


def lacking(C: np.ndarray) -> Need:
    found = need(Result(UPRIGHT, INSUFFICIENT, covariance=C), CONFIG)
    assert found is not None
    return found


def advice(status: str = INSUFFICIENT, C: np.ndarray | None = None, config: Config = CONFIG, **more: object) -> Advice:
    counted = {name: more.pop(name) for name in list(more) if name in Counted.__dataclass_fields__}
    return advise(Result(UPRIGHT, status, covariance=C, **more), config, CAMERA, Counted(**{"keyframes": 9, **counted}))


# ---- directions -----------------------------------------------------------------------------------------------------------


def test_weak_axes_are_named_weakest_first_and_rotations_compare_with_shifts() -> None:
    assert lacking(covariance()).weak == ()
    assert lacking(covariance(forward=2.0)).weak == ("forward",)
    assert lacking(covariance(roll=1.5, sideways=3.0, yaw=2.0)).weak == ("sideways", "yaw", "roll")
    # 1 deg of pitch is four times what is wanted, and as a height 10 m away 3.5 times.
    assert lacking(at_one_distance(10.0, np.deg2rad(1.0))).weak == ("pitch", "height")
    assert lacking(at_one_distance(20.0, np.deg2rad(1.0))).weak == ("height", "pitch")
    assert lacking(at_one_distance(2.0, np.deg2rad(1.0))).weak == ("pitch",)


def test_what_no_scene_shows_is_not_asked_for_and_a_refused_optimum_is_measured_by_its_tolerance() -> None:
    C = covariance(yaw=3.0)
    assert need(Result(UPRIGHT, CONVERGED, covariance=C, shared_covariance=C - covariance()), CONFIG).weak == ()
    assert need(Result(UPRIGHT, REFUSED), CONFIG) is None
    refused = Result(UPRIGHT, REFUSED, refusal=RefusalCode.TOO_UNCERTAIN, optimum_covariance=covariance(roll=0.8))
    assert need(refused, CONFIG).weak == ("roll",)  # 0.5 deg with 90 % are three axes of 0.18 deg
    assert need(refused, update(CONFIG, {"refine": {"tolerance_deg": 1.0}})).weak == ()


def asked_for(C: np.ndarray, T: np.ndarray = UPRIGHT, camera: Camera = CAMERA) -> list[Sight]:
    return list(sights(lacking(C), camera, T))


@pytest.mark.parametrize(
    ("C", "asked"),
    [
        (covariance(height=2.0), "horizontal edges nearer than 20 m (parked cars, low walls, kerbs)"),
        (covariance(sideways=2.0), "vertical edges nearer than 20 m (poles, trunks, corners of buildings)"),
        (covariance(forward=2.0), "edges nearer than 12 m towards the sides of the image (parked cars, walls, poles)"),
        (covariance(roll=3.0, forward=2.0), "edges nearer than 12 m towards the sides of the image (parked cars, walls, poles)"),
        (covariance(roll=2.0), "edges at any distance towards the sides of the image"),
        (covariance(yaw=2.0), "vertical edges at any distance (poles, trunks, corners of buildings)"),
        (
            at_one_distance(20.0, np.deg2rad(1.0)),
            "horizontal edges nearer than 11 m (parked cars, low walls, kerbs), and horizontal edges farther than 34 m",
        ),
        (
            covariance(pitch=2, yaw=2, roll=2, height=2),
            "poles, buildings or parked cars nearer than 11 m, and others farther than 34 m",
        ),
    ],
)
def test_what_shows_an_axis_follows_from_geometry(C: np.ndarray, asked: str) -> None:
    assert ", and ".join(map(str, asked_for(C))) == asked


def test_a_camera_on_its_side_sees_poles_lie() -> None:
    assert [sight.edges for sight in asked_for(covariance(height=2.0), ON_ITS_SIDE)] == [STANDING[0]]
    assert [sight.edges for sight in asked_for(covariance(sideways=2.0), ON_ITS_SIDE)] == [LYING[0]]


# ---- states ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("told", "text"),
    [
        (advice(CONVERGED, covariance()), ""),
        (advice(INITIAL, keyframes=0), "no keyframe yet: drive where there are poles, buildings or parked cars, in light"),
        (advice(INITIAL, keyframes=3), "keep driving: 3 of 5 keyframes, each of another view"),
        (advice(INITIAL), "keep driving: an estimate is due"),
        (advice(INITIAL, config=update(CONFIG, {"online": {"mode": MANUAL}})), "call ~/calibrate"),
        (
            advice(C=covariance(roll=2.0)),
            "not known well enough: roll; drive past edges at any distance towards the sides of the image",
        ),
        (advice(TENTATIVE, covariance(), missing=Confirmations(4, 1), of_all=CONFIRM), "keep driving: 1 of 5 further keyframes"),
        (advice(TENTATIVE, covariance(), missing=Confirmations(clocks=1), of_all=CONFIRM), "drive at another speed"),
        (advice(MOVED, covariance(), missing=Confirmations(5, 3), of_all=Confirmations(5, 4)), "3 further estimates"),
        (advice(SUSPECT, covariance()), "keep driving: the newest keyframes decide"),
        (advice(BLINDED, covariance(), fault=SensorFault.CAMERA_BLIND), "clean or uncover the camera"),
        (advice(BLINDED, covariance(), fault=SensorFault.LIDAR_BLIND), "clean or uncover the LiDAR"),
        (advice(REFUSED, refusal=RefusalCode.NOT_SIGNIFICANT), "drive where there are poles, buildings or parked cars"),
        (advice(REFUSED, refusal=RefusalCode.WRONG_INTRINSICS, cause=Cause.FOCAL_LENGTH), "calibrate the camera's intrinsics"),
        (advice(REFUSED, refusal=RefusalCode.WRONG_TIMES, cause=Cause.TIME_OFFSET), "mend the time stamps"),
        (advice(REFUSED, covariance()), "keep driving: more keyframes decide"),
    ],
)
def test_every_state_has_its_advice(told: Advice, text: str) -> None:
    assert text in told.text
    assert bool(told.text) == bool(text)
    assert (told.progress == 1.0) == (not told.text or told.text.endswith("more keyframes decide"))


def test_progress_rises_with_keyframes_information_and_confirmations() -> None:
    """In per cent; the least known direction alone counts, as the information about it."""
    steps = [advice(INITIAL, keyframes=k, missing=CONFIRM, of_all=CONFIRM) for k in range(6)]
    steps += [advice(C=covariance(roll=sigma, yaw=1.2), missing=CONFIRM, of_all=CONFIRM) for sigma in (4, 3, 2, 1.5, 1.3)]
    steps += [advice(C=covariance(yaw=1.2), missing=Confirmations(k, 1), of_all=CONFIRM) for k in (4, 2, 0)]
    steps += [advice(TENTATIVE, covariance(), missing=Confirmations(0, 1), of_all=CONFIRM), advice(CONVERGED, covariance())]
    progress = [one.progress for one in steps]
    assert progress == sorted(progress)
    assert (progress[0], progress[-1]) == (0.0, 1.0)
    assert len(set(progress)) == len(progress)
    assert advice(C=covariance(roll=2.0)).progress == pytest.approx((1 + 1 / 4) / 2)


def test_the_time_that_remains_follows_from_the_pace_of_keyframes() -> None:
    assert advice(INITIAL, keyframes=2, per_s=0.5, missing=CONFIRM).remaining_s == (3 + 5) / 0.5
    assert advice(INITIAL, keyframes=2).remaining_s is None
    # Twice the wanted sigma after 8 keyframes: four times as many are needed.
    assert advice(C=covariance(roll=2.0), fused=8, per_s=0.5).remaining_s == pytest.approx(3 * 8 / 0.5, abs=2)
    refused = {"refusal": RefusalCode.TOO_UNCERTAIN, "optimum_covariance": covariance(roll=1.0), "frames_used": 6}
    assert advice(REFUSED, **refused, per_s=1.0).remaining_s == pytest.approx(6 * ((0.25 / 0.1755) ** 2 - 1), abs=1)
    assert advice(BLINDED, covariance(), per_s=1.0).remaining_s is None
    assert advice(CONVERGED, covariance(), per_s=1.0).remaining_s == 0.0


# ---- whether it helps -----------------------------------------------------------------------------------------------------

ELSEWHERE = ("street", "warehouse", "trees")


def shown(f: FrameFeatures, T: np.ndarray, camera: Camera, sight: Sight) -> int:
    """How many edge points of a frame are what is asked for."""
    p = se3.transform(T, f.points.xyz)
    distance, inside = np.linalg.norm(p, axis=1), camera.project(p)[1]
    off_axis, upward = np.arctan2(np.hypot(p[:, 0], p[:, 1]), p[:, 2]), np.isin(f.points.kind, UPWARD)
    right = {LYING[0]: upward, STANDING[0]: ~upward}.get(sight.edges, True)
    outer = off_axis > np.deg2rad(camera.field_deg) / 4
    return int((inside & right & (sight.farther < distance) & (distance < sight.nearer) & (outer | (not sight.at_sides))).sum())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rig", "frames", "box", "status"),
    [
        ("vlp16_narrow", 3, SearchBox(2.0, 0.2), REFUSED),  # guard rails 30 m away in a picture of 34 deg
        ("vlp16_upside_down", 2, None, CONVERGED),
    ],
)
def test_what_the_coach_asks_for_shows_what_a_highway_hides(rig: str, frames: int, box: SearchBox | None, status: str) -> None:
    """As many frames more of the highway help less than those that show best what is asked for, one for each sight in turn."""
    drives = {name: RenderedDrive(seed=3, rig=rig, scene=name, frames=2 * frames, stride=20) for name in ("highway", *ELSEWHERE)}
    truth, calibrator = drives["highway"].reference, Calibrator(drives["highway"].camera)
    camera, start = calibrator.extract.camera, se3.perturb(truth, [0.6, -0.5, 0.6], [0.06, -0.05, 0.06])
    highway = [calibrator.extract(frame) for frame in drives["highway"]]
    pool = [calibrator.extract(drives[name][k]) for name in ELSEWHERE for k in range(2)]

    def estimated(features: list[FrameFeatures]) -> tuple[Need, float, Result]:
        result = calibrator.estimate(features, start, box)
        known = need(result, calibrator.config)
        assert known is not None, result.reason
        return known, se3.translation_error_m(truth, result.T_camera_lidar), result

    before, off_before, result = estimated(highway[:frames])
    assert result.status == status
    assert before.weak
    followed: list[FrameFeatures] = []
    asked = sights(before, camera, start)
    for k in range(frames):
        counts = [shown(f, truth, camera, asked[k % len(asked)]) for f in pool]
        followed.append(pool.pop(int(np.argmax(counts))))
    more, _, _ = estimated(highway)
    after, off_after, result = estimated(highway[:frames] + followed)
    assert result.status == CONVERGED, result.reason
    assert after.weak == ()
    assert after.variance < 0.5 * more.variance
    assert off_after < 0.5 * off_before
