"""Class names of datasets by number, as their publishers write them (what they mean to us: see labels)."""

from __future__ import annotations


def _names(text: str) -> list[str]:
    return text.split("|")


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
# What no street shows is an object to us.
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
# Lower 16 bits of SemanticKITTI's .label files; the moving ones among 252 to 259.
SEMANTIC_KITTI_RAW = {
    **{0: "unlabeled", 1: "outlier", 10: "car", 11: "bicycle", 13: "bus", 15: "motorcycle", 16: "on-rails", 18: "truck"},
    **{20: "other-vehicle", 30: "person", 31: "bicyclist", 32: "motorcyclist", 40: "road", 44: "parking", 48: "sidewalk"},
    **{49: "other-ground", 50: "building", 51: "fence", 52: "other-structure", 60: "lane-marking", 70: "vegetation"},
    **{71: "trunk", 72: "terrain", 80: "pole", 81: "traffic-sign", 99: "other-object", 252: "car", 253: "bicyclist"},
    **{254: "person", 255: "motorcyclist", 256: "on-rails", 257: "bus", 258: "truck", 259: "other-vehicle"},
}
