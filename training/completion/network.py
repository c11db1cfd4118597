"""The completion network: at each pixel a mixture of the depths that were measured around it, weighted by a small U-Net.

Near and far ends of the depths around are candidates, so that an outline is a choice between two surfaces, not a blur of both.
Depths within are logarithms: their ratios matter.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

STRIDE = 32  # of the coarsest level: heights and widths must be multiples of it
LEVELS = 5  # of the pyramid of measured depths, from half the size
OFFERED = (1, 2, 3)  # levels whose near and far ends are candidates: within 3, 6, 12 px
ALONG = 3  # cells of 2 px beside each other whose mean is a candidate: rings are nearly level
CHANNELS = (8, 16, 32, 48)  # at strides 2, 4, 8, 16; multiples of 8 run fastest
FARTHEST = 100.0  # m; what is farther is cut
LEAST, MIDDLE = 0.5, 2.5  # m; and the logarithm of usual depths
GREY = (110.0, 60.0)  # mean and standard deviation of usual grey levels
SHY = -2.0  # of the shares, before the sigmoid: at first the mean counts


def _larger(values: Tensor) -> Tensor:
    return functional.interpolate(values, scale_factor=2, mode="bilinear", align_corners=False)


def candidates(depth: Tensor) -> tuple[Tensor, Tensor]:
    """Depths (1, 1, H, W), 0 where not measured -> logarithms of what they can be (1, k, H/2, W/2), and whether it was measured.

    The first one is the mean, where nothing was measured that of the next coarser level; the second is the mean along the row,
    then come the nearest and farthest depths around.
    """
    weight = (depth > 0).to(depth.dtype)
    mean, near, far = depth, (FARTHEST - depth) * weight, depth  # 0 where not measured, so that the largest is what counts
    means, known, ends = [], [], []
    for level in range(1, LEVELS + 1):
        mean, weight = functional.avg_pool2d(mean, 2), functional.avg_pool2d(weight, 2)
        near, far = functional.max_pool2d(near, 2), functional.max_pool2d(far, 2)
        means.append(mean / (weight + 1e-6))
        if level == 1:
            beside, some = (functional.avg_pool2d(a, (1, ALONG), 1, (0, ALONG // 2)) for a in (mean, weight))
        known.append((weight > 0).to(depth.dtype))
        if level in OFFERED:
            ends.append((functional.max_pool2d(near, 3, 1, 1), functional.max_pool2d(far, 3, 1, 1)))
    filled = (means[-1] * known[-1]).sum((2, 3), keepdim=True) / (known[-1].sum((2, 3), keepdim=True) + 1e-6)
    filled = means[-1] + (1 - known[-1]) * filled
    for level in range(LEVELS - 2, -1, -1):
        filled = means[level] + (1 - known[level]) * _larger(filled)
    found = [filled, beside / (some + 1e-6) + (some == 0).to(depth.dtype) * filled]
    for level, (near, far) in zip(OFFERED, ends, strict=True):
        empty = (far == 0).to(depth.dtype)
        pair = torch.cat([(1 - empty) * (FARTHEST - near), far, empty], 1)
        if level > 1:
            pair = functional.interpolate(pair, scale_factor=2 ** (level - 1))
        found.append(pair[:, :2] + pair[:, 2:] * filled)
    return torch.log(torch.cat(found, 1).clamp(LEAST)), known[0]


class Block(nn.Module):
    """3x3 convolution, batch norm, ReLU."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.norm: nn.Module = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(self.norm(self.conv(x)))

    def fuse(self) -> None:
        """Puts the norm into the convolution's weights; for running only."""
        self.conv, self.norm = nn.utils.fusion.fuse_conv_bn_eval(self.conv, self.norm), nn.Identity()


class CompletionNetwork(nn.Module):
    """depth (1, 1, H, W) m, 0 = not measured, and image (1, 1, H, W) grey levels 0..255 -> dense depth (1, 1, H, W), m."""

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d = CHANNELS
        count = 1 + 2 * len(OFFERED)
        self.first = Block(count + 3, a)
        self.down = nn.ModuleList([nn.Sequential(Block(p, q, 2), Block(q, q)) for p, q in ((a, b), (b, c), (c, d))])
        self.narrow = nn.ModuleList([nn.Conv2d(p, q, 1) for p, q in ((d, c), (c, b), (b, a))])
        self.merge = nn.ModuleList([Block(n, n) for n in (c, b, a)])
        self.shares, self.shift = nn.Conv2d(a, count, 1), nn.Conv2d(a, 1, 1)
        for part, bias in ((self.shares, SHY), (self.shift, 0.0)):
            nn.init.zeros_(part.weight)
            nn.init.constant_(part.bias, bias)  # type: ignore[arg-type]

    def forward(self, depth: Tensor, image: Tensor) -> Tensor:
        found, known = candidates(depth)
        mean = found[:, :1]
        beside = found[:, 1:] - mean
        grey = (functional.avg_pool2d(image, 2) - GREY[0]) * (1 / GREY[1])
        x = self.first(torch.cat([mean - MIDDLE, beside, known, grey], 1))
        levels = [x]
        for layer in self.down:
            levels.append(layer(levels[-1]))
        x = levels.pop()
        for narrow, merge in zip(self.narrow, self.merge, strict=True):
            x = merge(_larger(narrow(x)) + levels.pop())
        moved = (torch.sigmoid(self.shares(x)) * beside).sum(1, keepdim=True)
        return _larger(torch.exp(mean + moved + 0.1 * self.shift(x)))

    def fuse(self) -> CompletionNetwork:
        """The same for running, without norms."""
        self.eval()
        for part in self.modules():
            if isinstance(part, Block):
                part.fuse()
        return self
