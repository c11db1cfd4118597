"""Classes of the points of a frame (thesis 3.5), from a network for range images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import SemanticsConfig
from calib_ros.errors import ModelError
from calib_ros.frame import UNLABELLED, Frame, PointCloud
from calib_ros.lidar.range_image import reflectivity
from calib_ros.lidar.rings import azimuth_step, ring_of_points
from calib_ros_semantics.models import labels
from calib_ros_semantics.models.class_output import ClassOutput
from calib_ros_semantics.models.labels import SQUEEZESEG, Classes
from calib_ros_semantics.models.onnx_model import Array, Deadline, InputImage, OnnxModel, SegmentationModel

Statistics = Mapping[str, tuple[float, float]]  # mean and standard deviation of each channel
CONVENTIONS = (
    "scores NxCxHxW or NxHxWxC and class numbers Nx1xHxW or NxHxW, as of lidar-bonnetal, SqueezeSeg, SqueezeSegV3, SalsaNext, "
    "CENet and, with one input, 3D-MiniNet"
)
MIN_POINTS = 100  # returns a scan needs
ROWS = 64  # unless the graph declares it: all known networks were trained on scanners of 64 rings
WIDTHS = (512, 1024, 2048)  # columns per revolution that networks are trained at
MAX_STRETCH = 1.5  # ratio of the columns of network and scan: stretched to twice its width a scan lost a third of the accuracy
MAX_OUTSIDE = 0.05  # share of points above or below the field of view without a note; 0.5 % of a KITTI scan
DEFAULT_FOV_DEG = (3.0, -25.0)  # highest and lowest elevation
# deg; points this far above or below the field of view go to the border rows, as in training: KITTI's scans reach 2.4 deg above.
FOV_MARGIN_DEG = 3.0
# A point this near in range to that of its pixel has its class, and points farther apart do not vote. In m, the cut-off of
# RangeNet++'s search for neighbours; as a share of the range, since far ground is seen at grazing angles. With true labels in the
# pixels 98.5 to 99.7 % of the points get theirs back (a KITTI scan, three synthetic ones, 512 to 2048 columns), with the cut-off
# alone 97.4 to 99.4 %.
SAME_RANGE, SAME_RANGE_SHARE = 1.0, 0.1
VOTE_REACH = 2  # pixels to each side that vote for a hidden point, as in RangeNet++: 5x5
VOTED_CLASSES = 10  # SemanticClasses that may get votes
# Channels of range images, their order and statistics, as the families of networks were trained with.
CHANNELS = ("range", "x", "y", "z", "remission", "mask")
SYNONYMS = {"depth": "range", "intensity": "remission", "reflectivity": "remission"}
RANGE_FIRST, XYZ_FIRST = CHANNELS, ("x", "y", "z", "remission", "range", "mask")
# Of SemanticKITTI, as lidar-bonnetal publishes it; SqueezeSeg has the same.
BONNETAL: Statistics = {
    **{"range": (12.12, 12.32), "x": (10.88, 11.47), "y": (0.23, 6.91), "z": (-1.04, 0.86), "remission": (0.21, 0.16)},
    "mask": (0.0, 1.0),
}
CENET: Statistics = {
    **{"range": (11.71279, 10.24), "x": (-0.1023471, 12.295865), "y": (0.4952, 9.4287), "z": (-1.0545, 0.8643)},
    **{"remission": (0.2877, 0.1450), "mask": (0.0, 1.0)},
}
FAMILIES: dict[str, tuple[tuple[str, ...], Statistics]] = {
    **dict.fromkeys(("bonnetal", "rangenet", "squeezesegv3", "salsanext", "3d-mininet"), (RANGE_FIRST, BONNETAL)),
    "cenet": (RANGE_FIRST, CENET),
    **dict.fromkeys(("squeezeseg", "squeezesegv2"), (XYZ_FIRST, BONNETAL)),
}


class CloudNetwork(SegmentationModel):
    """An ONNX network for classes of the pixels of a range image. ModelError if it fits no known convention."""

    def __init__(self, model: OnnxModel, config: SemanticsConfig) -> None:
        self.model, self.fallback, own = model, model.fallback, model.sidecar
        masks = []  # the input of two that is the mask of the other
        for t in model.inputs if len(model.inputs) == 2 else ():
            channels = (t.shape[1], t.shape[3]) if len(t.shape) == 4 else ()
            masks += [t] if "mask" in t.name.lower() or 1 in channels or len(t.shape) == 2 else []
        counts = (len(CHANNELS) - 1, len(CHANNELS)) if isinstance(own.channels, str) else (len(own.channels),)
        image = InputImage.of(model, [t for t in model.inputs if t not in masks], counts)
        if image is None:
            raise model.error(
                f"a network for classes of points takes one range image as 1xCxHxW or 1xHxWxC of {' or '.join(map(str, counts))} "
                f"channels ({', '.join(CHANNELS)}; name others as 'channels:' in {model.yaml}), and perhaps its mask; groups of "
                "neighbours, as 3D-MiniNet takes them beside the image, are not made here: export the part behind them, or take "
                "another network"
            )
        self._input, self._mask = image, masks[0] if masks else None
        rows, self._columns = image.size
        self._rows, self._fov = rows or ROWS, own.fov_deg or DEFAULT_FOV_DEG
        numbers = labels.NUMBERS_OF_CLOUDS
        if _family(model, None, bool(masks)) in ("squeezeseg", "squeezesegv2"):  # its four numbers also fit SemanticKITTI
            numbers = {"squeezeseg": SQUEEZESEG, **numbers}
        size = self._rows, self._columns or WIDTHS[0]
        empty = self._feeds(np.zeros(size, bool), np.zeros((*size, image.channels), np.float32))
        self._output = ClassOutput(model, (empty, size), labels.OF_CLOUDS, numbers, CONVENTIONS)
        self._set_channels()

    def _set_channels(self) -> None:
        """Of the YAML, else of the family, which the number of classes may tell. ModelError if they do not fit."""
        model, own = self.model, self.model.sidecar
        given = () if isinstance(own.channels, str) else own.channels
        names = tuple(SYNONYMS.get(name.lower(), name.lower()) for name in given)
        if own.channels in ("rgb", "bgr") or not set(names) <= set(CHANNELS) or len(set(names)) < len(names):
            raise model.error(f"'channels:' of a range image must be a list of {', '.join(CHANNELS)}, each once")
        self.family = _family(model, self._output.count, self._mask is not None)
        order, statistics = FAMILIES[self.family]
        self._names = names or order[: self._input.channels]
        for name, values in (("mean", own.mean), ("std", own.std)):
            if values and len(values) != len(self._names):
                raise model.error(f"'{name}:' must have {len(self._names)} numbers, one for each channel")
        mean, std = zip(*(statistics[name] for name in self._names), strict=True)
        self._mean, self._std = np.array(own.mean or mean, np.float32), np.array(own.std or std, np.float32)
        self._source = f"of {self.family}, assumed; its YAML may say otherwise"
        if own.mean and own.std:
            self._source = "as its YAML says"
        elif (
            not own.family and self.family == "bonnetal" and len(model.outputs) > 1
        ):  # as CENet has them, whose statistics differ
            self._source = "of bonnetal, assumed; say family: cenet, or mean and std, for others"

    def __call__(self, frame: Frame, deadline: Deadline, borders: bool = True) -> Classes:
        deadline.check()
        returns = frame.cloud.finite_mask()
        if int(returns.sum()) < MIN_POINTS:
            raise ModelError(f"the cloud has {int(returns.sum())} usable points; check that the LiDAR is not covered")
        self._output.settle(deadline)
        self._set_channels()
        feeds, view, self.note = self.feed(frame.cloud.select(returns))
        size = view.index.shape
        pixels = self._output.classes(self._output.values(feeds, deadline, size), size)
        self.known = self._output.known
        found = np.full(len(frame.cloud), UNLABELLED, np.uint8)
        found[returns] = classes_of_points(view, pixels)
        return found

    def describe(self) -> str:
        columns = self._columns or " or ".join(map(str, WIDTHS))
        mean, std = (", ".join(f"{v:.4g}" for v in values) for values in (self._mean, self._std))
        return (
            f"{self.family}: {self._rows}x{columns} {' '.join(self._names)}, {self._fov[1]:+g} to {self._fov[0]:+g} deg, fed as "
            f"(v - [{mean}]) / [{std}] of m and reflectivity 0..1, empty pixels 0 ({self._source}) -> {self._output.text}, on "
            f"{self.model.provider}"
        )

    def feed(self, cloud: PointCloud) -> tuple[dict[str, Array], RangeView, str]:
        """Inputs by name, their range image, and notes on what does not fit, for a cloud of finite points."""
        turn = self.model.sidecar.azimuth_deg
        distance = np.linalg.norm(cloud.xyz, axis=1)
        azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
        elevation = np.arctan2(cloud.xyz[:, 2], np.hypot(cloud.xyz[:, 0], cloud.xyz[:, 1]))
        density = 2 * np.pi / azimuth_step(ring_of_points(cloud, azimuth, elevation), azimuth)  # measurements of a ring per turn
        columns = self._columns or _nearest_width(density * turn / 360)
        light = reflectivity(cloud.intensity)
        notes = self._notes(columns * 360 / turn, density, elevation, light is not None)
        view = range_view(cloud.xyz, (self._rows, columns), self._fov, turn)
        nothing, one = np.zeros(len(cloud), np.float32), np.ones(len(cloud), np.float32)
        x, y, z = cloud.xyz.T
        values = dict(zip(CHANNELS, (distance, x, y, z, nothing if light is None else light, one), strict=True))
        points, there = np.stack([values[name] for name in self._names], axis=1), view.index >= 0
        image = np.zeros((*there.shape, len(self._names)), np.float32)
        image[there] = (points[view.index[there]] - self._mean) / self._std
        return self._feeds(there, image), view, "; ".join(notes)

    def _feeds(self, there: NDArray[np.bool_], image: NDArray[np.float32]) -> dict[str, Array]:
        """there: (h, w) pixels of the image (h, w, channels) that have a point."""
        feeds = {self._input.tensor.name: self._input.arranged(image)}
        if self._mask is not None:
            shape = self._mask.shape
            ahead = (1,) * (len(shape) - 2 if shape else 2)
            channel_last = len(shape) == 4 and shape[3] == 1
            feeds[self._mask.name] = there.reshape((1, *there.shape, 1) if channel_last else (*ahead, *there.shape))
        return feeds

    def _notes(self, columns: float, density: float, elevation: NDArray[np.floating], has_light: bool) -> list[str]:
        notes, name = [], self.model.path.name
        if not 1 / MAX_STRETCH < columns / density < MAX_STRETCH:
            notes.append(
                f"{name} takes {columns:.0f} columns per turn, but the scan has {density:.0f}; expect worse classes; export it "
                f"for {_nearest_width(density)}, or if its columns cover a part of the turn, declare it as 'azimuth_deg:'"
            )
        high, low = np.deg2rad(self._fov)
        outside = float(np.mean((elevation > high) | (elevation < low)))
        if outside > MAX_OUTSIDE:
            notes.append(
                f"{100 * outside:.0f} % of the points lie outside of the elevations {self._fov[1]:+g} to {self._fov[0]:+g} deg "
                f"that {name} takes; its YAML may declare another range as 'fov_deg:'"
            )
        if not has_light:
            notes.append(f"the scan has no intensity, which {name} takes; it gets zeros")
        return notes


def _nearest_width(columns: float) -> int:
    return min(WIDTHS, key=lambda width: abs(np.log(width / columns)))


def _family(model: OnnxModel, classes: int | None, has_mask: bool) -> str:
    """Family by the YAML, else by the names of file and tensors, else by the number of classes."""
    declared = model.family(FAMILIES)
    if declared:
        return declared
    names = " ".join([model.path.stem, *(t.name for t in (*model.inputs, *model.outputs))]).lower()
    if "cenet" in names:
        return "cenet"
    # lidar-bonnetal also has a network of this name, with another order of channels and 20 classes.
    squeezeseg = has_mask or ("squeezeseg" in names and "squeezesegv3" not in names)
    return "squeezeseg" if classes == 4 or (classes is None and squeezeseg) else "bonnetal"


@dataclass(frozen=True, eq=False)
class RangeView:
    """Range image of n points, as networks take it (Milioto et al. 2019, RangeNet++).

    index: (H, W) int32, the nearest point of each pixel, -1 where there is none.
    row, column: (n,) pixel of each point. inside: (n,) whether the image covers it. range: (n,) float32, m.
    whole_turn: whether the columns cover 360 deg.
    """

    index: NDArray[np.int32]
    row: NDArray[np.intp]
    column: NDArray[np.intp]
    inside: NDArray[np.bool_]
    range: NDArray[np.float32]
    whole_turn: bool

    @property
    def ranges(self) -> NDArray[np.float32]:
        """Range of each pixel (H, W), NaN where it is empty."""
        values = np.append(self.range, np.float32(np.nan))
        return np.asarray(values[self.index], np.float32)


def range_view(
    xyz: NDArray[np.float32], size: tuple[int, int], fov_deg: tuple[float, float], azimuth_deg: float = 360.0
) -> RangeView:
    """Range image of this (height, width) of points (n, 3) m, finite and not at the origin.

    fov_deg: highest and lowest elevation. azimuth_deg: angle that the columns cover, straight ahead (+x) in the middle.
    """
    height, width = size
    x, y, z = xyz.astype(np.float64).T
    distance = np.sqrt(x * x + y * y + z * z)
    highest, lowest = np.deg2rad(fov_deg)
    turn = -np.arctan2(y, x) / np.deg2rad(azimuth_deg) + 0.5
    inside = (turn >= 0) & (turn <= 1)
    column = np.clip(np.floor(turn * width), 0, width - 1).astype(np.intp)
    elevation, margin = np.arcsin(z / distance), np.deg2rad(FOV_MARGIN_DEG)
    inside &= (elevation <= highest + margin) & (elevation >= lowest - margin)
    down = 1 - (elevation - lowest) / (highest - lowest)
    row = np.clip(np.floor(down * height), 0, height - 1).astype(np.intp)
    index = np.full(size, -1, np.int32)
    order = np.argsort(-distance, kind="stable")  # later writes win: nearest last
    order = order[inside[order]]
    index[row[order], column[order]] = order
    return RangeView(index, row, column, inside, distance.astype(np.float32), azimuth_deg == 360.0)


def classes_of_points(view: RangeView, classes: Classes) -> Classes:
    """SemanticClass (n,) of the points from those of the pixels (H, W), each of which shows its nearest point.

    Points far behind it get the class most frequent in the neighbourhood at their own range, UNLABELLED where there is none.
    """
    out = classes[view.row, view.column]
    ranges, near = view.ranges, np.maximum(np.float32(SAME_RANGE), np.float32(SAME_RANGE_SHARE) * view.range)
    with np.errstate(invalid="ignore"):
        hidden = np.flatnonzero(view.inside & ~(np.abs(ranges[view.row, view.column] - view.range) < near))
    votes = np.zeros((len(hidden), VOTED_CLASSES), np.float32)
    height, width = classes.shape
    each = np.arange(len(hidden))
    for down in range(-VOTE_REACH, VOTE_REACH + 1):
        row = view.row[hidden] + down
        for right in range(-VOTE_REACH, VOTE_REACH + 1):
            column = view.column[hidden] + right
            there = (row >= 0) & (row < height)
            if not view.whole_turn:
                there &= (column >= 0) & (column < width)
            at = np.clip(row, 0, height - 1), column % width
            weight = np.nan_to_num(1 - np.abs(ranges[at] - view.range[hidden]) / near[hidden], nan=0.0)
            there &= (weight > 0) & (classes[at] < VOTED_CLASSES)
            votes[each[there], classes[at][there]] += weight[there]
    winner = votes.argmax(axis=1).astype(np.uint8)
    out[hidden] = np.where(votes.max(axis=1, initial=0) > 0, winner, UNLABELLED)
    out[~view.inside] = UNLABELLED
    return out
