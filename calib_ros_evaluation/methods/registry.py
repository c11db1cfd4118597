"""All methods that can be compared."""

from __future__ import annotations

from calib_ros.config import Config
from calib_ros.errors import BadInputError
from calib_ros_evaluation.methods.castorena import Castorena
from calib_ros_evaluation.methods.levinson import Levinson
from calib_ros_evaluation.methods.method import Method
from calib_ros_evaluation.methods.mulfeat import Mulfeat
from calib_ros_evaluation.methods.nid import Nid
from calib_ros_evaluation.methods.own import Own
from calib_ros_evaluation.methods.pandey import Pandey
from calib_ros_evaluation.methods.thesis import Thesis

# In the order of the thesis's table 4.2, then what came after it.
NAMES = ("pandey", "levinson", "castorena", "mulfeat", "thesis", "nid", "ours")


def methods(config: Config) -> dict[str, Method]:
    """Name -> method, in the order of NAMES; all work with this configuration."""
    made: tuple[Method, ...] = (
        Pandey(config=config),
        Levinson(config=config),
        Castorena(config=config),
        Mulfeat(config=config),
        Thesis(config=config),
        Nid(config=config),
        Own(config=config),
    )
    return {method.name: method for method in made}


def check_names(names: tuple[str, ...]) -> None:
    """BadInputError for a name that no method has."""
    for name in names:
        if name not in NAMES:
            raise BadInputError(f"there is no method '{name}'; choose among {', '.join(NAMES)}")
