"""Configuration of semantics: which models, and how long they may take."""

from __future__ import annotations

from dataclasses import dataclass

from calib_ros.config.options import Stage, option

AUTO, BUILTIN, GEOMETRIC, SOURCE = "auto", "builtin", "geometric", "source"


@dataclass(frozen=True)
class SemanticsConfig(Stage):
    """Semantic edges, classes and weights (thesis 3.4.2, 3.5, 3.6); everything works without them."""

    segmentation: str = option("auto", "auto = use the models below; none = use no models", choices=("auto", "none"))
    use: str = option(
        "auto",
        "when models run: in_doubt = for estimates that the edges alone leave in doubt; always = on every frame; auto = "
        "in_doubt for the models of this package without frame_weights, else always",
        choices=("auto", "always", "in_doubt"),
    )
    segment_anything: str = option(
        "",
        "Segment Anything, for semantic edges: ONNX file of the encoder (SAM, MobileSAM, SAM2, EdgeSAM, NanoSAM, "
        "EfficientSAM) or of FastSAM, or a folder of precomputed masks NAME/*.png; empty = none",
    )
    segment_anything_decoder: str = option("", "ONNX file of the decoder; not for FastSAM and folders")
    image_classes: str = option(
        BUILTIN,
        "classes of pixels: builtin = the network of this package, the ONNX file of another one, a folder of label images"
        " NAME.png, or source = the ground truth of the source; empty = none",
    )
    cloud_classes: str = option(
        AUTO,
        "classes of points: geometric = from the shape of clusters, the ONNX file of a range image network, a folder of "
        "NAME.label files (SemanticKITTI), or source = the ground truth of the source; auto = geometric if image_classes "
        "is set; empty = none",
    )
    provider: str = option(
        "cpu",
        "where models run: cpu, cuda or tensorrt, or auto = the fastest available in onnxruntime; one that fails falls "
        "back to cpu",
        choices=("cpu", "auto", "cuda", "tensorrt"),
    )
    threads: int = option(1, "CPU threads per model", low=1, high=256)
    budget_s: float = option(
        30.0, "time limit for the models of one kind per keyframe, which is used without them beyond it, s", low=0.01, high=3600.0
    )
    prompt_grid: int = option(
        16, "Segment Anything: points of the prompt grid along the longer side of the image", low=1, high=128
    )
    frame_weights: bool = option(
        False, "weight frames by their share of vehicles, persons, cyclists, poles, signs and lights (w_j of eq. 3.16)"
    )

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
        return self.of_package and not self.frame_weights
