"""Train `cap-net` and export it: `python -m training.net.train`.

Frames come from `training.net.scenes` (family a, deformed, seeds from 200 000 on); nothing real.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, IterableDataset

from training.net.augment import crop
from training.net.model import CapNet, loss_of
from training.net.scenes import TRAINING, TRAINING_SEED, Picture, picture

SIZE, BATCH, RATE, DECAY = 224, 8, 2.5e-3, 0.998
NEAR = 0.3  # share of the crops that are taken around a cap

Batch = tuple[torch.Tensor, ...]


class Crops(IterableDataset[Batch]):
    """Batches from the frames without end, with a generator of their own."""

    def __init__(self, frames: list[Picture], seed: int, stained: bool) -> None:
        self._frames, self._seed, self._stained = frames, seed, stained

    def __iter__(self) -> Iterator[Batch]:
        """Yield images, targets and weights."""
        rng = np.random.default_rng([self._seed, 9])
        while True:
            picks = rng.integers(len(self._frames), size=BATCH)
            rows = [crop(self._frames[k], SIZE, rng, NEAR, self._stained) for k in picks]
            yield tuple(torch.from_numpy(np.stack(part)) for part in zip(*rows, strict=True))


def averaged(slow: nn.Module, fast: nn.Module, step: int) -> None:
    """Move the running mean of the weights towards the current ones, faster at the start."""
    keep = min(DECAY, (1 + step) / (10 + step))
    with torch.no_grad():
        for a, b in zip(slow.state_dict().values(), fast.state_dict().values(), strict=True):
            if a.is_floating_point():
                a.lerp_(b, 1 - keep)
            else:
                a.copy_(b)


def train(net: CapNet, batches: Iterable[Batch], steps: int, rate: float, out: Path) -> None:
    """Train a network and write the running mean of its weights, every hundred steps.

    AdamW with a linear warm-up over 100 steps and a cosine to zero.
    """
    net = net.to(memory_format=torch.channels_last)
    slow = copy.deepcopy(net)
    optimizer = torch.optim.AdamW(net.parameters(), rate, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer,
        lambda k: min(1.0, (k + 1) / 100) * 0.5 * (1 + np.cos(np.pi * k / steps)),
    )
    began, total = time.monotonic(), 0.0
    for step, (image, target, weight) in enumerate(islice(batches, steps)):
        output = net(image.to(memory_format=torch.channels_last))
        loss = loss_of(output, target, weight)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 5.0)
        optimizer.step()
        schedule.step()
        averaged(slow, net, step)
        total += loss.item()
        if step % 100 == 99:
            print(
                f"step {step + 1}: loss {total / 100:.3f}, {time.monotonic() - began:.0f} s",
                flush=True,
            )
            total = 0.0
            torch.save(slow.state_dict(), out)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/net"), help="rendered frames")
    parser.add_argument("--frames", type=int, default=TRAINING)
    parser.add_argument("--steps", type=int, default=12000)
    parser.add_argument("--rate", type=float, default=RATE, help="largest learning rate")
    parser.add_argument("--stained", action="store_true", help="blotched and overexposed as well")
    parser.add_argument("--start", type=Path, help="weights to go on from")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/net/cap-net.pt"))
    arguments = parser.parse_args()
    seeds = range(TRAINING_SEED, TRAINING_SEED + arguments.frames)
    frames = [picture(seed, arguments.cache) for seed in seeds]
    torch.manual_seed(arguments.seed)
    net = CapNet()
    if arguments.start:
        net.load_state_dict(torch.load(arguments.start))
    crops = Crops(frames, arguments.seed, arguments.stained)
    batches = DataLoader(crops, batch_size=None, num_workers=1)  # cut by a process of its own
    train(net, batches, arguments.steps, arguments.rate, arguments.out)


if __name__ == "__main__":
    main()
