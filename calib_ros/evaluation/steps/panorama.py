"""A scan as a panorama (thesis figures 3.7 to 3.9) and from above."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.evaluation.steps.pictures import BACKGROUND, Scale, sizes
from calib_ros.lidar.scan import RangeImage
from calib_ros.overlay_bars import BAR, put, text_width

Image = NDArray[np.uint8]
Matrix = NDArray[np.float64]
HEIGHT = 320  # px that all rings together are at least high
RADIUS, SIDE = 40.0, 900  # what is seen from above: m around the LiDAR, and px


@dataclass(frozen=True, eq=False)
class Panorama:
    """index: (rows, columns) into the scan's points or -1, highest ring first, left of the vehicle left.

    borders: columns of the left and right border of the camera's picture.
    """

    index: NDArray[np.int32]
    borders: tuple[int, ...]

    @staticmethod
    def of(scan: RangeImage, T: Matrix, camera: Camera) -> Panorama:
        """The camera at T_camera_lidar (4, 4) sees what lies between the borders."""
        rays = np.array([[0, camera.K[1, 2], 1], [camera.width - 1, camera.K[1, 2], 1]]) @ np.linalg.inv(camera.K).T
        ahead = rays @ se3.inverse(T)[:3, :3].T
        columns = scan.index.shape[1]
        azimuth = np.arctan2(ahead[:, 1], ahead[:, 0])
        borders = tuple(int(c) for c in np.rint((np.pi - azimuth) / (2 * np.pi) * (columns - 1)))
        return Panorama(np.ascontiguousarray(scan.index[:, ::-1]), borders)

    def draw(self, colors: Image, scale: Scale | None = None) -> Image:
        """Colours (n, 3) of the points -> picture with azimuths above, the camera's borders, and the scale below."""
        rows, columns = self.index.shape
        cells = np.where((self.index >= 0)[..., None], colors[np.maximum(self.index, 0)], np.uint8(BACKGROUND))
        picture = np.repeat(cells, max(round(HEIGHT / rows), 1), axis=0)
        font, line, margin = sizes(columns)
        for x in self.borders:
            cv2.line(picture, (x, 0), (x, picture.shape[0]), (255, 255, 255), max(columns // 900, 1))
        top = np.full((line + margin, columns, 3), BAR, np.uint8)
        for degrees, name in ((180, "behind"), (90, "left 90 deg"), (0, "ahead"), (-90, "right 90 deg"), (-180, "behind")):
            width = text_width(name, font)
            x = round((180 - degrees) / 360 * columns) - width // 2
            put(top, name, (int(np.clip(x, margin, columns - width - margin)), line - margin // 2), font)
        picture = np.vstack([top, picture])
        return picture if scale is None else scale.below(picture)


def from_above(xyz: NDArray[np.float32], colors: Image) -> Image:
    """Points (n, 3) with colours (n, 3) from above, ahead is up; later points lie on top. Circles every 10 m."""
    picture = np.full((SIDE, SIDE, 3), BACKGROUND, np.uint8)
    half = SIDE // 2
    font, line, margin = sizes(SIDE)
    circles = {f"{r} m": round(r / RADIUS * half) for r in range(10, int(RADIUS) + 1, 10)}
    for radius in circles.values():
        cv2.circle(picture, (half, half), radius, (70, 70, 70), 1, cv2.LINE_AA)
    pixel = np.rint(half - xyz[:, [1, 0]].astype(np.float64) / RADIUS * half)
    inside = ((pixel >= 1) & (pixel < SIDE - 1)).all(axis=1)
    u, v = pixel[inside].astype(np.intp).T
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
        picture[v + dv, u + du] = colors[inside]
    for name, radius in circles.items():
        y = half - radius + line - margin
        picture[y - line + margin : y + margin, half : half + text_width(name, font) + 2 * margin] = BAR
        put(picture, name, (half + margin, y), font)
    cv2.drawMarker(picture, (half, half), (255, 255, 255), cv2.MARKER_TRIANGLE_UP, 16, 2)
    return picture
