"""Bags: round trips through both storages, topics, synchronisation, static transforms."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from bag_recorder import (
    DISTORTED,
    MS,
    PINHOLE,
    START,
    STORAGES,
    T_CAMERA_LIDAR,
    A,
    B,
    C,
    K,
    Recorder,
    assert_same,
    frame,
    recorded,
)
from ros_messages import TYPES
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_types_from_msg
from sample_sources import Listed

from calib_ros.camera import Camera
from calib_ros.cli.main import main
from calib_ros.config import MotionConfig
from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag import BagSource
from calib_ros.datasets.bag_file import Topic
from calib_ros.datasets.bag_topics import choose_points
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame, PointCloud
from calib_ros.online.pairing import Synchronizer
from calib_ros.registration.initial_guess import nominal
from calib_ros.se3 import exp, inverse
from calib_ros_check.recording import CheckOptions
from calib_ros_check.recording import opened as opened_by_check

# --- round trip -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("storage", "grey", "camera"), [("mcap", False, PINHOLE), ("sqlite3", True, DISTORTED)])
def test_round_trip(tmp_path, storage, grey, camera):
    source = Listed([frame(i, grey, camera) for i in range(5)])
    own = Camera(K * [[1.1], [1.1], [1]], 40, 24)  # a frame with its own calibration keeps it
    source.frames[3] = frame(3, grey, own, reference=T_CAMERA_LIDAR @ exp([0.01, 0, 0, 0, 0, 0.1]))
    calls = []
    path = write_bag(source, tmp_path / "deep/er/bag", storage, progress=lambda done, total: calls.append((done, total)))
    assert calls == [(i, 5) for i in range(1, 6)]
    assert path == tmp_path / "deep/er/bag"
    assert [p.name for p in path.parent.iterdir()] == ["bag"]
    with BagSource(path) as bag:
        assert len(bag) == 5
        for i in (3, 0, 4, 1, 2, -1):  # any order
            assert_same(bag[i], source[i])
        assert bag.camera == camera
        assert np.abs(bag.reference - T_CAMERA_LIDAR).max() < 1e-12
        assert (bag.camera_frame, bag.lidar_frame, bag.name) == ("camera", "lidar", "bag")
        assert len({bag[i].name for i in range(5)}) == 5
        with pytest.raises(IndexError):
            bag[5]
        description = bag.describe()
    assert description["storage"] == storage
    assert "/velodyne_points (PointCloud2, 5) as points" in description["topics"]
    assert "5 pairs; without partner: 0 of 5 images, 0 of 5 clouds" in description["frames"]


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bag_opens_from_its_file_and_through_open_dataset(tmp_path, storage):
    source = Listed([frame(i) for i in range(2)])
    path = write_bag(source, tmp_path / "bag", storage)
    file = next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))
    assert file.stem == "bag"
    for opened in (open_dataset(path), open_dataset(str(file)), open_dataset(path, image_topic=None, tolerance_s=0.02)):
        assert isinstance(opened, BagSource)
        assert_same(opened[1], source[1])
    (path / "metadata.yaml").unlink()  # as after a recording that was killed
    assert_same(open_dataset(path)[1], source[1])
    with pytest.raises(BadInputError, match="no option frobnicate"):
        open_dataset(path, frobnicate=1)


def test_missing_cloud_fields_are_left_out_and_frames_without_stamps_spaced(tmp_path):
    bare = frame(0, cloud=PointCloud(np.ones((4, 3), np.float32)), reference=None, cloud_stamp=None)
    bag = BagSource(write_bag(Listed([bare, frame(1, points=0)]), tmp_path / "without"))
    assert bag[0].cloud.intensity is bag[0].cloud.ring is bag[0].cloud.time is None
    assert bag[0].cloud_stamp == bare.stamp
    assert len(bag[1].cloud) == 0
    bag = BagSource(write_bag(Listed([bare]), tmp_path / "other"))
    assert bag.reference is None
    assert bag.describe()["reference"] == "none"
    source = Listed([frame(i, stamp=0, cloud_stamp=None) for i in range(3)])
    bag = BagSource(write_bag(source, tmp_path / "bag"))
    assert [bag[i].stamp for i in range(3)] == [0, 100_000_000, 200_000_000]
    source = Listed([frame(0), frame(3), replace(frame(1), cloud_stamp=frame(1).stamp + 5), frame(6)])
    bag = BagSource(write_bag(source, tmp_path / "backwards"))
    assert [bag[i].stamp - START for i in range(4)] == [0, 300_000_009, 400_000_009, 600_000_018]
    assert bag[2].cloud_stamp == bag[2].stamp + 5


def test_messages_are_in_the_order_of_their_stamps(tmp_path):
    # The cloud of each frame is younger than the image of the next one.
    source = Listed([replace(frame(i), cloud_stamp=frame(i).stamp + 130_000_000) for i in range(4)])
    path = write_bag(source, tmp_path / "bag", "sqlite3")
    with Reader(path) as reader:
        messages = [(time, connection.topic) for connection, time, _ in reader.messages()]
        assert [time for time, _ in messages] == sorted(time for time, _ in messages)
        assert messages[0][1] == "/tf_static"
        (qos,) = next(c for c in reader.connections if c.topic == "/tf_static").ext.offered_qos_profiles
    assert (qos.durability, qos.reliability, qos.depth) == (QosDurability.TRANSIENT_LOCAL, QosReliability.RELIABLE, 1)
    # In the file, too, for players that do not sort.
    with closing(sqlite3.connect(path / "bag.db3")) as database:
        stored = [time for (time,) in database.execute("SELECT timestamp FROM messages ORDER BY id")]
    assert stored == [time for time, _ in messages]


def test_static_transform_and_rectified_camera_as_ros_means_them(tmp_path):
    path = write_bag(Listed([frame(0, camera=DISTORTED)]), tmp_path / "bag")
    with Reader(path) as reader:
        messages = {c.topic: TYPES.deserialize_cdr(data, c.msgtype) for c, _, data in reader.messages()}
    transform = messages["/tf_static"].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("camera", "lidar")
    assert [transform.transform.translation.x, transform.transform.translation.z] == pytest.approx(T_CAMERA_LIDAR[[0, 2], 3])
    info = messages["/camera/camera_info"]
    assert info.header == messages["/camera/image_raw"].header
    assert np.allclose(info.p.reshape(3, 4)[:, :3], DISTORTED.rectified().K)
    assert np.array_equal(info.d, DISTORTED.D)
    assert messages["/velodyne_points"].header.frame_id == "lidar"
    assert messages["/velodyne_points"].point_step == 22
    assert messages["/velodyne_points"].is_dense is False


@pytest.mark.parametrize("storage", STORAGES)
def test_nothing_is_overwritten_or_left_half_written(tmp_path, storage):
    path = tmp_path / "bag"
    path.mkdir()
    with pytest.raises(BadInputError, match="exists already"):
        write_bag(Listed([frame(0)]), path, storage)
    path.rmdir()

    class Breaks(Listed):
        def __getitem__(self, index: int) -> Frame:
            if index == 2:
                raise KeyboardInterrupt
            return super().__getitem__(index)

    with pytest.raises(KeyboardInterrupt):
        write_bag(Breaks([frame(i) for i in range(3)]), path, storage)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    for source, target, options in (
        (Listed([frame(0)]), tmp_path / "file/bag", {"storage": storage}),
        (Listed([frame(0)]), path, {"storage": "zip"}),
        (Listed([frame(0)]), path, {"positions": []}),
    ):
        with pytest.raises(BadInputError):
            write_bag(source, target, **options)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


# --- bags of other people -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("storage", STORAGES)
def test_pairs_by_header_stamps_not_by_arrival(tmp_path, storage):
    with Recorder(tmp_path / "bag", storage) as record:
        for i in range(4):  # the clouds arrive 150 ms late, several messages at the same time
            stamp = START + i * 100 * MS
            record.trio(stamp, i, START, stamp + 3 * MS, stamp + 150 * MS)
        record.image(START + 1000 * MS)  # no cloud near
    bag = BagSource(tmp_path / "bag")
    assert len(bag) == 4
    for i in range(4):
        assert (bag[i].image == i).all()
        assert (bag[i].cloud.xyz == i).all()
        assert bag[i].stamp == START + i * 100 * MS
        assert bag[i].cloud_stamp == bag[i].stamp + 3 * MS
    assert "without partner: 1 of 5 images, 0 of 4 clouds" in bag.describe()["frames"]


def ahead(i: int, stamped_s: float) -> Frame:
    """A scan of 0.1 s that faces the camera's view half-way, at the image's stamp, with its stamp so long after that moment."""
    rng = np.random.default_rng(i)
    xyz = np.c_[np.full(200, 10.0), rng.uniform(-1, 1, (200, 2))].astype(np.float32)
    time = (np.linspace(-0.01, 0.01, 200) - stamped_s).astype(np.float32)
    stamp = START + i * 100 * MS + int(rng.integers(-4, 5)) * MS
    return frame(i, stamp=stamp, cloud_stamp=START + round((0.1 * i + stamped_s) * 1e9), cloud=PointCloud(xyz, time=time))


@pytest.mark.parametrize("stamped_s", [-0.05, 0.0, 0.05])
@pytest.mark.parametrize("known", [True, False])
def test_scans_pair_by_when_they_sweep_the_view_as_in_the_node(tmp_path, stamped_s, known):
    """Their extrinsic is in the recording, or nominal."""
    frames = [replace(ahead(i, stamped_s), reference=nominal() if known else None) for i in range(12)]
    bag = BagSource(write_bag(Listed(frames), tmp_path / "bag"))
    assert "12 pairs" in bag.describe()["frames"]
    assert f"{0 - 1000 * stamped_s:+.0f} ms" in bag.describe()["pairing"]
    synchronizer = Synchronizer(0.0, 8, round(-stamped_s * 1e9))
    online = []
    for made in frames:
        online += synchronizer.add(False, made.moment_of_cloud, made.moment_of_cloud)
        online += synchronizer.add(True, made.stamp, made.stamp)
    for i, made in enumerate(frames):
        assert (bag[i].stamp, bag[i].cloud_stamp) == (made.stamp, made.cloud_stamp)
    assert online == [(made.stamp, made.cloud_stamp) for made in frames][: len(online)]
    assert len(online) >= 10


def test_the_configuration_says_how_a_bag_is_paired(tmp_path):
    frames = [replace(ahead(i, 0.0), reference=nominal()) for i in range(12)]
    path = write_bag(Listed(frames), tmp_path / "bag")
    assert "+80 ms" in open_dataset(path, motion=MotionConfig(time_offset_s=0.08)).describe()["pairing"]
    assert "+0 ms" in open_dataset(path, motion=MotionConfig(deskew="off")).describe()["pairing"]
    assert len(open_dataset(path, tolerance_s=0.0015)) < 12
    behind = nominal(180.0)
    assert "+0 ms" in open_dataset(path, T_camera_lidar=behind).describe()["pairing"]  # nothing in view: by the stamps


def test_headers_without_stamps_fall_back_to_the_time_of_recording(tmp_path):
    path = recorded(tmp_path / "bag", lambda record, time, i: record.trio(0, i, time, START + 12345, time + 1), 3)
    bag = BagSource(path)
    assert [int(bag[i].image[0, 0]) for i in range(3)] == [0, 1, 2]
    assert [int(bag[i].cloud.xyz[0, 0]) for i in range(3)] == [0, 1, 2]
    assert bag[2].stamp == START + 200 * MS
    assert "headers have none" in bag.describe()["stamps"]


@pytest.mark.parametrize(
    ("ahead_s", "queue_s", "found_s", "cause"),
    [
        (37.02, 0.0, 37.0, "TAI and UTC"),
        (-18.02, 0.0, -18.0, "GPS time and UTC"),
        (2.5, 0.0, 2.5, "not synchronised"),
        (-START / 1e9 + 300, 0.0, -START / 1e9 + 300, "another epoch"),
        (0.0, 4.0, 0.0, "by --clock recording"),
        (0.2, 0.0, 0.0, ""),
    ],
)
def test_clocks_that_differ_are_told_from_messages_that_come_late(tmp_path, ahead_s, queue_s, found_s, cause):
    """By the times of recording; stamps of the future, other epochs and time scales are clocks, a queue is none."""
    with Recorder(tmp_path / "bag") as record:
        for i in range(60):
            at = START + i * 100 * MS
            record.trio(at, i, at + 20 * MS, at + round(ahead_s * 1e9), at + 20 * MS + round(queue_s * 1e9))
        record.cloud(2 * 10**18, value=60, time=START + 6000 * MS)  # one wrong stamp
    bag = BagSource(tmp_path / "bag")
    assert [remark for remark in bag.remarks if cause not in remark] == []
    assert len(bag.remarks) == (1 if found_s or queue_s else 0)
    assert [int(bag[i].cloud.xyz[0, 0]) - int(bag[i].image[0, 0]) for i in (0, 30, 59 if not ahead_s else -1)] == (
        [0, 0, 0] if ahead_s != 0.2 else [-2, -2, -2]
    )
    as_stamped = {"header": ahead_s, "recording": queue_s}
    for clock, offset_s in as_stamped.items():
        if abs(offset_s) > 10:
            with pytest.raises(BadInputError, match="--clock recording"):
                BagSource(tmp_path / "bag", clock=clock)
        else:
            own = BagSource(tmp_path / "bag", clock=clock)
            assert int(own[0].cloud.xyz[0, 0]) == max(0, round(-10 * offset_s))
    with pytest.raises(BadInputError, match="must be one of auto, header, recording"):
        BagSource(tmp_path / "bag", clock="sensor")


def test_a_camera_that_lags_by_seconds_is_paired_by_a_time_offset_that_is_given(tmp_path):
    """Pictures that are stamped 2.5 s after their exposure, when they are sent: nothing but the scenes shows it."""
    recorded(tmp_path / "bag", lambda record, at, i: record.trio(at, i, at + 20 * MS, at + 2500 * MS, at + 2520 * MS), 60)
    assert int(BagSource(tmp_path / "bag")[0].cloud.xyz[0, 0]) == 0
    bag = BagSource(tmp_path / "bag", motion=MotionConfig(time_offset_s=-2.5))
    assert [int(bag[i].cloud.xyz[0, 0]) - int(bag[i].image[0, 0]) for i in (0, 20, 34, -1)] == [0, 0, 0, 0]


def test_recorders_that_do_not_keep_to_real_time_move_no_clock(tmp_path):
    """Messages that were written again later, one topic after the other or at another rate, with their stamps as they were."""
    for name, image_at, cloud_at in (
        ("again", lambda s: s, lambda s: s + 10**16),
        ("in turn", lambda s: 5 * s, lambda s: 5 * s + 200 * 10**9),
        ("twice as fast", lambda s: s // 2, lambda s: s // 2),
    ):
        with Recorder(tmp_path / name) as record:
            for i in range(60):
                at = i * 10**9
                record.image(START + at, time=START + image_at(at), value=i)
                record.info(START + at, time=START + image_at(at))
                if i < 30 or name != "twice as fast":
                    record.cloud(START + at, time=START + cloud_at(at), value=i)
        bag = BagSource(tmp_path / name)
        assert not [remark for remark in bag.remarks if "paired by the stamps" not in remark]
        assert int(bag[7].cloud.xyz[0, 0]) == int(bag[7].image[0, 0]) == 7


def test_a_bag_whose_topics_are_empty_is_refused(tmp_path):
    """Topics are listed, and no message of them can be read."""
    path = write_bag(Listed([frame(0)]), tmp_path / "bag", "sqlite3")
    with closing(sqlite3.connect(next(path.glob("*.db3")))) as database:
        database.execute("DELETE FROM messages")
        database.commit()
    with pytest.raises(BadInputError, match="is readable"):
        BagSource(path)


def test_several_topics_of_a_type_need_a_choice(tmp_path):
    with Recorder(tmp_path / "bag") as record:
        record.trio(START)
        record.image(START, topic="/right/image_raw", value=7)
        record.info(START, topic="/right/camera_info", fx=9)
        record.cloud(START, topic="/rear/points", value=5)
    for topic, says in (
        (None, "/cam/image_raw, /right/image_raw; choose"),
        ("/right/image_raw", "/points, /rear/points; choose"),
    ):
        with pytest.raises(BadInputError, match=says):
            BagSource(tmp_path / "bag", image_topic=topic)
    bag = open_dataset(tmp_path / "bag", image_topic="right/image_raw", points_topic="/rear/points")
    assert bag.camera.K[0, 0] == 9  # the CameraInfo beside the image
    assert (bag[0].image == 7).all()
    assert (bag[0].cloud.xyz == 5).all()
    bag = BagSource(tmp_path / "bag", "/right/image_raw", "/points", "/cam/camera_info")
    assert bag.camera.K[0, 0] == 5
    with pytest.raises(BadInputError, match="no PointCloud2 messages on topic /front; it has /points, /rear/points"):
        BagSource(tmp_path / "bag", "/cam/image_raw", "/front")


def test_topics_of_a_damaged_bag_are_named_in_one_line(tmp_path):
    bag = SimpleNamespace(path=tmp_path, topics={f"/{k}\n": Topic(f"/{k}\n", "a/msg/B\nC", 1) for k in range(99)})
    with pytest.raises(BadInputError) as error:
        choose_points(bag, None)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 1200
    assert "..." in str(error.value)


def test_missing_types_and_pairs_are_named(tmp_path):
    recorded(tmp_path / "apart", lambda record, at, i: record.trio(at, cloud=at + 80 * MS))
    assert len(BagSource(tmp_path / "apart", tolerance_s=0.1)) == 1
    for tolerance in (0, -1, float("nan")):
        with pytest.raises(BadInputError, match="tolerance_s" if tolerance else "within 0.05 s"):
            BagSource(tmp_path / "apart", tolerance_s=tolerance)
    with Recorder(tmp_path / "bag") as record:
        record.image(START)
        record.cloud(START)
    with pytest.raises(BadInputError, match=r"no CameraInfo messages, only .*/cam/image_raw \(sensor_msgs/msg/Image\)"):
        BagSource(tmp_path / "bag")
    with Recorder(tmp_path / "planar") as record:
        record.image(START)
        names = ["angle_min", "angle_max", "angle_increment", "time_increment", "scan_time", "range_min", "range_max"]
        values = dict.fromkeys(names, 0.0) | dict.fromkeys(("ranges", "intensities"), np.zeros(0, np.float32))
        record.write("/scan", record.ros.make("sensor_msgs/msg/LaserScan", header=record.ros.header(START, "s"), **values), START)
    with pytest.raises(BadInputError, match="LaserScan: a scan of one plane"):
        BagSource(tmp_path / "planar")
    with pytest.raises(BadInputError, match="nothing at all"):
        BagSource(recorded(tmp_path / "empty", count=0))


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("velodyne_msgs/msg/VelodyneScan", "play the bag, run the .* node of velodyne_pointcloud"),
        ("ouster_sensor_msgs/msg/PacketMsg", "play the bag, run the .* node of ouster_ros"),
        ("draco_point_cloud_transport/msg/CompressedPointCloud2", "ros2 run point_cloud_transport republish"),
    ],
)
def test_packets_are_refused_with_what_makes_clouds(tmp_path, kind, says):
    with Recorder(tmp_path / "bag") as record:
        record.image(START)
        record.info(START)
        TYPES.register(get_types_from_msg("uint8[] buf", kind))
        record.write("/packets", TYPES.types[kind](np.zeros(9, np.uint8)), START)
    with pytest.raises(BadInputError, match=f"no PointCloud2 messages, only .*{says}"):
        BagSource(tmp_path / "bag")


def test_compressed_images(tmp_path):
    with Recorder(tmp_path / "bag") as record:
        record.compressed(START, "/cam/image_raw/compressed")
        record.compressed(START, "/cam/image_raw/compressedDepth", "16UC1; compressedDepth png")
        record.info(START)
        record.cloud(START)
    bag = BagSource(tmp_path / "bag")
    assert (bag[0].image == 9).all()
    with pytest.raises(BadInputError, match="this is a depth image"):
        BagSource(tmp_path / "bag", "/cam/image_raw/compressedDepth")[0]
    with Recorder(tmp_path / "depth") as record:
        record.compressed(START, "/cam/depth/compressedDepth", "16UC1; compressedDepth png")
        record.info(START)
        record.cloud(START)
    with pytest.raises(BadInputError, match=r"; /cam/depth/compressedDepth is a depth image, no camera picture"):
        BagSource(tmp_path / "depth")
    with Recorder(tmp_path / "both") as record:
        record.trio(START, value=3)
        record.compressed(START, "/cam/image_raw/compressed")
    assert (BagSource(tmp_path / "both")[0].image == 3).all()
    assert (BagSource(tmp_path / "both", "/cam/image_raw/compressed")[0].image == 9).all()


def test_images_of_a_topic_called_so_use_the_projection_matrix_unless_they_are_said_to_be_raw(tmp_path, capsys):
    """The topic's name says it, and the command line has the last word."""
    path = recorded(tmp_path / "bag", lambda record, at, i: record.trio(at, topic="/cam/image_rect_color"))
    bag = BagSource(path)
    assert bag.camera.K[0, 0] == 10
    assert bag.camera.is_pinhole
    assert "rectified" in bag.describe()["camera"]
    assert not BagSource(path, rectified=False).camera.is_pinhole
    assert not opened_by_check(str(path), CheckOptions(rectified=False)).camera.is_pinhole
    assert main(["info", str(path)]) == 0
    assert "--no-rectified" in capsys.readouterr().out
    assert main(["info", str(path), "--no-rectified"]) == 0
    assert "rectified" not in capsys.readouterr().out


