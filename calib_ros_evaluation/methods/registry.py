"""All methods that can be compared."""

from __future__ import annotations

from calib_ros.config import Config
from calib_ros_evaluation.methods.edges import Castorena, Levinson
from calib_ros_evaluation.methods.information import Nid, Pandey
from calib_ros_evaluation.methods.method import Method
from calib_ros_evaluation.methods.mulfeat import Mulfeat
from calib_ros_evaluation.methods.own import Own, Thesis

# In the order of the thesis's table 4.2, then what came after it.
METHODS = (Pandey, Levinson, Castorena, Mulfeat, Thesis, Nid, Own)
NAMES = tuple(method.name for method in METHODS)


def methods(config: Config) -> dict[str, Method]:
    """Name -> method, in the order of NAMES; all work with this configuration."""
    return {method.name: method(config=config) for method in METHODS}
