"""An ONNX file as a function of arrays: loading it, its inputs and outputs, running it within a time limit."""

from __future__ import annotations

import re
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros.errors import BudgetError, MissingDependencyError, ModelError
from calib_ros.frame import Frame
from calib_ros_semantics.models.sidecar import Sidecar

Array = NDArray[Any]
GREY_LEVELS = 2.0  # mean or std above this refer to 0..255, not to 0..1
POLL_S = 0.05  # how often the deadline of a running network is checked
CPU, CUDA = "CPUExecutionProvider", "CUDAExecutionProvider"
PROVIDERS = {"cpu": [CPU], "cuda": [CUDA, CPU], "tensorrt": ["TensorrtExecutionProvider", CUDA, CPU]}
TYPES: dict[str, type[np.generic]] = {
    **{"float": np.float32, "float16": np.float16, "double": np.float64, "bool": np.bool_},
    **{t.__name__: t for t in (np.uint8, np.int8, np.uint16, np.int16, np.int32, np.int64)},
}
# Messages of new and of older versions of onnxruntime.
MISSING_DATA = re.compile(r"(?:External data path does not exist: |No such file or directory )[\[\"]+([^\"\]]+)")
OPSET = re.compile(r"\bopset\b|\bIR version\b", re.IGNORECASE)


class SegmentationModel(ABC):
    """A loaded model, of whatever kind: what there is to say of it."""

    fallback = ""  # why it does not run on the configured provider
    note = ""  # how the last scan differs from those that it was made for
    needed = ""  # what a mask needs to count
    known: frozenset[int] | None = None  # SemanticClasses that a network tells apart, once it has run

    @abstractmethod
    def __call__(self, frame: Frame, deadline: Deadline, borders: bool = True) -> Any:
        """Its part of FrameSemantics; of pixels PixelClasses, with borders if requested. Raises ModelError, BudgetError."""

    @abstractmethod
    def describe(self) -> str:
        """Kind, inputs and outputs, as text."""


class OnnxModel:
    """A loaded ONNX file. Raises ModelError, naming the file and what to do, if it cannot be loaded."""

    def __init__(self, path: str | Path, config: SemanticsConfig) -> None:
        self.path, self.sidecar = Path(path), Sidecar.beside(path)
        self.yaml = self.path.with_suffix(".yaml")  # where its description is, or would be
        self._session, self.provider, self.fallback = _session(self.path, config)
        self.metadata: dict[str, str] = dict(self._session.get_modelmeta().custom_metadata_map)  # that the exporter wrote
        self.inputs = [_tensor(self.path, t) for t in self._session.get_inputs()]
        self.outputs = [_tensor(self.path, t) for t in self._session.get_outputs()]
        asked = self.sidecar.output
        if asked and asked not in [t.name for t in self.outputs]:
            raise self.error(f"there is no output '{asked}', which {self.yaml} asks for")

    @property
    def tensors(self) -> str:
        """All inputs and outputs, as text."""
        inputs, outputs = (", ".join(map(str, tensors)) for tensors in (self.inputs, self.outputs))
        return f"inputs: {inputs}; outputs: {outputs}"

    def run(self, feeds: Mapping[str, Array], deadline: Deadline, outputs: Sequence[str] | None = None) -> list[Array]:
        """Outputs, or those named in `outputs`, for input arrays by name, which are converted. Raises BudgetError, ModelError."""
        types = {t.name: t.dtype for t in self.inputs}
        given = {name: np.ascontiguousarray(value, types[name]) for name, value in feeds.items()}
        names = list(outputs) if outputs is not None else [t.name for t in self.outputs]
        import onnxruntime

        options = onnxruntime.RunOptions()
        options.log_severity_level = 4  # errors are raised instead
        options.only_execute_path_to_fetches = True  # skips a decoder's large masks where its small ones are used
        try:
            deadline.check()
            with deadline.enforced(options):
                return [np.asarray(out) for out in self._session.run(names, given, options)]
        except BudgetError:
            raise
        except Exception as error:  # onnxruntime's exceptions have no common base below Exception
            deadline.check()
            raise ModelError(f"{self.path} failed: {error_text(error)}; it has {self.tensors}") from None

    def family(self, known: Iterable[str]) -> str:
        """The one of the known families that the YAML names, however it writes it; empty without. ModelError for others."""
        own, named = _plain(self.sidecar.family), {_plain(name): name for name in known}
        if own and own not in named:
            raise self.error(f"family '{self.sidecar.family}' is unknown; known are {', '.join(named.values())}")
        return named.get(own, "")

    def error(self, problem: str) -> ModelError:
        """A ModelError with the file, the problem and the tensors found."""
        return ModelError(f"{self.path}: {problem}; it has {self.tensors}")


