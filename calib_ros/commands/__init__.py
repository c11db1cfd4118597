"""What the commands do: sources, calibrator and recalibrator put together, with progress for a person."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calib_ros.commands.calibration import calibrate, draw
    from calib_ros.commands.checking import models
    from calib_ros.commands.conversion import convert
    from calib_ros.commands.evaluation import Asked, compared, run_evaluation
    from calib_ros.commands.exporting import export
    from calib_ros.commands.page import steps
    from calib_ros.commands.replaying import replay
    from calib_ros.commands.settings import NOMINAL_BOX, configuration, search_box
    from calib_ros.commands.terminal import note, progress_bar

_HOME = {
    "Asked": "evaluation",
    "NOMINAL_BOX": "settings",
    "calibrate": "calibration",
    "compared": "evaluation",
    "configuration": "settings",
    "convert": "conversion",
    "draw": "calibration",
    "export": "exporting",
    "models": "checking",
    "note": "terminal",
    "progress_bar": "terminal",
    "replay": "replaying",
    "run_evaluation": "evaluation",
    "search_box": "settings",
    "steps": "page",
}
__all__ = [
    "NOMINAL_BOX",
    "Asked",
    "calibrate",
    "compared",
    "configuration",
    "convert",
    "draw",
    "export",
    "models",
    "note",
    "progress_bar",
    "replay",
    "run_evaluation",
    "search_box",
    "steps",
]


def __getattr__(name: str) -> Any:
    """Imported when first used, so that `calib-ros --help` does not wait for OpenCV and SciPy."""
    if name in _HOME:
        import importlib

        return getattr(importlib.import_module(f"calib_ros.commands.{_HOME[name]}"), name)
    raise AttributeError(f"module 'calib_ros.commands' has no attribute '{name}'")
