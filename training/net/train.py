"""Train `cap-net` and export it: `python -m training.net.train`.

Frames come from `training.net.scenes` (family a, deformed, seeds from 200 000 on); nothing real.
"""

from __future__ import annotations

import argparse
import copy
import math
import time
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from mushpipe.core.arrays import Singles
from training.net.augment import crop
from training.net.model import CapNet, loss_of
from training.net.scenes import TRAINING, TRAINING_SEED, Picture, pictures

SIZE, BATCH, RATE, DECAY, WARM_UP = 224, 8, 2.5e-3, 0.998, 100
NEAR = 0.3  # share of the crops that are taken around a cap

Batch = tuple[torch.Tensor, ...]


class Crops(IterableDataset[Batch]):
    """Batches from the frames without end, with a generator of their own in each process."""

    def __init__(
        self, frames: list[Picture], seed: int, stained: float, surfaces: bool, batch: int
    ) -> None:
        self._frames, self._seed, self._batch = frames, seed, batch
        self._stained, self._surfaces = stained, surfaces

    def __iter__(self) -> Iterator[Batch]:
        """Yield images, targets and weights."""
        worker = get_worker_info()
        rng = np.random.default_rng([self._seed, 9 + (worker.id if worker else 0)])
        while True:
            picks = rng.integers(len(self._frames), size=self._batch)
            rows = [self._cut(self._frames[k], rng) for k in picks]
            yield tuple(torch.from_numpy(np.stack(part)) for part in zip(*rows, strict=True))

    def _cut(self, frame: Picture, rng: np.random.Generator) -> tuple[Singles, Singles, Singles]:
        share = self._stained  # all or none takes no draw: seeds of `main` keep their crops
        stained = share == 1 or (share > 0 and rng.random() < share)
        return crop(frame, SIZE, rng, NEAR, stained, self._surfaces)


class Learner:
    """A network that learns, and the running mean of its weights.

    AdamW. The rate of learning and how fast the mean moves lie in tensors, so that a step may be a
    CUDA graph, which takes no numbers.

    Attributes:
        net: What learns.
        slow: The same with the mean of its weights; this one is used in the end.
    """

    def __init__(self, net: CapNet, rate: float, decay: float = DECAY) -> None:
        self.net = net.to(memory_format=torch.channels_last)
        self.slow = copy.deepcopy(self.net)
        self._most, self._decay = rate, decay
        self._weights = list(net.parameters())
        device = self._weights[0].device
        self._rate, self._away = torch.tensor(rate, device=device), torch.ones((), device=device)
        graph = device.type == "cuda"
        self._optimizer = torch.optim.AdamW(
            self._weights, self._rate, weight_decay=1e-3, capturable=graph, fused=graph
        )
        states = zip(self.slow.state_dict().values(), self.net.state_dict().values(), strict=True)
        self._pairs = [pair for pair in states if pair[0].is_floating_point()]

    def prepare(self, step: int, steps: int) -> None:
        """Set how much is learnt in a step: warm-up over `WARM_UP` steps, then a cosine to zero.

        The mean moves faster at the start.
        """
        cosine = 0.5 * (1 + math.cos(math.pi * step / steps))
        self._rate.fill_(self._most * cosine * min(1.0, (step + 1) / WARM_UP))
        self._away.fill_(1 - min(self._decay, (step + 1) / (10 + step)))

    def learn(self, loss: torch.Tensor) -> None:
        """Take a step."""
        self._optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self._weights, 5.0)
        self._optimizer.step()
        slow, fast = (list(each) for each in zip(*self._pairs, strict=True))
        with torch.no_grad():
            ways = torch._foreach_sub(fast, slow)
            torch._foreach_mul_(ways, self._away)
            torch._foreach_add_(slow, ways)


def train(learner: Learner, batches: Iterable[Batch], steps: int, out: Path) -> None:
    """Train a network and write the running mean of its weights, every hundred steps."""
    began, total = time.monotonic(), 0.0
    for step, (image, target, weight) in enumerate(islice(batches, steps)):
        learner.prepare(step, steps)
        output = learner.net(image.to(memory_format=torch.channels_last))
        loss = loss_of(output, target, weight)
        learner.learn(loss)
        total += loss.item()
        if step % 100 == 99:
            print(
                f"step {step + 1}: loss {total / 100:.3f}, {time.monotonic() - began:.0f} s",
                flush=True,
            )
            total = 0.0
            torch.save(learner.slow.state_dict(), out)


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
    frames = list(pictures(TRAINING_SEED, arguments.frames, arguments.cache))
    torch.manual_seed(arguments.seed)
    net = CapNet()
    if arguments.start:
        net.load_state_dict(torch.load(arguments.start))
    crops = Crops(frames, arguments.seed, float(arguments.stained), False, BATCH)
    batches = DataLoader(crops, batch_size=None, num_workers=1)  # cut by a process of its own
    learner = Learner(net, arguments.rate)
    train(learner, batches, arguments.steps, arguments.out)


if __name__ == "__main__":
    main()
