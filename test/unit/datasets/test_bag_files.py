"""The files of bags: compressed, damaged, without metadata, of ROS 1, and with messages of other drivers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bag_recorder import MS, START, STORAGES, A, Recorder, as_ros1, assert_same, frame, recorded
from rosbags.rosbag2 import CompressionMode
from sample_sources import Listed

from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag import BagSource
from calib_ros.datasets.bag_messages import zstd
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.errors import BadInputError
from calib_ros.messages.point_fields import decode_livox

COMPRESSED = [("mcap", CompressionMode.STORAGE), ("mcap", CompressionMode.MESSAGE), ("sqlite3", CompressionMode.FILE)]


@pytest.mark.parametrize(("storage", "compression"), [*COMPRESSED, ("sqlite3", CompressionMode.MESSAGE)])
def test_compressed_bags(tmp_path, storage, compression):
    bag = open_dataset(recorded(tmp_path / "bag", Recorder.trio, 3, storage, compression=compression))
    assert [int(bag[i].image[0, 0]) for i in range(3)] == [0, 1, 2]
    assert bag.describe()["storage"] == storage


def test_an_unusable_message_is_named_and_the_others_stay_usable(tmp_path):
    with Recorder(tmp_path / "bag") as record:
        record.trio(START)
        stamp = START + 100 * MS
        record.info(stamp)
        record.cloud(stamp)
        message = record.ros.image("32FC1", 8, 6, bytes(192), 32)
        message.header = record.ros.header(stamp, "cam")
        record.write("/cam/image_raw", message, stamp)
    bag = BagSource(tmp_path / "bag")
    assert (bag[0].image == 0).all()
    with pytest.raises(BadInputError, match=r"bag, /cam/image_raw at 1700000000.100000000: Image: encoding '32FC1'"):
        bag[1]


# --- damage; at random in the fuzz tests -----------------------------------------------------------------------------------


def use(path: Path, **options) -> str:
    """Opens and reads everything: "read", or why not."""
    try:
        with BagSource(path, **options) as bag:
            for i in range(len(bag)):
                bag[i]
    except BadInputError as error:
        return str(error)
    return "read"


def storage_of(path: Path) -> Path:
    return next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))


@pytest.mark.parametrize("storage", STORAGES)
def test_damaged_bags_say_what_helps(tmp_path, storage):
    copy = write_bag(Listed([frame(i) for i in range(4)]), tmp_path / "bag", storage)
    (copy / "metadata.yaml").unlink()
    assert use(copy) == "read"
    whole = storage_of(copy).read_bytes()
    advice = "mcap recover" if storage_of(copy).suffix == ".mcap" else "record it again"
    storage_of(copy).write_bytes(whole[: len(whole) // 3])
    assert advice in use(copy)
    storage_of(copy).unlink()
    assert "no .mcap, .db3 or .bag" in use(copy)


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bag_is_read_without_its_metadata(tmp_path, storage):
    """Damaged, or of a recorder that left it empty: the files hold all that is needed. Parts that are not there are named."""
    parts = [frame(i) for i in range(3)], [frame(i) for i in range(3, 6)]
    first, second = (write_bag(Listed(own), tmp_path / f"part{k}", storage) for k, own in enumerate(parts))
    for text in ("", "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: ''\n", "[unreadable"):
        (first / "metadata.yaml").write_text(text)
        bag = BagSource(first)
        assert (len(bag), len(bag.remarks)) == (3, 1)
        assert "metadata.yaml" in bag.remarks[0]
    (first / "metadata.yaml").unlink()
    file = storage_of(second)
    packed = first / f"part_10{file.suffix}.zstd"
    with zstd.open(packed, "wb") as target:
        target.write(file.read_bytes())
    bag = BagSource(first)
    assert [bag[i].stamp for i in range(6)] == [made.stamp for own in parts for made in own]
    assert bag.remarks == ()
    copy = first / f"copy{file.suffix}"
    copy.write_bytes(storage_of(first).read_bytes())
    assert "open one of the files" in use(first)
    copy.unlink()
    packed.write_bytes(packed.read_bytes()[:100])
    assert packed.name in use(first)
    assert "--incomplete" in use(first)
    with BagSource(first, incomplete=True) as bag:
        assert len(bag) == 3
        assert packed.name in bag.remarks[0]
    listed = (second / "metadata.yaml").read_text().replace(f"- {file.name}", f"- {file.name}\n  - gone_1{file.suffix}", 1)
    (second / "metadata.yaml").write_text(listed)
    assert f"gone_1{file.suffix}" in use(second)
    assert use(second, incomplete=True) == "read"


def test_bags_of_ros_1(tmp_path):
    """With their own byte layout of a header; the same frames as a bag of ROS 2."""
    path = tmp_path / "drive.bag"
    with Recorder(tmp_path / "bag") as record:
        for i in range(3):
            record.trio(START + i * 100 * MS, value=i)
        record.static(START, ("cam", "lidar", A))
    expected = BagSource(tmp_path / "bag")
    as_ros1(tmp_path / "bag", path)
    bag = open_dataset(path)
    assert (len(bag), bag.describe()["kind"], bag.camera_frame) == (3, "ROS 1 bag", "cam")
    assert np.abs(bag.reference - A).max() < 1e-9
    for i in range(3):
        assert_same(bag[i], expected[i])
    path.write_bytes(path.read_bytes()[:-200])
    assert "rosbag reindex" in use(path)


def test_livox_clouds(tmp_path):
    """Its own message, of points with times and lines."""
    with Recorder(tmp_path / "bag") as record:
        for i in range(3):
            stamp = START + i * 100 * MS
            record.image(stamp)
            record.info(stamp)
            fields = {"offset_time": 5 * MS, "y": 2.0, "z": 3.0, "reflectivity": 200, "tag": 16, "line": 3}
            made = [record.ros.make("livox_ros_driver2/msg/CustomPoint", x=float(k), **fields) for k in range(1 + i)]
            about = {"timebase": 0, "point_num": len(made), "lidar_id": 0, "rsvd": np.zeros(3, np.uint8)}
            message = record.ros.make(
                "livox_ros_driver2/msg/CustomMsg", **about, points=made, header=record.ros.header(stamp, "li")
            )
            record.write("/livox/lidar", message, stamp)
    bag = BagSource(tmp_path / "bag")
    cloud = bag[2].cloud
    assert bag.lidar_frame == "li"
    assert np.array_equal(cloud.xyz, [[k, 2, 3] for k in range(3)])
    assert np.allclose(cloud.time, 0.005)
    assert (set(cloud.ring), set(cloud.intensity)) == ({3}, {200})
    data = b"\0\1\0\0" + bytes(60)
    for length in (4, 30):
        with pytest.raises(BadInputError, match="CustomMsg"):
            decode_livox(data[:length])
    with pytest.raises(BadInputError, match="truncated"):
        decode_livox(data[:24] + b"\xff\xff\xff\x0f" * 5 + bytes(20))
