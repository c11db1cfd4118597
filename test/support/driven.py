"""A pipeline that is fed with frames as if they were messages."""

from __future__ import annotations

from calib_ros import se3
from calib_ros.config import Config, update
from calib_ros.frame import Frame
from calib_ros.online.events import Event, ExtrinsicUpdated, FrameIngested, Inputs, Problem
from calib_ros.online.pipeline import Pipeline
from calib_ros.result import INITIAL, Extrinsic, Result
from calib_ros_synthetic.drive import SyntheticDrive

QUICK = {
    "search": {"rotation_deg": 0.0, "translation_m": 0.0},
    "semantics": {"segmentation": "none"},
    "online": {"min_keyframes": 2, "buffer_size": 3, "similarity_threshold": 1.0},
}


def config(**online: object) -> Config:
    """Without rest, unless it is asked for."""
    return update(Config.from_dict(QUICK), {"online": {"rest_period_s": 0.0, **online}, "tracker": {"confirmations": 0}})


class Driven:
    """A pipeline fed with frames as if they were messages."""

    def __init__(self, drive: SyntheticDrive, settings: Config) -> None:
        self.errors: list[str] = []
        self.notices: list[str] = []
        self.states: list[Extrinsic] = []
        self.kept: list[int] = []
        start = Result(se3.perturb(drive.reference, [0.2, 0, 0], [0.01, 0, 0]), INITIAL)
        inputs = Inputs(lambda image, cloud, camera: image, lambda image, cloud: ("camera", "lidar"), lambda *_: start)
        self.pipeline = Pipeline(settings, inputs, self.on_event)
        self.pipeline.set_camera(drive.camera)

    def on_event(self, event: Event) -> None:
        if isinstance(event, ExtrinsicUpdated):
            self.states.append(event.extrinsic)
        elif isinstance(event, Problem):
            (self.notices if event.solved else self.errors).append(event.message)
        elif isinstance(event, FrameIngested) and event.is_keyframe:
            self.kept.append(event.image.stamp)

    def __enter__(self) -> Driven:
        return self

    def __exit__(self, *_: object) -> None:
        assert self.pipeline.stop()

    def feed(self, *frames: Frame) -> None:
        """One after the other."""
        for frame in frames:
            self.pipeline.add(True, frame.stamp, frame)
            self.pipeline.add(False, frame.stamp, frame)
            assert self.pipeline.wait_idle(60)

    @property
    def estimates(self) -> int:
        return self.pipeline.recalibrator.current.accepted if self.pipeline.recalibrator else 0
