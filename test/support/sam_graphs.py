"""ONNX graphs with the names, shapes and types of Segment Anything exports, which segment by colour.

The embedding carries the colours of the picture on a grid of 256x256; the mask of a prompt is what differs from its colour
by no more than a tolerance. The predicted IoU falls to 0 for what is one cell wide, for a prompt whose labels are not as the
export wants them, and where a mask was announced.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from onnx import TensorProto
from onnx_graphs import Graph

FLOAT, HALF, INT64, UINT8 = TensorProto.FLOAT, TensorProto.FLOAT16, TensorProto.INT64, TensorProto.UINT8
MEAN, STD = np.array([123.675, 116.28, 103.53]), np.array([58.395, 57.12, 57.375])
LEVELS = (0.06, 0.06, 0.06, 0.06)
PREDICTED = (0.97, 0.95, 0.93, 0.9)


class SamGraph(Graph):
    """A graph that segments by colour."""

    def save(self, path: Path, inputs: Sequence[tuple], outputs: Sequence[tuple], metadata: dict | None = None) -> str:
        return str(super().save(path, inputs, outputs, metadata))

    def slice(self, x: str, start: Sequence[int], end: Sequence[int], axes: Sequence[int], step: Sequence[int] = ()) -> str:
        return self.op("Slice", x, self.ints(*start), self.ints(*end), self.ints(*axes), self.ints(*(step or [1] * len(axes))))

    def sampled(self, x: str, step: int = 4) -> str:
        """Every step-th pixel of a picture (1, 3, h, w)."""
        return self.slice(x, (step // 2, step // 2), (9999, 9999), (2, 3), (step, step))

    def denormalised(self, x: str) -> str:
        """Colours 0..1 of a picture that was normalised as Segment Anything does."""
        std, mean = (self.const((part / 255).reshape(1, 3, 1, 1)) for part in (STD, MEAN))
        return self.op("Add", self.op("Mul", x, std), mean)

    def packed(self, colours: str, side: int, out: str) -> str:
        """Colours (1, 3, 4 side, 4 side) as an embedding (1, 256, side, side)."""
        deep = self.op("SpaceToDepth", colours, blocksize=4)
        return self.op("Concat", deep, self.const(np.zeros((1, 208, side, side))), axis=1, out=out)

    def unpacked(self, embedding: str) -> str:
        return self.op("DepthToSpace", self.slice(embedding, (0,), (48,), (1,)), blocksize=4, mode="DCR")

    def answer(self, colours: str, point: str, levels: Sequence[float], side: int = 256) -> tuple[str, str]:
        """Colours (1, 3, side, side) and points (n, 2) in pixels of 4 * side -> logits (n, k, side, side), IoU (n, k)."""
        cell = self.op("Clip", self.op("Mul", point, self.const(0.25)), self.const(0), self.const(side - 1))
        row_column = self.op("Gather", self.op("Cast", cell, to=INT64), self.ints(1, 0), axis=1)
        rows = self.op("Transpose", self.op("Squeeze", colours, self.ints(0)), perm=[1, 2, 0])
        own = self.op("Reshape", self.op("GatherND", rows, row_column), self.ints(-1, 3, 1, 1))
        distance = self.op("ReduceMax", self.op("Abs", self.op("Sub", colours, own)), axes=[1], keepdims=1)
        tolerance = self.const(np.reshape(levels, (1, -1, 1, 1)))
        # As high inside as low outside: boundaries then lie in the middle between cells.
        logits = self.op("Mul", self.op("Sub", tolerance, distance), self.const(200))
        logits = self.op("Clip", logits, self.const(-6), self.const(6))
        outside = self.op("Cast", self.op("LessOrEqual", logits, self.const(0)), to=FLOAT)
        grown = self.op("MaxPool", outside, kernel_shape=[2, 2])
        thick = self.op("Sub", self.const(1), self.op("ReduceMin", grown, axes=[2, 3], keepdims=0))
        return logits, self.op("Mul", thick, self.const([PREDICTED[: len(levels)]]))

    def worth(self, iou: str, labels: str, padding: bool, has_mask: str = "") -> str:
        """IoU (n, k) if the labels (n, m) are one 1 and, with padding, one -1, and no mask is announced; else 0."""
        wanted = [[1, -1]] if padding else [[1]]
        right = self.op("Sub", labels, self.const(wanted))
        wrong = self.op("ReduceMax", self.op("Abs", right), axes=[1], keepdims=1)
        if has_mask:
            wrong = self.op("Add", wrong, self.op("Reshape", has_mask, self.ints(-1, 1)))
        return self.op("Mul", iou, self.op("Cast", self.op("Equal", wrong, self.const(0)), to=FLOAT))

    def first_point(self, coords: str) -> str:
        return self.op("Squeeze", self.slice(coords, (0,), (1,), (1,)), self.ints(1))

    def resized(self, x: str, height_width: str) -> str:
        """(n, k, h, w) at a size that is a tensor (2,) int64."""
        front = self.slice(self.op("Shape", x), (0,), (2,), (0,))
        sizes = self.op("Concat", front, height_width, axis=0)
        return self.op("Resize", x, "", "", sizes, mode="linear", coordinate_transformation_mode="half_pixel")


def encoder(path: Path, name: str = "input_image", out: str = "image_embeddings", side: int = 1024, kind: int = FLOAT) -> str:
    """1x3xSxS normalised and padded -> 1x256x(S/16)x(S/16): official SAM, samexporter without preprocessing, EdgeSAM, NanoSAM."""
    g = SamGraph()
    x = g.op("Cast", name, to=FLOAT)
    embedding = g.packed(g.denormalised(g.sampled(x)), side // 16, "e")
    g.op("Cast", embedding, to=kind, out=out)
    return g.save(path, [(name, [1, 3, side, side], kind)], [(out, [1, 256, side // 16, side // 16], kind)])


def raw_encoder(path: Path, shape: Sequence[object] = ("image_height", "image_width", 3)) -> str:
    """samexporter with preprocessing inside: HxWx3 0..255; the graph pads to 1024x1024."""
    g = SamGraph()
    x = g.op("Div", g.op("Transpose", "input_image", perm=[2, 0, 1]), g.const(255))
    x = g.op("Unsqueeze", x, g.ints(0))
    lacking = g.op("Sub", g.ints(1024, 1024), g.slice(g.op("Shape", x), (2,), (4,), (0,)))
    padded = g.op("Pad", x, g.op("Concat", g.ints(0, 0, 0, 0, 0, 0), lacking, axis=0))
    g.packed(g.sampled(padded), 64, "image_embeddings")
    return g.save(path, [("input_image", shape)], [("image_embeddings", [1, 256, 64, 64])])


def official_decoder(
    path: Path,
    outputs: Sequence[str] = ("masks", "iou_predictions", "low_res_masks"),
    levels: Sequence[float] = LEVELS,
    names: dict[str, str] | None = None,
    side: int = 1024,
    sized: bool = True,
    kind: int = FLOAT,
) -> str:
    """The export of SAM's authors. sized: with orig_im_size. names: other names for its tensors. kind: type of its tensors."""
    g, low, cells = SamGraph(), side // 4, side // 16
    names = names or {}
    inputs = {
        "image_embeddings": [1, 256, cells, cells],
        "point_coords": [1, "num_points", 2],
        "point_labels": [1, "num_points"],
        "mask_input": [1, 1, low, low],
        "has_mask_input": [1],
    } | ({"orig_im_size": [2]} if sized else {})
    x = {n: g.op("Cast", names.get(n, n), to=FLOAT) for n in inputs}
    logits, iou = g.answer(g.unpacked(x["image_embeddings"]), g.first_point(x["point_coords"]), levels, low)
    made = {"iou_predictions": g.worth(iou, x["point_labels"], True, x["has_mask_input"]), "low_res_masks": logits}
    if "masks" in outputs:
        size = x["orig_im_size"]
        factor = g.op("Div", g.const(side), g.op("ReduceMax", size, keepdims=1))
        inner = g.op("Cast", g.op("Floor", g.op("Add", g.op("Mul", size, factor), g.const(0.5))), to=INT64)
        whole = g.resized(logits, g.ints(side, side))
        cut = g.op("Slice", whole, g.ints(0, 0), inner, g.ints(2, 3))
        made["masks"] = g.resized(cut, g.op("Cast", size, to=INT64))
    k = len(levels)
    shapes = {"masks": [1, k, "h", "w"], "iou_predictions": [1, k], "low_res_masks": [1, k, low, low]}
    for n in outputs:
        g.op("Cast", made[n], to=kind, out=names.get(n, n))
    return g.save(
        path,
        [(names.get(n, n), shape, kind) for n, shape in inputs.items()],
        [(names.get(n, n), shapes[n], kind) for n in outputs],
    )