@dataclass(frozen=True)
class Tensor:
    """An input or output: name, shape (None = any size), numpy type."""

    name: str
    shape: tuple[int | None, ...]
    dtype: Any

    def __str__(self) -> str:
        sizes = "x".join("?" if n is None else str(n) for n in self.shape) or "scalar"
        return f"{self.name} {np.dtype(self.dtype).name} {sizes}"


class InputImage(NamedTuple):
    """The input of a network that takes an image: its tensor, axis of the channels, and their number. size: height and width by
    graph and YAML, None = unknown."""

    tensor: Tensor
    axis: int
    channels: int
    size: tuple[int | None, int | None]

    @staticmethod
    def of(model: OnnxModel, tensors: Sequence[Tensor], counts: Sequence[int]) -> InputImage | None:
        """The only one of these inputs, if it takes one image of so many channels, first or last; else None. ModelError if its
        size is not that of the YAML."""
        if len(tensors) != 1:
            return None
        sizes = tensors[0].shape or (None,) * 4  # of an unknown rank: the usual layout
        if len(sizes) < 3 or sizes[:-3] not in ((), (None,), (1,)):
            return None
        first = len(sizes) - 3
        axis = next((axis for axis in (first, len(sizes) - 1) if sizes[axis] in counts), first)
        if sizes[axis] not in (*counts, None):
            return None
        own = [n for k, n in enumerate(sizes) if k != axis][-2:]
        given = model.sidecar.size or (None, None)
        if any(None not in (n, m) and n != m for n, m in zip(own, given, strict=True)):
            raise model.error(f"it does not run at the height and width {list(given)} that 'size:' says")
        return InputImage(tensors[0], axis, sizes[axis] or counts[0], (own[0] or given[0], own[1] or given[1]))

    def arranged(self, image: NDArray[Any]) -> Array:
        """An image (h, w, channels) as the network takes it."""
        batch = image if len(self.tensor.shape) == 3 else image[None]
        return np.ascontiguousarray(np.moveaxis(batch, -1, self.axis), self.tensor.dtype)


