"""An ONNX file as a function of arrays: loading it, its inputs and outputs, running it within a time limit.

The meaning of the tensors is up to the modules that use it: segment_anything, image_classes and cloud_classes.
"""

from __future__ import annotations

import dataclasses
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from calib_ros import io
from calib_ros.config import SemanticsConfig
from calib_ros.errors import BadInputError, BudgetError, MissingDependencyError, ModelError

Array = NDArray[Any]
GREY_LEVELS = 2.0  # mean or std above this refer to 0..255, not to 0..1
POLL_S = 0.05  # how often the deadline of a running network is checked
PROVIDERS = {
    "cpu": ["CPUExecutionProvider"],
    "cuda": ["CUDAExecutionProvider", "CPUExecutionProvider"],
    "tensorrt": ["TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"],
}
TYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
    "tensor(int8)": np.int8,
    "tensor(uint16)": np.uint16,
    "tensor(int16)": np.int16,
    "tensor(int32)": np.int32,
    "tensor(int64)": np.int64,
    "tensor(bool)": np.bool_,
}
# Messages of new and of older versions of onnxruntime.
MISSING_DATA = re.compile(r"(?:External data path does not exist: |No such file or directory )[\[\"]+([^\"\]]+)")
OPSET = re.compile(r"\bopset\b|\bIR version\b", re.IGNORECASE)
SIZES = (8, 8192)  # px; smallest and largest side of an input
EXPECTED = {
    "family": "a name",
    "mean": "a list of numbers",
    "std": "a list of numbers above 0",
    "scale": "a number above 0",
    "channels": "rgb, bgr or a list of names",
    "size": f"[height, width], each {SIZES[0]} to {SIZES[1]} px",
    "labels": "a list of class names, a mapping from numbers to names, or the name of a dataset",
    "fov_deg": "[highest, lowest]",
    "azimuth_deg": "an angle above 0, up to 360",
    "output": "a name",
}  # values of the entries of a Sidecar, for its errors


class OnnxModel:
    """A loaded ONNX file. Raises ModelError, naming the file and what to do, if it cannot be loaded."""

    def __init__(self, path: str | Path, config: SemanticsConfig) -> None:
        self.path, self.sidecar = Path(path), Sidecar.beside(path)
        self._session, self.fallback = _session(self.path, config)
        self.inputs = [_tensor(self.path, t) for t in self._session.get_inputs()]
        self.outputs = [_tensor(self.path, t) for t in self._session.get_outputs()]

    @property
    def provider(self) -> str:
        """Execution provider: cpu, cuda or tensorrt."""
        return str(self._session.get_providers()[0]).removesuffix("ExecutionProvider").lower()

    @property
    def metadata(self) -> dict[str, str]:
        """Metadata that the exporter wrote."""
        return dict(self._session.get_modelmeta().custom_metadata_map)

    @property
    def tensors(self) -> str:
        """All inputs and outputs, as text."""
        inputs, outputs = (", ".join(map(str, tensors)) for tensors in (self.inputs, self.outputs))
        return f"inputs: {inputs}; outputs: {outputs}"

    def run(
        self, feeds: Mapping[str, Array], deadline: Deadline | None = None, outputs: Sequence[str] | None = None
    ) -> list[Array]:
        """Outputs, or those named in `outputs`, for input arrays by name, which are converted to the types of the inputs.

        Raises BudgetError when the time is up, ModelError when the network fails.
        """
        types = {t.name: t.dtype for t in self.inputs}
        given = {name: np.ascontiguousarray(value, types[name]) for name, value in feeds.items()}
        names = list(outputs) if outputs is not None else [t.name for t in self.outputs]
        import onnxruntime

        options = onnxruntime.RunOptions()
        options.log_severity_level = 4  # errors are raised instead
        options.only_execute_path_to_fetches = True  # skips a decoder's large masks where its small ones are used
        try:
            if deadline is None:
                return [np.asarray(out) for out in self._session.run(names, given, options)]
            deadline.check()
            with deadline.enforced(options):
                return [np.asarray(out) for out in self._session.run(names, given, options)]
        except BudgetError:
            raise
        except Exception as error:  # onnxruntime's exceptions have no common base below Exception
            if deadline is not None and deadline.over:
                deadline.check()
            raise ModelError(f"{self.path} failed: {error_text(error)}; it has {self.tensors}") from None

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


@dataclass(frozen=True)
class Sidecar:
    """The YAML beside a model: what its tensors do not say. Empty or None entries are inferred.

    Attributes
    ----------
    family : overrides the family inferred from the tensors. output : name of the output to use.
    scale : factor on grey levels 0..255, such as 1/255. mean, std : per channel, after scale.
    channels : rgb or bgr; of range images the channel names in order.
    size : (height, width) to run at.
    labels : class names by number, or the name of a dataset.
    fov_deg : highest and lowest elevation of a range image. azimuth_deg : angle its columns cover, straight ahead in the middle.
    """

    family: str = ""
    mean: tuple[float, ...] = ()
    std: tuple[float, ...] = ()
    scale: float | None = None
    channels: str | tuple[str, ...] = ""
    size: tuple[int, int] | None = None
    labels: str | tuple[str, ...] | dict[int, str] = ""
    fov_deg: tuple[float, float] | None = None
    azimuth_deg: float = 360.0
    output: str = ""

    @staticmethod
    def beside(path: str | Path) -> Sidecar:
        """The YAML of a model's file; empty if there is none. ModelError names a wrong entry."""
        for suffix in (".yaml", ".yml"):
            own = Path(path).with_suffix(suffix)
            if own.is_file():
                return _read(own)
        return Sidecar()


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


