"""The tables of docs/inputs.md: what readers read and what they refuse stands in a row."""

from __future__ import annotations

import re

from paths import ROOT

from calib_ros.datasets.bag_topics import COMPRESSED, REMEDIES
from calib_ros.datasets.cloud_files import CLOUD_SUFFIXES
from calib_ros.datasets.folder import IMAGE_SUFFIXES
from calib_ros.lens import LENSES
from calib_ros.messages.compressed_points import COMPRESSED_POINTS
from calib_ros.messages.video import VIDEO

ROWS = dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", (ROOT / "docs/inputs.md").read_text(encoding="utf-8"), flags=re.MULTILINE))


def test_formats_lenses_and_types_of_the_readers_are_those_of_the_rows() -> None:
    suffixes = re.findall(r"`(\.\w+)`", " ".join(ROWS))
    assert set(suffixes) == {*IMAGE_SUFFIXES, *CLOUD_SUFFIXES, ".e57", ".json", ".xml"}
    assert set(ROWS["CameraInfo"].split(", ")) == set(LENSES)
    types = {kind.rpartition("/")[2] for kind in (COMPRESSED, COMPRESSED_POINTS, *VIDEO)} | set(REMEDIES)
    assert types <= {word.rpartition("/")[2] for row in ROWS for word in row.split()}
