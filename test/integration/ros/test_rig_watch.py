"""What the page of a rig hears of a real node over DDS."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rig_peer import RigPeer, describe, measured, poses
from ros_peer import cloud_message
from waiting import until

from calib_ros_synthetic.rig import SyntheticRig
from calib_ros_view.node.watch import Watch
from calib_ros_view.session.live import SILENT_S

pytestmark = [pytest.mark.ros, pytest.mark.slow]
CAMERAS, TOP = ("back_left", "back_right"), "lidar_top"


@pytest.mark.usefixtures("rendered_once")
def test_sensors_edges_pictures_and_clouds_are_heard_and_that_the_node_ends(tmp_path) -> None:
    rig = SyntheticRig("six_cameras_one_lidar", seed=3, frames=4, width=320, clocks=0.0, speed=4.0)
    items, file = measured(rig, CAMERAS, 3.0), describe(rig, CAMERAS, tmp_path / "rig.yaml")
    with Watch("/calib_ros") as feed:
        with RigPeer(rig, CAMERAS, file) as peer:
            until(lambda: feed.rig is not None and len(feed.rig.edges) == 2, "the rig")
            assert {(e.fate, e.level) for e in feed.rig.edges} == {("initial", "neutral")}
            peer.drive(items)
            until(lambda: all(e.residual for e in feed.rig.edges), "edges", state=lambda: str(feed.rig))
            assert (feed.rig.reference, feed.rig.cameras, feed.rig.lidars) == (TOP, list(CAMERAS), [TOP])
            assert max(e.residual[0] for e in feed.rig.edges) < 0.5
            until(lambda: np.allclose(feed.rig.poses[CAMERAS[0]], dict(poses(peer.rigs[-1]))[CAMERAS[0]]), "the newest poses")
            assert not feed.tiles, "nothing is asked for while nobody looks"
            stamp, _, scan = next(item for item in reversed(items) if item[1] == TOP)

            def heard() -> bool:
                feed.look()
                peer.publishers[f"/{TOP}/points"].publish(cloud_message(scan, stamp, frame_id=TOP))
                return len(feed.tiles) == 2 and TOP in feed.clouds

            until(heard, "pictures and a cloud", state=lambda: str((feed.tiles.keys(), feed.clouds.keys())))
            tile = f"{CAMERAS[0]}/{TOP}"
            assert feed.pairs_of(tile) == [(CAMERAS[0], TOP)]
            assert cv2.imdecode(np.frombuffer(feed.tiles[tile], np.uint8), cv2.IMREAD_COLOR).shape[1] in (320, 480)
            assert len(feed.clouds[TOP]) == len(scan.finite())
            assert not feed.problem
        until(lambda: feed.problem, f"silence of {SILENT_S} s")
        assert "not heard any more" in feed.problem
        assert not any("unexpected" in event.text for event in feed.history.events)