@pytest.mark.parametrize("separate", [False, True])
def test_reference_is_chained_through_the_tree(tmp_path, separate):
    edges = [("base", "mount", A), ("mount", "cam", B), ("/base", "/lidar", C), ("base", "imu", A)]
    with Recorder(tmp_path / "bag") as record:
        record.trio(START)  # the transforms come later than the frame
        if separate:
            for i, edge in enumerate(edges):
                record.static(START + i, edge)
        else:
            record.static(START + 5, *edges)
        record.trio(START + 100 * MS)
    bag = BagSource(tmp_path / "bag")
    for T in (bag.reference, bag[0].reference, bag[1].reference):
        assert np.abs(T - inverse(A @ B) @ C).max() < 1e-9


def test_trees_that_do_not_connect_and_frames_with_a_slash(tmp_path):
    with Recorder(tmp_path / "apart") as record:
        record.trio(START)
        record.static(START, ("base", "cam", A), ("other", "lidar", B))
        record.static(START, ("cam", "lidar", C), scale=0.0)  # no rotation at all: ignored, as tf2 does
    assert BagSource(tmp_path / "apart").reference is None
    with Recorder(tmp_path / "bag") as record:  # transforms of a namespace, too
        record.image(START, frame="/cam")
        record.info(START)
        record.cloud(START, frame="/lidar")
        record.static(START, ("lidar", "cam", A), topic="/robot/tf_static")
    assert np.abs(BagSource(tmp_path / "bag").reference - inverse(A)).max() < 1e-9
