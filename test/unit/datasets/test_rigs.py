"""The synthetic rigs: scanners as their data sheets say, and an exact truth in every one of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import RenderedDrive, on_pixels_of_their_class

from calib_ros import se3
from calib_ros.datasets.open import open_dataset
from calib_ros.frame import UNLABELLED
from calib_ros.frame import SemanticClass as Label
from calib_ros_synthetic import camera, lidar, rays, scanners, wide
from calib_ros_synthetic.camera import CONDITIONS
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_synthetic.rig import RigPair
from calib_ros_synthetic.rigs import PAIRS, RIGS
from calib_ros_synthetic.scanners import MODELS, scanner
from calib_ros_synthetic.scenes import SCENES
from calib_ros_synthetic.solids import Solids
from calib_ros_synthetic.wide import WideView

SPINNING = [name for name, model in MODELS.items() if model.firings > 1 and model.table is not None]


def agreement(drive: SyntheticDrive, T: np.ndarray) -> float:
    """Share of the points of frame 1 that fall on a pixel of their own class, within a pixel."""
    own, same = on_pixels_of_their_class(drive, 1, T, 1)
    assert np.count_nonzero(own != UNLABELLED) > 100
    return float(same[own != UNLABELLED].mean())


@pytest.mark.parametrize("name", SPINNING)
def test_a_scanner_follows_its_data_sheet(name: str) -> None:
    model, device = MODELS[name], scanner(name)
    beams, time = device.beams()
    assert model.table is not None
    elevation, offset, _ = model.table()
    rings, firings = beams.shape[1:]
    assert (rings, firings) == (len(elevation), model.firings)
    np.testing.assert_allclose(np.linalg.norm(beams, axis=0), 1, atol=1e-6)
    angle = np.rad2deg(np.arcsin(beams[2]))
    np.testing.assert_allclose(angle, np.broadcast_to(np.sort(elevation)[::-1, None], angle.shape), atol=1e-4)
    assert np.abs(time).max() < 0.0501
    # The head turns clockwise: from one column to the next the azimuth rises and the time falls.
    azimuth = np.unwrap(np.arctan2(beams[1], beams[0]).astype(float), axis=1)
    np.testing.assert_allclose(np.diff(azimuth, axis=1), 2 * np.pi / firings, atol=1e-5)
    np.testing.assert_allclose(np.diff(time, axis=1), -0.1 / firings, atol=1e-9)
    # What is left of the azimuth after the head's turn is the column the laser stands in.
    left = np.rad2deg(np.mod(azimuth[:, 0] + 2 * np.pi * 10 * time[:, 0] + np.pi, 2 * np.pi) - np.pi)
    np.testing.assert_allclose(left, offset[np.argsort(-elevation, kind="stable")], atol=1e-3)


@pytest.mark.parametrize(
    ("name", "channels", "points", "field_deg", "step_deg"),
    [("rs_m1", 5, 78_750, (120.0, 25.0), 0.2), ("ft120", 1, 19_200, (100.0, 75.0), 0.63)],
)
def test_a_solid_state_scanner_looks_ahead_along_lines(name, channels, points, field_deg, step_deg) -> None:
    beams, time = scanner(name).beams()
    order = scanner(name).order(time)
    x, y, z = beams[:, 0, order].astype(float)
    assert len(x) == points
    assert x.min() > 0
    level, middle = np.abs(z) < 0.02, np.abs(y) < 0.02  # along the axes: pictures of a lens are no boxes
    assert np.ptp(np.rad2deg(np.arctan2(y, x)[level])) == pytest.approx(field_deg[0], rel=0.06)
    assert np.ptp(np.rad2deg(np.arcsin(z[middle]))) == pytest.approx(field_deg[1], rel=0.06)
    channel = np.stack([x, y, z], axis=1).reshape(-1, channels, 3)
    step = np.rad2deg(np.arccos((channel[1:] * channel[:-1]).sum(axis=2).clip(-1, 1)))
    assert np.median(step) == pytest.approx(step_deg, rel=0.1)
    assert time.max() - time.min() <= 0.1
    assert (np.diff(time[0, order]) >= 0).all()


@pytest.mark.parametrize("name", ["vlp16_narrow", "os1_64_robot"])
def test_clouds_are_stored_as_the_driver_stores_them(name: str) -> None:
    model = MODELS[str(RIGS[name].sensors["lidar"].kind)]
    cloud = SyntheticDrive(1, 2, rig=name, width=96, noise=0)[1].cloud
    ring, time = cloud.ring, cloud.time
    assert ring is not None
    assert time is not None
    elevation = np.arcsin(cloud.xyz[:, 2] / np.linalg.norm(cloud.xyz, axis=1))
    order = -ring if model.from_top else ring
    assert np.corrcoef(order, elevation)[0, 1] > 0.99
    assert (np.diff(ring if model.by_rows else time) >= 0).all()


QUICK = ("hdl32e_front", "os1_64_robot")


@pytest.mark.parametrize("rig", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in PAIRS])
def test_points_fall_on_pixels_of_their_class_in_every_rig(rig: str) -> None:
    scene = list(SCENES)[PAIRS.index(rig) % 2]  # houses or woods: other scenes are beside each other below
    drive = RenderedDrive(seed=2, frames=4, rig=rig, scene=scene, width=320, noise=0, speed=0)
    true = agreement(drive, drive.reference)
    # What stands between the two sensors is seen by one of them only.
    apart = np.linalg.norm(np.subtract(*(sensor.pose()[:3, 3] for sensor in RIGS[rig].sensors.values())))
    assert true > (0.95 if apart < 0.5 else 0.89)
    for axis in np.eye(3):
        assert agreement(drive, se3.perturb(drive.reference, 3 * axis, np.zeros(3))) < true - 0.01


@pytest.mark.parametrize("scene", [pytest.param(n, marks=() if n in ("park", "warehouse") else pytest.mark.slow) for n in SCENES])
def test_every_scene_is_its_own(scene: str) -> None:
    drive = RenderedDrive(seed=2, frames=4, rig="os1_64_robot", scene=scene, width=240, noise=0, speed=0)
    assert agreement(drive, drive.reference) > 0.93
    frame = drive[1]
    share = np.bincount(frame.classes.ravel(), minlength=256) / frame.classes.size
    assert (share[Label.SKY] < 0.06) == (scene in ("car_park", "warehouse"))
    if scene in ("trees", "park"):
        assert share[Label.BUILDING] == 0
        assert share[Label.VEGETATION] > 0.15
    assert np.mean(frame.cloud.label == Label.GROUND) > 0.05


def test_a_cloud_in_the_frame_of_the_vehicle_hides_where_the_scanner_is() -> None:
    drive = RenderedDrive(seed=3, frames=3, rig="hdl64e_waymo", width=96, noise=0)
    frame = drive[1]
    assert drive.lidar_frame == "base_link"
    assert frame.compensated
    assert frame.cloud.ring is None
    assert frame.cloud.time is None
    assert np.abs(frame.cloud.xyz[:, 1]).max() <= 22.0
    ground = drive[1].cloud.label == Label.GROUND
    assert abs(np.median(frame.cloud.xyz[ground, 2])) < 0.15  # the origin is on the ground
    assert frame.cloud.intensity is not None
    assert frame.cloud.intensity.max() > 1000


def test_a_triggered_camera_takes_its_picture_when_the_scan_sweeps_it() -> None:
    drive = SyntheticDrive(1, 2, rig="hdl32e_side", width=96, noise=0)
    frame, cloud = drive[1], drive[1].cloud
    assert cloud.time is not None
    assert (frame.stamp - (frame.cloud_stamp or 0)) * 1e-9 == pytest.approx(-55 / 360 * 0.05, abs=0.0006)
    assert cloud.time.max() - cloud.time.min() == pytest.approx(0.05, abs=0.002)  # 20 Hz
    uv, inside = drive.camera.project(se3.transform(drive.reference, cloud.xyz))
    middle = inside & (np.abs(uv[:, 0] - drive.camera.width / 2) < 6)
    assert abs(np.median(cloud.time[middle]) - (frame.stamp - (frame.cloud_stamp or 0)) * 1e-9) < 0.002


def test_the_own_vehicle_stays_where_it_is_in_picture_and_scan() -> None:
    drive = RenderedDrive(seed=1, frames=4, rig="os1_128_windshield", width=160, noise=0)
    seen = [drive[i].classes == UNLABELLED for i in (0, 3)]
    np.testing.assert_array_equal(*seen)
    assert 0.1 < seen[0].mean() < 0.35
    assert seen[0][-1].mean() > 0.9
    hit = [drive[i].cloud.xyz[drive[i].cloud.label == UNLABELLED] for i in (0, 3)]
    assert len(hit[0]) > 500
    assert len(hit[0]) == len(hit[1])
    np.testing.assert_allclose(hit[0], hit[1], atol=1e-4)


def test_a_twist_is_carried_to_another_frame() -> None:
    T = se3.from_parts(se3.rotation_from_euler(0.3, -0.1, 2.0), [1.0, -2.0, 0.5])
    twist = np.array([0.1, -0.2, 0.3, 4.0, 0.5, -0.2])
    expected = se3.log(se3.inverse(T) @ se3.exp(twist * 0.1) @ T) / 0.1
    np.testing.assert_allclose(scanners.in_frame(twist, T), expected, atol=1e-9)


def test_source_text_with_names() -> None:
    text = "synthetic:seed=5,frames=8,rig=os1_128_windshield,scene=park"
    for fields, names in (("xyz", []), ("xyzir", ["intensity", "ring"])):
        cloud = SyntheticDrive(1, 1, rig="vlp16_narrow", width=64, fields=fields)[0].cloud
        assert [n for n in ("intensity", "ring", "time") if getattr(cloud, n) is not None] == names
    drive = open_dataset(text)
    assert isinstance(drive, RigPair)
    assert drive.name == text
    assert "os1_128_windshield" in drive.describe()["rig"]
    assert drive.rig.speed == SCENES["park"].cruise
    assert SyntheticDrive(rig="os1_64_robot").rig.speed == RIGS["os1_64_robot"].top_speed


PICTURE = {"width": 160, "seed": 2, "frames": 3, "rig": "vlp16_narrow"}


def test_conditions_change_the_picture_and_not_the_truth() -> None:
    drives = {name: RenderedDrive(**PICTURE, condition=name, speed=10.0, noise=0.0) for name in CONDITIONS}  # type: ignore[arg-type]
    pictures = {name: drive[1].image.astype(float) for name, drive in drives.items()}
    for name, drive in drives.items():
        np.testing.assert_array_equal(drive.reference, drives["clear"].reference)
        if name != "clear":
            assert np.abs(pictures[name] - pictures["clear"]).mean() > 0.4, name
    assert pictures["night"].mean() < 0.4 * pictures["clear"].mean()
    contrast = {name: np.abs(np.diff(p.mean(axis=2)[: p.shape[0] // 2], axis=1)).mean() for name, p in pictures.items()}
    assert contrast["haze"] < 0.7 * contrast["clear"]
    assert len(drives["haze"][1].cloud) < len(drives["clear"][1].cloud)
    for name in ("rain", "blur", "jpeg"):
        np.testing.assert_array_equal(drives[name][1].classes, drives["clear"][1].classes)


def test_the_rows_of_a_rolling_shutter_are_taken_one_after_the_other() -> None:
    parameters = dict(PICTURE, noise=0.0, speed=15.0)
    still, rolling = (SyntheticDrive(**parameters, condition=c) for c in ("clear", "rolling"))  # type: ignore[arg-type]
    picture = rolling[1].image.astype(float)

    def difference(image: np.ndarray) -> np.ndarray:
        return np.abs(image - picture).mean(axis=(1, 2))

    rows = len(picture)
    at_once = difference(still[1].image)
    assert at_once[rows // 2 - 4 : rows // 2 + 4].mean() < 0.5 * at_once[: rows // 4].mean()
    # The last row is the picture of a camera that was there half the readout later.
    for age, end in ((0.5, slice(0, 3)), (-0.5, slice(-3, None))):
        other = difference(still.moved(1, still.reference, age * CONDITIONS["rolling"].readout).image)
        assert other[end].mean() < 0.5 * at_once[end].mean()


def test_a_fisheye_sees_beside_and_behind_itself() -> None:
    drive = SyntheticDrive(1, 2, rig="os1_128_fisheye", width=240, noise=0, speed=0)
    view = drive.rig.view("camera")
    assert isinstance(view, WideView)
    assert view.z.min() < 0
    norm = np.sqrt(view.x**2 + view.y**2 + view.z**2)
    np.testing.assert_allclose(norm[view.seen], 1, atol=1e-5)
    angle = np.rad2deg(np.arccos(np.clip(view.z, -1, 1)))
    assert angle[view.seen].max() == pytest.approx(95, abs=0.6)
    assert drive[1].image[~view.seen].mean() < 2
    # Ahead it is the lens of Camera.project.
    ahead = view.seen & (angle < 70)
    directions = np.stack([view.x, view.y, view.z], -1)[ahead]
    uv, _ = drive.camera.project(10 * directions)
    v, u = np.nonzero(ahead)
    np.testing.assert_allclose(uv, np.stack([u, v], -1), atol=0.02)


def test_a_mid_360_never_repeats_and_sees_all_around() -> None:
    device = scanner("mid360")
    first, second = (replace(device, number=k).beams()[0] for k in (0, 1))
    assert np.abs(first - second).max() > 0.1
    elevation = np.rad2deg(np.arcsin(first[2, 0]))
    assert elevation.min() == pytest.approx(-7, abs=0.5)
    assert elevation.max() == pytest.approx(52, abs=0.5)
    azimuth = np.sort(np.arctan2(first[1, 0], first[0, 0]))
    assert np.rad2deg(np.diff(azimuth).max()) < 1
    drive = SyntheticDrive(1, 2, rig="mid360_90", width=64)
    assert drive[1].cloud.ring is None
    assert "rosette" in SyntheticDrive(1, rings=0).describe()["LiDAR"]
    assert len(drive[1].cloud) > 8000


PLACES = [{"rig": "vlp16_narrow"}, {"rig": "os1_128_fisheye"}, {"rings": 16, "height": 60, "tilt_deg": 2.0}]
LONG = pytest.param({"rig": "mid360_90"}, marks=pytest.mark.slow, id="mid360_90")


@pytest.mark.parametrize("place", [*PLACES, LONG], ids=lambda place: next(iter(place.values())))
def test_trying_every_solid_on_every_ray_finds_no_more(place, monkeypatch: pytest.MonkeyPatch) -> None:
    """Solids are cast on the rays of their windows only."""
    for module in (rays, scanners, wide):
        monkeypatch.setattr(module, "SMALLEST", 0.0)
    drive = {"seed": 4, "frames": 1, "width": 96, "noise": 0.0, **place}
    expected, rng = SyntheticDrive(**drive)[0], np.random.default_rng(0)

    def everywhere(own: rays.Rays, solids: Solids, jobs: rays.Jobs, t: np.ndarray, ids: np.ndarray) -> None:
        """All solids also on a tenth of the columns, drawn anew for every grid."""
        rays.cast(own, solids, jobs, t, ids)
        columns = rng.choice(t.shape[1], -(-t.shape[1] // 10), replace=False)
        some, hit = t[:, columns], ids[:, columns]
        rays.cast(own.window(slice(None), columns), solids, rays.Jobs.whole(len(solids), some.shape), some, hit)
        t[:, columns], ids[:, columns] = some, hit

    for module in (camera, lidar):
        monkeypatch.setattr(module, "cast", everywhere)
    found = SyntheticDrive(**drive)[0]
    np.testing.assert_array_equal(found.cloud.xyz, expected.cloud.xyz)
    assert np.mean(found.image != expected.image) < 1e-3
