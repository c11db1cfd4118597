"""Errors of calib_ros. Every message names what is wrong and what to do about it."""

from __future__ import annotations

from pathlib import Path


class CalibrationError(Exception):
    """Base of all errors that calib_ros raises; the message is one line."""


class BadInputError(CalibrationError):
    """A file, message or array cannot be used as it is."""


class BadTimesError(BadInputError):
    """The times of a frame are implausible, so that its points cannot be motion-compensated."""


class ConfigError(CalibrationError):
    """A parameter is unknown, of the wrong type or out of range."""


class TooFewFeaturesError(CalibrationError):
    """The frames are readable, but have too few features to estimate an extrinsic."""


class MissingDependencyError(CalibrationError):
    """An optional library or ROS package is not installed."""


class ModelError(CalibrationError):
    """A neural network cannot be loaded, fits no known convention, or fails while it runs."""


class BudgetError(CalibrationError):
    """Work was stopped because its time limit was reached."""


def raised_at(error: BaseException) -> str:
    """File and line that raised an error, as cloud.py:12; "" if nothing has."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return "" if trace is None else f"{Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}"


def defect(error: BaseException) -> str:
    """One line about a defect of ours: where it is, and what to do."""
    where = raised_at(error)
    name = type(error).__name__ + (f" in {where}" if where else "")
    said = ": ".join(filter(None, [name, str(error)]))
    return f"unexpected {said}; please report it with the data that led to it"
