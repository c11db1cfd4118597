"""Recordings of rigs: a bag with all topics and its description, KITTI, nuScenes and synthetic rigs by a description."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sample_sources
import yaml
from bag_recorder import START, Recorder

from calib_ros import se3
from calib_ros.cli.main import main
from calib_ros.datasets import bag, kitti, nuscenes, open_dataset
from calib_ros.datasets.bag_file import BagFile
from calib_ros.datasets.bag_rig import BagRig
from calib_ros.datasets.open import open_rig
from calib_ros.datasets.recent import Recent
from calib_ros.datasets.rig import RigDescription, Sensor, rig_yaml
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS
from calib_ros.registration.initial_guess import nominal
from calib_ros.rig.description import read_rig
from calib_ros.rig.recorded import joined, recorded_rig
from calib_ros_synthetic.parameters import parsed
from calib_ros_synthetic.rig import SyntheticRig

TEXT = "synthetic:seed=3,frames=1,stride=4,width=96,noise=0.0,rig=two_lidars_three_cameras"


def described(reference: str, **sensors: dict[str, Any]) -> RigDescription:
    return RigDescription(tuple(Sensor(name, **values) for name, values in sensors.items()), reference)


def camera(topic: str = "", **more: Any) -> dict[str, Any]:
    return {"kind": "camera", "topic": topic, **more}


def lidar(topic: str = "", **more: Any) -> dict[str, Any]:
    return {"kind": "lidar", "topic": topic, **more}


@pytest.fixture(scope="module")
def rig() -> SyntheticRig:
    return SyntheticRig(**parsed(TEXT))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rig") / "drive"
    assert main(["convert", TEXT, str(path)]) == 0
    return path


@pytest.fixture
def description(written: Path) -> Any:
    data = yaml.safe_load(written.with_name("drive.rig.yaml").read_text(encoding="utf-8"))
    return described(data["reference"], **{name: {**own, "prior": None} for name, own in data["sensors"].items()})


def test_a_bag_has_every_topic_of_the_rig_in_the_order_of_stamps(written: Path, rig: SyntheticRig) -> None:
    opened = BagFile(written)
    counts = {topic.name: topic.messages for topic in opened.topics.values()}
    expected = {f"/{name}/points": len(rig.stamps(name)) for name in rig.lidars}
    expected |= {f"/{name}/{what}": len(rig.stamps(name)) for name in rig.cameras for what in ("image", "camera_info")}
    assert counts == expected | {"/tf_static": 1}
    recorded = [time for _, time, _ in opened.raw(list(counts))]
    assert recorded == sorted(recorded)
    data = yaml.safe_load(written.with_name("drive.rig.yaml").read_text(encoding="utf-8"))
    front = data["sensors"]["front"]
    assert data["reference"] == "lidar_left"
    assert "prior" not in data["sensors"]["lidar_left"]
    assert (front["kind"], front["topic"], front["camera_info"]) == ("camera", "/front/image", "/front/camera_info")
    R = se3.rotation_from_quaternion(front["prior"]["quaternion_xyzw"])
    np.testing.assert_allclose(se3.from_parts(R, front["prior"]["translation_m"]), rig.prior("front"), atol=1e-5)


def test_a_bag_gives_back_the_rig(written: Path, description: Any, rig: SyntheticRig, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[int] = []
    whole = bag.decode_cloud
    monkeypatch.setattr(bag, "decode_cloud", lambda message: decoded.append(1) or whole(message))
    read, heads = [], BagFile.heads
    monkeypatch.setattr(BagFile, "heads", lambda *given: read.append(1) or heads(*given))
    opened = open_rig(written, description)
    assert isinstance(opened, BagRig)
    assert (opened.cameras, opened.lidars) == (rig.cameras, rig.lidars)
    for name in (*rig.cameras, *rig.lidars):
        np.testing.assert_allclose(opened.reference(name), rig.reference(name), atol=1e-9)
        assert opened.frame_id(name) == rig.frame_id(name)
    np.testing.assert_allclose(opened.camera("left").K, rig.camera("left").K)
    pair = opened.pair("left", "lidar_right")
    assert opened.pair("left", "lidar_right") is pair
    frame = pair[3]
    np.testing.assert_allclose(frame.reference, se3.inverse(rig.reference("left")) @ rig.reference("lidar_right"), atol=1e-9)
    images, scans = rig.stamps("left").tolist(), rig.stamps("lidar_right").tolist()
    np.testing.assert_array_equal(frame.image, rig.picture("left", images.index(frame.stamp))[0])
    # The same scan for another camera, and by itself, is decoded once.
    at = scans.index(frame.cloud_stamp)
    np.testing.assert_array_equal(frame.cloud.xyz, rig.scan("lidar_right", at)[0].xyz)
    opened.pair("front", "lidar_right")
    decoded.clear()
    listed = opened.scans("lidar_right")
    assert listed.stamps.tolist() == scans
    stamp, cloud = listed[at]
    assert (stamp, cloud) == (frame.cloud_stamp, frame.cloud)
    other = opened.pair("right", "lidar_right")
    decoded.clear()
    stamps = [int(other._clouds.stamps[k]) for k in other._pairs[1]]
    assert other[stamps.index(stamp)].cloud is cloud
    assert not decoded
    assert len(read) == 1  # of the bag, for all pairs


def test_priors_tell_where_a_camera_looks_when_a_bag_has_no_transforms(written: Path, rig: SyntheticRig) -> None:
    by_prior = described(
        "lidar_left",
        lidar_left=lidar("/lidar_left/points", frame="a"),
        side=camera("/right/image", frame="b", prior=rig.prior("right")),
    )
    opened = open_rig(written, by_prior)
    assert opened.reference("side") is None
    # The camera on the right looks where the scan is 22 ms after its stamp.
    assert opened.pair("side", "lidar_left")._sweep_offset / NANOSECONDS == pytest.approx(80 / 3600, abs=0.01)  # type: ignore[attr-defined]
    with pytest.raises(BadInputError, match=r"on topic /rear/image; it has /front/image.*; set sensors\.rear\.topic"):
        open_rig(written, described("lidar_left", lidar_left=lidar("/lidar_left/points"), rear=camera("/rear/image")))


def test_a_synthetic_rig_under_other_names(rig: SyntheticRig) -> None:
    chosen = described("eye", eye=camera("front"), scanner=lidar("lidar_right"), left=camera("/left/image"))
    opened = open_rig(TEXT, chosen)
    assert (opened.cameras, opened.lidars, opened.reference_sensor) == (("eye", "left"), ("scanner",), "eye")
    np.testing.assert_allclose(opened.reference("eye"), np.eye(4), atol=1e-12)
    T = se3.inverse(rig.reference("front")) @ rig.reference("lidar_right")
    np.testing.assert_allclose(opened.reference("scanner"), T, atol=1e-12)
    np.testing.assert_allclose(opened.pair("eye", "scanner").reference, T, atol=1e-12)
    assert opened.frame_id("left") == "left_optical"
    assert len(opened.scans("scanner")) == 8
    with pytest.raises(BadInputError, match="has no camera roof; name by topic one that it has: front, left, right"):
        open_rig(TEXT, described("scanner", scanner=lidar("lidar_left"), roof=camera()))


def test_kitti_with_two_cameras_reads_a_scan_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sample_sources.kitti(tmp_path, "odometry")
    (tmp_path / "image_3").symlink_to(tmp_path / "image_2")
    P2, Tr = (tmp_path / "calib.txt").read_text(encoding="utf-8").splitlines()
    P3 = np.array(P2.split()[1:], float)
    P3[3] -= 0.5 * P3[0]
    (tmp_path / "calib.txt").write_text("\n".join([P2, "P3: " + " ".join(map(str, P3)), Tr]), encoding="utf-8")
    read, whole = [], kitti.read_scan
    monkeypatch.setattr(kitti, "read_scan", lambda path: read.append(path) or whole(path))
    opened = open_rig(tmp_path, described("velo", velo=lidar(), left=camera("2"), right=camera("3")))
    frames = [opened.pair(name, "velo")[1] for name in opened.cameras]
    stamp, cloud = opened.scans("velo")[1]
    assert len(read) == 1
    assert cloud is frames[0].cloud is frames[1].cloud
    assert stamp == frames[0].moment_of_cloud
    between = se3.inverse(opened.reference("left")) @ opened.reference("right")
    np.testing.assert_allclose(between[:3, 3], [0.5, 0, 0], atol=1e-5)
    assert opened.frame_id("right") == "camera_color_right"
    with pytest.raises(BadInputError, match="has one LiDAR, but the description has 2 and 1 cameras"):
        open_rig(tmp_path, described("a", a=lidar(), b=lidar(), left=camera("2")))


def test_nuscenes_by_its_channels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sample_sources.nuscenes(tmp_path)
    read, whole = [], nuscenes.read_sweep
    monkeypatch.setattr(nuscenes, "read_sweep", lambda path: read.append(path) or whole(path))
    opened = open_rig(tmp_path, described("CAM_FRONT", CAM_FRONT=camera(), LIDAR_TOP=lidar()))
    frame = opened.pair("CAM_FRONT", "LIDAR_TOP")[0]
    listed = opened.scans("LIDAR_TOP")
    assert frame.cloud in [cloud for _, cloud in listed]
    assert len(read) == len(listed)
    np.testing.assert_allclose(opened.reference("LIDAR_TOP"), frame.reference, atol=1e-9)
    with pytest.raises(BadInputError, match="has no camera CAM_ROOF; choose one of"):
        open_rig(tmp_path, described("LIDAR_TOP", LIDAR_TOP=lidar(), roof=camera("CAM_ROOF")))


def test_plain_folders_of_cameras_share_the_scans_of_one(tmp_path: Path) -> None:
    for name in ("front", "left"):
        sample_sources.plain(tmp_path / name)
    text = (tmp_path / "left/calibration.yaml").read_text(encoding="utf-8")
    moved = se3.inverse(se3.exp([0, 0, 0, 0.5, 0, 0])) @ nominal(0.0)
    (tmp_path / "left/calibration.yaml").write_text(f"{text.split('T_camera')[0]}T_camera_lidar: {moved.tolist()}", "utf-8")
    shutil.rmtree(tmp_path / "left/clouds")
    opened = open_rig(tmp_path, described("roof", roof=lidar(), eye=camera("front"), left=camera()))
    frames = [opened.pair(name, "roof")[0] for name in opened.cameras]
    listed = opened.scans("roof")
    assert listed.stamps.tolist() == [opened.pair("eye", "roof")[k].moment_of_cloud for k in range(2)]
    assert listed[0] == (frames[0].moment_of_cloud, frames[0].cloud)
    assert frames[0].cloud is frames[1].cloud
    between = se3.inverse(opened.reference("eye")) @ opened.reference("left")
    np.testing.assert_allclose(between[:3, 3], [0.5, 0, 0], atol=1e-9)
    assert (opened.frame_id("roof"), opened.frame_id("left")) == ("roof", "camera")


def test_plain_folders_with_lidars_and_a_calibration_beside_them(tmp_path: Path) -> None:
    for name in ("cam0", "a", "b"):
        sample_sources.plain(tmp_path / name)
    text = (tmp_path / "cam0/calibration.yaml").read_text(encoding="utf-8")
    (tmp_path / "calibration.yaml").write_text(text, encoding="utf-8")
    (tmp_path / "cam0/calibration.yaml").unlink()
    shutil.rmtree(tmp_path / "cam0/clouds")
    (tmp_path / "cam0/times.csv").unlink()
    (tmp_path / "cam0/images/0.bmp").unlink()
    opened = open_rig(tmp_path, described("a", a=lidar(), b=lidar(), cam0=camera()))
    frame = opened.pair("cam0", "b")[0]
    assert (frame.name, frame.stamp) == ("1", 10**8)  # counted among the clouds, not among the images
    assert opened.camera("cam0").width == 40
    assert opened.reference("a") is not None
    assert opened.reference("cam0") is None is frame.reference  # to which of the two is not said
    with pytest.raises(BadInputError, match=r"images of camera rear is missing; name by sensors.rear.topic .*: a, b, cam0"):
        open_rig(tmp_path, described("a", a=lidar(), cam0=camera(), rear=camera()))
    with pytest.raises(BadInputError, match=r"clouds of LiDAR roof is missing; name by sensors.roof.topic a folder"):
        open_rig(tmp_path, described("roof", roof=lidar(), cam0=camera()))


def test_what_is_no_recording_of_a_rig_is_said(tmp_path: Path, written: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(BadInputError, match=r"does not exist"):
        open_rig(tmp_path / "none", described("l", l=lidar(), c=camera()))
    with pytest.raises(BadInputError, match=r"has one camera, but the description has c, d"):
        open_rig("synthetic:frames=1,width=96", described("l", l=lidar(), c=camera(), d=camera()))
    assert main(["convert", TEXT, str(written), "--frames", "0:2"]) == 2
    assert main(["convert", TEXT, str(written)]) == 2
    assert "drive.rig.yaml exists already" in capsys.readouterr().err
    assert main(["convert", TEXT, str(tmp_path / "pair"), "--camera", "left"]) == 0
    assert "1 frames written" in capsys.readouterr().out


def test_the_newest_are_kept() -> None:
    made: list[int] = []
    recent = Recent(2)
    for key in (1, 2, 1, 3, 1, 2):
        assert recent(key, lambda key=key: made.append(key) or key) == key  # type: ignore[misc]
    assert made == [1, 2, 3, 2]


def test_a_pair_is_a_rig_of_one() -> None:
    text = "synthetic:frames=2,width=96,seed=2"
    description, opened, _ = recorded_rig(text)
    (eye,), (scanner,) = description.cameras, description.lidars
    source = open_dataset(text)
    assert (description.reference, opened.frame_id(eye)) == (scanner, source.camera_frame)
    np.testing.assert_allclose(description[eye].prior, se3.inverse(source.reference), atol=1e-12)
    assert [stamp for stamp, _ in opened.scans(scanner)] == [source[k].moment_of_cloud for k in range(2)]


def test_a_bag_states_its_rig(written: Path, rig: SyntheticRig, tmp_path: Path) -> None:
    description, opened, remarks = recorded_rig(str(written))
    assert set(description.cameras) == set(rig.cameras)
    assert set(description.lidars) == set(rig.lidars)
    assert description["left"].topic == "/left/image"
    reference = rig.reference(description.reference)
    for name in {*rig.cameras, *rig.lidars} - {description.reference}:
        expected = se3.inverse(reference) @ rig.reference(name)
        np.testing.assert_allclose(description[name].prior, expected, atol=1e-9)
        np.testing.assert_allclose(opened.reference(name), expected, atol=1e-9)
    assert f"poses are relative to {description.reference}, with which most cameras share a view" in remarks[-1]
    # What was assumed reads back as the same rig.
    file = tmp_path / "rig.yaml"
    file.write_text(rig_yaml(description))
    again = read_rig(file)
    assert [(own.name, own.kind, own.topic, own.frame) for own in again.sensors] == [
        (own.name, own.kind, own.topic, own.frame) for own in description.sensors
    ]
    np.testing.assert_allclose(again["front"].prior, description["front"].prior, atol=1e-5)


def test_topics_of_one_frame_are_one_sensor_and_merged_clouds_are_none(tmp_path: Path) -> None:
    with Recorder(tmp_path / "bag") as bag:
        for topic in ("/front/image_raw", "/front/image_rect", "/rear/image_raw"):
            bag.image(START, topic, frame=topic.split("/")[1])
        bag.info(START, "/front/camera_info")
        for topic, frame in (("/front/points_raw", "top"), ("/merged/points", "base_link")):
            bag.cloud(START, topic, frame=frame)
    description, _, remarks = recorded_rig(str(tmp_path / "bag"))
    assert [own.topic for own in description.sensors] == ["/front/points_raw", "/front/image_rect"]
    left = "\n".join(remarks)
    for words in ("/front/image_raw is left out: /front/image_rect is of", "base_link is no frame of", "/rear/image_raw is left"):
        assert words in left
    with pytest.raises(BadInputError, match=r"where front_image_rect are relative to front; record /tf_static"):
        joined(description, "bag", [])


def test_folders_of_sensors_are_a_rig(tmp_path: Path) -> None:
    for name in ("front", "left"):
        sample_sources.plain(tmp_path / name)
    description, opened, _ = recorded_rig(str(tmp_path))
    assert (description.lidars, description.cameras) == (("lidar",), ("front", "left"))  # the same clouds twice are one LiDAR
    assert len(opened.pair("left", "lidar")) == len(opened.pair("front", "lidar"))
    cloud = next((tmp_path / "left/clouds").iterdir())
    cloud.write_bytes(cloud.read_bytes() + b"0 0 0")
    assert set(recorded_rig(str(tmp_path))[0].lidars) == {"front_lidar", "left_lidar"}
    with pytest.raises(BadInputError, match=r"holds folders of cameras: front, left; .*calib-ros rig"):
        open_dataset(tmp_path)


def test_nuscenes_and_kitti_state_their_rig(tmp_path: Path) -> None:
    sample_sources.nuscenes(tmp_path / "nuscenes")
    description, _, _ = recorded_rig(str(tmp_path / "nuscenes"))
    assert (description.reference, description.cameras) == ("LIDAR_TOP", ("CAM_FRONT",))
    sample_sources.kitti(tmp_path / "kitti", "odometry", sample_sources.frames())
    description, opened, _ = recorded_rig(str(tmp_path / "kitti"))
    assert description.cameras == ("camera_2",)
    np.testing.assert_allclose(
        description["camera_2"].prior, se3.inverse(opened.pair("camera_2", "velo_link").reference), atol=1e-9
    )
