"""The synthetic drive: its frames must be reproducible, and its truth exact."""

from __future__ import annotations

import itertools
import re

import numpy as np
import pytest
from paths import ROOT
from scenes import RenderedDrive, on_pixels_of_their_class

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame
from calib_ros.frame import SemanticClass as Label
from calib_ros_synthetic import rays
from calib_ros_synthetic.camera import CONDITIONS, Scene, render
from calib_ros_synthetic.drive import SyntheticDrive
from calib_ros_synthetic.rays import Rays, intersect
from calib_ros_synthetic.rig import open_drive
from calib_ros_synthetic.rigs import PAIRS, RIGS
from calib_ros_synthetic.scanners import PERIOD, scanner
from calib_ros_synthetic.scenes import SCENES
from calib_ros_synthetic.solids import Builder, Kind, Solids
from calib_ros_synthetic.street import Street

SIX = "six_cameras_one_lidar"
SMALL = {"rings": 16, "width": 160, "height": 96}
SHARP = {"rings": 32, "width": 620, "height": 188, "speed": 0, "noise": 0}


def agreement(drive: SyntheticDrive, frames: range, T: np.ndarray, reach: int = 0) -> dict[int, float]:
    """Class -> share of its points that fall on a pixel of the same class, or within `reach` pixels of one."""
    own, same = (
        np.concatenate(parts) for parts in zip(*(on_pixels_of_their_class(drive, i, T, reach) for i in frames), strict=True)
    )
    return {k: float(same[own == k].mean()) for k in range(10) if np.count_nonzero(own == k) > 30}


def test_frames_do_not_depend_on_the_order_of_access_nor_on_the_length() -> None:
    one, other = SyntheticDrive(2, frames=5, **SMALL), SyntheticDrive(2, frames=900, **SMALL)
    forward, back = [one[i] for i in range(3)], [other[i] for i in (2, 1, 0)][::-1]
    for a, b in zip(forward, back, strict=True):
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_array_equal(a.cloud.xyz, b.cloud.xyz)
        np.testing.assert_array_equal(a.cloud.intensity, b.cloud.intensity)
        np.testing.assert_array_equal(a.reference, b.reference)
    kept = one[0].image.copy()
    one[0].image[:] = 0
    np.testing.assert_array_equal(one[0].image, kept)  # a caller cannot change the drive
    assert not np.array_equal(forward[0].image, forward[1].image)


def test_seeds_give_different_streets() -> None:
    drives = [RenderedDrive(seed=seed, **SMALL, noise=0) for seed in range(3)]
    for a, b in itertools.combinations(drives, 2):
        assert (a[0].classes == b[0].classes).mean() < 0.9
        assert np.abs(a[0].image.astype(float) - b[0].image).mean() > 10
        assert se3.rotation_error_deg(a.reference, b.reference) > 0.3
    seen = np.unique(np.concatenate([d[i].cloud.label for d in drives for i in (0, 8)]))
    assert {Label.VEHICLE, Label.PERSON, Label.POLE, Label.SIGN, Label.BUILDING, Label.VEGETATION, Label.GROUND} <= set(
        seen.tolist()
    )
    assert Label.SKY not in seen


def test_length_indices_and_stamps() -> None:
    drive = SyntheticDrive(frames=2, stride=3, **SMALL)
    frames = list(drive)  # type: ignore[call-overload]
    assert len(frames) == len(drive) == 2
    assert [b.stamp - a.stamp for a, b in itertools.pairwise(frames)] == [300_000_000]
    assert all(isinstance(f, Frame) and f.cloud_stamp == f.stamp and f.camera == drive.camera for f in frames)
    np.testing.assert_array_equal(drive[-1].image, frames[1].image)
    for index in (2, -3):
        with pytest.raises(IndexError):
            drive[index]
    step = se3.inverse(drive.pose(0)) @ drive.pose(1)
    assert np.linalg.norm(step[:3, 3]) == pytest.approx(5.0 * 3 * PERIOD, rel=0.05)


