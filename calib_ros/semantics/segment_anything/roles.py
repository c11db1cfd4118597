"""What the tensors of a decoder of masks are: by their names, then by their shapes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from calib_ros.errors import ModelError
from calib_ros.semantics.onnx_model import OnnxModel, Tensor

KNOWN = (
    "known are the exports of SAM, MobileSAM, EdgeSAM and NanoSAM (image_embeddings, point_coords, point_labels and some of "
    "mask_input, has_mask_input, orig_im_size; masks or low_res_masks, iou_predictions or scores), SAM2 (with high_res_feats_0, "
    "high_res_feats_1, image_embed), EfficientSAM (batched_point_coords, batched_point_labels, orig_im_size; output_masks), "
    "Hugging Face (input_points, input_labels; pred_masks, iou_scores) and, alone, FastSAM (output0, output1)"
)


@dataclass(frozen=True)
class Roles:
    """What the tensors of a decoder are. features: (its input, name of the encoder's output)."""

    points: Tensor
    labels: Tensor
    mask_input: Tensor | None
    has_mask: Tensor | None
    image_size: Tensor | None
    features: tuple[tuple[Tensor, str], ...]
    masks: Tensor
    score: Tensor | None

    @property
    def in_own_pixels(self) -> bool:
        """Whether points are in pixels of the picture: EfficientSAM, whose decoder scales them itself."""
        return len(self.points.shape) == 4 and self.image_size is not None


def roles_of(decoder: OnnxModel, encoder: OnnxModel) -> Roles:
    """Roles of the decoder's tensors. ModelError, naming the tensors of both, if they fit no known export or not each other."""
    left = list(decoder.inputs)
    points = _take(left, ("coords", "points"), lambda t: len(t.shape) in (3, 4) and t.shape[-1] == 2)
    if points is None or len(points.shape) not in (3, 4) or points.shape[-1] not in (2, None):
        raise _misfit(decoder, encoder, "no input takes points")
    labels = _take(left, ("label",), lambda t: len(t.shape) == len(points.shape) - 1)
    if labels is None or len(labels.shape) != len(points.shape) - 1:
        raise _misfit(decoder, encoder, "no input takes the labels of the points")
    has_mask = _take(left, ("has_mask",), lambda t: t.shape in ((), (1,)))
    mask_input = _take(left, ("mask",), lambda t: len(t.shape) == 4 and t.shape[1] == 1)
    image_size = _take(left, ("size",), lambda t: t.shape == (2,))
    features = _features(left, decoder, encoder)
    outputs = list(decoder.outputs)
    largest = max(len(t.shape) for t in outputs)
    asked = decoder.sidecar.output
    if asked:
        masks = next((t for t in outputs if t.name == asked), None)
        if masks is None:
            raise decoder.error(f"there is no output '{asked}', which 'output:' of the YAML beside it names")
        outputs.remove(masks)
    else:
        masks = _take(outputs, ("low_res", "mask"), lambda t: len(t.shape) == largest >= 3)
    if masks is None:
        raise _misfit(decoder, encoder, "no output gives masks")
    score = _take(outputs, ("iou", "score"), lambda t: 1 <= len(t.shape) < len(masks.shape) - 1)
    return Roles(points, labels, mask_input, has_mask, image_size, features, masks, score)


def _take(left: list[Tensor], names: Sequence[str], fits: Callable[[Tensor], bool]) -> Tensor | None:
    """The tensor that a name belongs to, else the first that fits; it is taken out of the list."""
    named = (t for name in names for t in left if name in t.name.lower())
    found = next(named, None) or next(filter(fits, left), None)
    if found is not None:
        left.remove(found)
    return found


def _features(wanted: Iterable[Tensor], decoder: OnnxModel, encoder: OnnxModel) -> tuple[tuple[Tensor, str], ...]:
    """Which output of the encoder each of these inputs gets: that of the same name, else the first that has its shape."""
    given = {t.name: t for t in encoder.outputs}
    found, nameless = [], []
    for tensor in wanted:
        source = given.pop(tensor.name, None)
        if source is None:
            nameless.append(tensor)
        elif not _compatible(source, tensor):
            raise _misfit(decoder, encoder, f"the encoder gives {source}, but the decoder takes {tensor}")
        else:
            found.append((tensor, source.name))
    for tensor in nameless:
        name = next((name for name, source in given.items() if _compatible(source, tensor)), None)
        if name is None:
            raise _misfit(decoder, encoder, f"nothing is known that would belong to the input {tensor}")
        del given[name]
        found.append((tensor, name))
    if not found:
        raise _misfit(decoder, encoder, "no input takes the embedding")
    return tuple(found)


def _compatible(given: Tensor, taken: Tensor) -> bool:
    sizes = zip(given.shape, taken.shape, strict=False)
    return len(given.shape) == len(taken.shape) and all(None in (a, b) or a == b for a, b in sizes)


def _misfit(decoder: OnnxModel, encoder: OnnxModel, problem: str) -> ModelError:
    return ModelError(
        f"{encoder.path} and {decoder.path} are no pair of Segment Anything: {problem}; the encoder has {encoder.tensors}; "
        f"the decoder has {decoder.tensors}; {KNOWN}"
    )
