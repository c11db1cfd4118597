"""Errors of calib_ros. Every message names what is wrong and what to do about it."""


class CalibrationError(Exception):
    """Base of everything that calib_ros raises on purpose; its text is one line for a person."""


class BadInputError(CalibrationError):
    """A file, message or array cannot be used as it is."""


class BadTimesError(BadInputError):
    """The times of a frame cannot be right, so that its points cannot be moved to the image's moment."""


class ConfigError(CalibrationError):
    """A parameter is unknown, of the wrong type or out of range."""


class TooFewFeaturesError(CalibrationError):
    """The frames are readable, but do not hold enough edges to estimate an extrinsic."""


class MissingDependencyError(CalibrationError):
    """An optional library or ROS package is not installed."""


class ModelError(CalibrationError):
    """A neural network cannot be loaded, fits no known convention, or fails while it runs."""


class BudgetError(CalibrationError):
    """Work was broken off because its time was up."""
