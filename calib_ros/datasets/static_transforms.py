"""The tree of /tf_static: how two of its frames lie to each other."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.errors import BadInputError

Matrix = NDArray[np.float64]


class StaticTransforms:
    """Collects tf2_msgs/TFMessage. As in tf2, the latest of a child counts and broken ones are ignored."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Matrix]] = {}  # child -> parent, T_parent_child

    def add(self, msg: Any) -> None:
        """Take over all transforms of a TFMessage (`transforms`: geometry_msgs/TransformStamped)."""
        for item in msg.transforms:
            t, q = item.transform.translation, item.transform.rotation
            try:
                rotation = se3.rotation_from_quaternion([q.x, q.y, q.z, q.w])
            except BadInputError:
                continue
            translation = np.array([t.x, t.y, t.z], float)
            if np.isfinite(translation).all():
                parent, child = item.header.frame_id.lstrip("/"), item.child_frame_id.lstrip("/")
                self._parents[child] = (parent, se3.from_parts(rotation, translation))

    def lookup(self, target: str, source: str) -> Matrix | None:
        """T_target_source (4, 4) through the tree in either direction; None when they are not connected."""
        edges: dict[str, list[tuple[str, Matrix]]] = {}
        for child, (parent, T_parent_child) in list(self._parents.items()):  # another thread may add
            edges.setdefault(parent, []).append((child, T_parent_child))
            edges.setdefault(child, []).append((parent, se3.inverse(T_parent_child)))
        if target not in edges:
            return None
        found = {target: np.eye(4)}
        queue = deque([target])
        while queue:
            frame = queue.popleft()
            if frame == source:
                return found[frame]
            for neighbour, T_frame_neighbour in edges[frame]:
                if neighbour not in found:
                    found[neighbour] = found[frame] @ T_frame_neighbour
                    queue.append(neighbour)
        return None
