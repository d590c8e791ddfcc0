"""Train a `cap-net` on with late beds and worn caps: `python -m training.net.refined`.

It keeps what it knows: it learns towards its own maps of the same crops without the wear (Xie et
al. 2020, Self-training with Noisy Student, arXiv 1911.04252), but for cells where the truth says
otherwise, such as fresh stumps; and the mean of its weights before and after is what is written. An
hour on two cores, rendering included.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn
from torch.utils.data import DataLoader

from mushpipe.core.arrays import Singles
from mushpipe.stages.cap_decode import HEAT
from training.net.augment import crop
from training.net.export import mean
from training.net.model import CapNet, guided_loss, loss_of
from training.net.scenes import REFINING, Picture, pictures
from training.net.taught import STAINED
from training.net.train import NEAR, SIZE, Batch, Crops, Learner

STEPS, BATCH, RATE, DECAY = 5000, 16, 1e-3, 0.998
SHARE = 0.5  # of the loss that comes from the network as it was


class Pairs(Crops):
    """Batches of crops without wear and with it."""

    def _cut(self, frame: Picture, rng: np.random.Generator) -> tuple[Singles, ...]:
        stained = rng.random() < self._stained
        before = crop(frame, SIZE, copy.deepcopy(rng), NEAR, stained, True)[0]
        return (before, *crop(frame, SIZE, rng, NEAR, stained, True, late=True))


def opened(path: Path, batch: Tensor) -> CapNet:
    """Return the network of an ONNX file, to be trained on.

    Batch norms were made part of the convolutions: they get back the mean and variance that what
    they see has in a batch (B, 3, H, W), and undo them.
    """
    net = CapNet()
    net.eval()
    weights = {each.name: each for each in onnx.load(path).graph.initializer}
    nodes = [node for node in onnx.load(path).graph.node if node.op_type == "Conv"]
    layers = _in_order(net, batch[:1])
    for node, (layer, norm) in zip(nodes, layers, strict=True):
        weight, bias = (torch.tensor(numpy_helper.to_array(weights[k])) for k in node.input[1:])
        layer.weight.data.copy_(weight)
        if norm is None and layer.bias is not None:
            layer.bias.data.copy_(bias)
        elif norm is not None:
            norm.bias.data.copy_(bias)
            norm.running_var.fill_(1 - norm.eps)
    seen = [norm.register_forward_hook(_unfold) for _, norm in layers if norm is not None]
    with torch.no_grad():
        net(batch)
    for hook in seen:
        hook.remove()
    net.to(memory_format=torch.channels_last)  # in place
    return net


def _in_order(net: CapNet, image: Tensor) -> list[tuple[nn.Conv2d, nn.BatchNorm2d | None]]:
    """Return convolutions as they are computed, each with the batch norm right after it."""
    order: list[nn.Module] = []
    kinds = (nn.Conv2d, nn.BatchNorm2d)
    hooks = [
        module.register_forward_hook(lambda module, *_: order.append(module))
        for module in net.modules() if isinstance(module, kinds)
    ]  # fmt: skip
    with torch.no_grad():
        net(image)
    for hook in hooks:
        hook.remove()
    after = [*order[1:], None]
    return [
        (layer, norm if isinstance(norm, nn.BatchNorm2d) else None)
        for layer, norm in zip(order, after, strict=True) if isinstance(layer, nn.Conv2d)
    ]  # fmt: skip


def _unfold(norm: nn.BatchNorm2d, seen: tuple[Tensor], _: Tensor) -> None:
    """Let a batch norm say the same by way of mean and variance of what it has seen."""
    mean, variance = seen[0].mean((0, 2, 3)), seen[0].var((0, 2, 3)) + norm.eps
    norm.bias.data.add_(mean)
    norm.weight.data.copy_(variance.sqrt())
    norm.running_mean.copy_(mean)
    norm.running_var.copy_(variance - norm.eps)


def without_errors(guide: Tensor, output: Tensor, target: Tensor) -> Tensor:
    """Return a guide (B, 5, h, w) that says nothing of heat where it contradicts the target."""
    wrong = (guide[:, HEAT].sigmoid() - target[:, HEAT]).abs() > 0.5
    led = guide.clone()
    led[:, HEAT] = torch.where(wrong, output[:, HEAT].detach(), guide[:, HEAT])
    return led


def batches(cache: Path) -> Iterator[Batch]:
    """Yield crops without and with wear, target and weight, without end."""
    frames = list(chain(*(pictures(first, count, cache) for first, count in REFINING.items())))
    yield from DataLoader(Pairs(frames, 78, STAINED, True, BATCH), None, num_workers=1)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/net"), help="rendered frames")
    parser.add_argument("--start", type=Path, required=True, help="ONNX file to go on from")
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--out", type=Path, default=Path("out/net/refined.pt"))
    arguments = parser.parse_args()
    crops = batches(arguments.cache)
    guide = opened(arguments.start, torch.cat([next(crops)[0] for _ in range(8)]))
    learner = Learner(copy.deepcopy(guide), RATE, DECAY)
    for step, batch in enumerate(islice(crops, arguments.steps)):
        before, image, target, weight = batch
        with torch.no_grad():
            known = guide(before.to(memory_format=torch.channels_last))
        learner.prepare(step, arguments.steps)
        output = learner.net.train()(image.to(memory_format=torch.channels_last))
        own = loss_of(output, target, weight)
        led = guided_loss(output, without_errors(known, output, target), target)
        learner.learn((1 - SHARE) * own + SHARE * led)
        if step % 100 == 99:
            print(f"step {step + 1}: {own.item():.3f}, {led.item():.3f}", flush=True)
    torch.save(mean([learner.slow.state_dict(), guide.state_dict()]), arguments.out)


if __name__ == "__main__":
    main()
