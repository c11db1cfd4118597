"""What the class numbers of datasets and networks mean in the classes that camera and LiDAR have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros.classes import UNLABELLED, SemanticClass
from calib_ros.errors import ModelError
from calib_ros.semantics.label_datasets import (
    ADE20K,
    CAMVID,
    CITYSCAPES,
    CITYSCAPES_RAW,
    MAPILLARY,
    SEMANTIC_KITTI,
    SEMANTIC_KITTI_RAW,
    SQUEEZESEG,
    VOC,
)

C = SemanticClass
Classes = NDArray[np.uint8]
Names = Sequence[str] | Mapping[int, str]
UNKNOWN_NAMES = frozenset(
    {"unlabeled", "unlabelled", "void", "unknown", "background", "ignore", "dontcare", "out of roi", "outlier"}
)
# Names that datasets give to classes, in lower case, words parted by blanks. A trunk is vegetation, since no camera dataset parts
# it from its tree; so are fences from walls: they are nothing in particular.
_NAMES: dict[SemanticClass, str] = {
    C.OTHER: "other|static|dynamic|object|fence|other object|other structure|misc|bridge|tunnel|guard rail|barrier|ego vehicle|"
    "rectification border|license plate|billboard|bench|trash can|mailbox|railing",
    C.VEHICLE: "vehicle|car|van|truck|bus|train|tram|trailer|caravan|other vehicle|on rails|lorry|boat",
    C.PERSON: "person|pedestrian|people|person sitting|child|human|group of people",
    C.CYCLIST: "cyclist|rider|bicyclist|bicycle|bike|motorcycle|motorbike|minibike|motorcyclist|other rider",
    C.POLE: "pole|polegroup|utility pole|street light|streetlight|column|traffic sign frame",
    C.SIGN: "sign|traffic sign|traffic light|signboard|signsymbol|sign symbol|traffic sign front|traffic sign back",
    C.BUILDING: "building|wall|house|skyscraper|garage",
    C.VEGETATION: "vegetation|tree|trunk|bush|plant|palm|nature|hedge",
    C.GROUND: "ground|road|sidewalk|pavement|parking|terrain|grass|other ground|lane marking|rail track|curb|kerb|earth|field|"
    "path|dirt track|crosswalk|floor|sand|road marking|roadmarking|bike lane|service lane",
    C.SKY: "sky",
}
_CLASS_OF = {name: cls for cls, names in _NAMES.items() for name in names.split("|")}

# Class counts of networks that say nothing about their classes.
OF_IMAGES: dict[int, Sequence[str]] = {
    len(CITYSCAPES): CITYSCAPES,
    len(CITYSCAPES) + 1: [*CITYSCAPES, "background"],
    len(CITYSCAPES_RAW): CITYSCAPES_RAW,
    len(CITYSCAPES_RAW) + 1: [*CITYSCAPES_RAW, "license plate"],
    len(CAMVID): CAMVID,
    len(CAMVID) - 1: CAMVID[:-1],
    len(VOC): VOC,
    len(MAPILLARY): MAPILLARY,
    len(MAPILLARY) - 1: MAPILLARY[:-1],
    len(ADE20K): ADE20K,
}
OF_CLOUDS: dict[int, Sequence[str]] = {
    len(SEMANTIC_KITTI): SEMANTIC_KITTI,
    len(SEMANTIC_KITTI) - 1: SEMANTIC_KITTI[1:],
    len(SQUEEZESEG): SQUEEZESEG,
}
# Whose class numbers a network gives that has chosen already and does not say: the first that has all numbers seen so far.
# 34 raw numbers are never all below 20: there would be no vegetation, sky, person or car in sight.
NUMBERS_OF_IMAGES: dict[str, Names] = {"cityscapes": OF_IMAGES[20], "cityscapes_raw": OF_IMAGES[35]}
NUMBERS_OF_CLOUDS: dict[str, Names] = {"semantic_kitti": SEMANTIC_KITTI, "semantic_kitti_raw": SEMANTIC_KITTI_RAW}
# Datasets by the name that a YAML beside a model may give.
DATASETS: dict[str, Names] = {
    "cityscapes": CITYSCAPES,
    "cityscapes_raw": CITYSCAPES_RAW,
    "camvid": CAMVID,
    "voc": VOC,
    "mapillary": MAPILLARY,
    "ade20k": ADE20K,
    "semantic_kitti": SEMANTIC_KITTI,
    "semantic_kitti_raw": SEMANTIC_KITTI_RAW,
    "squeezeseg": SQUEEZESEG,
}


def class_of(name: str) -> int:
    """The SemanticClass of a dataset's name for a class, UNLABELLED for void and its like. ModelError for an unknown name."""
    plain = " ".join(name.lower().replace("_", " ").replace("-", " ").split())
    if plain in UNKNOWN_NAMES:
        return UNLABELLED
    found = _CLASS_OF.get(plain, _CLASS_OF.get(plain.rstrip("s")))
    if found is None:
        classes = ", ".join(c.name.lower() for c in SemanticClass)
        raise ModelError(f"class name '{name}' is unknown; map it to one of {classes}, or to void")
    return int(found)


def lookup(names: Names) -> Classes:
    """Table (65536,) uint8 from a dataset's class number to the SemanticClass; UNLABELLED for numbers without a name."""
    table = np.full(65536, UNLABELLED, np.uint8)
    for number, name in names.items() if isinstance(names, Mapping) else enumerate(names):
        table[number] = class_of(name)
    return table
