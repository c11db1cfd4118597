"""Jobs of a few milliseconds for test_pool.py, in a module that workers can import; run, a small evaluation of them."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from waiting import until

from calib_ros_check.jobs.pool import Answer, Journal, run
from calib_ros_evaluation.results import EvaluationJob, job


def groups(n: int, size: int = 3) -> list[list[EvaluationJob]]:
    """n groups of jobs on the same frames."""
    return [[job("pair", "edges", "street", [i, i + 1], {"seed": k}) for k in range(size)] for i in range(n)]


def answers(jobs: Sequence[EvaluationJob]) -> list[Answer]:
    """What the jobs come to, whoever does them."""
    return [{"value": one.frames[0] / 3 + one.option("seed"), "missing": None} for one in jobs]


def work(folder: Path, duration: float, jobs: Sequence[EvaluationJob], workers: int = 1) -> list[Answer]:
    """`answers`, after a while, and not before so many workers have begun; who did what stands in the file "log": process and
    key. Who began: files "at-work-..."."""
    (folder / f"at-work-{os.getpid()}").touch()
    until(lambda: len(list(folder.glob("at-work-*"))) >= workers, "work of the other workers")
    time.sleep(duration)
    with open(folder / "log", "ab", buffering=0) as log:
        for one in jobs:
            log.write(f"{os.getpid()} {one.key}\n".encode())
    return answers(jobs)


def fall(folder: Path, deaths: int, jobs: Sequence[EvaluationJob]) -> list[Answer]:
    """`work`, but the process that gets frame 3 is killed, as by the kernel when memory is out, until so many have been."""
    died = len(list(folder.glob("died-*")))
    if jobs[0].frames[0] == 3 and died < deaths:
        (folder / f"died-{died}").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return work(folder, 0.005, jobs)


def hang(jobs: Sequence[EvaluationJob]) -> list[Answer]:
    """Does not end on frame 3, whoever asks."""
    if jobs[0].frames[0] == 3:
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
        time.sleep(1000)
    return answers(jobs)


def refuse(error: type[Exception], jobs: Sequence[EvaluationJob]) -> list[Answer]:
    """Raises on frame 3."""
    if jobs[0].frames[0] == 3:
        raise error("frame 3 is bad")
    return answers(jobs)


def threads(jobs: Sequence[EvaluationJob]) -> list[Answer]:
    """Threads of OpenCV and of BLAS in the process that does it."""
    import cv2

    return [{"cv2": cv2.getNumThreads(), "blas": os.environ.get("OPENBLAS_NUM_THREADS")} for _ in jobs]


def main(folder: Path, n: int, workers: int, duration: float) -> None:
    """The evaluation of n groups."""
    with Journal(folder, {"version": "1"}) as journal:
        doing = partial(work, folder, duration, workers=workers)
        run(groups(n), doing, journal, lambda done, total: None, workers)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]))
