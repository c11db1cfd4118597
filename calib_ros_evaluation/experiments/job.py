"""What an evaluation does piece by piece: a method, or all of them, on frames of a source."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class EvaluationJob:
    """experiment: what it belongs to. method: name of a Method, empty where none is asked. scene: which source, by the label that
    it has in the evaluation. frames: positions in it. options: further numbers and texts, by name, in the order of their names.
    """

    experiment: str
    method: str
    scene: str
    frames: tuple[int, ...]
    options: tuple[tuple[str, float | int | str], ...] = ()

    @property
    def key(self) -> str:
        """The same for the same piece of work, whoever makes it up; no other has it."""
        frames = ",".join(map(str, self.frames))
        options = " ".join(f"{name}={value}" for name, value in self.options)
        return f"{self.experiment}|{self.method}|{self.scene}|{frames}|{options}"

    def option(self, name: str) -> Any:
        """Value of an option; KeyError if it has none of that name."""
        return dict(self.options)[name]


def job(
    experiment: str, method: str, scene: str, frames: Sequence[int], options: Mapping[str, float | int | str] | None = None
) -> EvaluationJob:
    """A job with its options in order."""
    return EvaluationJob(experiment, method, scene, tuple(frames), tuple(sorted((options or {}).items())))
