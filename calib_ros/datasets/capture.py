"""A folder that the node has written: the raw messages of its keyframes, on request or because something had happened.

It holds a bag; result.json, the extrinsic that the node used; config.yaml, its parameters; events.jsonl, what had happened by
then, a line each, see `calib_ros.online.black_box`; and a copy of image.mask.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from calib_ros import io, result
from calib_ros.config import Config, update
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame

BAG, CONFIG, RESULT, EVENTS, MASK = "bag", "config.yaml", "result.json", "events.jsonl", "mask"
STATUSES = 6  # the newest, that a person is told


def is_capture(path: Path) -> bool:
    """Whether a path is such a folder."""
    return (path / BAG).is_dir() and (path / RESULT).is_file()


def capture_config(folder: Path) -> Config:
    """The node's configuration. Raises as `Config.from_yaml`."""
    config, mask = Config.from_yaml(folder / CONFIG), next(folder.glob(f"{MASK}.*"), None)
    return config if mask is None else update(config, {"image": {"mask": str(mask)}})


def read_events(folder: Path) -> list[dict[str, Any]]:
    """What had happened, oldest first; nothing in folders of former versions. BadInputError for damaged lines."""
    path = folder / EVENTS
    lines = io.read_text(path, "events", "those of a capture").splitlines() if path.exists() else []
    try:
        events = [json.loads(line) for line in lines]
    except (ValueError, RecursionError):
        events = [None]
    if not all(isinstance(event, dict) for event in events):
        raise BadInputError(f"{path} must hold a JSON object in each line; copy the folder again, or remove the file")
    return events


class CaptureSource:
    """The keyframes, with the vehicle's motion as the node knew it. options: as of `BagSource`.

    reference: the extrinsic that the node used. middles: positions of the keyframes since it was disputed, or of all.
    """

    def __init__(self, folder: Path, **options: Any) -> None:
        from calib_ros.datasets.bag import BagSource  # rosbags takes a third of a second

        self._bag, self._events = BagSource(folder / BAG, **options), read_events(folder)
        self.name, self.camera, self.vehicle_frames = folder.resolve().name, self._bag.camera, self._bag.vehicle_frames
        self.camera_frame, self.lidar_frame = self._bag.camera_frame, self._bag.lidar_frame
        self.reference = result.load(folder / RESULT).T_camera_lidar
        self._twists = {event.get("stamp_ns"): event.get("twist") for event in self._events if event.get("event") == "keyframe"}
        self._occasion = next((event for event in self._events[::-1] if event.get("event") == "capture"), {})
        since = self._occasion.get("disputed_since_ns") or 0
        self.middles = [k for k, stamp in enumerate(self._bag.stamps) if stamp >= since] or list(range(len(self)))

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the node said, and what there is to know about the bag, for people."""
        some = f", by the {len(self.middles)} of {len(self)} keyframes since it was disputed"
        by = some if len(self.middles) < len(self) else ""
        remarks = [f"checked is {RESULT}, the extrinsic that the node used{by}"]
        if self._occasion:
            remarks.append(f"the node said {self._occasion.get('status')}: {self._occasion.get('reason')}")
        statuses = [event for event in self._events if event.get("event") == "status"][-STATUSES:]
        if said := ", ".join(f"{event.get('status')} {str(event.get('time'))[11:19]}" for event in statuses):
            remarks.append(f"status: {said} UTC")
        return (*remarks, *self._bag.remarks)

    def __len__(self) -> int:
        return len(self._bag)

    def __getitem__(self, index: int) -> Frame:
        frame = self._bag[index]
        return replace(frame, twist=self._twists.get(frame.stamp), reference=self.reference)

    def describe(self) -> dict[str, str]:
        """As of the bag."""
        return self._bag.describe() | {"reference": f"from {RESULT}"}
