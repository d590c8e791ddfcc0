"""The network: after CenterNet (Zhou, Wang & Kraehenbuehl 2019, arXiv 1904.07850), but tiny.

Strides 2 to 32: full convolutions down to stride 4, depthwise-separable residual blocks below, an
additive top-down path (Lin et al. 2017, arXiv 1612.03144), one head at stride 4. Widths are whole
multiples of 16, since ONNX Runtime computes as many channels at a time, and what follows a sum is
one operation with it; both make the network a fifth faster. The one that ships learnt from a large
one of the same plan, with full convolutions throughout.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from mushpipe.stages.cap_decode import CHANNELS, HEAT, MASK, OFFSET, RADIUS

BLOCKS = (2, 3, 3)  # residual blocks at strides 8, 16, 32


@dataclass(frozen=True)
class Plan:
    """How large a network is.

    Attributes:
        widths: Channels at strides 4, 8, 16 and 32.
        first: Channels at stride 2.
        neck: Channels of the top-down path.
        full: Whether convolutions are full 3x3 ones throughout.
    """

    widths: tuple[int, ...] = (32, 64, 96, 128)
    first: int = 16
    neck: int = 32
    full: bool = False


SMALL = Plan()  # 160 949 parameters
LARGE = Plan((48, 96, 160, 224), first=32, neck=64, full=True)  # 5 323 333


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


def fully(width: int) -> nn.Sequential:
    """Return two full 3x3 convolutions, each with batch norm."""
    return nn.Sequential(convolution(width, width, 3), *normed(width, width, 3))


class Residual(nn.Module):
    """ReLU(x + separable(x)), or with two full convolutions."""

    def __init__(self, width: int, full: bool) -> None:
        super().__init__()
        self.body = fully(width) if full else separable(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Apply it."""
        return functional.relu(x + self.body(x))


class CapNet(nn.Module):
    """RGB images (B, 3, H, W) in 0..1, H and W multiples of 32, to (B, 5, H/4, W/4)."""

    def __init__(self, plan: Plan = SMALL) -> None:
        super().__init__()
        widths, neck, full = plan.widths, plan.neck, plan.full
        self.stem = nn.Sequential(
            convolution(3, plan.first, 3, 2),
            convolution(plan.first, widths[0], 3, 2),
            Residual(widths[0], full),
        )
        self.down = nn.ModuleList(
            nn.Sequential(
                *(normed(a, b, 3, 2) if full else separable(a, b, 2)),
                nn.ReLU(),
                *(Residual(b, full) for _ in range(blocks)),
            )
            for (a, b), blocks in zip(pairwise(widths), BLOCKS, strict=True)
        )
        self.lateral = nn.ModuleList(nn.Conv2d(width, neck, 1) for width in widths)
        self.merge = nn.ModuleList(Residual(neck, full) for _ in widths)
        last = nn.Conv2d(neck, CHANNELS, 1)
        bias = torch.zeros(CHANNELS)
        bias[HEAT] = -4.0  # few cells are centres
        bias[RADIUS] = 1.5  # 18 px
        last.bias = nn.Parameter(bias)
        self.head = nn.Sequential(convolution(neck, neck, 1), last)

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


def guided_loss(output: Tensor, guide: Tensor, target: Tensor) -> Tensor:
    """Return how far an output (B, 5, h, w) is from that of a large network (Hinton et al. 2015).

    Relative entropy of the heat, more where both differ, as in the quality focal loss (Li et al.
    2020, arXiv 2006.04388, equation 2), per centre in the target (B, 5, h, w); L1 for radius and
    offset as far as the guide sees a centre there; cross entropy for the mask.
    """
    entropy = functional.binary_cross_entropy_with_logits
    chance, own = guide[:, HEAT].sigmoid(), output[:, HEAT].detach().sigmoid()
    away = entropy(output[:, HEAT], chance, reduction="none")
    away = away - entropy(guide[:, HEAT], chance, reduction="none")
    centers = (target[:, HEAT] >= 0.999).sum().clamp(min=8)
    heat = (away * (chance - own).abs().clamp(min=0.02)).sum() / centers
    seen = chance * (chance > 0.2)
    count = seen.sum().clamp(min=8)
    radius = ((output[:, RADIUS] - guide[:, RADIUS]).abs() * seen).sum() / count
    offset = ((output[:, OFFSET] - guide[:, OFFSET]).abs().sum(dim=1) * seen).sum() / count
    mask = entropy(output[:, MASK], guide[:, MASK].sigmoid())
    return 3.0 * heat + 2.0 * radius + 0.5 * offset + mask