@pytest.mark.parametrize("rings", [16, 32, 64, 128])
def test_a_cloud_is_sorted_as_in_kitti_and_its_time_follows_the_azimuth(rings: int) -> None:
    cloud = SyntheticDrive(1, rings=rings, width=160, height=96, noise=0, speed=8)[1].cloud
    xyz, ring, time, intensity = cloud.xyz.astype(float), cloud.ring, cloud.time, cloud.intensity
    assert ring is not None
    assert time is not None
    assert intensity is not None
    model = scanner(str(rings)).model
    assert model.table is not None
    degrees = model.table()[0]
    assert len(cloud) > 0.4 * rings * model.firings
    elevation = np.rad2deg(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))
    np.testing.assert_allclose(elevation, degrees[ring], atol=1e-3)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    np.testing.assert_allclose(time, -azimuth * PERIOD / (2 * np.pi), atol=1e-6)
    assert np.abs(time).max() <= PERIOD / 2
    order = ring * 10.0 + np.mod(azimuth, 2 * np.pi)
    assert (np.diff(order) > 0).all()
    distance = np.linalg.norm(xyz, axis=1)
    assert 0.9 < distance.min() < 6
    assert 50 < distance.max() < 100
    assert 0 <= intensity.min() < 0.1 < 0.5 < intensity.max() <= 1


def test_points_fall_on_pixels_of_their_class_with_the_true_extrinsic_only() -> None:
    drive = RenderedDrive(seed=2, **SHARP)
    frames = range(0, 20, 5)
    rosette = agreement(RenderedDrive(seed=2, **{**SHARP, "rings": 0}), range(0, 20, 10), drive.reference)
    assert min(rosette[Label.VEHICLE], rosette[Label.GROUND]) > 0.97
    true = agreement(drive, frames, drive.reference)
    assert true[Label.VEHICLE] > 0.98
    assert true[Label.GROUND] > 0.98
    assert agreement(drive, frames, drive.reference, reach=1)[Label.POLE] > 0.95
    for axis in np.eye(3)[:2]:
        turned = agreement(drive, frames, se3.perturb(drive.reference, axis, np.zeros(3)))
        assert turned[Label.VEHICLE] < true[Label.VEHICLE] - 0.02
    turned = agreement(drive, frames, se3.perturb(drive.reference, [0, 1, 0], np.zeros(3)), reach=1)
    assert turned[Label.POLE] < 0.5


def lens(model: str, f: float, *D: float) -> Camera:
    return Camera(np.array([[f, 0, 158.3], [0, f + 1, 121.1], [0, 0, 1]]), 320, 240, model, np.array(D))


LENSES = {
    "plumb_bob": lens("plumb_bob", 180, -0.30, 0.09, 1e-3, -5e-4, -0.01),
    "equidistant": lens("equidistant", 165, -0.02, 5e-3, -2e-3, 3e-4),
}


@pytest.mark.parametrize("name", LENSES)
def test_a_distorted_image_fits_camera_project(name: str) -> None:
    camera = LENSES[name]
    x, y, seen = rays.pixel_directions(camera)
    assert seen.all()
    back, _ = camera.project(np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3))
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    np.testing.assert_allclose(back.reshape(240, 320, 2), np.stack([u, v], -1), atol=0.01)

    drive = SyntheticDrive(2, rings=32, speed=0, noise=0, camera=camera)
    frames = range(0, 20, 7)
    true = agreement(drive, frames, drive.reference)
    assert true[Label.VEHICLE] > 0.97
    drive.camera = Camera(camera.K, camera.width, camera.height)  # as if the lens were ideal
    assert agreement(drive, frames, drive.reference)[Label.VEHICLE] < true[Label.VEHICLE] - 0.05


def box(centre: tuple[float, float, float], half: tuple[float, float, float], kind: Kind = Kind.BOX, **more: object) -> Solids:
    b = Builder()
    b.add(kind, Label.OTHER, centre, half, (0.02, 0.02, 0.02), **more)  # type: ignore[arg-type]
    return b.solids()


def crossing(line: np.ndarray, edge: float) -> float:
    """Where the grey levels (n,) within four pixels of the edge pass the middle of those on its two sides."""
    k = int(np.floor(edge)) - 3
    near = line[k : k + 8] - (line[k] + line[k + 7]) / 2
    j = int(np.flatnonzero(np.sign(near[:-1]) != np.sign(near[1:]))[0])
    return k + j + near[j] / (near[j] - near[j + 1])


