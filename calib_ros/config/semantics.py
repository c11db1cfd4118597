"""The constants of semantics: which models, how long they may take, what their classes weigh."""

from __future__ import annotations

from dataclasses import dataclass

from calib_ros.config.options import Stage, option

AUTO, BUILTIN, GEOMETRIC, SOURCE = "auto", "builtin", "geometric", "source"


@dataclass(frozen=True)
class SemanticsConfig(Stage):
    """Semantic edges, classes and weights (thesis 3.4.2, 3.5, 3.6); with segmentation = none all works without."""

    segmentation: str = option("auto", "auto = what the models below give; none = all of them off", choices=("auto", "none"))
    segment_anything: str = option(
        "",
        "Segment Anything, for semantic edges: ONNX file of the encoder (SAM, MobileSAM, SAM2, EdgeSAM, NanoSAM, EfficientSAM), "
        "of FastSAM, or a folder of ready masks NAME/*.png, NAME as calib-ros replay prints it; empty = none",
    )
    segment_anything_decoder: str = option("", "ONNX file of the decoder; not for FastSAM and folders")
    image_classes: str = option(
        BUILTIN,
        "classes of pixels: builtin = the compact network of this package, trained on streets; ONNX file of another segmentation "
        "network, a folder of label pictures NAME.png, or source = those that the source itself knows (synthetic drives); "
        "empty = none",
    )
    cloud_classes: str = option(
        AUTO,
        "classes of points: geometric = by the shape of clusters; ONNX file of a range image network, a folder of NAME.label "
        "files (SemanticKITTI), or source = those that the source itself knows; auto = geometric where there are image_classes, "
        "too; empty = none",
    )
    provider: str = option(
        "cpu",
        "where models run: cpu, cuda or tensorrt, or auto = the fastest that onnxruntime has; one that fails falls back to cpu",
        choices=("cpu", "auto", "cuda", "tensorrt"),
    )
    threads: int = option(
        1, "threads of each model on the CPU; more of them take cores from the rest of the vehicle", low=1, high=256
    )
    first_guess: bool = option(
        False,
        "where nothing else tells the initial extrinsic (no saved state, parameters or TF), guess it from the classes of "
        "online.min_keyframes keyframes, whichever way the camera looks; false = nominal",
    )
    budget_s: float = option(
        30.0,
        "time that the models of one kind may take for one keyframe, s; what takes longer is broken off, and the keyframe does "
        "without",
        low=0.01,
        high=3600.0,
    )
    prompt_grid: int = option(
        16, "Segment Anything: points of the grid of prompts along the longer side of the image", low=1, high=128
    )
    prompt_batch: int = option(16, "prompts of one run, where the export takes more than one", low=1, high=1024)
    edge_share: float = option(
        0.5,
        "share of Segment Anything's edges in the edge maps of the fast score (the thesis's: thesis.semantic_share)",
        low=0.0,
        high=1.0,
    )
    class_edge_share: float = option(
        0.0,
        "share of the borders of classes in the edge maps of the fast score, where Segment Anything is not configured or finds "
        "nothing (the thesis's: thesis.class_edge_share); 0, since with 0.2 of those of the builtin network 36 of 39 KITTI "
        "frames are found instead of 37, with 0.34 instead of 0.25 deg for the worst tenth, and a keyframe takes twice the room",
        low=0.0,
        high=1.0,
    )
    frame_weights: bool = option(
        False,
        "weigh frames by their share of vehicles, persons, cyclists, poles, signs and lights (w_j of eq. 3.16); off, since "
        "sets of 5 synthetic frames end 0.005 deg farther off with it (60 sets, 95 % interval 0.003 to 0.007), and 0.012 deg "
        "where half of them are empty roads",
    )
    match_classes: bool = option(
        False,
        "edges of vehicles, and of poles, signs and persons, meet image edges of the same classes only (thesis 5.3); needs both "
        "kinds of classes, and 26 MB more per keyframe of 0.5 Mpixel; "
        "from 20 starts on a KITTI scene it found 18 instead of 15, on synthetic ones it changes nothing",
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
        "weight of edges of vegetation: with 0.5 for it and the ground 30 of 40 single KITTI frames are found instead of 26, "
        "classes by shape; 0.2 finds no more and is less exact",
        low=0.0,
        high=10.0,
    )
    weight_ground: float = option(0.5, "weight of edges of the ground, kerbs for instance", low=0.0, high=10.0)
    weight_other: float = option(1.0, "weight of edges of anything else, and of what nobody knows", low=0.0, high=10.0)
    min_iou: float = option(0.88, "masks of a lower predicted IoU are dropped (not for FastSAM)", low=0.0, high=1.0)
    min_stability: float = option(
        0.95, "masks that change more when their threshold moves are dropped (not for FastSAM)", low=0.0, high=1.0
    )
    nms_iou: float = option(0.7, "of masks whose boxes overlap more than this only the best is kept", low=0.0, high=1.0)
