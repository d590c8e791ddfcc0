"""Train `cap-net` on at tables with few caps and much else: `python -m training.net.tables`.

In the crops of the training hardly a colour or a shade is left as it was, so that a network looks
for what no bed changes. At a table that leaves too little: what tells a cap from a cup is how light
falls off towards its rim, and its colour. So here tables, and beds beside them, are seen in plain
light in most crops. Beds stay what they were: in their crops the network is held to the maps it
began with (Li & Hoiem 2016, Learning without forgetting, arXiv 1606.09282).
"""

from __future__ import annotations

import argparse
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import DataLoader

from mushpipe.core.arrays import Singles
from training.net.augment import crop
from training.net.model import guided_loss, loss_of
from training.net.restored import give_norms, restored
from training.net.scenes import CLUTTERED, FAMILIAR, Picture, picture, settings
from training.net.taught import STAINED
from training.net.train import NEAR, SIZE, Crops, Learner

STEPS, RATE = 5500, 1.2e-3
KEPT = (3000, 4500)  # steps after which weights are kept as well; the network is the mean of all
ALTERED, PLAIN, TABLES = 6, 3, 7  # crops of a step: beds in any light, in plain light; tables
LIGHT = 0.6  # share of the latter two in plain light
SHARE = 0.7  # of the loss at beds that comes from the maps of the network it began with
MEASURED = 40  # batches, for the batch norms


class PlainCrops(Crops):
    """Crops of which most look as a camera shows them."""

    def _cut(self, frame: Picture, rng: np.random.Generator) -> tuple[Singles, Singles, Singles]:
        return crop(frame, SIZE, rng, NEAR, plain=LIGHT)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/net"), help="rendered frames")
    parser.add_argument("--start", type=Path, required=True, help="ONNX file to go on from")
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--out", type=Path, default=Path("out/net/tables.pt"))
    arguments = parser.parse_args()
    at_beds = [seed for seed in FAMILIAR if settings(seed)["scene"] == "bed"]
    beds = [picture(seed, arguments.cache) for seed in at_beds]
    tables = [
        picture(seed, arguments.cache) for seed in FAMILIAR + CLUTTERED if seed not in at_beds
    ]
    sources = (
        Crops(beds, 77, STAINED, True, ALTERED),
        PlainCrops(beds, 79, 0, False, PLAIN),
        PlainCrops(tables, 78, 0, False, TABLES),
    )
    streams = [iter(DataLoader(source, None, num_workers=1)) for source in sources]
    batches = (
        [torch.cat(part) for part in zip(*each, strict=True)] for each in zip(*streams, strict=True)
    )
    guide, net = (restored(arguments.start) for _ in range(2))
    guide.to(memory_format=torch.channels_last)
    give_norms(net, (image for image, *_ in islice(batches, MEASURED)))
    net.train()
    held, rest = slice(ALTERED + PLAIN), slice(ALTERED + PLAIN, None)
    learner = Learner(net, RATE)
    for step, (image, target, weight) in enumerate(islice(batches, arguments.steps)):
        image = image.to(memory_format=torch.channels_last)
        with torch.no_grad():
            maps = guide(image[held])
        learner.prepare(step, arguments.steps)
        output = learner.net(image)
        own = loss_of(output[held], target[held], weight[held])
        led = guided_loss(output[held], maps, target[held])
        seen = loss_of(output[rest], target[rest], weight[rest])
        learner.learn((1 - SHARE) * own + SHARE * led + seen)
        if step % 100 == 99:
            print(f"step {step + 1}: {led.item():.3f}, {seen.item():.3f}", flush=True)
        if step + 1 in (*KEPT, arguments.steps):
            path = arguments.out.with_stem(f"{arguments.out.stem}-{step + 1}")
            torch.save(learner.slow.state_dict(), path)


if __name__ == "__main__":
    main()
