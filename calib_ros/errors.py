"""Errors of calib_ros. Every message names what is wrong and what to do about it."""


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