def edge_sam_decoder(path: Path) -> str:
    """EdgeSAM: embedding and points only; scores and masks of the low resolution."""
    g = SamGraph()
    logits, iou = g.answer(g.unpacked("image_embeddings"), g.first_point("point_coords"), LEVELS)
    g.op("Identity", g.worth(iou, "point_labels", True), out="scores")
    g.op("Identity", logits, out="masks")
    inputs = [("image_embeddings", [1, 256, 64, 64]), ("point_coords", [1, "n", 2]), ("point_labels", [1, "n"])]
    return g.save(path, inputs, [("scores", [1, 4]), ("masks", [1, 4, 256, 256])])


def sam2_pair(folder: Path, honest: bool = True, prompts: object = "num_labels") -> tuple[str, str]:
    """SAM2 by samexporter. honest: whether the decoder takes several prompts at once, as it says. prompts: how many."""
    g = SamGraph()
    x = g.denormalised("image")
    g.packed(g.sampled(x), 64, "image_embed")
    g.op("Concat", g.sampled(x), g.const(np.zeros((1, 29, 256, 256))), axis=1, out="high_res_feats_0")
    g.op("Concat", g.sampled(x, 8), g.const(np.zeros((1, 61, 128, 128))), axis=1, out="high_res_feats_1")
    fine, middle, coarse = [1, 32, 256, 256], [1, 64, 128, 128], [1, 256, 64, 64]
    features = [("high_res_feats_0", fine), ("high_res_feats_1", middle), ("image_embed", coarse)]
    first = g.save(folder / "sam2.encoder.onnx", [("image", [1, 3, 1024, 1024])], features)
    g = SamGraph()
    red = g.slice("high_res_feats_0", (0,), (1,), (1,))
    colours = g.op("Concat", red, g.slice(g.unpacked("image_embed"), (1,), (3,), (1,)), axis=1)
    point = g.first_point("point_coords")
    if not honest:
        point = g.op("Reshape", point, g.ints(1, 2))
    logits, iou = g.answer(colours, point, LEVELS[:3])
    g.op("Identity", logits, out="masks")
    g.op("Identity", g.worth(iou, "point_labels", True, "has_mask_input"), out="iou_predictions")
    inputs = [
        ("point_coords", [prompts, "num_points", 2]),
        ("point_labels", [prompts, "num_points"]),
        ("mask_input", [prompts, 1, 256, 256]),
        ("has_mask_input", [prompts]),
    ]
    outputs = [("masks", [prompts, 3, 256, 256]), ("iou_predictions", [prompts, 3])]
    second = g.save(folder / "sam2.decoder.onnx", [features[2], *features[:2], *inputs], outputs)
    return first, second


