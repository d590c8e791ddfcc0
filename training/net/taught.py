"""Train the `cap-net` that ships, taught by a large network: `python -m training.net.taught`.

Both learn at once, from the same crops. A large network finds in simulated beds what a small one
does not, and its maps tell the small one more than the truth does (Hinton, Vinyals & Dean 2015,
arXiv 1503.02531). It takes ten minutes on an NVIDIA H200 beside 15 cores that cut crops; without a
GPU it runs too, for days. `python -m training.net.train` is the training for two cores.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import torch
from torch.utils.data import DataLoader

from training.net.model import LARGE, SMALL, CapNet, guided_loss, loss_of
from training.net.scenes import TRAINING_SEED, pictures
from training.net.train import Batch, Crops, Learner

FRAMES, STEPS, BATCH = 1000, 19772, 32
RATE, LARGE_RATE, DECAY = 4e-3, 2e-3, 0.999
STAINED = 0.5  # share of the crops
SHARE = 0.6  # of the loss that comes from the large network in the end


def share_at(done: float) -> float:
    """Return how much the large network counts once a part of the training is done, 0 at first."""
    return min(SHARE, max(0.0, 3 * (done - 0.1)))


def teach(
    small: Learner, large: Learner, batches: Iterable[Batch], steps: int, out: Path, device: str
) -> None:
    """Train both and write the running mean of the small one's weights now and then."""
    began, total = time.monotonic(), torch.zeros(2, device=device)
    large.slow.eval()
    for step, batch in enumerate(islice(batches, steps)):
        image, target, weight = (each.to(device, non_blocking=True) for each in batch)
        image, share = image.to(memory_format=torch.channels_last), share_at(step / steps)
        with torch.no_grad():
            guide = large.slow(image)
        hard = loss_of(large.net(image), target, weight)
        large.learn(hard)
        output = small.net(image)
        own = loss_of(output, target, weight)
        small.learn((1 - share) * own + share * guided_loss(output, guide, target))
        total += torch.stack([hard, own]).detach()
        if step % 100 == 99 or step == steps - 1:
            losses = ", ".join(f"{value:.3f}" for value in (total / (step % 100 + 1)).tolist())
            print(f"step {step + 1}: {losses}, {time.monotonic() - began:.0f} s", flush=True)
            total.zero_()
            torch.save({name: one.cpu() for name, one in small.slow.state_dict().items()}, out)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/net"), help="rendered frames")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--workers", type=int, default=15, help="processes that cut crops")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/net/taught.pt"))
    arguments = parser.parse_args()
    torch.backends.cudnn.allow_tf32 = torch.backends.cudnn.benchmark = True
    torch.manual_seed(arguments.seed)
    frames = list(pictures(TRAINING_SEED, arguments.frames, arguments.cache))
    crops = Crops(frames, arguments.seed, STAINED, True, BATCH)
    batches = DataLoader(crops, batch_size=None, num_workers=arguments.workers)
    small, large = (
        Learner(CapNet(plan).to(arguments.device), arguments.steps, rate, DECAY)
        for plan, rate in ((SMALL, RATE), (LARGE, LARGE_RATE))
    )
    teach(small, large, batches, arguments.steps, arguments.out, arguments.device)


if __name__ == "__main__":
    main()
