"""Read a `cap-net` back out of its ONNX file, for training to go on from it."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from training.net.model import CapNet


def restored(path: Path) -> CapNet:
    """Return the network of a file.

    There, batch norms are part of the convolutions before them; here they only shift.
    """
    net = CapNet()
    net.eval()
    graph = onnx.load(path).graph
    weights = {each.name: torch.tensor(numpy_helper.to_array(each)) for each in graph.initializer}
    stored = [node.input for node in graph.node if node.op_type == "Conv"]
    norms = _norms(net)
    with torch.no_grad():
        for conv, (_, kernel, shift) in zip(_in_order(net), stored, strict=True):
            conv.weight.copy_(weights[kernel])
            if (norm := norms.get(conv)) is None:
                conv.bias.copy_(weights[shift])
            else:
                norm.running_var.fill_(1 - norm.eps)
                norm.bias.copy_(weights[shift])
    return net


def give_norms(net: CapNet, images: Iterable[Tensor]) -> None:
    """Let the batch norms of a restored network, in place, take away what flows through it.

    Each gets mean and spread of these images, and the scale and shift by which the network computes
    what it did.
    """
    sums: dict[nn.Module, Tensor] = {}

    def add(norm: nn.Module, values: tuple[Tensor, ...]) -> None:
        x = values[0].double()
        sums[norm] = sums.get(norm, 0) + torch.stack([torch.ones_like(x), x, x * x]).sum((1, 3, 4))

    norms = _norms(net).values()
    hooks = [norm.register_forward_pre_hook(add) for norm in norms]
    with torch.no_grad():
        for image in images:
            net(image)
        for norm in norms:
            count, first, second = sums[norm]
            mean = first / count
            norm.running_mean.copy_(mean)
            norm.running_var.copy_(second / count - mean**2)
            norm.weight.copy_((norm.running_var + norm.eps).sqrt())
            norm.bias.add_(norm.running_mean)
    for hook in hooks:
        hook.remove()


def _norms(net: CapNet) -> dict[nn.Module, nn.BatchNorm2d]:
    """Return the batch norm after each convolution that has one."""
    return {
        conv: norm
        for part in net.modules()
        if isinstance(part, nn.Sequential)
        for conv, norm in pairwise(part)
        if isinstance(norm, nn.BatchNorm2d)
    }


def _in_order(net: CapNet) -> list[nn.Conv2d]:
    """Return the convolutions in the order they are computed in, which is that of the file."""
    order: list[nn.Conv2d] = []
    convs = [part for part in net.modules() if isinstance(part, nn.Conv2d)]
    hooks = [conv.register_forward_pre_hook(lambda one, _: order.append(one)) for conv in convs]
    with torch.no_grad():
        net(torch.zeros(1, 3, 64, 96))
    for hook in hooks:
        hook.remove()
    return order
