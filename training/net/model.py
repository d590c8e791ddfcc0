"""The network: after CenterNet (Zhou, Wang & Kraehenbuehl 2019, arXiv 1904.07850), but tiny.

Strides 2 to 32: full convolutions down to stride 4, depthwise-separable residual blocks below, an
additive top-down path (Lin et al. 2017, arXiv 1612.03144), one head at stride 4. Widths are whole
multiples of 16, since ONNX Runtime computes as many channels at a time, and what follows a sum is
one operation with it; both make the network a fifth faster.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from mushpipe.stages.cap_decode import CHANNELS, HEAT, MASK, OFFSET, RADIUS

WIDTHS = (32, 64, 96, 128)  # channels at strides 4, 8, 16, 32
BLOCKS = (2, 3, 3)  # residual blocks at strides 8, 16, 32
NECK = 32


def normed(inputs: int, outputs: int, size: int, stride: int = 1, groups: int = 1) -> nn.Sequential:
    """Return a convolution and batch norm."""
    conv = nn.Conv2d(inputs, outputs, size, stride, size // 2, groups=groups, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outputs))


def convolution(inputs: int, outputs: int, size: int, stride: int = 1) -> nn.Sequential:
    """Return a full convolution, batch norm and ReLU."""
    return nn.Sequential(*normed(inputs, outputs, size, stride), nn.ReLU())


def separable(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """Return a 5x5 depthwise and a 1x1 convolution, each with batch norm."""
    deep = normed(inputs, inputs, 5, stride, groups=inputs)
    return nn.Sequential(*deep, *normed(inputs, outputs, 1))


class Residual(nn.Module):
    """ReLU(x + separable(x))."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.body = separable(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Apply it."""
        return functional.relu(x + self.body(x))


class CapNet(nn.Module):
    """RGB images (B, 3, H, W) in 0..1, H and W multiples of 32, to (B, 5, H/4, W/4)."""

    def __init__(self) -> None:
        super().__init__()
        first = WIDTHS[0]
        self.stem = nn.Sequential(
            convolution(3, 16, 3, 2), convolution(16, first, 3, 2), Residual(first)
        )
        self.down = nn.ModuleList(
            nn.Sequential(*separable(a, b, 2), nn.ReLU(), *(Residual(b) for _ in range(blocks)))
            for (a, b), blocks in zip(pairwise(WIDTHS), BLOCKS, strict=True)
        )
        self.lateral = nn.ModuleList(nn.Conv2d(width, NECK, 1) for width in WIDTHS)
        self.merge = nn.ModuleList(Residual(NECK) for _ in WIDTHS)
        last = nn.Conv2d(NECK, CHANNELS, 1)
        bias = torch.zeros(CHANNELS)
        bias[HEAT] = -4.0  # few cells are centres
        bias[RADIUS] = 1.5  # 18 px
        last.bias = nn.Parameter(bias)
        self.head = nn.Sequential(convolution(NECK, NECK, 1), last)

    def forward(self, image: Tensor) -> Tensor:
        """Return the raw output."""
        levels = [self.stem(image)]
        for down in self.down:
            levels.append(down(levels[-1]))
        top: Tensor | None = None
        for level, lateral, merge in zip(
            reversed(levels), reversed(self.lateral), reversed(self.merge), strict=True
        ):
            x = lateral(level)
            if top is not None:
                x = x + functional.interpolate(top, scale_factor=2.0, mode="nearest")
            top = merge(x)
        result: Tensor = self.head(top)
        return result


def loss_of(output: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Return the loss of a batch.

    Focal loss of CenterNet for heat (equation 1 there), L1 for radius and offset wherever the
    target's heat is above a half, cross entropy for the mask.

    Args:
        output: (B, 5, h, w) of the network.
        target: (B, 5, h, w): heat 0..1, mask 0 or 1, log radius, offset.
        weight: (B, h, w): 0 where heat is not to be learnt.
    """
    heat, wanted = output[:, HEAT], target[:, HEAT]
    near = torch.clamp(heat.sigmoid(), 1e-4, 1 - 1e-4)
    center = wanted >= 0.999
    hit = (1 - near) ** 2 * near.log() * center
    miss = near**2 * (1 - near).log() * (1 - wanted) ** 4 * ~center
    focal = -((hit + miss) * weight).sum() / center.sum().clamp(min=8)
    inside = (wanted > 0.5).float() * wanted
    count = inside.sum().clamp(min=8)
    radius = ((output[:, RADIUS] - target[:, RADIUS]).abs() * inside).sum() / count
    offset = ((output[:, OFFSET] - target[:, OFFSET]).abs().sum(dim=1) * inside).sum() / count
    mask = functional.binary_cross_entropy_with_logits(output[:, MASK], target[:, MASK])
    return focal + 2.0 * radius + 0.5 * offset + mask
