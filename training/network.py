"""The image network: an encoder of inverted residuals (MobileNetV2, Sandler et al. 2018) and a decoder with skip connections.

Made for one CPU core: wide only where the picture is small, context comes from dilations
and a gate over the whole picture (squeeze and excitation, Hu et al. 2018), not from more strides.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from training.data import NAMES

STRIDE = 16  # of the coarsest level: heights and widths must be multiples of it
CHANNELS = (16, 32, 56, 104)  # at strides 2, 4, 8, 16
DECODED = (24, 40, 64)  # at strides 2, 4, 8
DILATIONS = (1, 2, 4, 8, 2, 4)  # of the coarsest level; they reach 43 cells, 688 px
GREY_LEVELS = ((123.7, 116.3, 103.5), (58.4, 57.1, 57.4))  # mean and std of RGB in many photographs (ImageNet's)


class ConvNorm(nn.Module):
    """Convolution, batch norm and, unless linear, ReLU."""

    def __init__(
        self, inputs: int, outputs: int, size: int = 1, stride: int = 1, dilation: int = 1, groups: int = 1, linear: bool = False
    ) -> None:
        super().__init__()
        padding = dilation * (size // 2)
        self.conv = nn.Conv2d(inputs, outputs, size, stride, padding, dilation, groups, bias=False)
        self.norm: nn.Module = nn.BatchNorm2d(outputs)
        self.linear = linear

    def forward(self, x: Tensor) -> Tensor:
        x = self.norm(self.conv(x))
        return x if self.linear else functional.relu(x)

    def fuse(self) -> None:
        """Puts the norm into the convolution's weights; for running only."""
        if isinstance(self.norm, nn.BatchNorm2d):
            self.conv, self.norm = nn.utils.fusion.fuse_conv_bn_eval(self.conv, self.norm), nn.Identity()


class Inverted(nn.Module):
    """Widened by 1x1, filtered per channel by 3x3, narrowed by 1x1; added to the input where the shapes agree."""

    def __init__(self, inputs: int, outputs: int, widen: int, stride: int = 1, dilation: int = 1) -> None:
        super().__init__()
        wide = inputs * widen
        self.layers = nn.Sequential(
            ConvNorm(inputs, wide), ConvNorm(wide, wide, 3, stride, dilation, groups=wide), ConvNorm(wide, outputs, linear=True)
        )
        self.adds = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = self.layers(x)
        return x + out if self.adds else out


class Gate(nn.Module):
    """Channels weighted by what the whole picture shows."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.down, self.up = nn.Conv2d(channels, channels // 4, 1), nn.Conv2d(channels // 4, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        whole = self.up(functional.relu(self.down(x.mean((2, 3), keepdim=True))))
        return x * torch.sigmoid(whole)


class Merge(nn.Module):
    """A coarse level, enlarged by 2, and the finer one of the encoder."""

    def __init__(self, coarse: int, fine: int, outputs: int) -> None:
        super().__init__()
        self.coarse, self.fine = ConvNorm(coarse, outputs, linear=True), ConvNorm(fine, outputs, linear=True)
        self.refine = nn.Sequential(ConvNorm(outputs, outputs, 3, groups=outputs), ConvNorm(outputs, outputs))

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        enlarged = functional.interpolate(self.coarse(coarse), scale_factor=2, mode="bilinear", align_corners=False)
        out: Tensor = self.refine(functional.relu(enlarged + self.fine(fine)))
        return out


class Network(nn.Module):
    """RGB pictures (n, 3, H, W) of grey levels 0..255, any type, H and W multiples of 16 -> scores (n, 11, H/2, W/2).

    In training also the scores of the auxiliary head, (n, 11, H/8, W/8), which teaches the encoder directly.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self) -> None:
        super().__init__()
        mean, std = (torch.tensor(values).view(1, 3, 1, 1) for values in GREY_LEVELS)
        self.register_buffer("mean", mean, persistent=False)
        self.register_buffer("scale", 1 / std, persistent=False)
        c2, c4, c8, c16 = CHANNELS
        d2, d4, d8 = DECODED
        self.stem = ConvNorm(3, 24, 3, stride=2)
        self.level2 = nn.Sequential(ConvNorm(24, 24, 3, groups=24), ConvNorm(24, c2, linear=True))
        self.level4 = nn.Sequential(Inverted(c2, c4, 4, stride=2), Inverted(c4, c4, 3))
        self.level8 = nn.Sequential(Inverted(c4, c8, 4, stride=2), Inverted(c8, c8, 3), Inverted(c8, c8, 3, dilation=2))
        self.level16 = nn.Sequential(
            Inverted(c8, c16, 4, stride=2), *(Inverted(c16, c16, 4, dilation=d) for d in DILATIONS), Gate(c16)
        )
        self.merge8, self.merge4, self.merge2 = Merge(c16, c8, d8), Merge(d8, c4, d4), Merge(d4, c2, d2)
        self.head = nn.Sequential(nn.Dropout2d(0.1), nn.Conv2d(d2, len(NAMES), 1))
        self.auxiliary = nn.Conv2d(d8, len(NAMES), 1)

    def forward(self, pictures: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        x = (pictures.float() - self.mean) * self.scale
        level2 = self.level2(self.stem(x))
        level4 = self.level4(level2)
        level8 = self.level8(level4)
        eighth = self.merge8(self.level16(level8), level8)
        scores: Tensor = self.head(self.merge2(self.merge4(eighth, level4), level2))
        return (scores, self.auxiliary(eighth)) if self.training else scores

    def fuse(self) -> Network:
        """Ready to run only: norms inside the convolutions."""
        self.eval()
        for module in self.modules():
            if isinstance(module, ConvNorm):
                module.fuse()
        return self


def parameters_of(network: nn.Module) -> int:
    """How many numbers a network learns."""
    return sum(p.numel() for p in network.parameters())