def test_an_edge_in_the_image_is_where_the_projection_says() -> None:
    """The borders of a dark box high in the sky, at all positions relative to the pixels."""
    camera = Camera(np.array([[300.0, 0, 79.6], [0, 300, 50.3], [0, 0, 1]]), 160, 100)
    R = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # world axes: x right, y forward, z up
    street, view, origin = Street(0, 10.0), rays.CameraView(camera), np.array([0.0, 0.0, 30.0])
    errors = []
    for shift in np.linspace(0, 8 / 300, 16, endpoint=False):  # one pixel in all
        low, high = np.array([-0.6 + shift, -0.4 + shift, 8.0]), np.array([0.7 + shift, 0.5 + shift, 10.0])
        solids = box(tuple(R @ (low + high) / 2), tuple(np.abs(R @ (high - low) / 2)))
        image, _ = render(Scene(street, solids, origin, R), view, 0.0, np.random.default_rng(0))
        grey = image.mean(axis=2)
        (left, top), (right, bottom) = camera.project([low, [*high[:2], low[2]]])[0]  # of the front face
        row, column = grey[round((top + bottom) / 2)], grey[:, round((left + right) / 2)]
        errors.append([crossing(a, e) - e for a, e in ((row, left), (row, right), (column, top), (column, bottom))])
    assert np.abs(errors).max() < 0.25  # four rays per pixel know an edge to an eighth of a pixel
    assert np.abs(np.mean(errors, axis=0)).max() < 0.06


def test_solids_are_hit_where_they_are() -> None:
    d = np.array([[1.0, 0.0, 0.02], [1.0, 0.004, 0.0], [1.0, 0.5, 0.0]], np.float32)
    rays = Rays(tuple(np.zeros((1, 1), np.float32) for _ in range(3)), tuple(d[:, k][None] for k in range(3)))  # type: ignore[arg-type]

    def hits(solids: Solids) -> np.ndarray:
        return intersect(solids, 0, rays)[0]

    np.testing.assert_allclose(hits(box((10, 0, 0), (2, 1, 1)))[:2], [8, 8], rtol=1e-5)
    np.testing.assert_allclose(hits(box((10, 0, 0), (2, 2, 2), Kind.ELLIPSOID))[1], 8.0002, atol=1e-3)
    np.testing.assert_allclose(hits(box((10, 0, 0), (2, 1, 0.3), Kind.CYLINDER))[1], 8.001, atol=1e-3)
    np.testing.assert_allclose(hits(box((10, 0, 0), (2, 1, 2), Kind.WHEEL))[1], 8, atol=1e-3)
    # Half way up, a side that loses half of its size at the top has lost a quarter.
    np.testing.assert_allclose(hits(box((10, 0, 0), (2, 1, 1), Kind.FRUSTUM, taper=(0.5, 0.5)))[1], 8.5, atol=1e-3)
    assert np.isinf(hits(box((10, 0, 0), (2, 1, 1)))[2])
    # A pole of 4 cm radius 90 m away: in float32 only a careful formula finds it, and where it is.
    pole = hits(box((90, 0.36, 0), (0.04, 0.04, 5), Kind.CYLINDER))
    assert pole[1] == pytest.approx(89.96, abs=2e-3)
    assert np.isinf(pole[0])


