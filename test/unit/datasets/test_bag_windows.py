"""Short windows of bags: the frames that the whole bag gives, by a fraction of its bytes."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from bag_recorder import MS, PINHOLE, START, STORAGES, A, B, Recorder, as_ros1, assert_same, frame, recorded
from rosbags.rosbag2 import CompressionMode, Reader
from sample_sources import Listed
from test_bag_files import COMPRESSED, storage_of

from calib_ros.camera import Camera
from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag import BagSource
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.errors import BadInputError

MESSAGES = 120  # of each topic, at 10 Hz
BYTES = """
import sys
from calib_ros.datasets.bag import BagSource

def read() -> int:
    return int(open("/proc/self/io").readline().split()[1])

before = read()
for windows in sys.argv[2:]:
    with BagSource(sys.argv[1], windows=int(windows)) as bag:
        for middle in bag.middles or [len(bag) // 2]:
            for position in (middle - 1, middle, middle + 1):
                bag[position]
    before, now = read(), before
    print(before - now)
"""


record = partial(recorded, count=MESSAGES)


def trio(recorder: Recorder, stamp: int, i: int) -> None:
    """Messages as recorded a little later than stamped; the cloud later than the image."""
    recorder.trio(stamp, i, stamp + 20 * MS, stamp, stamp + 70 * MS)


def assert_frames_of_the_whole(path: Path, count: int, found: int | None = None) -> BagSource:
    """Frames in windows are those of the whole bag, each between its neighbours."""
    bag, whole = BagSource(path, windows=count), BagSource(path)
    stamps = [whole[i].stamp for i in range(len(whole))]
    assert len(bag.middles) == (count if found is None else found)
    for middle in bag.middles:
        at = stamps.index(bag[middle].stamp)
        for step in (-1, 0, 1):
            assert_same(bag[middle + step], whole[at + step])
    return bag


@pytest.mark.parametrize(
    ("storage", "compression", "count"),
    [("mcap", CompressionMode.NONE, 1), ("sqlite3", CompressionMode.NONE, 4), *((*kind, 3) for kind in COMPRESSED)],
)
def test_windows_hold_frames_of_the_whole_bag_and_their_neighbours(tmp_path, storage, compression, count):
    bag = assert_frames_of_the_whole(record(tmp_path / "bag", trio, storage=storage, compression=compression), count)
    assert len(bag) <= 5 * count
    assert f"{count} windows of the recording" in bag.describe()["frames"]
    middles = [int(bag[middle].image[0, 0]) for middle in bag.middles]
    assert np.abs(np.array(middles) - MESSAGES * (np.arange(count) + 0.5) / count).max() < 3
    assert bag.reference is None


@pytest.mark.parametrize("storage", [*STORAGES, "ROS 1"])
def test_windows_cost_a_fraction_of_the_bytes(tmp_path, storage):
    rng = np.random.default_rng(0)
    camera = Camera(PINHOLE.K, 200, 160)
    image = rng.integers(0, 256, (160, 200, 3), np.uint8)
    large = [replace(frame(i, points=10_000), camera=camera, image=image) for i in range(100)]
    path = write_bag(Listed(large), tmp_path / "bag", "mcap" if storage == "ROS 1" else storage)
    size = storage_of(path).stat().st_size
    if storage == "ROS 1":
        as_ros1(path, tmp_path / "drive.bag")
        path = tmp_path / "drive.bag"

    done = subprocess.run([sys.executable, "-c", BYTES, path, "3", "30", "0"], capture_output=True, text=True, check=True)
    few, many, whole = map(int, done.stdout.split())
    assert 15 * 316_000 * 0.5 < few < 0.3 * size
    # Windows that would cover the bag: it is read once, and kept.
    assert size < many < 1.1 * size
    # Of the whole bag only the beginnings of messages, and the chunks of three frames.
    assert 3 * 316_000 < whole < 0.3 * size


def without_index(path: Path) -> Path:
    """The mcap file of a bag without its summary, as after a crash that a recorder survived."""
    file = storage_of(path)
    whole = file.read_bytes()
    summary = int.from_bytes(whole[-28:-20], "little")
    file.write_bytes(whole[:summary] + whole[-37:-28] + bytes(20) + whole[-8:])
    return path


def test_an_mcap_file_without_index_is_read_as_a_whole(tmp_path):
    path = without_index(record(tmp_path / "bag", trio))
    bag = assert_frames_of_the_whole(path, 4)
    assert (len(bag), bag.windows) == (MESSAGES, 0)
    file = storage_of(path)
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(BadInputError, match="mcap recover"):
        BagSource(path, windows=4)


def test_an_index_that_names_other_messages_is_told(tmp_path):
    path = record(tmp_path / "bag", trio)
    file = storage_of(path)
    with Reader(path) as reader:
        at = reader.storage.storages[0].chunks[0].message_index_offsets[1] + 9 + 6 + 8  # where the first message of a topic is
    whole = file.read_bytes()
    file.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    with pytest.raises(BadInputError, match=r"an index of messages is damaged.*mcap recover"):
        BagSource(path)


def test_messages_compressed_one_by_one_are_read_without_metadata(tmp_path):
    path = record(tmp_path / "bag", trio, storage="sqlite3", compression=CompressionMode.MESSAGE)
    stamps = [BagSource(path)[k].stamp for k in (0, MESSAGES - 1)]
    (path / "metadata.yaml").unlink()
    bag = BagSource(path)
    assert [bag[k].stamp for k in (0, MESSAGES - 1)] == stamps


def test_a_short_bag_is_read_as_a_whole(tmp_path):
    path = write_bag(Listed([frame(i) for i in range(12)]), tmp_path / "bag")
    bag = open_dataset(path, windows=4)
    assert (len(bag), bag.windows, bag.middles) == (12, 0, [1, 4, 7, 10])
    assert open_dataset(path, windows=20).middles == list(range(12))
    assert open_dataset(path).middles == []
    with pytest.raises(BadInputError, match="windows is -1"):
        open_dataset(path, windows=-1)


@pytest.mark.parametrize("late_ms", [400, 700, 4000])
def test_a_sensor_that_is_recorded_late_has_wider_windows_or_the_whole_bag(tmp_path, late_ms):
    path = record(tmp_path / "bag", lambda recorder, stamp, i: recorder.trio(stamp, cloud_time=stamp + late_ms * MS))
    bag = assert_frames_of_the_whole(path, 3)
    assert bag.windows == (0 if late_ms == 4000 else 3)


def test_windows_avoid_where_a_sensor_is_missing(tmp_path):
    def write(recorder: Recorder, stamp: int, i: int) -> None:
        if not 4000 < (stamp - START) / MS < 5000:
            recorder.image(stamp)
        recorder.info(stamp)
        recorder.cloud(stamp)

    bag = assert_frames_of_the_whole(record(tmp_path / "bag", write), 4)  # the second slot's middle is at 4.5 s
    assert 3.3 < (bag[bag.middles[1]].stamp - START) / 1e9 < 3.9
    # Half of the recording without images: the slots there stay empty.
    half = record(tmp_path / "half", lambda own, stamp, i: trio(own, stamp, i) if i < MESSAGES // 2 else own.cloud(stamp))
    bag = BagSource(half, windows=4)
    assert (len(bag.middles), bag.windows) == (2, 2)


@pytest.mark.parametrize("once", [True, False])
def test_seldom_camera_infos_are_found(tmp_path, once):
    def write(recorder: Recorder, stamp: int, i: int) -> None:
        recorder.image(stamp)
        recorder.cloud(stamp)
        if stamp == START or (not once and (stamp - START) % (2000 * MS) == 0):
            recorder.info(stamp, fx=5.0 + (stamp - START) / (2000 * MS))

    bag = assert_frames_of_the_whole(record(tmp_path / "bag", write), 4)
    assert bag.windows == 4
    assert len({bag[middle].camera.K[0, 0] for middle in bag.middles}) > (0 if once else 2)


@pytest.mark.parametrize("storage", STORAGES)
def test_static_transforms_are_those_of_the_whole_bag(tmp_path, storage):
    """Once at the beginning, and corrected once between two windows."""

    def write(recorder: Recorder, stamp: int, i: int) -> None:
        if stamp == START:
            recorder.static(stamp, ("cam", "lidar", A))
        if stamp == START + 6000 * MS:
            recorder.static(stamp, ("cam", "lidar", B))
        trio(recorder, stamp, i)

    bag = assert_frames_of_the_whole(record(tmp_path / "bag", write, storage=storage), 4)
    for middle, T in zip(bag.middles, (A, A, B, B), strict=True):
        assert np.abs(bag[middle].reference - T).max() < 1e-9


def test_a_bag_of_several_files(tmp_path):
    """Made by hand: the metadata of two bags, one after the other."""
    first = record(tmp_path / "first", trio)
    with Recorder(tmp_path / "second") as recorder:
        for i in range(MESSAGES, 2 * MESSAGES):
            trio(recorder, START + 100 * MS * i, i)
    metadata = yaml.safe_load((first / "metadata.yaml").read_text())
    about = metadata["rosbag2_bagfile_information"]
    about["relative_file_paths"].append("second.mcap")
    about["duration"]["nanoseconds"] = (2 * MESSAGES * 100 - 50) * MS
    for topic in about["topics_with_message_count"]:
        topic["message_count"] = 2 * MESSAGES
    (first / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    (tmp_path / "second/second.mcap").rename(first / "second.mcap")
    bag = assert_frames_of_the_whole(first, 4)
    assert bag.windows == 4
    assert bag[bag.middles[-1]].stamp > START + 100 * MS * MESSAGES
