"""What a person sees while a command runs."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[..., None]]:
    """A bar on a terminal, nothing in a pipe; yields a function that takes what is done, and the total if it is not 1."""
    with tqdm(
        total=1.0,
        desc=label,
        disable=not sys.stderr.isatty(),
        bar_format="{desc} {bar} {percentage:3.0f}% {elapsed}",
        leave=False,
    ) as bar:

        def step(done: float, total: float = 1.0) -> None:
            bar.n = done / total
            bar.refresh()

        yield step


def note(line: str) -> None:
    """A line beside the result, for a person."""
    print(line, file=sys.stderr)