def test_noise_has_the_stated_size_and_can_be_switched_off() -> None:
    clean, noisy = (RenderedDrive(seed=1, rings=32, width=160, height=96, noise=k, speed=0) for k in (0, 1))
    a, b = clean[2].cloud, noisy[2].cloud
    where = {(r, t): k for k, (r, t) in enumerate(zip(a.ring.tolist(), a.time.tolist(), strict=True))}  # type: ignore[union-attr]
    pairs = [(where[key], k) for k, key in enumerate(zip(b.ring.tolist(), b.time.tolist(), strict=True)) if key in where]  # type: ignore[union-attr]
    i, j = np.array(pairs).T
    ground = clean[2].cloud.label[i] == Label.GROUND
    error = (np.linalg.norm(b.xyz[j], axis=1) - np.linalg.norm(a.xyz[i], axis=1))[ground]
    assert 0.018 < 1.4826 * np.median(np.abs(error)) < 0.022
    assert abs(np.median(error)) < 0.001
    assert 0.9 < len(j) / len(a) < 0.999
    difference = noisy[2].image.astype(float) - clean[2].image
    assert 1.0 < difference.std() < 2.5
    np.testing.assert_array_equal(clean[2].classes, noisy[2].classes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("synthetic:sed=3", "seed, frames, rings"),
        ("synthetic:seed", "key=value"),
        ("synthetic:rings=20", "rings=20.*0, 16, 32, 64, 128"),
        ("synthetic:frames=abc", "frames=abc.*whole number"),
        ("synthetics", "no synthetic drive"),
        ("synthetic:rig=os2", f"rig=os2 is not known.*vlp16_narrow.*os1_128_windshield.*{SIX}"),
        ("synthetic:scene=moon", "scene=moon is not known.*street.*warehouse"),
        ("synthetic:condition=fog", "condition=fog is not known.*clear.*night"),
        ("synthetic:fields=all,fields=rgb", "fields=rgb is not known.*xyzi"),
        ("synthetic:rig=vlp16_narrow,rings=32", "rings=32 does not go with rig=vlp16_narrow"),
        (f"synthetic:rig={SIX},camera=top", "camera=top is not known; choose one of front, front_left"),
        (f"synthetic:rig={SIX},lidar=front", "lidar=front is not known; choose one of lidar_top"),
        (f"synthetic:rig={SIX},knock=roof", "knock=roof is not known; choose one of lidar_top, front"),
        (f"synthetic:rig={SIX},speed=0", "speed=0 does not go with several sensors"),
        (f"synthetic:rig={SIX},rings=32", "'rings=32' is not understood; write key=value with seed"),
        (f"synthetic:rig={SIX},knock_deg=90", "knock_deg=90 is not allowed; it must be a number from 0 to 20"),
    ],
)
def test_texts_that_name_no_drive_are_refused(text: str, message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        open_drive(text)


def test_the_page_lists_all_there_are() -> None:
    page = (ROOT / "docs" / "synthetic.md").read_text(encoding="utf-8")
    several = [name for name in RIGS if name not in PAIRS]
    for title, names in {"Rigs": PAIRS, "Scenes": SCENES, "Conditions": CONDITIONS, "Rigs of several sensors": several}.items():
        section = page.partition(f"## {title}\n")[2].partition("\n## ")[0].partition("\n| parameter")[0]
        rows = re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)
        assert (rows or re.findall(r"`(\w+)`", section)) == list(names), title


def test_source_text_and_bad_parameters() -> None:
    drive = SyntheticDrive.from_text(" synthetic:seed=3, frames=16,rings=32,width=640,height=480,speed=0,noise=0.5 ")
    assert [drive.rig.parameters[k] for k in ("seed", "frames", "rings", "speed", "noise")] == [3, 16, 32, 0.0, 0.5]
    assert (drive.camera.width, drive.camera.height) == (640, 480)
    again = SyntheticDrive.from_text(drive.name)
    assert again.name == drive.name
    assert again.rig.parameters == drive.rig.parameters
    assert SyntheticDrive.from_text("synthetic").name == SyntheticDrive().name
    assert all(isinstance(k, str) and isinstance(v, str) for k, v in drive.describe().items())
    wrong = [("seed", -1), ("frames", 0), ("frames", 2.5), ("frames", True), ("rings", 48), ("width", 10), ("height", 0)]
    wrong += [("speed", float("nan")), ("stride", 0), ("noise", -0.1), ("noise", "much"), ("tilt_deg", 90)]
    for name, value in wrong:
        with pytest.raises(BadInputError, match=f"{name}={value}.*from|{name}={value}.*one of"):
            SyntheticDrive(**{name: value})  # type: ignore[arg-type]


def test_the_extrinsic_can_be_given() -> None:
    rear = np.array([[0.0, 1, 0, 0], [0, 0, -1, 0.2], [-1, 0, 0, -0.3], [0, 0, 0, 1]])
    drive = RenderedDrive(seed=2, **SHARP, T_camera_lidar=rear)
    np.testing.assert_array_equal(drive.reference, rear)
    assert agreement(drive, range(0, 20, 10), rear)[Label.GROUND] > 0.97
    with pytest.raises(BadInputError, match="T_camera_lidar"):
        SyntheticDrive(T_camera_lidar=np.eye(3))
    nominal = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    assert se3.rotation_error_deg(nominal, SyntheticDrive(tilt_deg=1.5, **SMALL).reference) == pytest.approx(1.5)
