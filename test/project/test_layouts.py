"""The layouts for RViz and Foxglove name what the node publishes."""

from __future__ import annotations

import json
from typing import Any

import yaml
from calib_ros_msgs.msg import Extrinsic
from paths import ROOT

CONFIG = ROOT / "config"


def panels(layout: Any) -> list[str]:
    return [layout] if isinstance(layout, str) else panels(layout["first"]) + panels(layout["second"])


def test_rviz_shows_overlay_cloud_and_tf() -> None:
    manager = yaml.safe_load((CONFIG / "calib_ros.rviz").read_text())["Visualization Manager"]
    shown = {d["Class"].partition("/")[2]: d.get("Topic", {}) for d in manager["Displays"] if d["Enabled"]}
    assert {"Image", "PointCloud2", "TF"} <= set(shown)
    assert shown["Image"]["Value"] == "/calib_ros/overlay"
    assert shown["PointCloud2"]["Reliability Policy"] == "Best Effort"  # receives from every driver


def test_foxglove_shows_overlay_diagnostics_extrinsic_and_drift() -> None:
    layout = json.loads((CONFIG / "foxglove_layout.json").read_text())
    by_id = layout["configById"]
    assert sorted(panels(layout["layout"])) == sorted(by_id)
    kinds = {name.partition("!")[0]: settings for name, settings in by_id.items()}
    assert kinds["Image"]["imageMode"]["imageTopic"] == "/calib_ros/overlay"
    assert kinds["DiagnosticStatusPanel"]["topicToRender"] == "/diagnostics"
    assert kinds["RawMessages"]["topicPath"] == "/calib_ros/extrinsic"
    for path in kinds["Plot"]["paths"]:
        topic, _, field = path["value"].partition(".")
        assert topic == "/calib_ros/extrinsic"
        assert field in Extrinsic.get_fields_and_field_types()
