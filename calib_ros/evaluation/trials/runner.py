"""Does the jobs of an evaluation that are not done yet, wherever there are hands for them."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from typing import Protocol

from calib_ros.evaluation.trials.job import Answer, Job
from calib_ros.evaluation.trials.journal import Journal

Perform = Callable[[Sequence[Job]], list[Answer]]  # answers of a group, one per job, in its order; must be picklable
Results = Generator[tuple[Sequence[Job], list[Answer]], None, None]


class Pool(Protocol):
    """Those who do the work."""

    def results(self, perform: Perform, groups: Sequence[Sequence[Job]]) -> Results:
        """Every group with its answers as it is finished, in any order; each is done by one worker.

        Closing the generator stops all. What `perform` raises goes up. CalibrationError if workers are lost again and again, or
        there are none.
        """
        ...


def run(
    groups: Sequence[Sequence[Job]], perform: Perform, journal: Journal, pool: Pool, progress: Callable[[int, int], None]
) -> None:
    """Do all jobs that `journal` has no answer of, and write theirs to it as they come.

    groups: jobs that share features (the same frames and method), done together. progress: gets the number of jobs done, those of
    earlier runs too, and of all. Raises what `perform` raises; answers until then are kept.
    """
    total = len({job.key for group in groups for job in group})
    missing = _missing(groups, journal)
    done = total - sum(map(len, missing))
    progress(done, total)
    if not missing:
        return
    with closing(pool.results(perform, missing)) as results:
        for group, answers in results:
            for job, answer in zip(group, answers, strict=True):
                journal.add(job, answer)
            done += len(group)
            progress(done, total)


def _missing(groups: Sequence[Sequence[Job]], journal: Journal) -> list[list[Job]]:
    """Groups of the jobs without an answer, each job once."""
    seen = set(journal.done)
    missing = []
    for group in groups:
        new = []
        for job in group:
            if job.key not in seen:
                seen.add(job.key)
                new.append(job)
        if new:
            missing.append(new)
    return missing
