"""What is killed, loses workers, hangs or runs twice at once gives every result once; without Dask, too."""

from __future__ import annotations

import os
import signal
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

from calib_ros.errors import BadInputError, CalibrationError, MissingDependencyError, TooFewFeaturesError
from calib_ros_check.jobs import pool
from calib_ros_check.jobs.pool import Answer, Journal
from calib_ros_evaluation.results import EvaluationJob, job

ABOUT = {"version": "1"}
BAD = {one.key for one in groups(8)[3]}  # jobs of `fall` and `refuse` that do not go well


def expected(n: int, without: set[str] = frozenset()) -> dict[str, Answer]:
    found = {one.key: answer for group in groups(n) for one, answer in zip(group, answers(group), strict=True)}
    return {key: answer for key, answer in found.items() if key not in without}


def ran(folder: Path, run_jobs: Callable, jobs: Sequence[Sequence[EvaluationJob]] = groups(8), **options) -> dict[str, Answer]:
    """All answers of the journal in a folder, once the jobs are done."""
    with Journal(folder, ABOUT) as journal:
        pool.run(jobs, run_jobs, journal, **{"progress": lambda done, total: None, **options})
        return dict(journal.done)


def kept(folder: Path) -> dict[str, Answer]:
    """The answers of a journal."""
    with Journal(folder, ABOUT) as journal:
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


@pytest.fixture
def dask() -> None:
    pytest.importorskip("distributed")


@pytest.mark.parametrize("workers", [1, 2])
def test_every_job_once(tmp_path: Path, workers: int) -> None:
    told: list[tuple[int, int]] = []
    twice = [*groups(6), groups(6)[2]]  # a job that is asked for twice is one job
    doing, options = partial(work, tmp_path, 0.005), {"workers": workers, "progress": lambda *counts: told.append(counts)}
    assert ran(tmp_path, doing, twice, **options) == expected(6)
    assert sorted(performed(tmp_path)) == sorted(expected(6))
    assert told == [(n, 18) for n in range(0, 19, 3)]
    told.clear()
    ran(tmp_path, doing, groups(7), **options)
    assert len(performed(tmp_path)) == 21
    assert told == [(18, 21), (21, 21)]


def test_without_dask_jobs_run_in_this_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert ran(tmp_path, partial(work, tmp_path, 0.0), workers=2, lost=lost) == expected(8)
    assert busy(tmp_path) == {os.getpid()}
    with pytest.raises(MissingDependencyError, match="pip install distributed"):
        ran(tmp_path, answers, groups(9), scheduler="tcp://127.0.0.1:8786")


