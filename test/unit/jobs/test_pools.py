"""An evaluation that is killed, loses workers or runs twice at once gives every result once."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import cv2
import pytest
import trial_jobs
from paths import ROOT, SUPPORT
from trial_jobs import answers, fall, groups, refuse, work

from calib_ros.errors import BadInputError, CalibrationError, TooFewFeaturesError
from calib_ros_check.jobs import cluster
from calib_ros_check.jobs.cluster import ClusterPool
from calib_ros_check.jobs.journal import Answer, Journal
from calib_ros_check.jobs.local import LocalPool
from calib_ros_check.jobs.pool import Pool, run
from calib_ros_evaluation.experiments.job import EvaluationJob, job

ABOUT = {"version": "1"}


def silent(done: int, total: int) -> None:
    """No progress wanted."""


def expected(n: int) -> dict[str, Answer]:
    return {one.key: answer for group in groups(n) for one, answer in zip(group, answers(group), strict=True)}


def performed(folder: Path) -> list[str]:
    """Keys of what `work` did, in order."""
    return [line.split(" ", 1)[1] for line in (folder / "log").read_text().splitlines()]


def busy(folder: Path) -> set[int]:
    """Processes that began something of it."""
    return {int(path.name.rpartition("-")[2]) for path in folder.glob("at-work-*")}


def until(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def lines(folder: Path) -> int:
    path = folder / "results.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def alive(pid: int) -> bool:
    """Whether a process runs; one that nobody has waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


# --- local workers


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(SUPPORT), str(ROOT), os.environ.get("PYTHONPATH", "")])}


