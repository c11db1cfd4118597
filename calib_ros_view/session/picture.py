"""The picture of a frame with the point cloud over it, and the cloud in its colours, drawn anew for every extrinsic."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix
from calib_ros.camera import MIN_DEPTH
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame
from calib_ros.image.enhance import to_gray
from calib_ros.lidar.edges import EdgeKind, EdgePoints
from calib_ros.overlay import PALETTE, depth_levels

Image = NDArray[np.uint8]
EDGE_KIND = "edge kind"
COLORINGS = ("depth", "reflectivity", "ring", "class", EDGE_KIND)
NEEDED = {"reflectivity": "intensities", "ring": "rings", "class": "classes"}  # of points that are to be coloured so
BACKGROUNDS = ("colour", "grey", "edges")
COMPARISONS = ("now", "side by side", "blended")
KINDS = {  # BGR, and the name
    EdgeKind.SIDE: ((255, 0, 255), "range, left or right"),
    EdgeKind.TOP: ((255, 255, 0), "range, above"),
    EdgeKind.REFLECTIVITY: ((0, 255, 255), "reflectivity"),
    EdgeKind.SKY_SIDE: ((120, 120, 255), "sky, left or right"),
    EdgeKind.SKY_TOP: ((255, 160, 80), "sky, above"),
}
PLAIN = (150, 150, 150)  # BGR of points that are no edge, where points are coloured by the kind of their edge
DIM = 0.6  # of the image's brightness, so that points stand out
BEFORE_SHARE = 0.45  # of the picture before, where the two are blended
GAP = 6  # px between two pictures
MOST_SIZE, WIDEST, NARROWEST = 9, 2600, 64  # px: a point, the picture
QUALITY = 85  # of JPEG
CANNY = (60.0, 150.0)  # thresholds of the edges that are shown, which are those of people
CELLS_ACROSS = 320  # of the depth buffer over the image's width; wider than the gaps between rings would let points shine through
BEHIND = 1.05  # times the least depth of a cell, and BEHIND_M more, from which a point is hidden
BEHIND_M = 0.5
UNSEEN = (110, 110, 110)  # RGB of points that the camera does not see
MOST_POINTS = 60_000  # that a phone still turns smoothly


@dataclass(frozen=True)
class Look:
    """How a picture is drawn.

    coloring: of COLORINGS. size: of a point, px. opacity: 0..1. near, far: m, of the points that are drawn. cloud, edges: whether
    points and LiDAR edges are. background: of BACKGROUNDS. comparison: of COMPARISONS, with the extrinsic before. window: (left,
    top, right, bottom), shares of the image. width: of the picture, px. Raises BadInputError for values out of range.
    """

    coloring: str = "depth"
    size: int = 2
    opacity: float = 0.9
    near: float = 0.0
    far: float = 80.0
    cloud: bool = True
    edges: bool = False
    background: str = "colour"
    comparison: str = "now"
    window: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    width: int = 1242

    def __post_init__(self) -> None:
        for name, allowed in (("coloring", COLORINGS), ("background", BACKGROUNDS), ("comparison", COMPARISONS)):
            if getattr(self, name) not in allowed:
                raise BadInputError(f"{name} '{getattr(self, name)}' is not known; choose one of {', '.join(allowed)}")
        left, top, right, bottom = self.window
        if not (0 <= left < right <= 1 and 0 <= top < bottom <= 1):
            raise BadInputError(f"the window {self.window} is no part of the image")
        for name, low, high in (("size", 1, MOST_SIZE), ("opacity", 0, 1), ("near", 0, np.inf), ("width", NARROWEST, WIDEST)):
            if not low <= getattr(self, name) <= high:
                raise BadInputError(f"{name} {getattr(self, name)} is out of range [{low}, {high}]")
        if not self.far > self.near:
            raise BadInputError(f"far, {self.far:g} m, must be more than near, {self.near:g} m")


class FramePicture:
    """Draws one frame; what does not depend on the extrinsic is prepared once.

    edges: points of the LiDAR edges, where they are known. labels: (n,) SemanticClass of the points of the cloud, in place of the
    cloud's own.
    """

    def __init__(self, frame: Frame, edges: EdgePoints | None = None, labels: NDArray[np.uint8] | None = None) -> None:
        self.frame = frame
        keep = frame.cloud.finite_mask()
        cloud = frame.cloud.finite()
        self._xyz = np.ascontiguousarray(cloud.xyz.T)  # (3, n): column by column, projecting takes a fifth of the time
        self._intensity, self._ring = cloud.intensity, cloud.ring
        self._labels = cloud.label if labels is None else labels[keep]
        self._edge_xyz = np.ascontiguousarray(edges.xyz.T if edges is not None else np.zeros((3, 0)), np.float32)
        table = np.full((max(EdgeKind) + 1, 3), 255, np.uint8)
        table[list(KINDS)] = [color for color, _ in KINDS.values()]
        self._edge_colors: Image = table[edges.kind if edges is not None else []]
        self._backgrounds: dict[str, Image] = {}

    def missing(self, coloring: str) -> str:
        """What points need to be coloured so, and these do not have; empty if nothing. They are coloured by depth then."""
        fields = {"reflectivity": self._intensity, "ring": self._ring, "class": self._labels}
        return NEEDED[coloring] if coloring in fields and fields[coloring] is None else ""

    def size(self, look: Look) -> tuple[int, int]:
        """Width and height of one picture, px."""
        left, top, right, bottom = look.window
        camera = self.frame.camera
        height = look.width * camera.height * (bottom - top) / (camera.width * (right - left))
        return look.width, max(round(height), 1)

    def draw(self, T: Matrix, before: Matrix | None, look: Look) -> Image:
        """The picture (h, w, 3), BGR, at T_camera_lidar (4, 4). before: to compare with."""
        now = self._drawn(T, look)
        if before is None or look.comparison == "now":
            return now
        earlier = self._drawn(before, look)
        if look.comparison == "blended":
            return np.asarray(cv2.addWeighted(earlier, BEFORE_SHARE, now, 1 - BEFORE_SHARE, 0), np.uint8)
        height, width = now.shape[:2]
        if 2 * height > width:  # tall pictures stand beside each other
            return np.hstack([earlier, np.zeros((height, GAP, 3), np.uint8), now])
        return np.vstack([earlier, np.zeros((GAP, width, 3), np.uint8), now])

    def _drawn(self, T: Matrix, look: Look) -> Image:
        picture = self._background(look)
        if look.cloud:
            uv, index, depth = self._placed(self._xyz, T, look)
            _draw(picture, uv, self._colors(index, depth, look), look.size, look.opacity)
        if look.edges or (look.cloud and look.coloring == EDGE_KIND):
            uv, index, _ = self._placed(self._edge_xyz, T, look)
            _draw(picture, uv, self._edge_colors[index], look.size + 1, 1.0)
        return picture

    def _placed(
        self, xyz: NDArray[np.float32], T: Matrix, look: Look
    ) -> tuple[NDArray[np.int32], NDArray[np.intp], NDArray[np.float32]]:
        """Pixels (m, 2) of those points (3, n) that are drawn, their indices (m,), and depths (m,), m; far ones first."""
        P = T[:3, :3].astype(np.float32) @ xyz + T[:3, 3:].astype(np.float32)
        camera, (scale, left, top), (width, height) = self.frame.camera, self._place(look), self.size(look)
        if camera.is_pinhole:
            index = np.flatnonzero(P[2] > MIN_DEPTH)
            K, P = camera.K.astype(np.float32), P[:, index]
            depth = P[2]
            u, v = K[0, 0] * P[0] / depth + K[0, 2], K[1, 1] * P[1] / depth + K[1, 2]
            inside = (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1)
        else:
            index = np.arange(P.shape[1])
            depth = np.sqrt(np.einsum("in,in->n", P, P))  # a fisheye sees to its sides
            uv, inside = camera.project(P.T)
            u, v = uv.T
        with np.errstate(invalid="ignore"):
            u, v = (u - left) * scale, (v - top) * scale
            inside &= (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
        kept = np.flatnonzero(inside & (depth >= look.near) & (depth <= look.far))
        kept = kept[np.argsort(-depth[kept], kind="stable")]  # near points over far ones
        return np.rint(np.stack([u[kept], v[kept]], axis=1)).astype(np.int32), index[kept], depth[kept]

    def _place(self, look: Look) -> tuple[float, float, float]:
        """Where pixels of the image lie in the picture of its window: px of that for one, and the first column and row."""
        (left, top, right, _), camera = look.window, self.frame.camera
        return look.width / ((right - left) * camera.width), left * camera.width, top * camera.height

    def _colors(self, index: NDArray[np.intp], depth: NDArray[np.float32], look: Look) -> Image:
        """BGR (n, 3) of points."""
        if look.coloring == "reflectivity" and self._intensity is not None:
            values = self._intensity
            low, high = np.quantile(values, [0.02, 0.98])
            share = np.clip((values[index] - low) / max(float(high - low), 1e-6), 0, 1)
            return np.asarray(PALETTE[np.rint(1 + 253 * share).astype(np.intp)], np.uint8)
        if look.coloring == "ring" and self._ring is not None:
            return np.asarray(PALETTE[1 + (self._ring[index] * 41) % 253], np.uint8)  # neighbours differ
        if look.coloring == "class" and self._labels is not None:
            from calib_ros_semantics.class_pictures import palette  # who knows classes has it

            return np.asarray(palette()[self._labels[index]], np.uint8)
        if look.coloring == EDGE_KIND:
            return np.full((len(index), 3), PLAIN, np.uint8)
        return np.asarray(PALETTE[depth_levels(depth, min(look.far, 200.0))], np.uint8)

    def _background(self, look: Look) -> Image:
        """The image below the points, of which the window is cut out, at the size of the picture; the caller's to draw on."""
        if look.background not in self._backgrounds:
            gray, own = to_gray(self.frame.image), self.frame.image
            if look.background == "edges":
                lines = np.maximum(cv2.Canny(gray, *CANNY), (0.25 * gray).astype(np.uint8))
                own = np.asarray(cv2.cvtColor(lines, cv2.COLOR_GRAY2BGR), np.uint8)
            else:
                own = own if look.background == "colour" and own.ndim == 3 else cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)
                own = np.asarray(cv2.convertScaleAbs(own, alpha=DIM), np.uint8)
            self._backgrounds[look.background] = own
        image, size, (scale, left, top) = self._backgrounds[look.background], self.size(look), self._place(look)
        if scale == 1:
            row, column = round(top), round(left)
            return np.array(image[row : row + size[1], column : column + size[0]])
        between = cv2.INTER_NEAREST if scale > 2 else cv2.INTER_AREA if scale < 0.7 else cv2.INTER_LINEAR
        if between == cv2.INTER_AREA and look.window == Look().window:
            return np.asarray(cv2.resize(image, size, interpolation=between), np.uint8)
        flags = (cv2.INTER_LINEAR if between == cv2.INTER_AREA else between) | cv2.WARP_INVERSE_MAP
        M = np.array([[1 / scale, 0, left], [0, 1 / scale, top]])
        return np.asarray(cv2.warpAffine(image, M, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def encoded(picture: Image) -> bytes:
    """A picture (h, w, 3) as JPEG."""
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()


def _draw(picture: Image, uv: NDArray[np.int32], colors: Image, size: int, opacity: float) -> None:
    """Squares of `size` px at pixels (n, 2), later ones over earlier ones."""
    if not len(uv):
        return
    height, width = picture.shape[:2]
    top = picture if opacity >= 1 else picture.copy()
    first = -((size - 1) // 2)
    # Row by row of the square, nearest points last in each: a point that is hidden in one row is in all.
    for dv in range(first, first + size):
        for du in range(first, first + size):
            u, v = np.clip(uv[:, 0] + du, 0, width - 1), np.clip(uv[:, 1] + dv, 0, height - 1)
            top[v, u] = colors
    if opacity < 1:
        cv2.addWeighted(top, opacity, picture, 1 - opacity, 0, dst=picture)


def colored_cloud(
    frame: Frame, T: Matrix, most: int = MOST_POINTS
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.bool_]]:
    """The points of a frame, (n, 3) m in the LiDAR's frame, their colours (n, 3) RGB in its image at T_camera_lidar (4, 4), and
    whether the camera sees them (n,); those outside of the image, or hidden behind other points, are grey.

    most: points kept, drawn evenly; those in the image first, since they are what is looked at.
    """
    xyz = frame.cloud.finite().xyz
    P = se3.transform(T, xyz)
    uv, inside = frame.camera.project(P)
    visible = np.flatnonzero(inside)
    # Those that lie behind nearer ones of the same cell of the image are hidden.
    depth, cell = np.linalg.norm(P[visible], axis=1), np.floor(uv[visible] * CELLS_ACROSS / frame.camera.width).astype(np.intp)
    flat = cell[:, 1] * (CELLS_ACROSS + 1) + cell[:, 0]
    nearest = np.full(int(flat.max(initial=-1)) + 1, np.inf)
    np.minimum.at(nearest, flat, depth)
    visible = visible[depth <= BEHIND * nearest[flat] + BEHIND_M]
    rgb = np.full((len(xyz), 3), UNSEEN, np.uint8)
    u, v = np.rint(uv[visible]).astype(np.intp).T
    image = frame.image if frame.image.ndim == 3 else np.repeat(frame.image[..., None], 3, axis=2)
    rgb[visible] = image[v, u, ::-1]
    seen = np.zeros(len(xyz), bool)
    seen[visible] = True
    kept = np.arange(len(seen))
    if len(seen) > most:
        rng, first, others = np.random.default_rng(0), np.flatnonzero(seen), np.flatnonzero(~seen)
        more = rng.choice(others, most - len(first), replace=False) if len(first) < most else others[:0]
        kept = np.sort(np.concatenate([first if len(first) < most else rng.choice(first, most, replace=False), more]))
    return np.ascontiguousarray(xyz[kept]), rgb[kept], seen[kept]
