"""What makes a picture bad: light, haze, rain drops, motion blur, a rolling shutter, compression. One name each."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros_synthetic.surfaces import DAY, LAMPS, Lighting

Picture = NDArray[np.float32]
BLUR_TAPS = 9  # samples along the way that a pixel's surface moves during the exposure
LONGEST_BLUR = 60.0  # px


@dataclass(frozen=True)
class Conditions:
    """What a picture is taken under.

    lighting: of the scene; indoors, the lamps' light is scaled by it. noise: factor on the noise of the image sensor.
    visibility: m at which haze leaves 1/e of a LiDAR's light. exposure: s, for motion blur. readout: s from the first row to the
    last. drops: on the lens. jpeg: quality, 1 to 100; 0 = not compressed.
    """

    lighting: Lighting = field(default_factory=lambda: DAY)
    noise: float = 1.0
    visibility: float = np.inf
    exposure: float = 0.0
    readout: float = 0.0
    drops: int = 0
    jpeg: int = 0

    def lit(self, indoors: bool) -> Lighting:
        """The lighting of a scene under these conditions."""
        if not indoors:
            return self.lighting
        a, b = self.lighting, LAMPS
        return replace(a, sun=a.sun * b.sun, ambient=a.ambient * b.ambient, sky=a.sky * b.sky, haze=min(a.haze, b.haze))


NIGHT = Lighting(sun=0.02, ambient=0.035, sky=0.01, headlights=60.0, haze=900.0, exposure=2.2)
HAZY = Lighting(sun=0.25, ambient=1.0, sky=1.0, haze=55.0)

CONDITIONS: dict[str, Conditions] = {
    "clear": Conditions(),
    "night": Conditions(lighting=NIGHT, noise=5.0, exposure=0.012),  # headlights, hardly any contrast beyond them
    "haze": Conditions(lighting=HAZY, noise=1.5, visibility=160.0),  # two thirds of the contrast are lost at 55 m
    "rain": Conditions(lighting=Lighting(sun=0.1, ambient=0.9, sky=0.8, haze=160.0), noise=2.0, visibility=300.0, drops=40),
    "blur": Conditions(noise=1.5, exposure=0.020),  # a long exposure from a moving vehicle
    "rolling": Conditions(readout=0.030),  # a CMOS sensor read row by row in 30 ms
    "jpeg": Conditions(noise=1.5, jpeg=25),  # blocks of 8 x 8
}
CLEAR = CONDITIONS["clear"]


def motion_blurred(image: Picture, flow: Picture, exposure: float) -> Picture:
    """Image (H, W, 3) averaged along the way that each pixel's surface takes. flow: (H, W, 2) px/s. exposure: s.

    The way is centred on the moment of the picture, so that no edge is displaced.
    """
    way = flow * np.float32(exposure)
    length = np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-6)
    way *= np.minimum(1, np.float32(LONGEST_BLUR) / length)
    if float(np.abs(way).max()) < 0.3:
        return image
    v, u = np.mgrid[: image.shape[0], : image.shape[1]].astype(np.float32)
    out = np.zeros_like(image)
    for k in np.linspace(-0.5, 0.5, BLUR_TAPS, dtype=np.float32):
        out += cv2.remap(image, u + k * way[..., 0], v + k * way[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out / BLUR_TAPS, np.float32)


def with_drops(image: Picture, count: int, rng: np.random.Generator) -> Picture:
    """Image (H, W, 3) through rain drops: each shows the scene upside down, small and out of focus. rng: places the drops."""
    height, width = image.shape[:2]
    v, u = np.mgrid[:height, :width].astype(np.float32)
    weight = np.zeros((height, width), np.float32)
    for _ in range(count):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        radius = width * rng.uniform(0.006, 0.026)
        tall = rng.uniform(1.0, 1.5)
        r0, r1 = max(int(y - 1.5 * radius * tall), 0), min(int(y + 1.5 * radius * tall) + 2, height)
        c0, c1 = max(int(x - 1.5 * radius), 0), min(int(x + 1.5 * radius) + 2, width)
        if r1 <= r0 or c1 <= c0:
            continue
        rows, columns = np.mgrid[r0:r1, c0:c1].astype(np.float32)
        dx, dy = columns - np.float32(x), (rows - np.float32(y)) / np.float32(tall)
        inside = np.clip((radius - np.hypot(dx, dy)) / (0.25 * radius), 0, 1)
        u[r0:r1, c0:c1] += inside * (-5.0 * dx)
        v[r0:r1, c0:c1] += inside * (-5.0 * dy)
        weight[r0:r1, c0:c1] = np.maximum(weight[r0:r1, c0:c1], inside)
    blurred = cv2.GaussianBlur(image, (0, 0), width / 320)
    seen = cv2.remap(blurred, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return np.asarray(image + weight[..., None] * (seen - image), np.float32)


def compressed(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    """Image (H, W, 3) after JPEG compression of a quality from 1 to 100."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
