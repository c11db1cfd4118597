"""Which class each number stands for that a network gives: told by the YAML beside it, by its file, or by how many there are."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from calib_ros import plain_yaml
from calib_ros.classes import UNLABELLED, SemanticClass
from calib_ros.errors import ModelError
from calib_ros.semantics import labels
from calib_ros.semantics.labels import Classes, Names
from calib_ros.semantics.onnx_model import OnnxModel
from calib_ros.semantics.sidecar import Sidecar

METADATA_KEYS = ("names", "labels", "classes", "class_names", "id2label", "CLASSES")
NUMBERS = 65536  # of labels.lookup
IGNORED = (-1, 255)  # what datasets and networks give to pixels that do not count


class LabelTable:
    """From class numbers to SemanticClass. Numbers that the names leave out are UNLABELLED. ModelError for unknown names."""

    guess = ""  # the dataset that is assumed, where nobody told what the numbers mean

    def __init__(self, names: Names) -> None:
        self._table = labels.lookup(names)

    def classes(self, numbers: NDArray[Any]) -> Classes:
        """SemanticClass of integers of any shape, UNLABELLED for -1. ModelError for numbers that are no classes."""
        low, high = int(numbers.min(initial=0)), int(numbers.max(initial=0))
        if low < -1 or high >= NUMBERS:
            raise ModelError(f"it holds numbers from {low} to {high}, which are no classes")
        found: Classes = self._table[np.maximum(numbers, 0)]
        found[numbers < 0] = UNLABELLED
        return found


class GuessedTable(LabelTable):
    """Of several datasets by name the first that has all numbers seen so far.

    What was seen once counts for good: a dataset that was ruled out does not return with a frame that happens to fit it, and a
    number that none has means that all frames were read wrongly, so that every later call is an error, too.
    """

    def __init__(self, datasets: Mapping[str, Names]) -> None:
        self._datasets = dict(datasets)
        self._seen: NDArray[Any] = np.empty(0, np.int64)
        self._assume(next(iter(datasets)))

    def classes(self, numbers: NDArray[Any]) -> Classes:
        """As of LabelTable; ModelError if no dataset has all numbers seen so far."""
        self._seen = np.union1d(self._seen, np.setdiff1d(numbers, IGNORED))
        fitting = (name for name, names in self._datasets.items() if np.isin(self._seen, _numbers_of(names)).all())
        name = next(fitting, None)
        if name is None:
            raise ModelError(
                f"its class numbers, {self._seen.min()} to {self._seen.max()} so far, are those of no known dataset; say in a "
                "YAML beside it what 'labels:' mean"
            )
        if name != self.guess:
            self._assume(name)
        return super().classes(numbers)

    def _assume(self, name: str) -> None:
        self.guess = name
        super().__init__(self._datasets[name])


def _numbers_of(names: Names) -> list[int]:
    return list(names) if isinstance(names, Mapping) else list(range(len(names)))


def table_of(model: OnnxModel, count: int | None, by_count: Mapping[int, Names], by_number: Mapping[str, Names]) -> LabelTable:
    """Classes of a network. count: of its scores per pixel; None = it gives class numbers.

    by_count: names for the counts that are known; by_number: candidates for numbers, by dataset. ModelError if nobody says what
    they are.
    """
    yaml = model.path.with_suffix(".yaml")
    names = told(model.sidecar, yaml)
    if names is not None:
        if count is not None and not _fits(names, count):
            raise model.error(f"{yaml.name} names {len(names)} classes by 'labels:', but the network gives scores of {count}")
        return _table(yaml, names)
    own = _metadata_names(model.metadata)
    if own is not None and (count is None or len(own) == count) and _tells(own):
        return LabelTable(own)
    if count is None:
        return GuessedTable(by_number)
    if count not in by_count:
        known = ", ".join(map(str, sorted(by_count)))
        raise model.error(
            f"it gives scores of {count} classes, which are of no known dataset (these have {known}); name them by 'labels:' in "
            f"{yaml}"
        )
    return LabelTable(by_count[count])


def table_of_folder(folder: Path, default: Names) -> LabelTable:
    """Classes of the label files of a folder, by its labels.yaml, else the default. ModelError for a wrong labels.yaml."""
    beside = folder / "labels.yaml"
    names = told(Sidecar.beside(beside), beside)
    return LabelTable(default) if names is None else _table(beside, names)


def told(sidecar: Sidecar, path: Path) -> Names | None:
    """The names that the YAML at this path gives; None if it gives none. ModelError for an unknown dataset."""
    if not sidecar.labels:
        return None
    if not isinstance(sidecar.labels, str):
        return sidecar.labels
    if sidecar.labels not in labels.DATASETS:
        raise ModelError(
            f"{path}: labels = '{sidecar.labels}' is none of {', '.join(labels.DATASETS)}; use one, or a list of names"
        )
    return labels.DATASETS[sidecar.labels]


def _table(path: Path, names: Names) -> LabelTable:
    try:
        return LabelTable(names)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from None


def _fits(names: Names, count: int) -> bool:
    return max(names, default=0) < count if isinstance(names, Mapping) else len(names) == count


def _metadata_names(metadata: Mapping[str, str]) -> dict[int, str] | None:
    """Names by number that the exporter wrote, as a list or a mapping in the syntax of Python or JSON; None if there are none."""
    for key in METADATA_KEYS:
        try:
            found = plain_yaml.load(metadata.get(key, ""))
            pairs = found.items() if isinstance(found, dict) else enumerate(found if isinstance(found, list) else ())
            names = {int(number): _plain(str(name)) for number, name in pairs}
        except (yaml.YAMLError, ValueError, TypeError, RecursionError):  # whatever else stands there: no classes
            continue
        if names and min(names) >= 0 and max(names) < 65536:
            return names
    return None


def _plain(name: str) -> str:
    """The first of several names of a class; what no street shows is an object. An exporter's names may be of any dataset."""
    first = re.split(r"[,;/]", name)[0].strip()
    try:
        labels.class_of(first)
    except ModelError:
        return "object"
    return first


def _tells(names: Mapping[int, str]) -> bool:
    """Whether any name is of a class that matters: a list of other things, or of c0, c1, ..., is no better than none."""
    return any(labels.class_of(name) not in (UNLABELLED, SemanticClass.OTHER) for name in names.values())