def efficient_sam_pair(folder: Path) -> tuple[str, str]:
    """EfficientSAM: pictures RGB 0..1 of any size, points in their pixels, masks of their size."""
    g = SamGraph()
    g.packed(g.sampled(g.resized("batched_images", g.ints(1024, 1024))), 64, "image_embeddings")
    first = g.save(
        folder / "efficient.encoder.onnx",
        [("batched_images", ["batch", 3, "height", "width"])],
        [("image_embeddings", ["batch", 256, 64, 64])],
    )
    g = SamGraph()
    width_height = g.op("Cast", g.op("Gather", "orig_im_size", g.ints(1, 0)), to=FLOAT)
    coords = g.op("Squeeze", g.op("Squeeze", g.slice("batched_point_coords", (0,), (1,), (2,)), g.ints(2)), g.ints(0))
    point = g.op("Mul", coords, g.op("Div", g.const(1024), width_height))
    logits, iou = g.answer(g.unpacked("image_embeddings"), point, LEVELS[:3])
    iou = g.worth(iou, g.op("Squeeze", "batched_point_labels", g.ints(0)), False)
    g.op("Unsqueeze", g.resized(logits, "orig_im_size"), g.ints(0), out="output_masks")
    g.op("Unsqueeze", iou, g.ints(0), out="iou_predictions")
    second = g.save(
        folder / "efficient.decoder.onnx",
        [
            ("image_embeddings", ["batch", 256, 64, 64]),
            ("batched_point_coords", [1, "queries", "points", 2]),
            ("batched_point_labels", [1, "queries", "points"]),
            ("orig_im_size", [2], INT64),
        ],
        [("output_masks", [1, "queries", 3, "h", "w"]), ("iou_predictions", [1, "queries", 3])],
    )
    return first, second


