"""How a scan becomes the input of a network that takes range images: channels, normalisation, size, layout."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import PointCloud
from calib_ros.lidar.columns import azimuth_step
from calib_ros.lidar.rings import ring_of_points
from calib_ros.lidar.scan import reflectivity
from calib_ros.semantics.cloud_channels import FOV_DEG, NAMES, channels_of
from calib_ros.semantics.cloud_projection import RangeView, range_view
from calib_ros.semantics.onnx_model import Array, OnnxModel, Tensor

ROWS = 64  # where the graph does not tell: all known networks were trained on scanners of 64 rings
WIDTHS = (512, 1024, 2048)  # columns per turn that networks are trained at
# Times that the columns of graph and scan may differ: stretched to twice its width a scan lost a third of the accuracy.
SAME_DENSITY = 1.5
OUTSIDE = 0.05  # share of points above or below the field of view that is worth a word; 0.5 % of a KITTI scan


class CloudInput:
    """The inputs of a network that takes a range image, and a mask of its pixels in some exports.

    ModelError if it takes something else, or its YAML contradicts it.
    """

    def __init__(self, model: OnnxModel) -> None:
        self._model, sidecar = model, model.sidecar
        masks = [t for t in model.inputs if len(model.inputs) == 2 and _is_mask(t)]
        images = [t for t in model.inputs if t not in masks and len(t.shape) in (0, 3, 4)]
        if len(images) != 1 or len(model.inputs) != 1 + len(masks):
            raise model.error("a network for classes of points takes one range image as 1x5xHxW or 1xHxWx5, and perhaps its mask")
        self._image, self._mask = images[0], masks[0] if masks else None
        if len(self._image.shape) == 4 and self._image.shape[0] not in (None, 1):
            raise model.error("it takes several scans at once; export it for one")
        self._axis, count = self._layout(self._image)
        self._channels = channels_of(model, count, None, bool(masks))
        own = [n for k, n in enumerate(self._image.shape) if k != self._axis][-2:] or [None, None]
        asked = sidecar.size or (None, None)
        if any(n is not None and m is not None and n != m for n, m in zip(own, asked, strict=True)):
            raise model.error(f"it does not run at the height and width {list(asked)} that 'size:' says")
        self._rows, self._columns = own[0] or asked[0] or ROWS, own[1] or asked[1]
        self._fov = sidecar.fov_deg or FOV_DEG

    @property
    def family(self) -> str:
        """Name of the family whose channels it gets."""
        return self._channels.family

    def settle(self, classes: int | None) -> None:
        """Takes order and normalisation of the channels from the family, which is known with the number of classes."""
        self._channels = channels_of(self._model, len(self._channels.names), classes, self._mask is not None)

    @property
    def text(self) -> str:
        """For people."""
        columns = self._columns or " or ".join(map(str, WIDTHS))
        text = f"{self._rows}x{columns} {' '.join(self._channels.names)}, {self._fov[1]:+g} to {self._fov[0]:+g} deg"
        return text + (", mean and std of bonnetal assumed, say family: cenet for others" if self._channels.assumed else "")

    def example(self) -> tuple[dict[str, Array], tuple[int, int]]:
        """Inputs without a point, and their height and width, to try a network at."""
        size = (self._rows, self._columns or WIDTHS[0])
        nothing = np.empty((0, 3), np.float32)
        return self._feeds(range_view(nothing, size, self._fov), dict.fromkeys(NAMES, nothing[:, 0])), size

    def feed(self, cloud: PointCloud) -> tuple[dict[str, Array], RangeView, str]:
        """Inputs by name, the range image they are made of, and what is amiss, for a cloud whose points are all finite."""
        turn = self._model.sidecar.azimuth_deg
        distance = np.linalg.norm(cloud.xyz, axis=1)
        elevation = np.arctan2(cloud.xyz[:, 2], np.hypot(cloud.xyz[:, 0], cloud.xyz[:, 1]))
        density = _columns_per_turn(cloud, elevation)
        columns = self._columns or min(WIDTHS, key=lambda width: abs(np.log(width / (density * turn / 360))))
        light = reflectivity(cloud.intensity)
        notes = self._notes(columns * 360 / turn, density, elevation, light is not None)
        view = range_view(cloud.xyz, (self._rows, columns), self._fov, turn)
        nothing, one = np.zeros(len(cloud), np.float32), np.ones(len(cloud), np.float32)
        x, y, z = cloud.xyz.T
        values = dict(zip(NAMES, (distance, x, y, z, nothing if light is None else light, one), strict=True))
        return self._feeds(view, values), view, "; ".join(notes)

    def _feeds(self, view: RangeView, values: Mapping[str, NDArray[np.float32]]) -> dict[str, Array]:
        """values: (n,) of each channel by its name."""
        there, channels = view.index >= 0, self._channels
        image = np.zeros((*there.shape, len(channels.names)), np.float32)
        points = np.stack([values[name] for name in channels.names], axis=1)
        image[there] = (points[view.index[there]] - channels.mean) / channels.std
        batch = image if len(self._image.shape) == 3 else image[None]
        feeds = {self._image.name: np.moveaxis(batch, -1, self._axis)}
        if self._mask is not None:
            shape = self._mask.shape
            ahead = (1,) * (len(shape) - 2 if shape else 2)
            channel_last = len(shape) == 4 and shape[3] == 1
            feeds[self._mask.name] = there.reshape((1, *there.shape, 1) if channel_last else (*ahead, *there.shape))
        return feeds

    def _notes(self, columns: float, density: float, elevation: NDArray[np.floating], has_light: bool) -> list[str]:
        notes, best = [], min(WIDTHS, key=lambda width: abs(np.log(width / density)))
        if not 1 / SAME_DENSITY < columns / density < SAME_DENSITY:
            notes.append(
                f"{self._model.path.name} takes {columns:.0f} columns per turn, but the scan has {density:.0f}; expect fewer "
                f"right classes; export it for {best}, or if its columns cover a part of the turn, say it as 'azimuth_deg:'"
            )
        high, low = np.deg2rad(self._fov)
        outside = float(np.mean((elevation > high) | (elevation < low)))
        if outside > OUTSIDE:
            notes.append(
                f"{100 * outside:.0f} % of the points lie outside of the elevations {self._fov[1]:+g} to {self._fov[0]:+g} deg "
                f"that {self._model.path.name} takes; its YAML may say others as 'fov_deg:'"
            )
        if not has_light:
            notes.append(f"the scan has no intensity, which {self._model.path.name} takes; it gets zeros")
        return notes

    def _layout(self, tensor: Tensor) -> tuple[int, int]:
        """Axis and number of the channels."""
        shape, given = tensor.shape, self._model.sidecar.channels
        wanted = (len(given),) if given and not isinstance(given, str) else (len(NAMES) - 1, len(NAMES))
        if not shape:
            return 1, wanted[0]
        first = len(shape) - 3
        for axis in (first, len(shape) - 1):
            if shape[axis] in wanted:
                return axis, int(shape[axis] or 0)
        if shape[first] is None:
            return first, wanted[0]
        raise self._model.error(
            f"{tensor.name} has no axis of {' or '.join(map(str, wanted))} channels ({', '.join(NAMES)}); name those it takes as "
            f"'channels:' in {self._model.path.with_suffix('.yaml')}"
        )


def _is_mask(tensor: Tensor) -> bool:
    """Whether an input of two is the mask of the other."""
    channels = (tensor.shape[1], tensor.shape[3]) if len(tensor.shape) == 4 else ()
    return "mask" in tensor.name.lower() or 1 in channels or len(tensor.shape) == 2


def _columns_per_turn(cloud: PointCloud, elevation: NDArray[np.floating]) -> float:
    """How many times per turn the scanner measures, from its points."""
    azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
    return 2 * np.pi / azimuth_step(ring_of_points(cloud, azimuth, elevation), azimuth)
