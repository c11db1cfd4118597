"""The saved state is the last good extrinsic or is refused, whatever happens to the file or its writer."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from calib_ros import io, se3
from calib_ros.camera import Camera
from calib_ros.config import Config, SearchConfig
from calib_ros.errors import BadInputError
from calib_ros.io import write_atomically
from calib_ros.online.state import load_state, provenance_of, read_state, save_state
from calib_ros.result import CONVERGED, VERSION, Result

ROOT = np.random.default_rng(5).normal(size=(6, 6))
COVARIANCE = 1e-5 * ROOT @ ROOT.T
RESULT = Result(
    se3.exp([0.1, -1.2, 0.9, 0.27, -0.05, -1e-7]),
    CONVERGED,
    "état",
    0.7251,
    COVARIANCE,
    12,
    "cam_2",
    "velo",
    1.23456,
    frame_scores=(0.7, 0.75),
    frame_names=("0000000004", "0000000017"),
    stamp="2026-01-02T03:04:05.678+00:00",
)
CAMERA = Camera(np.array([[700.1, 0, 600], [0, 701.2, 180], [0, 0, 1]]), 1242, 375, "plumb_bob", [-0.3, 0.1, 1e-4, 0, 0])
PROVENANCE = provenance_of(Config(), accepted=7, keyframes=31, sensor_stamp_ns=1_700_000_000_123_456_789)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    save_state(tmp_path / "state.json", RESULT, CAMERA, PROVENANCE)
    return tmp_path / "state.json"


def restored(path: Path) -> Result:
    return load_state(path, CAMERA, "cam_2", "velo")


def same(result: Result) -> None:
    assert np.allclose(result.T_camera_lidar, RESULT.T_camera_lidar, rtol=0, atol=1e-14)
    assert np.array_equal(result.covariance, COVARIANCE)
    for name in ("status", "reason", "score", "frames_used", "camera_frame", "lidar_frame", "stamp"):
        assert getattr(result, name) == getattr(RESULT, name), name


def refused(path: Path, data: bytes) -> bool:
    """Is the file with this content refused, in one line that names it? If not, it is the whole state."""
    path.unlink(missing_ok=True)  # ext4 flushes a file that is cut to nothing and written again, and thousands are written here
    path.write_bytes(data)
    message = ""
    try:
        same(restored(path))
    except BadInputError as error:
        message = str(error)
    assert not message or (str(path) in message and "\n" not in message)
    return message != ""


# --- what goes out comes back ---------------------------------------------------------------------------------------------


def test_state_round_trip(path: Path) -> None:
    held = read_state(path)
    same(restored(path))
    same(held.result)
    assert held.camera == CAMERA
    assert held.provenance == PROVENANCE
    data = json.loads(path.read_text())
    assert (data["version"], data["stamp"], data["frames_used"]) == (VERSION, RESULT.stamp, 12)
    assert [frame["name"] for frame in data["frames"]] == ["0000000004", "0000000017"]
    assert data["provenance"]["objective"] == "fast"
    assert path.stat().st_mode & 0o777 == 0o644
    assert [p.name for p in path.parent.iterdir()] == ["state.json"]


def test_the_fingerprint_is_that_of_the_constants() -> None:
    same, other = (provenance_of(Config(search=search), 0, 0, 0)["config"] for search in (SearchConfig(), SearchConfig(seed=8)))
    assert other != same == PROVENANCE["config"]
    assert re.fullmatch("[0-9a-f]{16}", same)


def test_states_of_older_versions_are_read(path: Path) -> None:
    save_state(path, RESULT, CAMERA)
    assert read_state(path).provenance == {"sensor_stamp_ns": 0}
    data = json.loads(path.read_text())
    del data["sha256"], data["provenance"]  # as files were before they had checksums
    path.write_text(json.dumps(data))
    same(restored(path))
    assert read_state(path).provenance is None
    RESULT.save(path)  # a result file of the command line
    same(restored(path))


@pytest.mark.parametrize("dumps", [yaml.safe_dump, json.dumps, lambda data: json.dumps(dict(reversed(data.items())), indent=8)])
def test_hand_written_and_reformatted_states_are_accepted(path: Path, dumps: Callable[[object], str]) -> None:
    whole = json.loads(path.read_text())
    data = {"translation_m": [1, 2, 3], "quaternion_xyzw": [0, 0, 0, 1], "camera_frame": "cam_2", "lidar_frame": "velo"}
    path.write_text(dumps(data))
    assert restored(path).T_camera_lidar[:3, 3].tolist() == [1, 2, 3]
    assert read_state(path).camera is None
    path.write_text(dumps(whole))
    same(restored(path))
    assert read_state(path).camera == CAMERA


# --- other sensors --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("camera", "lidar"), [("cam_3", "velo"), ("cam_2", "top"), ("velo", "cam_2"), ("", ""), ("CAM_2", "velo")]
)
def test_other_frames_are_refused(path: Path, camera: str, lidar: str) -> None:
    with pytest.raises(BadInputError, match=f"velo -> cam_2, but the sensors are {lidar} -> {camera};"):
        load_state(path, CAMERA, camera, lidar)


@pytest.mark.parametrize(
    ("camera", "text"),
    [
        (Camera(CAMERA.K, 1241, 375, "plumb_bob", CAMERA.D), "1242x375, now 1241x375"),
        (Camera(CAMERA.K, 1242, 375), "plumb_bob with 5 coefficients, now plumb_bob with 0"),
        (Camera(CAMERA.K, 1242, 375, "equidistant", CAMERA.D[:4]), "now equidistant with 4"),
        (Camera(CAMERA.K + np.diag([0.5, 0, 0]), 1242, 375, "plumb_bob", CAMERA.D), "fx 700.1 fy 701.2 .*, now 700.6 701.2"),
        (Camera(CAMERA.K, 1242, 375, "plumb_bob", CAMERA.D * 1.01), "now"),
    ],
)
def test_another_camera_is_refused(path: Path, camera: Camera, text: str) -> None:
    with pytest.raises(BadInputError, match=text):
        load_state(path, camera, "cam_2", "velo")


# --- damage ---------------------------------------------------------------------------------------------------------------


def test_cut_off_at_every_byte(path: Path) -> None:
    whole = path.read_bytes()
    loaded = [end for end in range(len(whole) + 1) if not refused(path, whole[:end])]
    assert loaded == [len(whole) - 1, len(whole)]  # without the last newline it is whole


def test_a_flipped_bit_in_every_byte(path: Path) -> None:
    whole, rng = path.read_bytes(), np.random.default_rng(1)
    bits = rng.integers(8, size=len(whole))
    count = sum(refused(path, whole[:k] + bytes([whole[k] ^ 1 << int(bit)]) + whole[k + 1 :]) for k, bit in enumerate(bits))
    assert count > 0.95 * len(whole)  # the rest is white space, and the e of 1e-05 that becomes an E


@pytest.mark.parametrize("checksum", [None, 5, "", [], {}, True, "0" * 64, "é"])
def test_malformed_checksums_are_refused(path: Path, checksum: object) -> None:
    data = json.loads(path.read_text())
    assert refused(path, json.dumps({**data, "sha256": checksum}).encode())
    del data["sha256"]  # a writer of provenance writes a checksum
    assert refused(path, json.dumps(data).encode())


GARBAGE = [0, -1, 1e999, float("nan"), "", "x", True, [], [[]], {}, {"a": 1}, ["x"] * 4, [None] * 16, "9" * 5000]


@pytest.mark.parametrize("key", ["T_camera_lidar", "covariance", "score", "frames_used", "camera_frame", "lidar_frame", "camera"])
def test_values_of_the_wrong_type(path: Path, key: str) -> None:
    """In a file without checksum, so that the values themselves are looked at."""
    data = json.loads(path.read_text())
    del data["sha256"], data["provenance"]
    for value in GARBAGE:
        path.write_text(json.dumps({**data, key: value}))
        with contextlib.suppress(BadInputError):
            assert np.allclose(restored(path).T_camera_lidar, RESULT.T_camera_lidar)
            assert key in ("score", "frames_used", "covariance")


@pytest.mark.parametrize(
    "bad",
    [
        replace(RESULT, T_camera_lidar=np.full((4, 4), np.nan)),
        replace(RESULT, T_camera_lidar=2 * np.eye(4)),
        replace(RESULT, covariance=np.full((6, 6), np.inf)),
        replace(RESULT, covariance=np.eye(3)),
    ],
)
def test_unreadable_state_never_replaces_a_readable_one(path: Path, bad: Result) -> None:
    with pytest.raises(BadInputError, match="the state to be saved"):
        save_state(path, bad, CAMERA)
    same(restored(path))


# --- writers that die -----------------------------------------------------------------------------------------------------

KILLED = f"""
import os, signal, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_state import *
io.os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
save_state(sys.argv[1], replace(RESULT, reason="another"), CAMERA)
"""


def test_killed_in_the_middle_of_saving(path: Path) -> None:
    """The old state stays, beside a file that a later write removes."""
    done = subprocess.run([sys.executable, "-c", KILLED, str(path)], timeout=120)
    assert done.returncode == -signal.SIGKILL
    same(restored(path))
    (left,) = {p.name for p in path.parent.iterdir()} - {path.name}
    assert re.fullmatch(r"\.state\.json\.[a-z0-9_]{8}\.partial", left)


def test_only_abandoned_temporary_files_are_removed(tmp_path: Path) -> None:
    keep = [".state.json.original", "state.json.abcdefgh.partial", ".other.json.abcdefgh.partial", ".state.json.ABCDEFGH.partial"]
    keep += [".state.json.abcdefghi.partial", ".stateXjson.abcdefgh.partial", ".state.json.partial", "state.json~"]
    gone = [".state.json.abcdefgh.partial", ".state.json.a_b0c9de.partial"]
    for name in keep + gone:
        (tmp_path / name).write_text("x")
        os.utime(tmp_path / name, (0, 0))
    (tmp_path / ".state.json.afolder1.partial").mkdir()
    os.utime(tmp_path / ".state.json.afolder1.partial", (0, 0))
    save_state(tmp_path / "state.json", RESULT, CAMERA)
    same(restored(tmp_path / "state.json"))
    assert not set(gone) & {p.name for p in tmp_path.iterdir()}
    assert set(keep) <= {p.name for p in tmp_path.iterdir()}


def test_a_power_cut_after_the_rename(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file is flushed before it gets its name, the folder after, although not every one can be."""
    calls: list[str] = []
    fsync, rename = os.fsync, os.replace

    def flushed(handle: int) -> None:
        calls.append("folder" if os.path.isdir(f"/proc/self/fd/{handle}") else "file")
        if calls[-1] == "folder":
            raise OSError(22, "Invalid argument")
        fsync(handle)

    monkeypatch.setattr(io.os, "fsync", flushed)
    monkeypatch.setattr(io.os, "replace", lambda a, b: (calls.append("rename"), rename(a, b)))
    write_atomically(tmp_path / "file", b"x")
    assert calls == ["file", "rename", "folder"]
    assert (tmp_path / "file").read_bytes() == b"x"