def test_a_full_disk_leaves_no_half_line(tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk."""
    script = (
        "import resource, signal, sys; from pathlib import Path; from trial_jobs import *\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "run(groups(9), answers, Journal(Path(sys.argv[1]), {'version': '1'}), LocalPool(1), lambda done, total: None)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True, env=environment())
    assert "CalibrationError: cannot write" in done.stderr
    assert "goes on where it stopped" in done.stderr
    with Journal(tmp_path, ABOUT) as journal:
        assert journal.notes == []
        assert 0 < len(journal.done) < 27
        run(groups(9), answers, journal, LocalPool(1), silent)
        assert journal.done == expected(9)


@pytest.mark.parametrize("workers", [1, 2])
def test_every_job_once(tmp_path: Path, workers: int) -> None:
    told: list[tuple[int, int]] = []
    twice = [*groups(6), groups(6)[2]]  # a job that is asked for twice is one job
    with Journal(tmp_path, ABOUT) as journal:
        run(twice, partial(work, tmp_path, 0.005), journal, LocalPool(workers), lambda *counts: told.append(counts))
        assert journal.done == expected(6)
    assert sorted(performed(tmp_path)) == sorted(expected(6))
    assert told == [(n, 18) for n in range(0, 19, 3)]
    told.clear()
    with Journal(tmp_path, ABOUT) as journal:
        run(groups(7), partial(work, tmp_path, 0.005), journal, LocalPool(workers), lambda *counts: told.append(counts))
    assert len(performed(tmp_path)) == 21
    assert told == [(18, 21), (21, 21)]


def test_killed_evaluation_resumes(tmp_path: Path) -> None:
    command = [sys.executable, str(SUPPORT / "trial_jobs.py"), str(tmp_path), "30", "2", "0.05"]
    process = subprocess.Popen(command, env=environment())
    until(lambda: lines(tmp_path) > 10 and len(busy(tmp_path)) == 2)
    process.kill()
    process.wait()
    workers = busy(tmp_path)
    until(lambda: not any(map(alive, workers)))  # they end with it
    with Journal(tmp_path, ABOUT) as journal:
        kept = set(journal.done)
    assert 9 < len(kept) < 90
    first = performed(tmp_path)

    subprocess.run(command, env=environment(), check=True)
    with Journal(tmp_path, ABOUT) as journal:
        assert journal.done == expected(30)
        assert lines(tmp_path) == 91
    again = performed(tmp_path)[len(first) :]
    assert sorted(again) == sorted(set(expected(30)) - kept)


def test_busy_worker_ends_with_the_evaluation(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, str(SUPPORT / "trial_jobs.py"), str(tmp_path), "2", "2", "60"], env=environment())
    until(lambda: len(busy(tmp_path)) == 2)
    process.kill()
    process.wait()
    until(lambda: not any(map(alive, busy(tmp_path))))


def test_ctrl_c_stops_all_at_once(tmp_path: Path) -> None:
    """As a terminal sends it: to all processes of the group."""
    process = subprocess.Popen(
        [sys.executable, str(SUPPORT / "trial_jobs.py"), str(tmp_path), "90", "2", "0.2"],
        env=environment(),
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # shells have background jobs ignore it
    )
    until(lambda: len(busy(tmp_path)) == 2)
    workers = busy(tmp_path)
    for pid in workers:
        os.kill(pid, signal.SIGINT)
    before = lines(tmp_path)
    until(lambda: lines(tmp_path) > before + 6)
    assert busy(tmp_path) == workers  # they do not mind
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert process.returncode == -signal.SIGINT
    assert err.count("Traceback") == 1  # its own, none of a worker
    assert not any(map(alive, workers))
    assert lines(tmp_path) < 200


def test_a_group_whose_worker_died_is_done_again(tmp_path: Path) -> None:
    with Journal(tmp_path, ABOUT) as journal:
        run(groups(8), partial(fall, tmp_path, 1), journal, LocalPool(2), silent)
        assert journal.done == expected(8)
    did = performed(tmp_path)
    assert set(did) == set(expected(8))
    assert len(did) <= len(expected(8)) + 3  # what ran beside it may have run twice
    assert did[-6:].count(groups(8)[3][0].key) == 1  # at the end, after all that never was in a crash


def test_a_group_that_kills_its_worker_twice_is_named(tmp_path: Path) -> None:
    with Journal(tmp_path, ABOUT) as journal:
        with pytest.raises(CalibrationError, match=r"killed by SIGKILL: pair\|edges\|street\|3,4\|seed=0.*fewer --workers"):
            run(groups(8), partial(fall, tmp_path, 2), journal, LocalPool(2), silent)
        assert len(journal.done) == 21


@pytest.mark.parametrize("workers", [1, 2])
def test_job_exceptions_propagate(tmp_path: Path, workers: int) -> None:
    with Journal(tmp_path, ABOUT) as journal:
        with pytest.raises(TooFewFeaturesError, match="frame 3 is bad"):
            run(groups(8), partial(refuse, TooFewFeaturesError), journal, LocalPool(workers), silent)
        assert 6 <= len(journal.done) < 24
        assert not set(journal.done) & {one.key for one in groups(8)[3]}


def test_unpicklable_error_arrives_as_text(tmp_path: Path) -> None:
    with Journal(tmp_path, ABOUT) as journal, pytest.raises(RuntimeError, match="Unportable: no way") as caught:
        run(groups(8), partial(refuse, trial_jobs.Unportable), journal, LocalPool(2), silent)
    assert "trial_jobs.py" in str(caught.value.__cause__)  # where in the worker


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_have_one_thread(tmp_path: Path, workers: int) -> None:
    before = cv2.getNumThreads(), os.environ.get("OPENBLAS_NUM_THREADS")
    with Journal(tmp_path, ABOUT) as journal:
        run(groups(2), trial_jobs.threads, journal, LocalPool(workers), silent)
        for answer in journal.done.values():
            assert answer["cv2"] == 1
            assert workers == 1 or answer["blas"] == "1"
    assert before == (cv2.getNumThreads(), os.environ.get("OPENBLAS_NUM_THREADS"))


def test_worker_start_failure_is_not_attributed_to_a_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a library of the interpreter is broken: the process ends before it asks for a job."""
    broken = "import os, sys\nif '--multiprocessing-fork' in sys.orig_argv: os._exit(7)\n"
    (tmp_path / "sitecustomize.py").write_text(broken)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with Journal(tmp_path, ABOUT) as journal, pytest.raises(CalibrationError, match="at its start, exit status 7"):
        run(groups(8), answers, journal, LocalPool(2), silent)
    with pytest.raises(BadInputError, match="at least 1"):
        LocalPool(0)


def lost(jobs: Sequence[EvaluationJob], how: str) -> list[Answer]:
    """What becomes of jobs that nobody finishes."""
    return [{"lost": how} for _ in jobs]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_group_that_kills_its_workers_may_be_an_outcome(tmp_path: Path, workers: int) -> None:
    with Journal(tmp_path, ABOUT) as journal:
        run(groups(8), partial(fall, tmp_path, 99), journal, LocalPool(workers), silent, lost)
        bad = {one.key for one in groups(8)[3]}
        assert {key: answer for key, answer in journal.done.items() if key not in bad} == {
            key: answer for key, answer in expected(8).items() if key not in bad
        }
        assert [journal.done[key] for key in bad] == 3 * [{"lost": "its worker ended twice, killed by SIGKILL"}]


# --- Dask workers


@contextmanager
def scheduler(workers: int, threads: int = 1) -> Iterator[object]:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=workers, threads_per_worker=threads, processes=True, host="127.0.0.1", dashboard_address=None, silence_logs=50
    ) as local:
        yield local


def test_dask_gives_the_same_results_even_if_a_worker_is_lost(tmp_path: Path) -> None:
    with scheduler(2) as local, Journal(tmp_path, ABOUT) as journal:
        victims: list[int] = []

        def rob(done: int, total: int) -> None:
            if done >= 9 and not victims:
                victims.append(int((tmp_path / "log").read_text().split()[0]))
                os.kill(victims[0], signal.SIGKILL)

        run(groups(20), partial(work, tmp_path, 0.05), journal, ClusterPool(local.scheduler_address), rob)
        assert journal.done == expected(20)
        did = performed(tmp_path)
        assert set(did) == set(expected(20))
        assert len(did) - 60 <= 4 * 3  # what it had finished and not handed over, or held, was done again
        assert len(victims) == 1

        one_more = [[job("other", "edges", "street", [3])]]
        with pytest.raises(TooFewFeaturesError, match="frame 3 is bad"):
            run(one_more, partial(refuse, TooFewFeaturesError), journal, ClusterPool(local.scheduler_address), silent)


