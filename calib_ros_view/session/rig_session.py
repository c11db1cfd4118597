"""The recording of a rig at some moments: pictures of all cameras, clouds of all LiDARs, and a session for every pair."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix
from calib_ros.config import Config, update
from calib_ros.datasets.rig import RigSource
from calib_ros.datasets.source import frame_positions, spread_positions
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import Frame, PointCloud
from calib_ros.rig.description import CAMERA, RigDescription
from calib_ros.rig.edges import SEEN, seen_share
from calib_ros_check.rig.shown import NEUTRAL, EdgeShown, RigShown
from calib_ros_view.session.live import Pair
from calib_ros_view.session.picture import FramePicture, Look, encoded
from calib_ros_view.session.session import Session

FRAMES = 10  # of a recording, unless said otherwise
TILE = Look(width=480, size=1)  # of a camera, with all its LiDARs


class RigSession:
    """A recorded rig, for its page. rig: what is shown of its sensors. frames: as --frames, None = some, evenly spread. out:
    where pairs are saved, with their names before its ending. Raises what reading the first moment raises.

    tiles: by camera the JPEG of its picture. clouds: (n, 3) points, m, in the frame of a LiDAR, by its name. version: counts what
    changes. problem: of what is shown now, in a line. Only `go` changes what is shown.
    """

    def __init__(
        self, source: RigSource, description: RigDescription, rig: RigShown, config: Config, frames: str | None, out: Path
    ) -> None:
        self.name, self.rig, self.problem, self.version = source.name, rig, "", 0
        self.tiles: dict[str, bytes] = {}
        self.clouds: dict[str, NDArray[np.float32]] = {}
        self._source, self._description, self._config, self._frames, self._out = source, description, config, frames, out
        self._lock = threading.Lock()
        first = description.cameras[0] if description.cameras else ""
        count = len(source.pair(first, description.lidars[0]) if first else source.scans(description.lidars[0]))
        if not count:
            raise BadInputError(f"{source.name} has no frames of {first or description.lidars[0]}; choose another recording")
        # Sensors run at their own rates: a moment is the share of the drive at which it is.
        self.moments = [k / max(count - 1, 1) for k in self._positions(count)]
        self.moment = len(self.moments) // 2
        self._read_clouds(self.moments[self.moment])
        shares = {
            (a, b): seen_share(source.camera(a), se3.inverse(rig.poses[a]) @ rig.poses[b], self.clouds[b].astype(float))
            for a in (rig.cameras if description.pairs is None else ())
            for b in rig.lidars
        }
        listed = [(a, b) for a, b in description.pairs or () if description[a].kind == CAMERA]
        self.pairs = listed or [pair for pair, share in shares.items() if share >= SEEN]
        if not rig.edges:
            edges = tuple(EdgeShown(*pair, "registration", "not measured", NEUTRAL) for pair in self.pairs)
            self.rig = replace(rig, edges=edges)
        self.go(0)

    def _positions(self, count: int) -> list[int]:
        return frame_positions(self._frames, count) if self._frames else spread_positions(FRAMES, count)

    def pairs_of(self, tile: str) -> Sequence[Pair]:
        """Pairs of a camera and a LiDAR that can be opened from a picture."""
        return [pair for pair in self.pairs if pair[0] == tile]

    def corners(self, camera: str) -> Matrix:
        """(4, 3) of a camera's picture, m, in its frame at a depth of 1 m, by the focal lengths alone: of a fisheye what a plain
        lens would show."""
        own = self._source.camera(camera)
        u, v = np.array([0, own.width, own.width, 0]), np.array([0, 0, own.height, own.height])
        return np.stack([(u - own.K[0, 2]) / own.K[0, 0], (v - own.K[1, 2]) / own.K[1, 1], np.ones(4)], axis=1)

    def go(self, by: int) -> None:
        """Show another moment, or draw this one again. What cannot be read is told in `problem`."""
        with self._lock:
            self.moment, self.problem = (self.moment + by) % len(self.moments), ""
            share = self.moments[self.moment]
            try:
                self._read_clouds(share)
                for camera in self.rig.cameras:
                    self.tiles[camera] = encoded(self._drawn(camera, share))
            except CalibrationError as error:
                self.problem = str(error)
            self.version += 1

    def _read_clouds(self, share: float) -> None:
        for lidar in self.rig.lidars:
            scans = self._source.scans(lidar)
            if not len(scans):
                raise BadInputError(f"{self.name} has no scan of {lidar}; choose another recording")
            _, cloud = scans[round(share * (len(scans) - 1))]
            self.clouds[lidar] = cloud.finite().xyz

    def _drawn(self, camera: str, share: float) -> NDArray[np.uint8]:
        """A camera's picture with the points of all its LiDARs, each as it was next to the image."""
        poses, found, frame = self.rig.poses, [], None
        for _, lidar in self.pairs_of(camera) or [(camera, self.rig.lidars[0])]:
            source = self._source.pair(camera, lidar)
            frame = source[round(share * (len(source) - 1))]
            found.append(se3.transform(poses[lidar], frame.cloud.finite().xyz).astype(np.float32))
        assert frame is not None
        whole = Frame(frame.image, PointCloud(np.concatenate(found)), frame.camera)
        return FramePicture(whole).draw(se3.inverse(poses[camera]), None, TILE)

    def session(self, camera: str, lidar: str) -> Session:
        """Of a pair, read anew. BadInputError for names that are no pair, or frames that cannot be used."""
        if (camera, lidar) not in self.pairs:
            raise BadInputError(f"{camera} and {lidar} are no pair of this rig; open one that its page lists")
        with self._lock:
            source, mask = self._source.pair(camera, lidar), self._description[camera].mask
            config = update(self._config, {"image": {"mask": mask}}) if mask else self._config
            start = se3.inverse(self.rig.poses[camera]) @ self.rig.poses[lidar]
            out = self._out.with_name(f"{self._out.stem}.{camera}.{lidar}{self._out.suffix}")
            return Session([source[k] for k in self._positions(len(source))], source, start, config, out)
