"""An evaluation that is killed, loses workers or runs twice at once gives every result once."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import cv2
import pytest
import trial_jobs
from paths import ROOT, SUPPORT
from trial_jobs import answers, fall, groups, refuse, work
from waiting import LIMIT_S, until

from calib_ros.errors import BadInputError, CalibrationError, TooFewFeaturesError
from calib_ros_check.jobs import cluster
from calib_ros_check.jobs.cluster import ClusterPool
from calib_ros_check.jobs.journal import Answer, Journal
from calib_ros_check.jobs.local import LocalPool
from calib_ros_check.jobs.pool import Pool, run
from calib_ros_evaluation.experiments.job import EvaluationJob, job

ABOUT = {"version": "1"}
BAD = {one.key for one in groups(8)[3]}  # jobs of `fall` and `refuse` that do not go well


def expected(n: int, without: set[str] = frozenset()) -> dict[str, Answer]:
    found = {one.key: answer for group in groups(n) for one, answer in zip(group, answers(group), strict=True)}
    return {key: answer for key, answer in found.items() if key not in without}


def ran(
    folder: Path,
    pool: Pool,
    run_jobs: Callable,
    jobs: Sequence[Sequence[EvaluationJob]] = groups(8),
    progress: Callable[[int, int], object] = lambda done, total: None,
    lost: Callable | None = None,
) -> dict[str, Answer]:
    """All answers of the journal in a folder, once the jobs are done."""
    with Journal(folder, ABOUT) as journal:
        run(jobs, run_jobs, journal, pool, progress, lost)
        return dict(journal.done)


def kept(folder: Path) -> dict[str, Answer]:
    """The answers of a journal."""
    with Journal(folder, ABOUT) as journal:
        assert journal.notes == []
        return dict(journal.done)


def performed(folder: Path) -> list[str]:
    """Keys of what `work` did, in order."""
    return [line.split(" ", 1)[1] for line in (folder / "log").read_text().splitlines()]


def busy(folder: Path) -> set[int]:
    """Processes that began something of it."""
    return {int(path.name.rpartition("-")[2]) for path in folder.glob("at-work-*")}


def lines(folder: Path) -> int:
    path = folder / "results.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def alive(pid: int) -> bool:
    """Whether a process runs; one that nobody has waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(SUPPORT), str(ROOT), os.environ.get("PYTHONPATH", "")])}


def command(folder: Path, *numbers: float) -> list[str]:
    """A small evaluation in a process of its own: groups, workers, seconds of each group."""
    return [sys.executable, str(SUPPORT / "trial_jobs.py"), str(folder), *map(str, numbers)]


# --- local workers


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
    assert 0 < len(kept(tmp_path)) < 27
    assert ran(tmp_path, LocalPool(1), answers, groups(9)) == expected(9)


@pytest.mark.parametrize("workers", [1, 2])
def test_every_job_once(tmp_path: Path, workers: int) -> None:
    told: list[tuple[int, int]] = []
    twice = [*groups(6), groups(6)[2]]  # a job that is asked for twice is one job
    doing, tell = partial(work, tmp_path, 0.005), lambda *counts: told.append(counts)
    assert ran(tmp_path, LocalPool(workers), doing, twice, tell) == expected(6)
    assert sorted(performed(tmp_path)) == sorted(expected(6))
    assert told == [(n, 18) for n in range(0, 19, 3)]
    told.clear()
    ran(tmp_path, LocalPool(workers), doing, groups(7), tell)
    assert len(performed(tmp_path)) == 21
    assert told == [(18, 21), (21, 21)]


def test_a_killed_evaluation_ends_its_workers_and_resumes(tmp_path: Path) -> None:
    for seconds, begun in ((0.5, 10), (60, 0)):  # also of workers in the middle of a group
        folder = tmp_path / f"{seconds}"
        folder.mkdir()
        process = subprocess.Popen(command(folder, 30, 2, seconds), env=environment())
        until(lambda folder=folder, begun=begun: lines(folder) > begun and len(busy(folder)) == 2, "work")
        process.kill()
        process.wait()
        until(lambda folder=folder: not any(map(alive, busy(folder))), "their end")
    folder = tmp_path / "0.5"
    before, first = set(kept(folder)), performed(folder)
    assert 9 < len(before) < 90
    subprocess.run(command(folder, 30, 2, 0.05), env=environment(), check=True)
    assert kept(folder) == expected(30)
    assert lines(folder) == 91
    assert sorted(performed(folder)[len(first) :]) == sorted(set(expected(30)) - before)


