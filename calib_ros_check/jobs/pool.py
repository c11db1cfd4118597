"""Runs jobs that have no answer yet, on workers: processes of this machine (`local`), or of a Dask cluster (`cluster`)."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from typing import Protocol, TypeAlias, TypeVar

import cv2

from calib_ros.errors import CalibrationError
from calib_ros_check.jobs.journal import Answer, Job, Journal

J = TypeVar("J", bound=Job)
RunJobs: TypeAlias = Callable[[Sequence[J]], list[Answer]]  # the answers of a group, one per job, in its order; picklable
# What becomes of a group whose worker ended again and again, and how it ended: its answers, or an exception.
Lost: TypeAlias = Callable[[Sequence[J], str], list[Answer]]
Results: TypeAlias = Generator[tuple[Sequence[J], list[Answer]], None, None]
Ended: TypeAlias = list[tuple[Sequence[J], str]]  # groups whose workers ended, and how

GOES_ON = "the same command goes on where it stopped"
NAMED = 3  # jobs of a group in an error


class Pool(Protocol):
    """Workers: processes of this machine (`LocalPool`), or of a cluster (`ClusterPool`)."""

    def results(self, run_jobs: RunJobs[J], groups: Sequence[Sequence[J]], lost: Lost[J] | None = None) -> Results[J]:
        """Every group with its answers as it is finished, in any order. A group is jobs that share work; one worker does all.

        Closing the generator stops all workers. lost: gives the answers of groups that end their workers again and again.
        Raises what `run_jobs` raises, and CalibrationError if there are no workers, or, without `lost`, for such a group.
        """
        ...


def run(
    groups: Sequence[Sequence[J]],
    run_jobs: RunJobs[J],
    journal: Journal,
    pool: Pool,
    progress: Callable[[int, int], None],
    lost: Lost[J] | None = None,
) -> None:
    """Run all jobs that `journal` has no answer for, and add each answer as it arrives.

    progress: called with the number of finished jobs, those of earlier runs included, and of all. lost: see Pool. Raises what
    `run_jobs` raises; answers until then are kept.
    """
    total = len({job.key for group in groups for job in group})
    missing = _missing(groups, journal)
    done = total - sum(map(len, missing))
    progress(done, total)
    if not missing:
        return
    with closing(pool.results(run_jobs, missing, lost)) as results:
        for group, answers in results:
            for job, answer in zip(group, answers, strict=True):
                journal.add(job, answer)
            done += len(group)
            progress(done, total)


def _missing(groups: Sequence[Sequence[J]], journal: Journal) -> list[list[J]]:
    """Groups of the jobs without an answer, each job once."""
    known = set(journal.done)
    missing = []
    for group in groups:
        new = list({job.key: job for job in group if job.key not in known}.values())
        known.update(job.key for job in new)
        if new:
            missing.append(new)
    return missing


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenCV with one thread, BLAS too where threadpoolctl is installed: so CPU time and sums do not depend on the workers."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        limits = importlib.import_module("threadpoolctl").threadpool_limits(1)
    except ImportError:
        limits = contextlib.nullcontext()
    try:
        with limits:
            yield
    finally:
        cv2.setNumThreads(before)


def all_answers(
    spread: Callable[[Sequence[Sequence[J]], Ended[J]], Results[J]], groups: Sequence[Sequence[J]], lost: Lost[J] | None
) -> Results[J]:
    """The answers of all groups by `spread`, which yields those of groups that are finished, and adds the others to a list.

    They run once more, each alone: memory may have been short, or another group have ended the worker. See Pool.
    """
    ended: Ended[J] = []
    again: Ended[J] = []
    yield from spread(groups, ended)
    for group, _ in ended:
        yield from spread([group], again)
    for group, how in again:
        if lost is None:
            names = ", ".join(job.key for job in group[:NAMED]) + (f" and {len(group) - NAMED} more" * (len(group) > NAMED))
            advice = f"out of memory? use fewer --workers, or give them more; {GOES_ON}"
            raise CalibrationError(f"jobs whose {how}, also alone: {names}; {advice}")
        yield group, lost(group, f"its {how}, also alone")
