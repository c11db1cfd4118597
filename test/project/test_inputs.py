"""The tables of docs/inputs.md: each row has a test that makes such an input, and readers read no more than the rows say."""

from __future__ import annotations

import re

import pytest
from paths import ROOT

from calib_ros.datasets.bag_topics import COMPRESSED, REMEDIES
from calib_ros.datasets.cloud_files import CLOUD_SUFFIXES
from calib_ros.datasets.folder import IMAGE_SUFFIXES
from calib_ros.lens import LENSES
from calib_ros.messages.compressed_points import COMPRESSED_POINTS
from calib_ros.messages.video import VIDEO

ROWS = dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", (ROOT / "docs/inputs.md").read_text(encoding="utf-8"), flags=re.MULTILINE))
# Row -> tests below test/unit/.
TESTS: dict[str, tuple[str, ...]] = {
    "ROS 2 bags": (
        "datasets/test_bag.py::test_round_trip",
        "datasets/test_bag_files.py::test_compressed_bags",
        "datasets/test_bag_windows.py::test_windows_cost_a_fraction_of_the_bytes",
    ),
    "bags without `metadata.yaml`": ("datasets/test_bag_files.py::test_a_bag_is_read_without_its_metadata",),
    "mcap cut off": ("datasets/test_bag_files.py::test_damaged_bags_say_what_helps",),
    "ROS 1 bags": ("datasets/test_bag_files.py::test_bags_of_ros_1",),
    "KITTI": (
        "datasets/test_kitti.py::test_raw_frames_are_those_with_picture_and_scan",
        "datasets/test_kitti.py::test_odometry",
        "datasets/test_kitti.py::test_drives_of_kitti_360",
        "datasets/test_kitti.py::test_object_frames_have_their_own_calibration",
    ),
    "ONCE": ("datasets/test_once.py::test_frames_have_a_picture_and_a_scan_of_the_same_time",),
    "nuScenes": ("datasets/test_nuscenes.py::test_key_frames_of_the_first_scene",),
    "Image": (
        "messages/test_messages.py::test_colour_encodings_give_bgr",
        "messages/test_messages.py::test_grey_stays_two_dimensional",
        "messages/test_messages.py::test_sixteen_bit_is_stretched_whatever_band_it_uses",
        "messages/test_messages.py::test_bayer_patterns_give_their_colours",
        "messages/test_messages.py::test_yuv_encodings_give_their_colours",
    ),
    "CompressedImage": (
        "messages/test_messages.py::test_compressed_colour_and_grey",
        "messages/test_messages.py::test_compressed_png_of_other_depths",
    ),
    "foxglove_msgs/CompressedVideo": (
        "datasets/test_bag_video.py::test_pictures_of_each_codec_in_order_decode_each_packet_once",
    ),
    "FFMPEGPacket": ("datasets/test_bag_video.py::test_pictures_of_each_codec_in_order_decode_each_packet_once",),
    "compressedDepth": ("datasets/test_bag.py::test_compressed_images",),
    "PointCloud2": (
        "messages/test_messages.py::test_velodyne_layout",
        "messages/test_messages.py::test_organised_ouster_layout_with_padded_rows",
        "messages/test_messages.py::test_point_times_in_every_unit",
    ),
    "CompressedPointCloud2": (
        "messages/test_compressed_points.py::test_a_compressed_cloud_is_that_which_was_compressed",
        "messages/test_compressed_points.py::test_times_that_draco_loses_and_fields_that_it_has_not_are_told",
        "messages/test_compressed_points.py::test_cloudini_is_refused_with_what_helps",
    ),
    "CustomMsg of Livox": ("datasets/test_bag_files.py::test_livox_clouds",),
    "VelodyneScan": ("datasets/test_bag.py::test_packets_are_refused_with_what_makes_clouds",),
    "PacketMsg of Ouster": ("datasets/test_bag.py::test_packets_are_refused_with_what_makes_clouds",),
    "LaserScan": ("datasets/test_bag.py::test_missing_types_and_pairs_are_named",),
    "CameraInfo": ("messages/test_messages.py::test_camera_info", "test_lens.py::test_names_of_other_tools"),
    "`.png` `.jpg` `.jpeg` `.bmp` `.tif` `.tiff` `.webp`": ("datasets/test_folder.py::test_pictures_of_every_kind",),
    "`.pcd`": ("datasets/test_cloud_files.py::test_every_format_gives_the_same_points",),
    "`.ply`": ("datasets/test_cloud_files.py::test_every_format_gives_the_same_points",),
    "`.las` `.laz`": ("datasets/test_cloud_files.py::test_formats_of_surveyors",),
    "`.csv` `.txt` `.xyz` `.asc` `.pts`": (
        "datasets/test_cloud_files.py::test_text_clouds_as_tools_write_them",
        "datasets/test_cloud_files.py::test_formats_of_surveyors",
    ),
    "`.bin`": (
        "datasets/test_cloud_files.py::test_every_format_gives_the_same_points",
        "datasets/test_cloud_files.py::test_scans_of_more_numbers_than_four_are_recognised",
    ),
    "`.npz`": ("datasets/test_cloud_files.py::test_every_format_gives_the_same_points",),
    "`.e57` and others": ("datasets/test_folder.py::test_files_of_a_format_that_is_not_read_are_named",),
    "`calibration.yaml` `.json` `.xml` `camchain.yaml`": (
        "datasets/test_folder.py::test_frames_are_the_names_with_image_and_cloud",
        "datasets/test_camera_files.py::test_files_of_opencv",
        "datasets/test_camera_files.py::test_files_of_kalibr",
        "datasets/test_camera_files.py::test_files_of_basalt",
    ),
    "`times.csv`": ("datasets/test_folder.py::test_times_give_stamps_and_order_and_points_count_from_the_clouds_stamp",),
}


@pytest.mark.parametrize("row", ROWS)
def test_a_row_has_a_test_that_makes_such_an_input(row: str) -> None:
    for one in TESTS[row]:
        path, _, test = one.partition("::")
        assert f"def {test}(" in (ROOT / "test/unit" / path).read_text(encoding="utf-8")


def test_no_row_is_missing() -> None:
    assert list(TESTS) == list(ROWS)
    suffixes = re.findall(r"`(\.\w+)`", " ".join(ROWS))
    assert set(suffixes) == {*IMAGE_SUFFIXES, *CLOUD_SUFFIXES, ".e57", ".json", ".xml"}
    assert set(ROWS["CameraInfo"].split(", ")) == set(LENSES)
    types = {kind.rpartition("/")[2] for kind in (COMPRESSED, COMPRESSED_POINTS, *VIDEO)} | set(REMEDIES)
    assert types <= {word.rpartition("/")[2] for row in ROWS for word in row.split()}