def test_ctrl_c_stops_all_at_once(tmp_path: Path) -> None:
    """As a terminal sends it: to all processes of the group."""
    process = subprocess.Popen(
        command(tmp_path, 90, 2, 0.2),
        env=environment(),
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # shells have background jobs ignore it
    )
    until(lambda: len(busy(tmp_path)) == 2, "two workers")
    workers = busy(tmp_path)
    for pid in workers:
        os.kill(pid, signal.SIGINT)
    before = lines(tmp_path)
    until(lambda: lines(tmp_path) > before + 6, "answers")
    assert busy(tmp_path) == workers  # they do not mind
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode == -signal.SIGINT
    assert err.count("Traceback") == 1  # its own, none of a worker
    assert not any(map(alive, workers))
    assert lines(tmp_path) < 200


def lost(jobs: Sequence[EvaluationJob], how: str) -> list[Answer]:
    """What becomes of jobs that nobody finishes."""
    return [{"lost": how} for _ in jobs]


def test_a_group_whose_worker_died_is_done_again_and_at_last_named(tmp_path: Path) -> None:
    (tmp_path / "once").mkdir()
    assert ran(tmp_path / "once", LocalPool(2), partial(fall, tmp_path / "once", 1)) == expected(8)
    did = performed(tmp_path / "once")
    assert sorted(did) == sorted(expected(8))
    assert set(did[-3:]) == BAD  # at the end, after all that never was in a crash
    with pytest.raises(CalibrationError, match=r"SIGKILL, also alone: pair\|edges\|street\|3,4\|seed=0.*fewer --workers"):
        ran(tmp_path, LocalPool(2), partial(fall, tmp_path, 2))
    assert kept(tmp_path) == expected(8, BAD)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_group_that_kills_its_workers_may_be_an_outcome(tmp_path: Path, workers: int) -> None:
    found = ran(tmp_path, LocalPool(workers), partial(fall, tmp_path, 99), lost=lost)
    assert found == expected(8, BAD) | {key: {"lost": "its worker was killed by SIGKILL, also alone"} for key in BAD}


@pytest.mark.parametrize("workers", [1, 2])
def test_errors_of_jobs_propagate(tmp_path: Path, workers: int) -> None:
    with pytest.raises(TooFewFeaturesError, match="frame 3 is bad"):
        ran(tmp_path, LocalPool(workers), partial(refuse, TooFewFeaturesError))
    assert 6 <= len(kept(tmp_path)) < 24
    assert not set(kept(tmp_path)) & BAD
    if workers > 1:
        with pytest.raises(RuntimeError, match="Unportable: no way") as caught:
            ran(tmp_path, LocalPool(workers), partial(refuse, trial_jobs.Unportable))
        assert "trial_jobs.py" in str(caught.value.__cause__)  # where in the worker


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_have_one_thread(tmp_path: Path, workers: int) -> None:
    before = cv2.getNumThreads(), os.environ.get("OPENBLAS_NUM_THREADS")
    for answer in ran(tmp_path, LocalPool(workers), trial_jobs.threads, groups(2)).values():
        assert answer["cv2"] == 1
        assert workers == 1 or answer["blas"] == "1"
    assert before == (cv2.getNumThreads(), os.environ.get("OPENBLAS_NUM_THREADS"))


def test_worker_start_failure_is_not_attributed_to_a_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a library of the interpreter is broken: the process ends before it asks for a job."""
    broken = "import os, sys\nif '--multiprocessing-fork' in sys.orig_argv: os._exit(7)\n"
    (tmp_path / "sitecustomize.py").write_text(broken)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(CalibrationError, match="at its start, a worker ended with exit status 7"):
        ran(tmp_path, LocalPool(2), answers)
    with pytest.raises(BadInputError, match="at least 1"):
        LocalPool(0)


# --- Dask workers


@contextmanager
def scheduler(workers: int, threads: int = 1) -> Iterator[str]:
    """Its address."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=workers, threads_per_worker=threads, processes=True, host="127.0.0.1", dashboard_address=None, silence_logs=50
    ) as local:
        yield local.scheduler_address


def test_dask_gives_the_same_results_even_if_a_worker_is_lost(tmp_path: Path) -> None:
    victims: list[int] = []

    def rob(done: int, total: int) -> None:
        if done >= 9 and not victims:
            victims.append(int((tmp_path / "log").read_text().split()[0]))
            os.kill(victims[0], signal.SIGKILL)

    with scheduler(2) as address:
        assert ran(tmp_path, ClusterPool(address), partial(work, tmp_path, 0.05), groups(20), rob) == expected(20)
        did = performed(tmp_path)
        assert set(did) == set(expected(20))
        assert len(did) - 60 <= 4 * 3  # what it had finished and not handed over, or held, was done again
        assert len(victims) == 1
        with pytest.raises(TooFewFeaturesError, match="frame 3 is bad"):
            ran(tmp_path, ClusterPool(address), partial(refuse, TooFewFeaturesError), [[job("other", "edges", "street", [3])]])


