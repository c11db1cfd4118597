"""The journal on disk: what is damaged costs its own job, and nothing of anyone else is touched."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from trial_jobs import groups

from calib_ros.errors import BadInputError
from calib_ros_check.jobs.pool import Journal
from calib_ros_evaluation.results import job

ABOUT = {"version": "1"}
FOREIGN = (b"someone else's\n", b'{"my": "data"}', b'{"my": 1}\n{"half a li', b'{"about":{},"by":"fleet check"}\n')


def test_journal_round_trip(tmp_path: Path) -> None:
    one = job("pair", "edges", "street", [0], {"seed": 1})
    with Journal(tmp_path / "new" / "folder", ABOUT) as journal:
        assert journal.done == {}
        journal.add(
            one, {"x": np.float64(0.1), "n": np.int64(3), "curve": np.array([1.5, np.nan]), "bad": [float("inf")], "t": "ü"}
        )
        told = dict(journal.done)
    with Journal(tmp_path / "new" / "folder", ABOUT) as journal:
        assert journal.done == told == {one.key: {"x": 0.1, "n": 3, "curve": [1.5, None], "bad": [None], "t": "ü"}}
        assert journal.notes == []
    entries = [json.loads(line) for line in (tmp_path / "new/folder/results.jsonl").read_text().splitlines()]
    assert entries[0] == {"about": ABOUT, "by": "evaluation"}
    named = {"experiment": "pair", "method": "edges", "scene": "street", "frames": [0], "options": [["seed", 1]]}
    assert entries[1]["job"] == named


def filled(folder: Path) -> list[bytes]:
    """A journal of three jobs; its lines."""
    with Journal(folder, ABOUT) as journal:
        for one in groups(1)[0]:
            journal.add(one, {"value": one.option("seed")})
    return (folder / "results.jsonl").read_bytes().splitlines(keepends=True)


@pytest.mark.parametrize("kept", [1, 40, -2, -1])
def test_a_line_that_was_cut_off_is_dropped(tmp_path: Path, kept: int) -> None:
    whole = filled(tmp_path)
    path = tmp_path / "results.jsonl"
    path.write_bytes(b"".join(whole[:-1]) + whole[-1][:kept])
    jobs = groups(1)[0]
    with Journal(tmp_path, ABOUT) as journal:
        assert list(journal.done) == [one.key for one in jobs[:2]]
        assert "cut off" in journal.notes[0]
        journal.add(jobs[2], {"value": 2})
    assert path.read_bytes() == b"".join(whole)


@pytest.mark.parametrize("damage", [b"\0\0\0\n", b'{"key":"a"}\n', b"[1]\n", b"\xff\xfe{\n"])
def test_a_damaged_line_costs_its_job_only(tmp_path: Path, damage: bytes) -> None:
    whole = filled(tmp_path)
    (tmp_path / "results.jsonl").write_bytes(b"".join([whole[0], whole[1], damage, whole[3]]))
    jobs = groups(1)[0]
    with Journal(tmp_path, ABOUT) as journal:
        assert list(journal.done) == [jobs[0].key, jobs[2].key]
        assert "line 3 is damaged" in journal.notes[0]


@pytest.mark.parametrize("start", [b"", b'{"abou', b'{"about": {"ver'])
def test_a_journal_killed_at_its_first_line_begins_anew(tmp_path: Path, start: bytes) -> None:
    (tmp_path / "results.jsonl").write_bytes(start)
    filled(tmp_path)
    with Journal(tmp_path, ABOUT) as journal:
        assert len(journal.done) == 3


@pytest.mark.parametrize(
    ("before", "now", "words"),
    [
        ({"version": "1"}, {"version": "2"}, ['version was "1", is now "2"']),
        ({"a": 1, "b": {"c": [1], "d": 2}}, {"a": 1, "b": {"c": [2], "d": 3}}, ["b.c was [1], is now [2]"]),
        ({"a": 1, "gone": 2}, {"a": 1}, ["gone was 2, is now null"]),
        ({"long": "x" * 500}, {"long": "y" * 500}, ['was "xxx', "...", 'is now "yyy']),
    ],
)
def test_other_evaluation_names_the_difference(tmp_path: Path, before: dict, now: dict, words: list[str]) -> None:
    with Journal(tmp_path, before):
        pass
    with pytest.raises(BadInputError, match=r"--out.*--fresh") as caught:
        Journal(tmp_path, now)
    assert all(word in str(caught.value) for word in words)
    assert len(str(caught.value)) < 400
    with Journal(tmp_path, now, fresh=True) as journal:
        assert journal.done == {}


@pytest.mark.parametrize(
    ("theirs", "fresh", "words"),
    [
        *((theirs, fresh, "was not written by this evaluation") for fresh in (False, True) for theirs in FOREIGN),
        (b'{"about":{"a"\n', False, "line 1 is damaged"),
    ],
)
def test_a_file_that_is_no_journal_of_this_command_is_refused_and_kept(
    tmp_path: Path, theirs: bytes, fresh: bool, words: str
) -> None:
    (tmp_path / "results.jsonl").write_bytes(theirs)
    with pytest.raises(BadInputError, match=f"{words}; choose another --out"):
        Journal(tmp_path, ABOUT, fresh)
    assert (tmp_path / "results.jsonl").read_bytes() == theirs


def test_two_evaluations_cannot_share_a_folder_and_some_are_impossible(tmp_path: Path) -> None:
    with Journal(tmp_path, ABOUT) as journal, pytest.raises(BadInputError, match="another evaluation is writing"):
        Journal(tmp_path, ABOUT, fresh=True)
    assert journal.path.read_bytes().count(b"\n") == 1
    for impossible in (journal.path, Path("/proc/none")):
        with pytest.raises(BadInputError, match="cannot write"):
            Journal(impossible, ABOUT)
