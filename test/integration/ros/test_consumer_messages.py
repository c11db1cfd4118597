"""Who may use the extrinsic, over DDS: in the message, the service's answer and the diagnostics."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from ros_peer import Peer
from vehicle import Vehicle, vehicle_fixture  # noqa: F401  # a fixture

from calib_ros.ros.client import result_from_message

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]


def told(message: Any) -> dict[str, bool]:
    return {consumer.name: consumer.usable for consumer in message.consumers}


def test_each_consumer_is_told_by_its_own_tolerances(vehicle: Vehicle) -> None:
    peer: Peer = vehicle.peer
    assert told(peer.extrinsics[-1]) == {}
    assert "usable for" not in peer.new_values()
    sigma = np.sqrt(np.diag(result_from_message(peer.get_extrinsic().extrinsic).covariance))
    deg, m = 2.5 * np.rad2deg(np.linalg.norm(sigma[:3])), 2.5 * np.linalg.norm(sigma[3:])
    peer.change(consumers=[f"coarse {deg} {m}", f"turns {0.1 * deg} {m}", f"shifts {deg} {0.1 * m}"])
    assert told(peer.until(lambda: told(peer.extrinsics[-1]) and peer.extrinsics[-1], "a new message")) == {
        "coarse": True,
        "turns": False,
        "shifts": False,
    }
    assert peer.new_values()["usable for"] == "coarse"
    answer = peer.get_extrinsic()
    coarse = answer.extrinsic.consumers[0]
    assert (coarse.name, coarse.usable) == ("coarse", True)
    np.testing.assert_allclose([coarse.tolerance_deg, coarse.tolerance_m], [deg, m])
    assert not any(told(answer.last_good).values())  # under one's own responsibility

    refused = peer.set(consumers=["coarse 0.5"])
    assert "consumers: 'coarse 0.5' must be NAME DEG M" in refused
    assert "\n" not in refused
    assert len(told(peer.get_extrinsic().extrinsic)) == 3  # as before

    peer.change(max_data_age_s=0.5)  # too old for anybody
    peer.until(lambda: not any(told(peer.extrinsics[-1]).values()), "nobody is served")
    assert peer.new_values()["usable for"] == "none"
    peer.change(consumers=[], max_data_age_s=3600.0)
    peer.until(lambda: not peer.extrinsics[-1].consumers, "no consumers")
