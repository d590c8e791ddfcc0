"""Train one of several networks on, towards the mean of all: `python -m training.net.joined`.

Networks of other seeds err elsewhere, and the mean of their maps is better than each of them. One
learns from it in twenty minutes on two cores (Hinton, Vinyals & Dean 2015, arXiv 1503.02531).
"""

from __future__ import annotations

import argparse
from itertools import islice
from pathlib import Path

import torch
from torch.utils.data import DataLoader

from training.net.model import CapNet, guided_loss, loss_of
from training.net.scenes import TRAINING_SEED, pictures
from training.net.taught import FRAMES, STAINED
from training.net.train import Crops, Learner

STEPS, BATCH, RATE, DECAY = 4011, 16, 1.2e-3, 0.995
SHARE = 0.7  # of the loss that comes from the mean


def network(path: Path) -> CapNet:
    """Return the network of a file of weights."""
    net = CapNet()
    net.load_state_dict(torch.load(path))
    net.to(memory_format=torch.channels_last)  # in place
    return net


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/net"), help="rendered frames")
    parser.add_argument("--weights", type=Path, nargs="+", required=True, help="first: who learns")
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--out", type=Path, default=Path("out/net/joined.pt"))
    arguments = parser.parse_args()
    frames = list(pictures(TRAINING_SEED, FRAMES, arguments.cache))
    batches = DataLoader(Crops(frames, 77, STAINED, True, BATCH), None, num_workers=1)
    guides = [network(path).eval() for path in arguments.weights]
    learner = Learner(network(arguments.weights[0]), RATE, DECAY)
    for step, (image, target, weight) in enumerate(islice(batches, arguments.steps)):
        image = image.to(memory_format=torch.channels_last)
        with torch.no_grad():
            guide = torch.stack([net(image) for net in guides]).mean(0)
        learner.prepare(step, arguments.steps)
        output = learner.net(image)
        own, led = loss_of(output, target, weight), guided_loss(output, guide, target)
        learner.learn((1 - SHARE) * own + SHARE * led)
        if step % 100 == 99:
            print(f"step {step + 1}: {own.item():.3f}, {led.item():.3f}", flush=True)
    torch.save(learner.slow.state_dict(), arguments.out)


if __name__ == "__main__":
    main()