@dataclass(frozen=True)
class Normalisation:
    """(pixels * scale - mean) / std of grey levels 0..255. mean, std: one number, or one per channel. declared: by a YAML."""

    scale: float
    mean: tuple[float, ...] = (0.0,)
    std: tuple[float, ...] = (1.0,)
    declared: bool = False

    @staticmethod
    def of(model: OnnxModel, usual: Normalisation) -> Normalisation:
        """The normalisation of the YAML beside a model, else the usual one of RGB. ModelError if its numbers do not fit."""
        own = model.sidecar
        if not isinstance(own.channels, str):
            raise model.error("'channels:' of the YAML beside it must be rgb or bgr")
        for name, values in (("mean", own.mean), ("std", own.std)):
            if len(values) not in (0, 1, 3):
                raise model.error(f"'{name}:' of the YAML beside it must have 1 or 3 numbers")
        mean, std, scale = own.mean or (0.0,), own.std or (1.0,), own.scale
        if scale is None:
            if not own.mean and not own.std:
                return replace(usual, mean=usual.mean[::-1], std=usual.std[::-1]) if own.channels == "bgr" else usual
            scale = 1.0 if max(map(abs, mean + std)) > GREY_LEVELS else 1 / 255
        return Normalisation(scale, mean, std, declared=True)

    def __call__(self, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Normalised pixels (h, w, channels)."""
        mean, std = np.array(self.mean, np.float32), np.array(self.std, np.float32)
        result: NDArray[Any] = (pixels * np.float32(self.scale) - mean) / std
        return result

    @property
    def text(self) -> str:
        """How grey levels become the input, and whether somebody said so."""
        means, stds = ([f"{v:.4g}" for v in values] for values in (self.mean, self.std))
        times = "v" if self.scale == 1 else "v / 255" if abs(self.scale * 255 - 1) < 1e-3 else f"v * {self.scale:.4g}"
        shifted = times if set(means) == {"0"} else f"({times} - [{', '.join(means)}])"
        whole = shifted if set(stds) == {"1"} else f"{shifted} / [{', '.join(stds)}]"
        source = "as its YAML says" if self.declared else "assumed; its YAML may say otherwise"
        return f"{whole} of grey levels v in 0..255 ({source})"


def _plain(name: str) -> str:
    return name.lower().replace("_", "").replace("-", "")


def fitted(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """An image (H, W) or (H, W, 3) at another size (height, width)."""
    if image.shape[:2] == size:
        return image
    # Averaging all pixels when shrinking keeps thin objects.
    shrinks = size[0] <= image.shape[0] and size[1] <= image.shape[1]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size[::-1], interpolation=how), np.uint8)


def to_rgb(image: NDArray[np.uint8], size: tuple[int, int], bgr: bool = False) -> NDArray[np.float32]:
    """Image (H, W) or (H, W, 3) BGR -> (h, w, 3) float32 RGB or BGR, 0..255, at another size."""
    colour = fitted(np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8) if image.ndim == 2 else image, size)
    return np.asarray(colour if bgr else colour[:, :, ::-1], np.float32)


class Deadline:
    """A time limit of `seconds` from now, which also ends when `cancelled` returns True (a node that shuts down)."""

    def __init__(self, seconds: float, cancelled: Callable[[], bool] = lambda: False) -> None:
        self.seconds, self._cancelled = seconds, cancelled
        self._end = time.monotonic() + seconds

    @property
    def over(self) -> bool:
        """Whether the time is up."""
        return time.monotonic() >= self._end or self._cancelled()

    def check(self) -> None:
        """Raise BudgetError if the time is up."""
        if self._cancelled():
            raise BudgetError("broken off, since its result is no longer wanted")
        if self.over:
            raise BudgetError(f"broken off after the budget of {self.seconds:g} s (semantics.budget_s)")

    @contextmanager
    def enforced(self, run_options: Any) -> Iterator[None]:
        """Context in which a watcher thread sets `terminate` of onnxruntime's RunOptions when the time is up."""
        done = threading.Event()

        def watch() -> None:
            while not done.wait(POLL_S):
                if self.over:
                    run_options.terminate = True
                    return

        watcher = threading.Thread(target=watch, name="calib_deadline", daemon=True)
        watcher.start()
        try:
            yield
        finally:
            done.set()
            watcher.join()


def error_text(error: BaseException | None) -> str:
    """The message of an onnxruntime exception in one line of at most 300 characters, without its codes; its end matters."""
    text = re.sub(r"^\[ONNXRuntimeError\] : \d+ : \w+ : ", "", " ".join(str(error).split()) or type(error).__name__)
    return text if len(text) <= 300 else f"{text[:98]} ... {text[-197:]}"


def _session(path: Path, config: SemanticsConfig) -> tuple[Any, str, str]:
    """The session, its provider (cpu, cuda or tensorrt), and why that is not the configured one; empty if it is."""
    try:
        import onnxruntime
    except ImportError:
        raise MissingDependencyError("models need onnxruntime: python3 -m pip install onnxruntime") from None
    if not path.is_file():
        what = "this is a folder, not an ONNX file" if path.is_dir() else "there is no such file"
        raise ModelError(f"model {path}: {what}; correct the path or leave it empty to go without")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = config.threads, 1
    options.log_severity_level = 4
    # Idle threads that spin take the core that the sensor callbacks need; an arena never shrinks.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.enable_cpu_mem_arena = False
    available, asked = onnxruntime.get_available_providers(), config.provider
    if asked == "auto":
        asked = next(p for p in ("tensorrt", "cuda", "cpu") if PROVIDERS[p][0] in available)
    usable, failed = [p for p in PROVIDERS[asked] if p in available], None
    for providers in dict.fromkeys((tuple(usable), (CPU,))):
        try:
            # The built-in fallback prints to stdout, and loads a broken file twice.
            session = onnxruntime.InferenceSession(str(path), options, providers=list(providers), enable_fallback=0)
            break
        except Exception as error:
            failed = error
    else:
        raise ModelError(f"model {path} cannot be loaded: {_load_error(failed, path, onnxruntime.__version__)}") from None
    own = str(session.get_providers()[0]).removesuffix("ExecutionProvider").lower()
    if PROVIDERS[asked][0] not in available:
        return session, own, f"onnxruntime has no {asked} here: {path.name} runs on {own}"
    why = "; check the driver and its libraries" if failed is None else f": {error_text(failed)}"
    return session, own, f"{path.name} cannot run on {asked}, but on {own}{why}" * (own != asked)


def _load_error(error: BaseException | None, path: Path, version: str) -> str:
    """Why a file cannot be loaded, and what to do."""
    text, whole = error_text(error), " ".join(str(error).split()).replace(str(path), "")
    missing = MISSING_DATA.search(whole)
    if missing is not None:
        return f"its weights are in {missing.group(1)}, which is missing; put that file beside it, under this name"
    if OPSET.search(whole):
        return f"{text}; export it again, with an opset that onnxruntime {version} knows, or install a newer onnxruntime"
    return f"{text}; download or export it again"


def _tensor(path: Path, node: Any) -> Tensor:
    kind = node.type.removeprefix("tensor(").removesuffix(")")
    if kind not in TYPES:
        raise ModelError(f"model {path}: tensor {node.name} is of type {node.type}, which no known convention has")
    sizes = tuple(n if isinstance(n, int) and n > 0 else None for n in node.shape or ())
    return Tensor(node.name, sizes, TYPES[kind])
