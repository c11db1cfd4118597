"""Which class each number stands for that a network gives: told by the YAML beside it, by its file, or by how many there are."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
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
IGNORED = (-1, 255)  # what datasets and networks give to pixels that do not count


class LabelTable:
    """From class numbers to SemanticClass, by one of the candidates.

    Of several, the first counts whose names cover all numbers of a frame. A single one is what somebody meant: numbers that it
    does not name are UNLABELLED. ModelError for names that are unknown.
    """

    def __init__(self, candidates: Sequence[Names]) -> None:
        self._tables = [labels.lookup(names) for names in candidates]
        self._numbers = [list(names) if isinstance(names, Mapping) else list(range(len(names))) for names in candidates]

    def classes(self, numbers: NDArray[Any]) -> Classes:
        """SemanticClass of integers of any shape, UNLABELLED for -1. ModelError if no candidate has them all."""
        low, high = int(numbers.min(initial=0)), int(numbers.max(initial=0))
        if low < -1 or high >= len(self._tables[0]):
            raise ModelError(f"it holds numbers from {low} to {high}, which are no classes")
        found: Classes = self._table(numbers)[np.maximum(numbers, 0)]
        found[numbers < 0] = UNLABELLED
        return found

    def _table(self, numbers: NDArray[Any]) -> Classes:
        if len(self._tables) == 1:
            return self._tables[0]
        there = np.setdiff1d(numbers, IGNORED)
        for table, known in zip(self._tables, self._numbers, strict=True):
            if np.isin(there, known).all():
                return table
        raise ModelError(
            f"its class number {there.max()} is that of no known dataset; say in a YAML beside it what 'labels:' mean"
        )


def table_of(model: OnnxModel, count: int | None, by_count: Mapping[int, Names], by_number: Sequence[Names]) -> LabelTable:
    """Classes of a network. count: of its scores per pixel; None = it gives class numbers.

    by_count: names for the counts that are known; by_number: candidates for numbers. ModelError if nobody says what they are.
    """
    yaml = model.path.with_suffix(".yaml")
    names = told(model.sidecar, yaml)
    if names is not None:
        if count is not None and not _fits(names, count):
            raise model.error(f"{yaml.name} names {len(names)} classes by 'labels:', but the network gives scores of {count}")
        return _table(yaml, names)
    own = _metadata_names(model.metadata)
    if own is not None and (count is None or len(own) == count) and _tells(own):
        return LabelTable([own])
    if count is None:
        return LabelTable(by_number)
    if count not in by_count:
        known = ", ".join(map(str, sorted(by_count)))
        raise model.error(
            f"it gives scores of {count} classes, which are of no known dataset (these have {known}); name them by 'labels:' in "
            f"{yaml}"
        )
    return LabelTable([by_count[count]])


def table_of_folder(folder: Path, default: Names) -> LabelTable:
    """Classes of the label files of a folder, by its labels.yaml, else the default. ModelError for a wrong labels.yaml."""
    beside = folder / "labels.yaml"
    names = told(Sidecar.beside(beside), beside)
    return LabelTable([default]) if names is None else _table(beside, names)


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
        return LabelTable([names])
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
