"""The density completion of depth, step by step (thesis 3.4.3, figure 3.13)."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.evaluation.steps.pictures import VIRIDIS, Scale, busiest, tiles
from calib_ros.evaluation.steps.step import Image, Scene, Step
from calib_ros.lidar import density
from calib_ros.lidar.edge_maps import DEPTH_UNITS, far_level

Levels = NDArray[np.int16]
SECTION = "3.4.3"


def completion_stages(sparse_depth: Levels, far: int) -> list[tuple[str, Levels]]:
    """Sparse depth (h, w) -> the map after each step of figure 3.13, still inverted; the last is complete()'s result."""
    square = {size: np.ones((size, size), np.uint8) for size in (density.SMALL, density.MIDDLE, density.LARGE)}
    empty = np.int16(density.EMPTY)
    stages = [("inversion", np.where(sparse_depth != empty, np.int16(far + 1) - sparse_depth, empty))]
    stages.append(("dilation", np.asarray(cv2.dilate(stages[-1][1], density.NEAREST), np.int16)))
    closed = cv2.morphologyEx(stages[-1][1], cv2.MORPH_CLOSE, square[density.SMALL])
    stages.append(("closing", np.asarray(closed, np.int16)))
    for name, size in (("middle holes", density.MIDDLE), ("large holes", density.LARGE)):
        before = stages[-1][1]
        stages.append((name, np.where(before == empty, np.asarray(cv2.dilate(before, square[size]), np.int16), before)))
    stages.append(("blur", np.asarray(cv2.medianBlur(stages[-1][1], density.BLUR), np.int16)))
    return stages


def completion_steps(scene: Scene) -> Iterator[Step]:
    """Sparse depth to the map before the last step, which gives dense depth."""
    sparse_depth, far = scene.maps.lidar.sparse_depth, far_level(scene.config.thesis)
    stages = completion_stages(sparse_depth, far)
    seen = sparse_depth[sparse_depth != density.EMPTY]
    low, high = np.round((far + 1 - np.percentile(seen, [99, 1])) / DEPTH_UNITS) if len(seen) else (0, far / DEPTH_UNITS)
    inverted = Scale(f"{far / DEPTH_UNITS:g} m - depth, m", float(low), max(float(high), float(low) + 1), VIRIDIS)
    texts = {
        "inversion": "Depth is inverted, so that near points are large and win where the next steps take a maximum. Points are "
        "drawn larger.",
        "dilation": "Dilation by a diamond of 5 px: every point fills the pixels next to it.",
        "closing": f"Closing by {density.SMALL} px: gaps between the points of a surface fill up, its outline stays.",
        "middle holes": f"Empty pixels take the largest value within {density.MIDDLE} px; filled ones stay.",
        "large holes": f"The same within {density.LARGE} px. Look at the borders: objects grow into sky and ground by up "
        f"to {density.LARGE // 2} px, which is why edges count only where a point lies.",
    }
    for name, text in texts.items():
        levels = dict(stages)[name]
        shown = levels != density.EMPTY
        draw = inverted.dots if name == "inversion" else inverted.dense
        yield Step(
            SECTION,
            f"Completion: {name}",
            f"Figure 3.13. {text} {shown.mean():.1%} of the pixels are filled.",
            draw(levels / DEPTH_UNITS, shown),
        )
    yield Step(
        SECTION,
        "Completion, magnified",
        "Figure 3.13 on the part of the picture with the strongest jumps, pixel by pixel: from single points to a surface. "
        "The last step but the inversion back is a median blur, which takes away what sticks out of a surface.",
        _magnified(stages, scene.maps.discontinuity, inverted),
        wide=True,
    )


def _magnified(stages: list[tuple[str, Levels]], interest: NDArray[np.float32], scale: Scale) -> Image:
    h, w = interest.shape
    window = busiest(interest, max(h // 3, 2), max(w // 8, 2))
    pictures = [
        scale.palette[np.where(levels[window] != density.EMPTY, scale.levels(levels[window] / DEPTH_UNITS), 0)]
        for _, levels in stages
    ]
    return scale.below(tiles(pictures, [name for name, _ in stages], 3, w))
