"""Random cameras: size, field of view from 34 to 190 deg, height and attitude; and what lens and sensor make of the light."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros_synthetic.conditions import with_drops
from calib_ros_synthetic.rays import CameraView
from calib_ros_synthetic.wide import WideView
from training.world.looks import Float32, Rng

# Width and height of the pictures, 140 000 to 260 000 pixels.
SIZES = ((480, 360), (544, 400), (640, 384), (640, 352), (768, 256), (832, 256), (720, 304), (608, 416), (448, 448), (384, 496))
Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RandomCamera:
    """view: its rays. R: world from camera (3, 3). height: m above the road. yaw: of its view from the road, rad. focal: px."""

    view: CameraView
    R: Floats
    height: float
    yaw: float
    focal: float


def camera_of(rng: Rng, scale: float = 1.0) -> RandomCamera:
    """scale: factor on the pictures' sizes."""
    width, height = (max(16, round(n * scale)) for n in SIZES[int(rng.integers(len(SIZES)))])
    kind = rng.random()
    yaw = rng.normal(0, 0.12)
    where = rng.random()
    if where > 0.74:
        yaw += rng.choice([np.pi, np.pi / 2, -np.pi / 2, np.pi / 4, -np.pi / 4])
    pitch, roll = np.deg2rad(rng.normal(1.5, 3.5)), np.deg2rad(rng.normal(0, 1.5))
    if kind < 0.88:
        field = np.deg2rad(rng.uniform(34, 60) if kind < 0.28 else rng.uniform(60, 105))
        focal = width / 2 / np.tan(field / 2)
        horizon = height * rng.uniform(0.32, 0.62)
        K = np.array([[focal, 0, width / 2 + rng.normal(0, 5)], [0, focal, horizon], [0, 0, 1.0]])
        view = CameraView(Camera(K, width, height))
    else:
        field_deg = rng.uniform(105, 190)
        focal = max(width, height) / np.deg2rad(field_deg) * rng.uniform(0.9, 1.2)
        D = np.r_[rng.normal(0, 0.02), 0, 0, 0]
        K = np.array([[focal, 0, width / 2.0], [0, focal, height * rng.uniform(0.42, 0.58)], [0, 0, 1]])
        view = WideView(Camera(K, width, height, "equidistant", D), field_deg + 12)
        pitch += np.deg2rad(rng.uniform(0, 20))
    tall = float(rng.choice([rng.uniform(1.1, 1.9), rng.uniform(0.5, 1.1), rng.uniform(1.9, 3.2)], p=[0.7, 0.12, 0.18]))
    return RandomCamera(view, _attitude(yaw, pitch, roll), tall, float(yaw), float(focal))


def _attitude(yaw: float, pitch: float, roll: float) -> Floats:
    """World from camera: yaw to the left, pitch downwards, roll clockwise."""
    base = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # x right, y down, z ahead
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return np.asarray(Rz @ Ry @ Rx @ base)


def exposed(image: Float32, sky: NDArray[np.bool_], rng: Rng) -> NDArray[np.uint8]:
    """Grey levels (H, W, 3) of light (H, W, 3): exposure by what is no sky, bloom, vignetting, drops, blur, noise."""
    height, width = sky.shape
    seen = image[~sky] if (~sky).sum() > 100 else image.reshape(-1, 3)
    middle = float(np.median(seen.mean(axis=1))) + 0.01
    # Dark streets under a white sky are as common as walls that are white themselves.
    out = image * np.float32(np.exp(rng.normal(np.log(0.12), 0.6)) / middle)
    if rng.random() < 0.6:
        over = np.clip(out - 0.8, 0, 6)
        for share, sigma in ((0.12, 0.008), (0.06, 0.05)):
            out = out + np.float32(share * rng.random()) * cv2.GaussianBlur(over, (0, 0), max(sigma * width, 0.5))
    if rng.random() < 0.5:
        v, u = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
        out = out * (1 - rng.uniform(0, 0.3) * (u * u + v * v))[..., None].astype(np.float32)
    out = out + np.float32(rng.choice([0.0, rng.uniform(0, 0.012)], p=[0.6, 0.4]))  # stray light
    out = np.clip(out, 0, 1) ** np.float32(1 / rng.uniform(1.6, 2.3))
    curve = rng.uniform(0, 1)  # most cameras darken the shadows and brighten the lights
    out = (out + np.float32(curve) * (out * out * (3 - 2 * out) - out)) * 255
    grey = out.mean(axis=2, keepdims=True)
    out = np.clip(grey + (out - grey) * np.float32(rng.uniform(0.7, 1.8)), 0, 255)
    if rng.random() < 0.1:
        out = _shaken(out, rng)
    out = cv2.GaussianBlur(out, (0, 0), rng.uniform(0.3, 0.8))
    if rng.random() < 0.04:
        out = with_drops(np.asarray(out, np.float32), int(rng.integers(5, 40)), rng)
    out = out + np.float32(rng.choice([0.5, 1.5, 4.0, 9.0], p=[0.3, 0.4, 0.2, 0.1])) * rng.standard_normal(out.shape, np.float32)
    return np.asarray(np.clip(np.rint(out), 0, 255), np.uint8)


def _shaken(image: Float32, rng: Rng) -> Float32:
    """Blurred along a line of some pixels."""
    length, angle = int(rng.integers(3, 8)), rng.uniform(0, np.pi)
    kernel = np.zeros((9, 9), np.float32)
    for t in np.linspace(-length / 2, length / 2, 15):
        kernel[round(4 + t * np.sin(angle) * 0.4), round(4 + t * np.cos(angle))] += 1
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), np.float32)
