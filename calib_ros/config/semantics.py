"""Configuration of semantics: which models, how long they may take, and the weights of their classes."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

from calib_ros.config.options import Stage, option

AUTO, BUILTIN, GEOMETRIC, SOURCE = "auto", "builtin", "geometric", "source"


@dataclass(frozen=True)
class SemanticsConfig(Stage):
    """Semantic edges, classes and weights (thesis 3.4.2, 3.5, 3.6); everything works without them."""

    segmentation: str = option("auto", "auto = use the models below; none = use no models", choices=("auto", "none"))
    use: str = option(
        "auto",
        "when models run: in_doubt = on the frames of an estimate that is refused or not far above chance; always = on every "
        "frame; auto = in_doubt for the models of this package, always for other ones and where a setting below needs the "
        "classes in every estimate",
        choices=("auto", "always", "in_doubt"),
    )
    segment_anything: str = option(
        "",
        "Segment Anything, for semantic edges: ONNX file of the encoder (SAM, MobileSAM, SAM2, EdgeSAM, NanoSAM, EfficientSAM) "
        "or of FastSAM, or a folder of precomputed masks NAME/*.png, NAME as calib-ros replay prints it; empty = none",
    )
    segment_anything_decoder: str = option("", "ONNX file of the decoder; not for FastSAM and folders")
    image_classes: str = option(
        BUILTIN,
        "classes of pixels: builtin = the compact network of this package, trained on rendered streets; or the ONNX file of "
        "another segmentation network, a folder of label images NAME.png, or source = the ground truth of the source (synthetic "
        "drives); empty = none",
    )
    cloud_classes: str = option(
        AUTO,
        "classes of points: geometric = from the shape of clusters; or the ONNX file of a range image network, a folder of "
        "NAME.label files (SemanticKITTI), or source = the ground truth of the source; auto = geometric if image_classes is set; "
        "empty = none",
    )
    provider: str = option(
        "cpu",
        "where models run: cpu, cuda or tensorrt, or auto = the fastest available in onnxruntime; one that fails falls back to "
        "cpu",
        choices=("cpu", "auto", "cuda", "tensorrt"),
    )
    threads: int = option(1, "CPU threads per model; more take cores from the other processes of the vehicle", low=1, high=256)
    first_guess: bool = option(
        False,
        "if there is no initial extrinsic (no saved state, parameters or TF), estimate it from the classes of "
        "online.min_keyframes keyframes, for any yaw of the camera, as initial.method: semantic does",
    )
    budget_s: float = option(
        30.0,
        "time limit for the models of one kind per keyframe, s; a model that exceeds it is stopped and its keyframe is used "
        "without it",
        low=0.01,
        high=3600.0,
    )
    prompt_grid: int = option(
        16, "Segment Anything: points of the prompt grid along the longer side of the image", low=1, high=128
    )
    prompt_batch: int = option(16, "Segment Anything: prompts per run, if the export accepts several", low=1, high=1024)
    edge_share: float = option(
        0.5,
        "share of Segment Anything's edges in the edge maps of the fast score (for the thesis's: thesis.semantic_share)",
        low=0.0,
        high=1.0,
    )
    frame_weights: bool = option(
        False,
        "weight frames by their share of vehicles, persons, cyclists, poles, signs and lights (w_j of eq. 3.16); off, since it "
        "does not lower the errors of joint estimates",
    )
    consistency_check: bool = option(
        True,
        "use the classes of points and pixels also to choose where the search starts, and to decide on an estimate that the "
        "edges alone neither confirm nor refute; needs both kinds of classes",
        formerly="witness",
    )
    weight_vehicle: float = option(1.0, "weight of edges of vehicles", low=0.0, high=10.0)
    weight_person: float = option(1.0, "weight of edges of persons and cyclists", low=0.0, high=10.0)
    weight_pole: float = option(1.0, "weight of edges of poles, traffic signs and lights", low=0.0, high=10.0)
    weight_building: float = option(1.0, "weight of edges of buildings", low=0.0, high=10.0)
    weight_vegetation: float = option(
        0.5,
        "weight of edges of vegetation, which move and have no outline",
        low=0.0,
        high=10.0,
    )
    weight_ground: float = option(0.5, "weight of edges of the ground, for instance kerbs", low=0.0, high=10.0)
    weight_other: float = option(1.0, "weight of edges of other and unknown classes", low=0.0, high=10.0)
    min_iou: float = option(0.88, "masks with a lower predicted IoU are dropped (not for FastSAM)", low=0.0, high=1.0)
    min_stability: float = option(
        0.95,
        "masks with a lower stability score are dropped: they change when their threshold moves (not for FastSAM)",
        low=0.0,
        high=1.0,
    )
    nms_iou: float = option(0.7, "of masks whose boxes overlap by more than this IoU only the best is kept", low=0.0, high=1.0)
    retired: ClassVar[tuple[str, ...]] = ("class_edge_share", "match_classes")

    @property
    def of_package(self) -> bool:
        """Whether all models come with the package."""
        chosen = self.image_classes in ("", BUILTIN) and self.cloud_classes in ("", AUTO, GEOMETRIC)
        return chosen and not self.segment_anything

    @property
    def in_doubt_only(self) -> bool:
        """Whether classes wait until an estimate without them leaves doubt; see ``use``."""
        if self.use != "auto":
            return self.use == "in_doubt"
        weights = [f.name for f in fields(self) if f.name.startswith("weight_")]
        usual = all(getattr(self, name) == getattr(type(self), name) for name in weights)
        asked = self.frame_weights or self.first_guess
        return self.of_package and usual and not asked
