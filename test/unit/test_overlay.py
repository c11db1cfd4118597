"""The diagnostic picture, on hand-made clouds whose pixels are known."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib_ros import overlay, se3
from calib_ros.camera import Camera
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame, PointCloud
from calib_ros.lidar.edges import EdgePoints
from calib_ros.overlay import EDGE, PALETTE, depth_levels, layout
from calib_ros.result import Extrinsic, Result

# The LiDAR looks along x (forward), y left, z up; the camera sits 0.2 m in front of it.
T = se3.from_parts([[0, -1, 0], [0, 0, -1], [1, 0, 0]], [0, 0, -0.2])
K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])


def at(u: float, v: float, depth: float, camera_K: np.ndarray = K) -> np.ndarray:
    """The LiDAR point (3,) that an undistorted camera sees at pixel (u, v) and at a depth in m."""
    ray = np.linalg.solve(camera_K, [u, v, 1.0])
    return se3.transform(se3.inverse(T), ray * depth)


def make(*points: np.ndarray, size: tuple[int, int] = (320, 240), gray: bool = True, camera: Camera | None = None) -> Frame:
    """A frame of `size` (width, height) with a picture of one brightness."""
    width, height = size
    image = np.full((height, width) if gray else (height, width, 3), 100, np.uint8)
    cloud = PointCloud(np.array(points, np.float32).reshape(-1, 3))
    return Frame(image, cloud, camera or Camera(K, width, height))


def panel(picture: np.ndarray, frame: Frame, index: int = 0, panels: int = 1) -> np.ndarray:
    """The part of a picture that shows the image."""
    height, width = frame.image.shape[:2]
    x, y = layout(width, height, panels).panels[index]
    return picture[y : y + height, x : x + width]


def lit(picture: np.ndarray) -> set[tuple[int, int]]:
    """Pixels (u, v) that are coloured: the image itself is grey."""
    v, u = np.nonzero(np.ptp(picture.astype(int), axis=2))
    return set(zip(u.tolist(), v.tolist(), strict=True))


def edges_at(*points: np.ndarray) -> EdgePoints:
    n = len(points)
    return EdgePoints(np.array(points, np.float32), np.ones(n, np.float32), np.zeros(n, np.uint8))


def test_points_light_their_pixels_in_the_colour_of_their_depth() -> None:
    frame = make(at(50, 60, 5), at(200, 100, 20), at(1, 1, 59), at(318, 238, 3))
    shown = panel(overlay.render(frame, T), frame)
    assert lit(shown) == {(50, 60), (200, 100), (1, 1), (318, 238)}
    for (u, v), depth in {(50, 60): 5.0, (200, 100): 20.0, (1, 1): 59.0, (318, 238): 3.0}.items():
        assert shown[v, u].tolist() == PALETTE[depth_levels(depth, 60)].tolist()
    assert shown[238, 318, 2] > 100 + int(shown[238, 318, 0])  # near is warm


def test_the_nearer_point_wins() -> None:
    """Of a pixel, whatever the order."""
    for order in (1, -1):
        frame = make(*[at(100, 100, 30), at(100, 100, 6), at(100, 100, 55)][::order])
        shown = panel(overlay.render(frame, T), frame)
        assert shown[100, 100].tolist() == PALETTE[depth_levels(6, 60)].tolist()


def test_invisible_points_are_not_drawn() -> None:
    behind = se3.transform(se3.inverse(T), -np.array([0.1, 0.1, 5.0]))
    frame = make(behind, at(50, 50, 61), at(-1, 50, 5), at(320, 50, 5), at(50, 240, 5), at(50, -1, 5), at(9, 9, 5))
    assert lit(panel(overlay.render(frame, T), frame)) == {(9, 9)}
    assert (50, 50) in lit(panel(overlay.render(frame, T, max_range=70), frame))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("camera", [None, Camera(K, 320, 240, "plumb_bob", np.array([-0.2, 0.05, 0, 0, 0]))])
def test_nan_and_infinite_points_are_left_out(camera: Camera | None) -> None:
    bad = [[np.nan] * 3, [np.inf, 0, 0], [-np.inf, 1, 0], [5, np.nan, 0], [1e38, 1e38, 1e38]]
    good = at(160, 120, 8)
    frame = make(*map(np.array, bad), good, camera=camera)
    edges = edges_at(*map(np.array, bad))
    assert lit(panel(overlay.render(frame, T, edges=edges), frame)) == {(160, 120)}


@pytest.mark.parametrize(
    ("size", "stacked"), [((1242, 375), True), ((1920, 1080), True), ((640, 480), False), ((320, 240), False)]
)
def test_before_and_after_panels_sit_where_stated(size: tuple[int, int], stacked: bool) -> None:
    wide = np.array([[size[0], 0, size[0] / 2], [0, size[0], size[1] / 2], [0, 0, 1.0]])
    frame = make(at(size[0] // 2, size[1] // 2, 10, wide), size=size, camera=Camera(wide, *size))
    turned = se3.perturb(T, [0, 2.0, 0], [0, 0, 0])
    picture = overlay.render(frame, T, T_before=turned)
    plan = layout(*size, 2)
    assert picture.shape == (plan.size[1], plan.size[0], 3)
    (x0, y0), (x1, y1) = plan.panels
    assert (x0 == x1, y0 == y1) == (stacked, not stacked)
    assert (y1 >= y0 + size[1]) if stacked else (x1 >= x0 + size[0])
    before, after = (lit(panel(picture, frame, i, 2)) for i in (0, 1))
    assert (size[0] // 2, size[1] // 2) in after - before
    moved = np.mean([u for u, _ in before]) - np.mean([u for u, _ in after])
    assert moved == pytest.approx(size[0] * np.tan(np.deg2rad(2)), abs=1)


def test_edges_are_drawn_over_points() -> None:
    frame = make(at(9, 9, 5))
    assert panel(overlay.render(frame, T, edges=edges_at(at(9, 9, 40))), frame)[9, 9].tolist() == list(EDGE)


def test_any_size_gives_a_picture() -> None:
    for size, (before, panels) in itertools.product(((1, 1), (40, 30), (90, 700), (2000, 8)), ((None, 1), (T, 2))):
        frame = make(at(0, 0, 5), size=size, camera=Camera(K, *size))
        picture = overlay.render(frame, T, T_before=before, edges=edges_at(at(0, 0, 5)), lines=["a b c"], status="converged")
        assert picture.shape[1::-1] == layout(*size, panels).size


def test_odd_input() -> None:
    frame = make(at(9, 9, 5))
    for bad in (np.eye(3), np.zeros(16), np.zeros((1, 4, 4))):
        with pytest.raises(BadInputError, match=r"\(4, 4\)"):
            overlay.render(frame, bad)
        with pytest.raises(BadInputError, match=r"\(4, 4\)"):
            overlay.render(frame, T, T_before=bad)
    assert lit(panel(overlay.render(frame, np.full((4, 4), np.nan)), frame)) == set()


def test_captions_of_accepted_refused_and_initial_extrinsics() -> None:
    moved = se3.perturb(T, [0, 1.5, 0], [0, 0.03, 0.04])
    covariance = np.diag(np.r_[np.deg2rad([0.05, 0.12, 0.01]), 0.012, 0.02, 0.001] ** 2)
    result = Result(moved, "converged", "ignored", 0.524, covariance, 18, initial=T)
    turn = se3.translation_error_m(T, moved)
    told = ["frames 18/20", "score 0.52", f"moved 1.50 deg / {100 * turn:.1f} cm", "1 sigma 0.12 deg / 2.0 cm", "drift 0.4"]
    assert overlay.caption(Extrinsic(result, 0.42, 3), 20) == told
    assert overlay.caption(Extrinsic(result), 20, initial=moved)[2] == "moved 0.00 deg / 0.0 cm"
    refused = Result(T, "refused", "too uncertain: " + "the scenes show too little " * 9, 0.1, frames_used=5)
    *_, reason = overlay.caption(Extrinsic(refused), 5)
    assert reason.startswith("too uncertain: the scenes")
    assert reason.endswith(" ...")
    assert overlay.caption(Extrinsic(Result(T, "initial", "no estimate yet")), 2) == ["frames 0/2", "no estimate yet"]


def test_write_png(tmp_path: Path) -> None:
    picture = overlay.render(make(at(9, 9, 5)), T)
    overlay.write_png(tmp_path / "new" / "overlay.png", picture)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "new" / "overlay.png")), picture)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["overlay.png"]
