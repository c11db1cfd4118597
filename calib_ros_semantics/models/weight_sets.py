"""Which weights a network runs with: name, licence and fingerprint, known before the network is needed."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib_ros.config.semantics import BUILTIN

SHOWN = 12  # digits of a SHA-256: enough to tell files apart, and to read aloud


class WeightSet(NamedTuple):
    """The weights of a network. licence: as its file states it, empty = not at all, None = its file cannot be read here."""

    name: str
    licence: str | None
    sha256: str

    @property
    def text(self) -> str:
        """In a line, such as "streets (Apache-2.0; SHA-256 0123456789ab)"."""
        licence = "licence not known" if self.licence is None else self.licence or "licence not stated"
        return f"{self.name} ({licence}; SHA-256 {self.sha256[:SHOWN]})"


def of_package(name: str = "streets") -> Path:
    """The ONNX file of weights of the package's own; their licence lies beside it."""
    return Path(__file__).parent / "weights" / f"{name}.onnx"


def file_of(choice: str) -> Path:
    """The ONNX file that a value of semantics.image_classes names."""
    return of_package() if choice == BUILTIN else Path(choice)


def weights_of(path: Path) -> WeightSet | None:
    """The weights in an ONNX file, named by its metadata, else by the file; None if there is no such file."""
    try:
        seen = path.stat()
        return _read(path, (seen.st_mtime_ns, seen.st_size, seen.st_ino)) if path.is_file() else None
    except (OSError, ValueError):  # ValueError: an empty file cannot be mapped
        return None


@lru_cache(maxsize=16)
def _read(path: Path, state: tuple[int, ...]) -> WeightSet:
    """weights_of, once as long as the file does not change. Raises OSError."""
    digest = hashlib.sha256(np.memmap(path, np.uint8, "r").data).hexdigest()  # encoders have hundreds of megabytes
    try:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL  # it is not going to run
        options.log_severity_level = 4
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        own = session.get_modelmeta().custom_metadata_map
    except Exception:  # what cannot be loaded on a CPU; of it the model itself says why
        return WeightSet(path.stem, None, digest)
    return WeightSet(own.get("name") or path.stem, own.get("license", ""), digest)
