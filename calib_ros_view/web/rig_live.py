"""The pages of the pairs of a running rig, each with a watch of its own from when it is opened first."""

from __future__ import annotations

from calib_ros_view.node.rig_watch import RigWatch
from calib_ros_view.node.watch import Watch
from calib_ros_view.session.rig_shown import Pair
from calib_ros_view.web.live_page import LivePage
from calib_ros_view.web.rig_sessions import RIG, failed
from calib_ros_view.web.server import Pictures


class LivePairs:
    """Opens pairs that a rig has. Use as a context manager: leaving it ends their watches."""

    def __init__(self, feed: RigWatch, pictures: Pictures) -> None:
        self.feed, self._pictures = feed, pictures
        self._opened: dict[Pair, LivePage] = {}

    def __enter__(self) -> LivePairs:
        return self

    def __exit__(self, *_: object) -> None:
        for own in self._opened.values():
            own.watch.close()

    async def page(self, camera: str, lidar: str) -> None:
        """Build the page of a pair for a browser, or one with a line about why there is none."""
        pair = camera, lidar
        if pair not in self.feed.pairs:
            failed(f"{self.feed.name} has no pair of {camera} and {lidar}; open one that its page lists")
            return
        if pair not in self._opened:
            self._opened[pair] = LivePage(Watch(f"{self.feed.name}/{camera}/{lidar}"), self._pictures, RIG)
        self._opened[pair].page()