def test_a_full_disk_ends_the_run_and_nothing_is_lost(tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk."""
    script = (
        "import resource, signal, sys; from pathlib import Path; from trial_jobs import *\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "run(groups(9), answers, Journal(Path(sys.argv[1]), {'version': '1'}), lambda done, total: None)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True, env=environment())
    assert "CalibrationError: cannot write" in done.stderr
    assert "goes on where it stopped" in done.stderr
    assert 0 < len(kept(tmp_path)) < 27
    assert ran(tmp_path, answers, groups(9)) == expected(9)


@pytest.mark.slow
def test_a_killed_evaluation_ends_its_workers_and_resumes(tmp_path: Path, dask: None) -> None:
    process = subprocess.Popen(command(tmp_path, 30, 2, 0.5), env=environment())
    until(lambda: lines(tmp_path) > 10 and len(busy(tmp_path)) == 2, "work")
    process.kill()
    process.wait()
    until(lambda: not any(map(alive, busy(tmp_path))), "their end")
    before, first = set(kept(tmp_path)), performed(tmp_path)
    assert 9 < len(before) < 90
    subprocess.run(command(tmp_path, 30, 2, 0.05), env=environment(), check=True)
    assert (kept(tmp_path), lines(tmp_path)) == (expected(30), 91)
    assert sorted(performed(tmp_path)[len(first) :]) == sorted(set(expected(30)) - before)


def test_ctrl_c_stops_all_at_once(tmp_path: Path, dask: None) -> None:
    """As a terminal sends it: to all processes of the group."""
    process = subprocess.Popen(
        command(tmp_path, 90, 2, 0.2),
        env=environment(),
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # shells have background jobs ignore it
    )
    until(lambda: lines(tmp_path) > 6, "answers")
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode == -signal.SIGINT
    assert err.count("Traceback") == 1 + err.count("another exception occurred"), err  # its own, none of a worker
    until(lambda: not any(map(alive, busy(tmp_path))), "their end")
    assert lines(tmp_path) < 200


def lost(jobs: Sequence[EvaluationJob], how: str) -> list[Answer]:
    """What becomes of jobs that nobody finishes."""
    return [{"lost": how} for _ in jobs]


@pytest.mark.slow
def test_a_group_whose_worker_died_is_done_again_and_at_last_named(tmp_path: Path, dask: None) -> None:
    (tmp_path / "once").mkdir()
    assert ran(tmp_path / "once", partial(fall, tmp_path / "once", 1), workers=2) == expected(8)
    assert set(performed(tmp_path / "once")[-3:]) == BAD  # at the end, after all that never was in a crash
    with pytest.raises(CalibrationError, match=r"ended, also alone: pair\|edges\|street\|3,4\|seed=0.*fewer --workers"):
        ran(tmp_path, partial(fall, tmp_path, 2), workers=2)
    assert kept(tmp_path) == expected(8, BAD)
    found = ran(tmp_path, partial(fall, tmp_path, 99), lost=lost)
    assert found == expected(8, BAD) | {key: {"lost": "its worker ended, also alone"} for key in BAD}


def test_a_group_that_hangs_is_named_and_the_rest_goes_on(tmp_path: Path, dask: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "HANG_S", 1.0)
    found = ran(tmp_path, trial_jobs.hang, workers=2, lost=lost)
    assert found == expected(8, BAD) | {key: {"lost": "its worker hung for 1 s per job"} for key in BAD}


@pytest.mark.parametrize("workers", [1, 2])
def test_errors_of_jobs_propagate(tmp_path: Path, workers: int) -> None:
    with pytest.raises(TooFewFeaturesError, match="frame 3 is bad"):
        ran(tmp_path, partial(refuse, TooFewFeaturesError), workers=workers)
    assert not set(kept(tmp_path)) & BAD
    with pytest.raises(BadInputError, match="at least 1"):
        ran(tmp_path, answers, workers=0)


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_have_one_thread(tmp_path: Path, workers: int) -> None:
    before = cv2.getNumThreads(), os.environ.get("OPENBLAS_NUM_THREADS")
    for answer in ran(tmp_path, trial_jobs.threads, groups(2), workers=workers).values():
        assert (answer["cv2"], answer["blas"]) == (1, "1")
    assert before == (cv2.getNumThreads(), os.environ.get("OPENBLAS_NUM_THREADS"))


def test_worker_start_failure_is_not_attributed_to_a_job(tmp_path: Path, dask: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a library of the interpreter is broken: the process ends before it asks for a job."""
    broken = "import os, sys\nif '--multiprocessing-fork' in sys.orig_argv: os._exit(7)\n"
    (tmp_path / "sitecustomize.py").write_text(broken)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(CalibrationError, match="workers end at their start"):
        ran(tmp_path, answers, workers=2)


# --- a cluster that runs already


@contextmanager
def scheduler(workers: int, threads: int = 1) -> Iterator[str]:
    """Its address."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=threads,
        processes=True,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs=50,
    ) as local:
        yield local.scheduler_address


@pytest.mark.slow
def test_a_cluster_gives_the_same_results_even_if_a_worker_is_lost(tmp_path: Path) -> None:
    victims: list[int] = []

    def rob(done: int, total: int) -> None:
        if done >= 9 and not victims:
            victims.append(int((tmp_path / "log").read_text().split()[0]))
            os.kill(victims[0], signal.SIGKILL)

    with scheduler(2) as address:
        found = ran(tmp_path, partial(work, tmp_path, 0.05), groups(20), scheduler=address, progress=rob)
        assert found == expected(20)
        assert len(performed(tmp_path)) - 60 <= 4 * 3  # what it had finished and not handed over, or held, was done again
        assert len(victims) == 1
        other = [[job("other", "edges", "street", [3])]]
        with pytest.raises(TooFewFeaturesError, match="frame 3 is bad"):
            ran(tmp_path, partial(refuse, TooFewFeaturesError), other, scheduler=address)


def test_a_cluster_that_does_not_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    several = pytest.raises(CalibrationError, match=r"workers of several threads.*--nthreads 1")
    with scheduler(1, threads=2) as address, several:
        ran(tmp_path, answers, scheduler=address)
    with scheduler(1) as address:
        monkeypatch.setattr(pool, "VERSION", "99.0")  # here, not on the worker
        with pytest.raises(CalibrationError, match=r"calib_ros 99\.0, .* on all workers: one has calib_ros 0\.1"):
            ran(tmp_path, answers, scheduler=address)
    assert kept(tmp_path) == {}


def process_of_dask(kind: str, folder: Path, *options: str, **variables: str) -> subprocess.Popen:
    """A scheduler or a worker in a process of its own."""
    line = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *options, "--no-dashboard"]
    return subprocess.Popen(line, env=environment() | variables, stderr=subprocess.DEVNULL, cwd=folder)


def test_worker_without_calib_ros_is_reported(tmp_path: Path) -> None:
    """A worker elsewhere, with a Python where calib_ros is not installed: here a finder of modules that does not find it."""
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\nclass No:\n    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] == 'calib_ros': raise ModuleNotFoundError(f'No module named {name!r}')\n"
        "sys.meta_path.insert(0, No())\n"
    )
    options = ("--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path))
    with scheduler(0) as address:
        worker = process_of_dask("worker", tmp_path, address, *options, PYTHONPATH=str(tmp_path))
        with pytest.raises(CalibrationError, match=r"must be installed on all workers: No module named 'calib_ros'"):
            ran(tmp_path, answers, scheduler=address)
        worker.kill()


@pytest.mark.parametrize("victim", ["worker", pytest.param("scheduler", marks=pytest.mark.slow)])
def test_a_cluster_that_is_lost_on_the_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, victim: str) -> None:
    """Killed without a nanny that would start it again, when the first answers are there."""
    pytest.importorskip("distributed")
    file = tmp_path / "scheduler.json"
    head = process_of_dask("scheduler", tmp_path, "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file))
    hand = process_of_dask("worker", tmp_path, "--scheduler-file", str(file), "--nthreads", "1", "--no-nanny")

    def end(done: int, total: int) -> None:
        if done:
            monkeypatch.setattr(pool, "WITHOUT_WORKERS_S", 0.2)
            (hand if victim == "worker" else head).kill()

    try:
        until(file.exists, "a scheduler")
        (address,) = [word for word in file.read_text().split('"') if word.startswith("tcp://")][:1]
        says = "has no workers; start" if victim == "worker" else "is lost"
        with pytest.raises(CalibrationError, match=f"{says}.*goes on where it stopped"):
            ran(tmp_path, partial(work, tmp_path, 0.1), groups(40), scheduler=address, progress=end)
    finally:
        head.kill()
        hand.kill()
    assert 3 <= len(kept(tmp_path)) < 120


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense", "127.0.0.1:port"])
def test_an_address_where_no_scheduler_is(tmp_path: Path, dask: None, monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    monkeypatch.setattr(pool, "CONNECT_S", 1.0)
    with pytest.raises(BadInputError, match=f"no Dask scheduler answers at '{address}'; .* tcp://HOST:8786"):
        ran(tmp_path, answers, scheduler=address)
