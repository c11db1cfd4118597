"""Class numbers of datasets and networks -> SemanticClass, the classes that camera and LiDAR have in common."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from calib_ros import io
from calib_ros.errors import ModelError
from calib_ros.frame import UNLABELLED, SemanticClass
from calib_ros_semantics.models.onnx_model import OnnxModel
from calib_ros_semantics.models.sidecar import MAX_NUMBERS, Sidecar

C = SemanticClass
Classes = NDArray[np.uint8]
Names = Sequence[str] | Mapping[int, str]


def _names(text: str) -> list[str]:
    return text.split("|")


# Class names of datasets by number, as published.
CITYSCAPES = _names(
    "road|sidewalk|building|wall|fence|pole|traffic light|traffic sign|vegetation|terrain|sky|person|rider|car|truck|bus|train|"
    "motorcycle|bicycle"
)
CITYSCAPES_RAW = _names(
    "unlabeled|ego vehicle|rectification border|out of roi|static|dynamic|ground|road|sidewalk|parking|rail track|building|wall|"
    "fence|guard rail|bridge|tunnel|pole|polegroup|traffic light|traffic sign|vegetation|terrain|sky|person|rider|car|truck|bus|"
    "caravan|trailer|train|motorcycle|bicycle"
)
CAMVID = _names("sky|building|pole|road|pavement|tree|sign|fence|car|pedestrian|cyclist|void")
# Classes that streets do not show are "object".
VOC = _names(
    "background|object|bicycle|object|boat|object|bus|car|object|object|object|object|object|object|motorbike|person|object|"
    "object|object|train|object"
)
MAPILLARY = _names(
    "object|object|curb|fence|guard rail|barrier|wall|bike lane|crosswalk|curb|parking|pavement|rail track|road|service lane|"
    "sidewalk|bridge|building|tunnel|person|bicyclist|motorcyclist|other rider|road marking|lane marking|object|sand|sky|object|"
    "terrain|vegetation|object|object|bench|object|billboard|ground|object|object|object|mailbox|ground|object|ground|"
    "street light|pole|traffic sign frame|utility pole|traffic light|traffic sign back|traffic sign front|trash can|bicycle|boat|"
    "bus|car|caravan|motorcycle|on rails|other vehicle|trailer|truck|object|ego vehicle|ego vehicle|unlabeled"
)
_ADE20K = {
    **{0: "wall", 1: "building", 2: "sky", 3: "floor", 4: "tree", 6: "road", 9: "grass", 11: "sidewalk", 12: "person"},
    **{13: "earth", 17: "plant", 20: "car", 25: "house", 29: "field", 42: "column", 43: "signboard", 46: "sand"},
    **{48: "skyscraper", 52: "path", 72: "palm", 80: "bus", 83: "truck", 87: "streetlight", 91: "dirt track", 93: "pole"},
    **{94: "ground", 102: "van", 116: "motorbike", 127: "bicycle", 136: "traffic light"},
}
ADE20K = [_ADE20K.get(number, "object") for number in range(150)]
SEMANTIC_KITTI = _names(
    "unlabeled|car|bicycle|motorcycle|truck|other-vehicle|person|bicyclist|motorcyclist|road|parking|sidewalk|other-ground|"
    "building|fence|vegetation|trunk|terrain|pole|traffic-sign"
)
SQUEEZESEG = _names("unknown|car|pedestrian|cyclist")
# Lower 16 bits of SemanticKITTI's .label files; 252 to 259 are moving objects.
SEMANTIC_KITTI_RAW = {
    **{0: "unlabeled", 1: "outlier", 10: "car", 11: "bicycle", 13: "bus", 15: "motorcycle", 16: "on-rails", 18: "truck"},
    **{20: "other-vehicle", 30: "person", 31: "bicyclist", 32: "motorcyclist", 40: "road", 44: "parking", 48: "sidewalk"},
    **{49: "other-ground", 50: "building", 51: "fence", 52: "other-structure", 60: "lane-marking", 70: "vegetation"},
    **{71: "trunk", 72: "terrain", 80: "pole", 81: "traffic-sign", 99: "other-object", 252: "car", 253: "bicyclist"},
    **{254: "person", 255: "motorcyclist", 256: "on-rails", 257: "bus", 258: "truck", 259: "other-vehicle"},
}
UNKNOWN_NAMES = frozenset(
    {"unlabeled", "unlabelled", "void", "unknown", "background", "ignore", "dontcare", "out of roi", "outlier"}
)
# Class names of datasets, in lower case, words separated by blanks. A trunk is vegetation, since no camera dataset separates it
# from its tree. Fences are OTHER: datasets do not agree on what separates them from walls.
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


def _by_count(*lists: Sequence[str]) -> dict[int, Sequence[str]]:
    return {len(names): names for names in lists}


# Names by the number of classes, for networks that do not name them.
OF_IMAGES = _by_count(
    CITYSCAPES, [*CITYSCAPES, "background"], CITYSCAPES_RAW, [*CITYSCAPES_RAW, "license plate"], CAMVID, CAMVID[:-1], VOC,
    MAPILLARY, MAPILLARY[:-1], ADE20K,
)  # fmt: skip
OF_CLOUDS = _by_count(SEMANTIC_KITTI, SEMANTIC_KITTI[1:], SQUEEZESEG)
# Candidates for networks that give class numbers without names; the first that has all numbers met so far is assumed. The 34 raw
# numbers of Cityscapes are never all below 20: that would be a scene without vegetation, sky, person and car.
NUMBERS_OF_IMAGES: dict[str, Names] = {"cityscapes": OF_IMAGES[20], "cityscapes_raw": OF_IMAGES[35]}
NUMBERS_OF_CLOUDS: dict[str, Names] = {"semantic_kitti": SEMANTIC_KITTI, "semantic_kitti_raw": SEMANTIC_KITTI_RAW}
# Datasets by the name that a YAML beside a model may give.
DATASETS: dict[str, Names] = {
    **{"cityscapes": CITYSCAPES, "cityscapes_raw": CITYSCAPES_RAW, "camvid": CAMVID, "voc": VOC, "mapillary": MAPILLARY},
    **{"ade20k": ADE20K, **NUMBERS_OF_CLOUDS, "squeezeseg": SQUEEZESEG},
}
METADATA_KEYS = ("names", "labels", "classes", "class_names", "id2label", "CLASSES")  # under which exporters write class names
IGNORED = (-1, 255)  # numbers of pixels without a class


class LabelTable:
    """Class numbers -> SemanticClass, by the class names of a dataset; numbers without a name are UNLABELLED. Of several datasets
    it is the first that has all numbers met so far, in whatever frame. ModelError for unknown class names."""

    def __init__(self, datasets: Mapping[str, Names]) -> None:
        self._datasets, self._seen = dict(datasets), np.empty(0, np.int64)
        self._assume(next(iter(datasets)))

    def _assume(self, name: str) -> None:
        self.dataset, self._table = name, lookup(self._datasets[name])

    @property
    def guess(self) -> str:
        """The assumed dataset, where the meaning of the numbers is not declared."""
        return self.dataset if len(self._datasets) > 1 else ""

    @property
    def known(self) -> frozenset[int]:
        """The SemanticClasses that it tells apart."""
        return frozenset(np.unique(self._table).tolist()) - {UNLABELLED}

    def classes(self, numbers: NDArray[Any]) -> Classes:
        """SemanticClass of integers of any shape; UNLABELLED for -1. ModelError for numbers that are no classes."""
        if self.guess:
            self._choose(numbers)
        low, high = int(numbers.min(initial=0)), int(numbers.max(initial=0))
        if low < -1 or high >= MAX_NUMBERS:
            raise ModelError(f"it holds numbers from {low} to {high}, which are no classes")
        found: Classes = self._table[np.maximum(numbers, 0)]
        found[numbers < 0] = UNLABELLED
        return found

    def _choose(self, numbers: NDArray[Any]) -> None:
        self._seen = np.union1d(self._seen, np.setdiff1d(numbers, IGNORED))
        fitting = (name for name, names in self._datasets.items() if np.isin(self._seen, list(_numbered(names))).all())
        name = next(fitting, None)
        if name is None:
            raise ModelError(
                f"its class numbers, {self._seen.min()} to {self._seen.max()} so far, are those of no known dataset; say in a "
                "YAML beside it what 'labels:' mean"
            )
        if name != self.dataset:
            self._assume(name)


def table_of(model: OnnxModel, count: int | None, by_count: Mapping[int, Names], by_number: Mapping[str, Names]) -> LabelTable:
    """The class table of a network: of its YAML, else of its metadata, else of a known dataset. ModelError if there is none.

    count: scores per pixel; None = the network gives class numbers. by_count: names for known counts. by_number: candidates for
    class numbers, by dataset.
    """
    path, names = model.yaml, _declared_names(model.sidecar, model.yaml)
    if names is not None:
        if count is not None and (max(names) >= count if isinstance(names, Mapping) else len(names) != count):
            raise model.error(f"{path.name} names {len(names)} classes by 'labels:', but the network gives scores of {count}")
        return _declared_table(path, names)
    own = _metadata_names(model.metadata)
    if own is not None and count in (None, len(own)):
        return LabelTable({"": own})
    if count is None:
        return LabelTable(by_number)
    if count not in by_count:
        none = f"which are of no known dataset (these have {', '.join(map(str, sorted(by_count)))})"
        raise model.error(
            f"it gives scores of {count} classes, {none}; name them by 'labels:' in {path}. If it is Segment Anything, it goes "
            "to semantics.segment_anything; detectors of boxes and classifiers of whole pictures are of no use"
        )
    return LabelTable({"": by_count[count]})


def table_of_folder(folder: Path, usual: Names) -> LabelTable:
    """The class table of a folder of label files: of its labels.yaml, else the usual one. ModelError for a wrong labels.yaml."""
    beside = folder / "labels.yaml"
    return _declared_table(beside, _declared_names(Sidecar.beside(beside), beside) or usual)


def _declared_names(sidecar: Sidecar, path: Path) -> Names | None:
    """The class names declared in the YAML at this path; None if there are none. ModelError for an unknown dataset."""
    if not isinstance(sidecar.labels, str):
        return sidecar.labels or None
    if sidecar.labels and sidecar.labels not in DATASETS:
        raise ModelError(f"{path}: labels = '{sidecar.labels}' is none of {', '.join(DATASETS)}; use one, or a list of names")
    return DATASETS.get(sidecar.labels)


def _declared_table(path: Path, names: Names) -> LabelTable:
    try:
        return LabelTable({"": names})
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from None


def class_of(name: str) -> int:
    """The SemanticClass of a class name of a dataset; UNLABELLED for void and the like. ModelError for an unknown name."""
    plain = " ".join(name.lower().replace("_", " ").replace("-", " ").split())
    if plain in UNKNOWN_NAMES:
        return UNLABELLED
    found = _CLASS_OF.get(plain, _CLASS_OF.get(plain.rstrip("s")))
    if found is None:
        classes = ", ".join(c.name.lower() for c in SemanticClass)
        raise ModelError(f"class name '{name}' is unknown; map it to one of {classes}, or to void")
    return int(found)


def lookup(names: Names) -> Classes:
    """Table (65536,) uint8 from class number to SemanticClass; UNLABELLED for numbers without a name."""
    table = np.full(MAX_NUMBERS, UNLABELLED, np.uint8)
    for number, name in _numbered(names).items():
        table[number] = class_of(name)
    return table


def _numbered(names: Names) -> Mapping[int, str]:
    return names if isinstance(names, Mapping) else dict(enumerate(names))


def resized(classes: Classes, size: tuple[int, int]) -> Classes:
    """Classes (h, w) at another size (height, width), nearest neighbour."""
    if classes.shape == size:
        return classes
    return np.asarray(cv2.resize(classes, (size[1], size[0]), interpolation=cv2.INTER_NEAREST_EXACT), np.uint8)


def _metadata_names(metadata: Mapping[str, str]) -> dict[int, str] | None:
    """Names by number in the metadata, as a list or mapping in the syntax of Python or JSON; None if there are none, or none of a
    class of streets: a list like c0, c1, ... is no better than none."""
    for key in METADATA_KEYS:
        try:
            found = io.load(metadata.get(key, ""))
            pairs = _numbered(found).items() if isinstance(found, list | dict) else ()
            names = {int(number): _plain(str(name)) for number, name in pairs}
        except (yaml.YAMLError, ValueError, TypeError, RecursionError):  # anything else is no list of classes
            continue
        if names and min(names) >= 0 and max(names) < MAX_NUMBERS:
            useful = any(class_of(name) not in (UNLABELLED, SemanticClass.OTHER) for name in names.values())
            return names if useful else None
    return None


def _plain(name: str) -> str:
    """The first of several names of a class; "object" for names of other datasets than streets."""
    first = re.split(r"[,;/]", name)[0].strip()
    try:
        class_of(first)
    except ModelError:
        return "object"
    return first