@pytest.mark.slow  # Dask starts a dozen workers anew, one after the other
def test_a_group_that_kills_its_dask_workers_may_be_an_outcome(tmp_path: Path) -> None:
    dask = pytest.importorskip("dask")
    patience = dask.config.set({"distributed.scheduler.allowed-failures": 1})  # instead of 3
    with patience, scheduler(2) as local, Journal(tmp_path, ABOUT) as journal:
        pool = ClusterPool(local.scheduler_address)
        run(groups(8), partial(fall, tmp_path, 99), journal, pool, silent, lost)
        bad = {one.key for one in groups(8)[3]}
        assert {key for key, answer in journal.done.items() if "lost" in answer} == bad
        assert len(journal.done) == 24
        assert len(list(tmp_path.glob("died-*"))) > 2  # with others, and alone
        with pytest.raises(CalibrationError, match=r"several workers ended with these jobs: other\|edges\|street\|3"):
            run([[job("other", "edges", "street", [3])]], partial(fall, tmp_path, 99), journal, pool, silent)


def test_dask_workers_that_do_not_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with scheduler(1, threads=2) as local, Journal(tmp_path, ABOUT) as journal:
        pool = ClusterPool(local.scheduler_address)
        with pytest.raises(CalibrationError, match=r"has 2 threads.*--nthreads 1"):
            run(groups(1), answers, journal, pool, silent)
        monkeypatch.setattr(cluster, "VERSION", "99.0")  # here, not on the worker
        with pytest.raises(CalibrationError, match=r"must be installed on.*; tcp://.* has 0\.1"):
            run(groups(1), answers, journal, pool, silent)
        assert journal.done == {}


def test_worker_without_calib_ros_is_reported(tmp_path: Path) -> None:
    """A worker elsewhere, with a Python where calib_ros is not installed: here a finder of modules that does not find it."""
    pytest.importorskip("distributed")
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\nclass No:\n    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] == 'calib_ros': raise ModuleNotFoundError(f'No module named {name!r}')\n"
        "sys.meta_path.insert(0, No())\n"
    )
    with scheduler(0) as local, Journal(tmp_path, ABOUT) as journal:
        command = [
            sys.executable,
            "-m",
            "distributed.cli.dask_worker",
            local.scheduler_address,
            "--nthreads",
            "1",
            "--no-dashboard",
        ]
        with subprocess.Popen(
            [*command, "--no-nanny", "--local-directory", str(tmp_path)],
            env=os.environ | {"PYTHONPATH": str(tmp_path)},
            stderr=subprocess.DEVNULL,
        ) as process:
            try:
                with pytest.raises(CalibrationError, match=r"must be installed.*tcp://.*No module named 'calib_ros'"):
                    run(groups(1), answers, journal, ClusterPool(local.scheduler_address), silent)
            finally:
                process.terminate()


def test_a_scheduler_without_workers_and_one_that_is_lost(tmp_path: Path) -> None:
    """The scheduler in a process of its own, with one worker; it is killed when the first answers are there."""
    pytest.importorskip("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    address = f"tcp://127.0.0.1:{port}"
    module = [sys.executable, "-m"]
    options = {"env": environment(), "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    with (
        subprocess.Popen(
            [*module, "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"], **options
        ) as head,
        Journal(tmp_path, ABOUT) as journal,
    ):
        try:
            with pytest.raises(CalibrationError, match=r"no workers.*dask worker"):
                run(groups(1), answers, journal, ClusterPool(address, wait_s=0.2), silent)
            worker = [*module, "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
            with subprocess.Popen(worker, **options) as hand:
                try:
                    slow = partial(work, tmp_path, 0.1)
                    with pytest.raises(CalibrationError, match=r"scheduler at tcp.* is lost.*goes on where it stopped"):
                        run(groups(40), slow, journal, ClusterPool(address), lambda done, total: head.kill() if done else None)
                finally:
                    hand.kill()
            assert 3 <= len(journal.done) < 120
        finally:
            head.kill()


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("tcp://127.0.0.1:9", "no Dask scheduler answers at tcp://127.0.0.1:9"),
        ("nonsense", "'nonsense' is no address"),
        ("127.0.0.1:port", "is no address"),
    ],
)
def test_an_address_where_no_scheduler_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, address: str, words: str) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "CONNECT_S", 1.0)
    with Journal(tmp_path, ABOUT) as journal, pytest.raises(BadInputError, match=words):
        run(groups(1), answers, journal, ClusterPool(address), silent)


def test_pool_interfaces() -> None:
    """For mypy, which does not read tests, and for the reader."""
    pools: Sequence[Pool] = [LocalPool(1), ClusterPool("tcp://127.0.0.1:9")]
    jobs: Sequence[Sequence[EvaluationJob]] = []
    assert [list(pool.results(answers, jobs)) for pool in pools[:1]] == [[]]