@pytest.mark.slow  # Dask starts a dozen workers anew, one after the other
def test_a_group_that_kills_its_dask_workers_may_be_an_outcome(tmp_path: Path) -> None:
    dask = pytest.importorskip("dask")
    patience = dask.config.set({"distributed.scheduler.allowed-failures": 1})  # instead of 3
    with patience, scheduler(2) as address:
        found = ran(tmp_path, ClusterPool(address), partial(fall, tmp_path, 99), lost=lost)
        assert {key for key, answer in found.items() if "lost" in answer} == BAD
        assert len(found) == 24
        assert len(list(tmp_path.glob("died-*"))) > 2  # with others, and alone
        with pytest.raises(CalibrationError, match=r"ended several times, also alone: other\|edges\|street\|3"):
            ran(tmp_path, ClusterPool(address), partial(fall, tmp_path, 99), [[job("other", "edges", "street", [3])]])


def test_where_all_dask_workers_have_gone_it_is_said(tmp_path: Path) -> None:
    """Killed without a nanny that would start them again."""
    pytest.importorskip("distributed")
    with scheduler(0) as address:
        options = (address, "--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path))
        with process_of_dask("worker", tmp_path, *options) as worker:
            pool = ClusterPool(address, wait_s=LIMIT_S)

            def end(done: int, total: int) -> None:
                if done:
                    worker.kill()
                    pool.wait_s = 0.2

            with pytest.raises(CalibrationError, match=r"has no workers any more.*goes on where it stopped"):
                ran(tmp_path, pool, partial(work, tmp_path, 0.1), groups(40), end)
    assert 3 <= len(kept(tmp_path)) < 120


def test_dask_workers_that_do_not_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with scheduler(1, threads=2) as address:
        with pytest.raises(CalibrationError, match=r"has 2 threads.*--nthreads 1"):
            ran(tmp_path, ClusterPool(address), answers)
        monkeypatch.setattr(cluster, "VERSION", "99.0")  # here, not on the worker
        with pytest.raises(CalibrationError, match=r"must be installed on.*; tcp://.* has 0\.1"):
            ran(tmp_path, ClusterPool(address), answers)
    assert kept(tmp_path) == {}


@contextmanager
def process_of_dask(kind: str, folder: Path, *options: str, **variables: str) -> Iterator[subprocess.Popen]:
    """A scheduler or a worker in a process of its own."""
    line = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *options, "--no-dashboard"]
    with subprocess.Popen(line, env=environment() | variables, stderr=subprocess.DEVNULL, cwd=folder) as process:
        try:
            yield process
        finally:
            process.kill()


def test_worker_without_calib_ros_is_reported(tmp_path: Path) -> None:
    """A worker elsewhere, with a Python where calib_ros is not installed: here a finder of modules that does not find it."""
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\nclass No:\n    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] == 'calib_ros': raise ModuleNotFoundError(f'No module named {name!r}')\n"
        "sys.meta_path.insert(0, No())\n"
    )
    options = ("--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path))
    with (
        scheduler(0) as address,
        process_of_dask("worker", tmp_path, address, *options, PYTHONPATH=str(tmp_path)),
        pytest.raises(CalibrationError, match=r"must be installed.*tcp://.*No module named 'calib_ros'"),
    ):
        ran(tmp_path, ClusterPool(address, wait_s=LIMIT_S), answers)


def is_listening(port: int) -> bool:
    with socket.socket() as client:
        return client.connect_ex(("127.0.0.1", port)) == 0


def test_a_scheduler_without_workers_and_one_that_is_lost(tmp_path: Path) -> None:
    """The scheduler is killed when the first answers are there."""
    pytest.importorskip("distributed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    address = f"tcp://127.0.0.1:{port}"
    pool = ClusterPool(address, wait_s=0.2)

    def end(done: int, total: int) -> None:
        if done:
            head.kill()
            pool.wait_s = 5.0

    with process_of_dask("scheduler", tmp_path, "--host", "127.0.0.1", "--port", port) as head:
        until(lambda: is_listening(int(port)), "a scheduler")
        with pytest.raises(CalibrationError, match=r"no workers.*dask worker"):
            ran(tmp_path, pool, answers)
        pool.wait_s = LIMIT_S
        with (
            process_of_dask("worker", tmp_path, address, "--nthreads", "1", "--no-nanny"),
            pytest.raises(CalibrationError, match=r"scheduler at tcp.* is lost.*goes on where it stopped"),
        ):
            ran(tmp_path, pool, partial(work, tmp_path, 0.1), groups(40), end)
    assert 3 <= len(kept(tmp_path)) < 120


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
    with pytest.raises(BadInputError, match=words):
        ran(tmp_path, ClusterPool(address), answers)
