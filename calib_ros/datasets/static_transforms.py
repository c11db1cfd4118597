"""The tree of /tf_static."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Matrix
from calib_ros.errors import BadInputError


class StaticTransforms:
    """The tree of /tf_static. As in tf2, the latest transform of a child counts and broken ones are ignored."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Matrix]] = {}  # child -> parent, T_parent_child

    def add(self, msg: Any) -> None:
        """Add all transforms of a TFMessage."""
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

    def parent(self, child: str) -> str | None:
        """The parent of a frame; None if it has none, or is unknown."""
        edge = self._parents.get(child)
        return None if edge is None else edge[0]

    def lookup(self, target: str, source: str, without: str | None = None) -> Matrix | None:
        """T_target_source (4, 4) through the tree in either direction; None if the frames are not connected. without: a child
        whose edge to its parent is left out."""
        found = self._reached(target, without)
        return found[source][0] if source in found else None

    def others(self, target: str, source: str) -> dict[str, Matrix]:
        """T_target_frame (4, 4) of all frames that are connected to `target` but these two, by name."""
        return {frame: T for frame, (T, _) in self._reached(target).items() if frame not in (target, source)}

    def path(self, target: str, source: str) -> list[tuple[str, str]]:
        """The edges (parent, child) between two frames, from the target on; none if they are not connected."""
        found, edges = self._reached(target), []
        while source in found and source != target:
            before = found[source][1]
            edges.append((before, source) if self.parent(source) == before else (source, before))
            source = before
        return edges[::-1]

    def _reached(self, target: str, without: str | None = None) -> dict[str, tuple[Matrix, str]]:
        """Every frame that the tree connects to `target`, with T_target_frame (4, 4) and the frame before it."""
        edges: dict[str, list[tuple[str, Matrix]]] = {}
        for child, (parent, T_parent_child) in list(self._parents.items()):  # another thread may add
            if child != without:
                edges.setdefault(parent, []).append((child, T_parent_child))
                edges.setdefault(child, []).append((parent, se3.inverse(T_parent_child)))
        if target not in edges:
            return {}
        found = {target: (np.eye(4), target)}
        queue = deque([target])
        while queue:
            frame = queue.popleft()
            for neighbour, T_frame_neighbour in edges[frame]:
                if neighbour not in found:
                    found[neighbour] = (found[frame][0] @ T_frame_neighbour, frame)
                    queue.append(neighbour)
        return found
