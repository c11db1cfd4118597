"""Pictures of another shape than a network's input go in as tiles, and come back as one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from masks_of_pictures import frame_of, later
from onnx_graphs import centres, segmentation

from calib_ros.config import SemanticsConfig
from calib_ros.registration.classes import IMAGE
from calib_ros_semantics.models.labels import CITYSCAPES, lookup
from calib_ros_semantics.models.segmentation import load_model
from calib_ros_semantics.models.tiles import Tiling


@pytest.mark.parametrize(
    ("image", "tile", "size", "tiles"),
    [
        ((375, 1242), (384, 384), (309, 1024), 4),  # enlarged no more than a picture for a network of any size
        ((375, 1242), (256, 512), (256, 848), 2),  # a row of tiles, not two
        ((1280, 1920), (512, 1024), (683, 1024), 2),  # a column
        ((375, 1242), (1024, 1024), (309, 1024), 1),  # with a border above and below
        ((1242, 375), (384, 384), (1024, 309), 4),
        ((375, 1242), (1024, 2048), (618, 2048), 1),
        ((900, 1600), (512, 1024), None, 0),  # nearly the same shape is stretched
        ((480, 640), (384, 512), None, 0),
    ],
)
def test_the_shape_is_kept_and_all_is_covered(image, tile, size, tiles) -> None:
    tiling = Tiling.of(image, tile, 1024)
    if size is None:
        assert tiling is None
        return
    assert (tiling.size, len(tiling.corners)) == (size, tiles)
    number = np.arange(size[0] * size[1], dtype=np.int32).reshape(size)
    seen = np.zeros(size, int)
    for row, column in tiling.corners:
        seen[max(row, 0) : row + tile[0], max(column, 0) : column + tile[1]] += 1
    assert seen.min() == 1
    parts = list(tiling.cut((number % 251).astype(np.uint8)))
    assert {part.shape for part in parts} == {tile}
    if max(size) <= 1024:
        assert np.array_equal(tiling.numbers(parts), number % 251)


def test_scores_are_probabilities_that_count_most_in_the_middle_of_a_tile() -> None:
    tiling = Tiling((8, 24), (8, 16), ((0, 0), (0, 8)))
    left, right = np.zeros((2, 8, 16)), np.zeros((2, 8, 16))
    left[0], right[1] = 50, 50
    merged = tiling.scores([left, right])
    assert merged.shape == (2, 8, 24)
    np.testing.assert_allclose(merged.sum(axis=0), 1, atol=1e-3)
    np.testing.assert_allclose(merged[1, 4, [2, 12, 21]], [0, 0.56, 1], atol=0.01)
    assert np.all(np.diff(merged[1, 4]) > -1e-4)
    np.testing.assert_allclose(tiling.scores([np.full((2, 4, 8), 0.5)] * 2), 0.5, atol=1e-3)


@pytest.mark.parametrize("output", ["scores 1 19 128 128", "argmax 1 1 128 128"])
def test_a_square_network_sees_what_is_narrow_in_a_wide_picture(tmp_path: Path, output: str) -> None:
    """Posts of 3 pixels, which are lost where 1242 columns go into 128."""
    level = np.rint(centres(19, 0, 255)).astype(np.uint8)
    numbers = np.full((375, 1242), CITYSCAPES.index("road"))
    numbers[:, 100::200] = numbers[:, 101::200] = numbers[:, 102::200] = CITYSCAPES.index("pole")
    image = np.repeat(level[numbers][..., None], 3, axis=2)
    path = segmentation(tmp_path / "n.onnx", 19, output, inputs="1 3 128 128")
    found = load_model(IMAGE, str(path), SemanticsConfig())(frame_of(image), later()).classes
    assert found.shape == (375, 1242)
    assert (found != lookup(CITYSCAPES)[numbers]).mean() < 0.05