def formula(scale: float, mean: Iterable[float], std: Iterable[float], declared: bool) -> str:
    """How grey levels 0..255 become the input of a network, and whether somebody said so, as text."""
    means, stds = ([f"{v:.4g}" for v in values] for values in (mean, std))
    times = "v" if scale == 1 else "v / 255" if abs(scale * 255 - 1) < 1e-3 else f"v * {scale:.4g}"
    shifted = times if set(means) == {"0"} else f"({times} - [{', '.join(means)}])"
    whole = shifted if set(stds) == {"1"} else f"{shifted} / [{', '.join(stds)}]"
    return f"{whole} of grey levels v in 0..255 ({'as its YAML says' if declared else 'assumed; its YAML may say otherwise'})"


def error_text(error: BaseException) -> str:
    """The message of an onnxruntime exception in one line of at most 300 characters, without its codes; its end matters."""
    text = re.sub(r"^\[ONNXRuntimeError\] : \d+ : \w+ : ", "", " ".join(str(error).split()) or type(error).__name__)
    return text if len(text) <= 300 else f"{text[:98]} ... {text[-197:]}"


def _session(path: Path, config: SemanticsConfig) -> tuple[Any, str]:
    """The session, and why it does not run on the configured provider; empty if it does."""
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
    available = onnxruntime.get_available_providers()
    if config.provider == "auto":
        provider = next(p for p in ("tensorrt", "cuda", "cpu") if PROVIDERS[p][0] in available)
    else:
        provider = config.provider
    usable = [p for p in PROVIDERS[provider] if p in available]
    fallback = ""
    if PROVIDERS[provider][0] not in usable:
        fallback = f"onnxruntime has no {provider} here: {path.name} runs on {_provider_name(usable)}"
    try:
        # The built-in fallback prints to stdout, and loads a broken file twice.
        session = onnxruntime.InferenceSession(str(path), options, providers=usable, enable_fallback=0)
    except Exception as error:
        if provider != "cpu":
            try:
                session = onnxruntime.InferenceSession(str(path), options, providers=PROVIDERS["cpu"])
                return session, f"{path.name} cannot run on {provider}, but on cpu: {error_text(error)}"
            except Exception as on_cpu:
                error = on_cpu
        raise ModelError(f"model {path} cannot be loaded: {_load_error(error, path, onnxruntime.__version__)}") from None
    if usable[0] not in session.get_providers():  # onnxruntime continues without a provider whose libraries are missing
        instead = _provider_name(session.get_providers())
        fallback = f"{path.name} cannot run on {provider}, but on {instead}; check the driver and its libraries"
    return session, fallback


def _load_error(error: BaseException, path: Path, version: str) -> str:
    """Why a file cannot be loaded, and what to do."""
    text, whole = error_text(error), " ".join(str(error).split()).replace(str(path), "")
    missing = MISSING_DATA.search(whole)
    if missing is not None:
        return f"its weights are in {missing.group(1)}, which is missing; put that file beside it, under this name"
    if OPSET.search(whole):
        return f"{text}; export it again, with an opset that onnxruntime {version} knows, or install a newer onnxruntime"
    return f"{text}; download or export it again"


def _provider_name(providers: Sequence[str]) -> str:
    return providers[0].removesuffix("ExecutionProvider").lower()


def _tensor(path: Path, node: Any) -> Tensor:
    if node.type not in TYPES:
        raise ModelError(f"model {path}: tensor {node.name} is of type {node.type}, which no known convention has")
    sizes = tuple(n if isinstance(n, int) and n > 0 else None for n in node.shape or ())
    return Tensor(node.name, sizes, TYPES[node.type])


def _read(path: Path) -> Sidecar:
    names = [f.name for f in dataclasses.fields(Sidecar)]
    try:
        data = io.load(io.read_text(path, "description of a model", "a small YAML"))
    except BadInputError as error:
        raise ModelError(str(error)) from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ModelError(f"{path} is not valid YAML{io.what_is_wrong(error)}; it may hold {', '.join(names)}") from None
    if data is None:
        return Sidecar()
    if not isinstance(data, dict):
        raise ModelError(f"{path} must hold names and values; known are {', '.join(names)}")
    for name in data:
        if name not in names:
            raise ModelError(f"{path}: unknown entry '{name}'; known are {', '.join(names)}")
    return Sidecar(**{name: _validated(path, name, value) for name, value in data.items() if value is not None})


def _validated(path: Path, name: str, value: Any) -> Any:
    fits = False
    if name in ("family", "output"):
        fits = isinstance(value, str)
    elif name == "scale":
        fits = _is_number(value) and value > 0
    elif name == "azimuth_deg":
        fits = _is_number(value) and 0 < value <= 360
    elif name in ("mean", "std", "size", "fov_deg"):
        fits = isinstance(value, list) and len(value) > 0 and all(_is_number(v) for v in value)
        fits = fits and (name != "std" or min(value) > 0)
        fits = fits and (
            name != "size" or (len(value) == 2 and all(isinstance(v, int) and SIZES[0] <= v <= SIZES[1] for v in value))
        )
        fits = fits and (name != "fov_deg" or (len(value) == 2 and -90 <= value[1] < value[0] <= 90))
    elif name == "channels":
        fits = value in ("rgb", "bgr") or (isinstance(value, list) and all(isinstance(v, str) for v in value))
    elif isinstance(value, dict):
        fits = all(
            isinstance(k, int) and not isinstance(k, bool) and 0 <= k < 65536 and isinstance(v, str) for k, v in value.items()
        )
    else:
        fits = isinstance(value, str) or (isinstance(value, list) and all(isinstance(v, str) for v in value))
    if not fits:
        raise ModelError(f"{path}: {name} = {value!r} must be {EXPECTED[name]}")
    if isinstance(value, list):
        return tuple(float(v) for v in value) if name in ("mean", "std", "fov_deg") else tuple(value)
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e12
