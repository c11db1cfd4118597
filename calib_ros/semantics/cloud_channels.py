"""Order, mean and standard deviation of the channels of range images, as the families of networks were trained with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.semantics.onnx_model import OnnxModel

FOV_DEG = (3.0, -25.0)  # highest and lowest elevation
NAMES = ("range", "x", "y", "z", "remission", "mask")
SYNONYMS = {"depth": "range", "intensity": "remission", "reflectivity": "remission"}
RANGE_FIRST, XYZ_FIRST = NAMES, ("x", "y", "z", "remission", "range", "mask")
Statistics = Mapping[str, tuple[float, float]]
MASK = (0.0, 1.0)
# Of SemanticKITTI, as lidar-bonnetal publishes it; SqueezeSeg has the same.
BONNETAL: Statistics = dict(
    zip(NAMES, ((12.12, 12.32), (10.88, 11.47), (0.23, 6.91), (-1.04, 0.86), (0.21, 0.16), MASK), strict=True)
)
CENET: Statistics = dict(
    zip(
        NAMES,
        ((11.71279, 10.24), (-0.1023471, 12.295865), (0.4952, 9.4287), (-1.0545, 0.8643), (0.2877, 0.1450), MASK),
        strict=True,
    )
)
FAMILIES: dict[str, tuple[tuple[str, ...], Statistics]] = {
    **dict.fromkeys(("bonnetal", "rangenet", "squeezesegv3", "salsanext", "3d-mininet"), (RANGE_FIRST, BONNETAL)),
    "cenet": (RANGE_FIRST, CENET),
    **dict.fromkeys(("squeezeseg", "squeezesegv2"), (XYZ_FIRST, BONNETAL)),
}


@dataclass(frozen=True, eq=False)
class Channels:
    """names in their order; mean, std: of each, (c,) float32, subtracted and divided by.

    assumed: nobody told mean and std, and the network has several outputs, as CENet has, whose own are different.
    """

    family: str
    names: tuple[str, ...]
    mean: NDArray[np.float32]
    std: NDArray[np.float32]
    assumed: bool


def channels_of(model: OnnxModel, count: int, classes: int | None, has_mask: bool) -> Channels:
    """Those of a network with `count` channels: of its YAML, else of its family.

    classes: how many it gives scores of, None = unknown. has_mask: it takes the mask as another input. ModelError for a YAML
    that does not fit.
    """
    sidecar = model.sidecar
    given = () if isinstance(sidecar.channels, str) else sidecar.channels
    names = tuple(SYNONYMS.get(name.lower(), name.lower()) for name in given)
    if sidecar.channels in ("rgb", "bgr") or not set(names) <= set(NAMES):
        raise model.error(f"'channels:' of a range image must be a list of {', '.join(NAMES)}")
    if len(set(names)) < len(names):
        raise model.error("'channels:' of a range image must name each channel once")
    family = _family(model, classes, has_mask)
    order, statistics = FAMILIES[family]
    names = names or order[:count]
    for name, values in (("mean", sidecar.mean), ("std", sidecar.std)):
        if values and len(values) != len(names):
            raise model.error(f"'{name}:' must have {len(names)} numbers, one for each channel")
    mean, std = (tuple(statistics[name][k] for name in names) for k in (0, 1))
    told = sidecar.family or (sidecar.mean and sidecar.std)
    assumed = not told and family == "bonnetal" and len(model.outputs) > 1
    mean, std = sidecar.mean or mean, sidecar.std or std
    return Channels(family, names, np.array(mean, np.float32), np.array(std, np.float32), assumed)


def _family(model: OnnxModel, classes: int | None, has_mask: bool) -> str:
    """As told by the YAML, the names of file and tensors, or the number of classes."""
    asked = model.sidecar.family.lower()
    if asked:
        if asked not in FAMILIES:
            raise model.error(f"family '{asked}' is unknown; known are {', '.join(FAMILIES)}")
        return asked
    said = " ".join([model.path.stem, *(t.name for t in (*model.inputs, *model.outputs))]).lower()
    if "cenet" in said:
        return "cenet"
    # lidar-bonnetal has a network of this name, too, which has its own order and 20 classes.
    squeezeseg = has_mask or ("squeezeseg" in said and "squeezesegv3" not in said)
    return "squeezeseg" if classes == 4 or (classes is None and squeezeseg) else "bonnetal"
