"""Video topics: pictures as encoded, from the key frame before, each packet decoded once; what cannot be decoded is refused."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from bag_recorder import MS, START, Recorder
from compressed_bags import ENCODERS, FFMPEG, FOXGLOVE, encoded, record_video
from ros_messages import TYPES
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from calib_ros.datasets.bag import BagSource
from calib_ros.datasets.bag_file import BagFile
from calib_ros.datasets.bag_video import BagVideo
from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.messages.video import FORMER_DEFINITION


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    """A pattern that moves, of which each picture differs from the next."""
    pytest.importorskip("av", reason="PyAV is not installed")
    coarse = np.random.default_rng(0).integers(0, 256, (16, 24, 3), np.uint8)
    pattern = cv2.resize(coarse, (192, 128), interpolation=cv2.INTER_CUBIC)
    return [np.roll(pattern, 7 * k, 1) for k in range(25)]


def record(path: Path, packets: list[bytes], kind: str = FOXGLOVE, layout: str = "h264") -> Path:
    with Recorder(path) as recorder:
        record_video(recorder, packets, "/cam/image_raw/ffmpeg", kind, layout)
        for k in range(len(packets)):
            recorder.info(START + 100 * MS * k, time=START + (100 * k + 20) * MS, size=(192, 128))
            recorder.cloud(START + 100 * MS * k, time=START + (100 * k + 50) * MS, value=k)
    return path


def decoded(bag: BagSource) -> int:
    assert bag._video is not None
    return bag._video.decoded


def assert_shows(image: np.ndarray, pictures: list[np.ndarray], number: int) -> None:
    assert (image.shape, shown(image, pictures)) == (pictures[number].shape, number)


def shown(image: np.ndarray, pictures: list[np.ndarray]) -> int:
    """Which picture it is, within a grey level of some."""
    differences = [
        cv2.absdiff(*(cv2.cvtColor(one, cv2.COLOR_BGR2GRAY) for one in (image, picture))).mean() for picture in pictures
    ]
    assert min(differences) < 3
    return int(np.argmin(differences))


@pytest.mark.parametrize("codec", ENCODERS)
def test_pictures_of_each_codec_in_order_decode_each_packet_once(tmp_path, pictures, codec):
    kind, layout = (FOXGLOVE, codec) if codec in ("h264", "av1") else (FFMPEG, f"{ENCODERS[codec][0]};yuv420p;bgr8;bgr8")
    bag = BagSource(record(tmp_path / "bag", encoded(pictures, codec), kind, layout))
    assert (len(bag), bag.camera_frame) == (len(pictures), "cam")
    for k in range(len(bag)):
        frame = bag[k]
        assert_shows(frame.image, pictures, k)
        assert (frame.cloud.xyz == k).all()
    assert decoded(bag) == len(pictures)


def test_jumps_decode_from_the_key_frame_before(tmp_path, pictures):
    bag = BagSource(record(tmp_path / "bag", encoded(pictures)))
    costs = []
    for position in (13, 14, 14, 22, 3, 24, 20):
        before = decoded(bag)
        assert_shows(bag[position].image, pictures, position)
        costs.append(decoded(bag) - before)
    assert costs == [4, 1, 0, 3, 4, 5, 1]


def test_pictures_that_refer_to_later_ones_are_put_in_order(tmp_path, pictures):
    packets = encoded(pictures, tune="film", bf="2")
    bag = BagFile(record(tmp_path / "bag", packets))
    names = [(START + (100 * k + 20) * MS, START + 100 * k * MS) for k in range(len(packets))]
    forwards, backwards = (BagVideo(bag, "/cam/image_raw/ffmpeg") for _ in range(2))
    order = [shown(forwards.picture(*name), pictures) for name in names]
    assert sorted(order) == list(range(25))
    assert order != sorted(order)
    assert forwards.decoded <= 25
    assert order[::-1] == [shown(backwards.picture(*name), pictures) for name in names[::-1]]


def test_a_recording_that_begins_between_key_frames(tmp_path, pictures):
    bag = BagSource(record(tmp_path / "bag", encoded(pictures)[4:]))
    assert len(bag) == 25 - 10
    assert_shows(bag[0].image, pictures, 10)
    assert bag.remarks == ("6 pictures before the video's first key frame are left out",)
    with pytest.raises(BadInputError, match=r"no key frame.*let the encoder make one each second"):
        BagSource(record(tmp_path / "none", encoded(pictures)[1:9]))


def test_windows_need_what_was_recorded_before_them(tmp_path, pictures):
    many = encoded([pictures[k % 25] for k in range(120)], keys=30)
    bag = BagSource(record(tmp_path / "bag", many), windows=2)
    assert bag.windows == 2
    for middle in bag.middles:
        number = (bag[middle].stamp - START) // (100 * MS)
        assert_shows(bag[middle].image, pictures, number % 25)
    assert decoded(bag) <= 60


@pytest.mark.parametrize("codec", ENCODERS)
def test_truncated_and_damaged_packets_are_refused_until_the_next_key_frame(tmp_path, pictures, codec):
    packets = encoded(pictures, codec)
    # Of H.265, FFmpeg does not see that the end of a packet is missing.
    packets[13] = b"" if codec == "h265" else packets[13][: len(packets[13]) // 2]
    bag = BagSource(record(tmp_path / "bag", packets, layout=codec))
    assert_shows(bag[12].image, pictures, 12)
    for position in (13, 14, 19):
        with pytest.raises(
            BadInputError, match=r"image_raw/ffmpeg at 17.*since the last key frame is damaged or lost.*choose other"
        ):
            bag[position]
    for position in (11, 20):
        assert_shows(bag[position].image, pictures, position)


def test_packets_of_ros_1_have_another_layout(tmp_path, pictures):
    ros1 = get_typestore(Stores.ROS1_NOETIC)
    ros1.register(get_types_from_msg(FORMER_DEFINITION, FFMPEG))
    packet = ros1.types[FFMPEG]
    path = record(tmp_path / "bag", encoded(pictures), FFMPEG, "libx264")
    with Reader(path) as reader, Ros1Writer(tmp_path / "drive.bag") as writer:
        own = {c.topic: writer.add_connection(c.topic, c.msgtype, typestore=ros1) for c in reader.connections}
        for connection, time, data in reader.messages():
            if connection.msgtype == FFMPEG:
                new = TYPES.deserialize_cdr(data, FFMPEG)
                stamp = ros1.types["builtin_interfaces/msg/Time"](new.header.stamp.sec, new.header.stamp.nanosec)
                header = ros1.types["std_msgs/msg/Header"](0, stamp, "cam")
                written = ros1.serialize_ros1(packet(header, new.data, 192, 128, "libx264", 0, 0), FFMPEG)
            else:
                written = TYPES.cdr_to_ros1(data, connection.msgtype)
            writer.write(own[connection.topic], time, written)
    bag = BagSource(tmp_path / "drive.bag")
    assert (len(bag), bag.describe()["kind"]) == (25, "ROS 1 bag")
    assert_shows(bag[13].image, pictures, 13)


def test_other_codecs_and_a_missing_library_say_what_helps(tmp_path, pictures, monkeypatch):
    with pytest.raises(BadInputError, match="video of format 'prores' is not read; republish it as h264"):
        BagSource(record(tmp_path / "other", encoded(pictures), layout="prores"))
    path = record(tmp_path / "bag", encoded(pictures))
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingDependencyError, match="pip install av"):
        BagSource(path)


def test_images_win_over_video(tmp_path, pictures):
    with Recorder(tmp_path / "bag") as recorder:
        recorder.trio(START, value=3)
        record_video(recorder, encoded(pictures)[:1], "/other/video")
    assert (BagSource(tmp_path / "bag")[0].image == 3).all()
    assert BagSource(tmp_path / "bag", "/other/video").image_topic == "/other/video"
