"""What the class numbers of datasets and networks mean in the classes that camera and LiDAR have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros.classes import UNLABELLED, SemanticClass
from calib_ros.errors import ModelError

C = SemanticClass
Classes = NDArray[np.uint8]
UNKNOWN_NAMES = frozenset(
    {"unlabeled", "unlabelled", "void", "unknown", "background", "ignore", "dontcare", "out of roi", "outlier"}
)
# Names that datasets give to classes, in lower case, words parted by blanks. A trunk is vegetation, since no camera dataset parts
# it from its tree; so are fences from walls: they are nothing in particular.
_NAMES: dict[SemanticClass, str] = {
    C.OTHER: "other|static|dynamic|object|fence|other object|other structure|misc|bridge|tunnel|guard rail|barrier|ego vehicle|"
    "rectification border|license plate|billboard|bench|trash can|mailbox|railing",
    C.VEHICLE: "vehicle|car|van|truck|bus|train|tram|trailer|caravan|minibike|other vehicle|on rails|lorry|boat",
    C.PERSON: "person|pedestrian|people|person sitting|child|human|group of people",
    C.CYCLIST: "cyclist|rider|bicyclist|bicycle|bike|motorcycle|motorbike|motorcyclist|other rider",
    C.POLE: "pole|polegroup|utility pole|street light|streetlight|column|traffic sign frame",
    C.SIGN: "sign|traffic sign|traffic light|signboard|signsymbol|sign symbol|traffic sign front|traffic sign back",
    C.BUILDING: "building|wall|house|skyscraper|garage",
    C.VEGETATION: "vegetation|tree|trunk|bush|plant|palm|nature|hedge",
    C.GROUND: "ground|road|sidewalk|pavement|parking|terrain|grass|other ground|lane marking|rail track|curb|kerb|earth|field|"
    "path|dirt track|crosswalk|floor|sand|road marking|roadmarking|bike lane|service lane",
    C.SKY: "sky",
}
_CLASS_OF = {name: cls for cls, names in _NAMES.items() for name in names.split("|")}

CITYSCAPES = [
    "road",
    "sidewalk",
    "building",
    "wall",
    "fence",
    "pole",
    "traffic light",
    "traffic sign",
    "vegetation",
    "terrain",
    "sky",
    "person",
    "rider",
    "car",
    "truck",
    "bus",
    "train",
    "motorcycle",
    "bicycle",
]
CITYSCAPES_RAW = [
    "unlabeled",
    "ego vehicle",
    "rectification border",
    "out of roi",
    "static",
    "dynamic",
    "ground",
    "road",
    "sidewalk",
    "parking",
    "rail track",
    "building",
    "wall",
    "fence",
    "guard rail",
    "bridge",
    "tunnel",
    "pole",
    "polegroup",
    "traffic light",
    "traffic sign",
    "vegetation",
    "terrain",
    "sky",
    "person",
    "rider",
    "car",
    "truck",
    "bus",
    "caravan",
    "trailer",
    "train",
    "motorcycle",
    "bicycle",
]
CAMVID = ["sky", "building", "pole", "road", "pavement", "tree", "sign", "fence", "car", "pedestrian", "cyclist", "void"]
VOC = [
    "background",
    "object",
    "bicycle",
    "object",
    "boat",
    "object",
    "bus",
    "car",
    "object",
    "object",
    "object",
    "object",
    "object",
    "object",
    "motorbike",
    "person",
    "object",
    "object",
    "object",
    "train",
    "object",
]
SEMANTIC_KITTI = [
    "unlabeled",
    "car",
    "bicycle",
    "motorcycle",
    "truck",
    "other-vehicle",
    "person",
    "bicyclist",
    "motorcyclist",
    "road",
    "parking",
    "sidewalk",
    "other-ground",
    "building",
    "fence",
    "vegetation",
    "trunk",
    "terrain",
    "pole",
    "traffic-sign",
]
SQUEEZESEG = ("unknown", "car", "pedestrian", "cyclist")
# Class counts of networks that say nothing about their classes.
OF_IMAGES: dict[int, Sequence[str]] = {
    len(CITYSCAPES): CITYSCAPES,
    len(CITYSCAPES) + 1: [*CITYSCAPES, "background"],
    len(CITYSCAPES_RAW): CITYSCAPES_RAW,
    len(CITYSCAPES_RAW) + 1: [*CITYSCAPES_RAW, "license plate"],
    len(CAMVID): CAMVID,
    len(CAMVID) - 1: CAMVID[:-1],
    len(VOC): VOC,
}
OF_CLOUDS: dict[int, Sequence[str]] = {
    len(SEMANTIC_KITTI): SEMANTIC_KITTI,
    len(SEMANTIC_KITTI) - 1: SEMANTIC_KITTI[1:],
    len(SQUEEZESEG): SQUEEZESEG,
}
# Datasets by the name that a YAML beside a model may give.
DATASETS: dict[str, Sequence[str]] = {
    "cityscapes": CITYSCAPES,
    "cityscapes_raw": CITYSCAPES_RAW,
    "camvid": CAMVID,
    "voc": VOC,
    "semantic_kitti": SEMANTIC_KITTI,
    "squeezeseg": SQUEEZESEG,
}
# Lower 16 bits of SemanticKITTI's .label files; the moving ones among 252 to 259.
SEMANTIC_KITTI_RAW = {
    **{0: "unlabeled", 1: "outlier", 10: "car", 11: "bicycle", 13: "bus", 15: "motorcycle", 16: "on-rails", 18: "truck"},
    **{20: "other-vehicle", 30: "person", 31: "bicyclist", 32: "motorcyclist", 40: "road", 44: "parking", 48: "sidewalk"},
    **{49: "other-ground", 50: "building", 51: "fence", 52: "other-structure", 60: "lane-marking", 70: "vegetation"},
    **{71: "trunk", 72: "terrain", 80: "pole", 81: "traffic-sign", 99: "other-object", 252: "car", 253: "bicyclist"},
    **{254: "person", 255: "motorcyclist", 256: "on-rails", 257: "bus", 258: "truck", 259: "other-vehicle"},
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


def lookup(names: Sequence[str] | Mapping[int, str]) -> Classes:
    """Table (65536,) uint8 from a dataset's class number to the SemanticClass; UNLABELLED for numbers without a name."""
    table = np.full(65536, UNLABELLED, np.uint8)
    for number, name in names.items() if isinstance(names, Mapping) else enumerate(names):
        table[number] = class_of(name)
    return table
