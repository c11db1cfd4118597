"""Frames without points, and masks compared with known ones."""

from __future__ import annotations

import numpy as np

from calib_ros.camera import Camera
from calib_ros.frame import Frame, PointCloud
from calib_ros_semantics.models.masks import Masks

NO_POINTS = PointCloud(np.zeros((0, 3), np.float32))


def frame_of(image: np.ndarray, name: str = "") -> Frame:
    height, width = image.shape[:2]
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], float)
    return Frame(image=image, cloud=NO_POINTS, camera=Camera(K=K, width=width, height=height), name=name)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def compared(masks: Masks, truth: list[np.ndarray], enough: float = 0.8) -> tuple[float, int, int]:
    """Recall of true masks, how many masks tell one that another told already, and how many tell none."""
    pictures = [masks.picture(k) for k in range(len(masks))]
    table = np.array([[iou(picture, true) for true in truth] for picture in pictures]).reshape(len(pictures), len(truth))
    told = [int(row.argmax()) for row in table if row.max() > 0.5]
    recall = float((table.max(axis=0, initial=0) > enough).mean())
    return recall, len(told) - len(set(told)), len(pictures) - len(told)