def transformers_pair(folder: Path) -> tuple[str, str]:
    """SAM by Hugging Face's exporter: a second embedding, prompts in a dimension more, points that the graph fills up itself."""
    embedding, points = ["b", 256, 64, 64], ["b", "prompts", "points", 2]
    g = SamGraph()
    g.packed(g.denormalised(g.sampled("pixel_values")), 64, "image_embeddings")
    g.op("Identity", g.const(np.ones((1, 256, 64, 64))), out="image_positional_embeddings")
    features = [("image_embeddings", embedding), ("image_positional_embeddings", embedding)]
    first = g.save(folder / "vision.onnx", [("pixel_values", ["b", 3, 1024, 1024])], features)
    g = SamGraph()
    coords = g.op("Squeeze", g.op("Squeeze", g.slice("input_points", (0,), (1,), (2,)), g.ints(2)), g.ints(0))
    colours = g.unpacked(g.op("Mul", "image_embeddings", "image_positional_embeddings"))
    logits, iou = g.answer(colours, coords, LEVELS[:3])
    labels = g.op("Cast", g.op("Squeeze", "input_labels", g.ints(0)), to=FLOAT)
    g.op("Unsqueeze", g.worth(iou, labels, False), g.ints(0), out="iou_scores")
    g.op("Unsqueeze", logits, g.ints(0), out="pred_masks")
    second = g.save(
        folder / "prompt.onnx",
        [("input_points", points), ("input_labels", points[:3], INT64), *features],
        [("iou_scores", ["b", "prompts", 3]), ("pred_masks", ["b", "prompts", 3, 256, 256])],
    )
    return first, second


def fast_sam(
    path: Path,
    side: int,
    detections: np.ndarray,
    palette: np.ndarray,
    transposed: bool = False,
    metadata: dict | None = None,
    extra: bool = False,
) -> str:
    """YOLOv8-seg. detections: (n, 5 + p) centre, size, confidence, coefficients; prototype k is how like colour k of the
    palette (p, 3), 0..1, a pixel is. extra: with a table without detections and two maps of features before the prototypes."""
    g, cells = SamGraph(), side // 4
    colours = g.sampled("images")
    like = [
        g.op("ReduceMax", g.op("Abs", g.op("Sub", colours, g.const(c.reshape(1, 3, 1, 1)))), axes=[1], keepdims=1)
        for c in palette
    ]
    far = g.op("Concat", *like, axis=1)
    likeness = g.op("Mul", g.op("Sub", g.const(0.08), far), g.const(100))
    g.op("Clip", likeness, g.const(-6), g.const(6), out="output1")
    table = detections if transposed else detections.T
    g.op("Identity", g.const(table[None]), out="output0")
    outputs = [("output0", [1, *table.shape]), ("output1", [1, len(palette), cells, cells])]
    if extra:
        g.op("Identity", g.const(np.zeros((1, *table.shape))), out="empty")
        g.op("AveragePool", "images", out="few", kernel_shape=[8, 8], strides=[8, 8])
        g.op("Concat", *["few"] * 35, axis=1, out="many")
        maps = [(name, [1, n, side // 8, side // 8]) for name, n in (("few", 3), ("many", 105))]
        outputs = [("empty", [1, *table.shape]), *maps[:1], *outputs, *maps[1:]]
    return g.save(path, [("images", [1, 3, side, side])], outputs, metadata)
