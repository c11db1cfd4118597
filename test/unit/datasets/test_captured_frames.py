"""What the node has captured, as a source: its extrinsic, its motion, what it said, and the keyframes that this is about."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sample_sources import Listed, frames

from calib_ros.cli.main import main
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.datasets.capture import capture_config
from calib_ros.datasets.open import is_single
from calib_ros.errors import BadInputError
from calib_ros.registration.initial_guess import nominal
from calib_ros.result import MOVED, Result
from calib_ros_check.fleet.recordings import find_recordings, is_fleet
from calib_ros_check.recording import CheckOptions, check_source

FRAMES = frames(4)
TWIST = [0.0, 0.0, 0.1, 5.0, 0.0, 0.0]
TIME = "2026-01-31T12:34:56.789+00:00"


def captured(folder: Path, *events: dict[str, Any], config: str = "") -> Path:
    write_bag(Listed(FRAMES), folder / "bag")
    Result(nominal(4.0), MOVED, time_offset_s=0.05, time_offset_sigma_s=0.001).save(folder / "result.json")
    (folder / "config.yaml").write_text(config)
    if events:
        (folder / "events.jsonl").write_text("".join(f"{json.dumps(event)}\n" for event in events))
    return folder


def test_frames_have_the_extrinsic_and_motion_of_the_node(tmp_path: Path) -> None:
    source = open_dataset(captured(tmp_path / "c", {"event": "keyframe", "stamp_ns": FRAMES[1].stamp, "twist": TWIST}))
    assert (source.name, len(source), source.middles) == ("c", 4, [0, 1, 2, 3])
    assert [None if source[k].twist is None else source[k].twist.tolist() for k in range(4)] == [None, TWIST, None, None]
    for k, frame in enumerate(FRAMES):
        np.testing.assert_array_equal(source[k].image, frame.image)
        np.testing.assert_allclose(source[k].reference, nominal(4.0), atol=1e-12)
    np.testing.assert_allclose(source.reference, nominal(4.0), atol=1e-12)
    assert source.describe()["reference"] == "from result.json"


def test_keyframes_before_the_extrinsic_was_disputed_do_not_speak_about_it(tmp_path: Path) -> None:
    said = [{"event": "status", "status": status, "time": TIME} for status in ("converged", "moved")]
    occasion = {"event": "capture", "status": "moved", "reason": "off by 2 deg", "disputed_since_ns": FRAMES[2].stamp}
    source = open_dataset(captured(tmp_path, *said, occasion))
    assert source.middles == [2, 3]
    assert source.remarks == (
        "checked is result.json, the extrinsic that the node used, by the 2 of 4 keyframes since it was disputed",
        "the node said moved: off by 2 deg",
        "status: converged 12:34:56, moved 12:34:56 UTC",
    )


def test_folders_of_former_versions_and_captures_on_request_speak_about_all(tmp_path: Path) -> None:
    source = open_dataset(captured(tmp_path))
    assert source.middles == [0, 1, 2, 3]
    assert source.remarks == ("checked is result.json, the extrinsic that the node used",)


def test_the_configuration_is_that_of_the_node_with_its_mask(tmp_path: Path) -> None:
    of_the_node = "export.joint: a, capture: {on: [moved], keep: 3}"
    text = f"search.rounds: 3, image.mask: /gone/mask.png, {of_the_node}"
    folder = captured(tmp_path, config=f"/**:\n  ros__parameters: {{{text}}}\n")
    assert capture_config(folder) == Config.from_dict({"search": {"rounds": 3}, "image": {"mask": "/gone/mask.png"}})
    cv2.imwrite(str(folder / "mask.png"), np.full((24, 40), 255, np.uint8))
    assert capture_config(folder).image.mask == str(folder / "mask.png")


def test_the_check_goes_by_what_the_node_knew_unless_told_otherwise(tmp_path: Path) -> None:
    folder = str(captured(tmp_path, config="search: {rounds: 3}"))
    checked = check_source(folder)
    assert (checked.config.search.rounds, checked.config.motion.time_offset_s) == (3, 0.05)
    assert checked.result.notes[0].startswith("checked is result.json")
    given = Config.from_dict({"search": {"rounds": 2}})
    assert check_source(folder, CheckOptions(config=given)).config == given


@pytest.mark.parametrize("line", ["{", "[1]", '{"event": "status"}\n\n'])
def test_damaged_events_are_one_line(tmp_path: Path, line: str) -> None:
    folder = captured(tmp_path)
    (folder / "events.jsonl").write_text(line)
    with pytest.raises(BadInputError, match=r"events\.jsonl must hold a JSON object in each line; copy the folder again"):
        open_dataset(folder)


def test_a_capture_is_one_recording_and_a_folder_of_them_a_fleet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = (captured(tmp_path / name) for name in ("event_a", "event_b"))
    assert is_single(first)
    assert not is_fleet([str(first)])
    assert is_fleet([str(tmp_path)])
    assert [Path(recording.path) for recording in find_recordings([str(tmp_path)])] == [first, second]
    assert main(["info", str(first)]) == 0
    assert "4 pairs" in capsys.readouterr().out
