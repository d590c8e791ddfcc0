"""Train the `cap-net` that ships, taught by a large network: `python -m training.net.taught`.

Small networks of several seeds and the large one learn at once, from the same crops. A large
network finds in simulated beds what a small one does not, and its maps tell the small ones more
than the truth does (Hinton, Vinyals & Dean 2015, arXiv 1503.02531). It takes eleven minutes on an
NVIDIA H200 beside 15 cores that cut crops; without a GPU it runs too, for days.
`python -m training.net.train` is the training for two cores.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from training.net.model import LARGE, SMALL, CapNet, Plan, guided_loss, loss_of
from training.net.scenes import TRAINING_SEED, pictures
from training.net.train import Batch, Crops, Learner

FRAMES, STEPS, BATCH = 2000, 37352, 32
RATE, LARGE_RATE, DECAY = 4e-3, 2e-3, 0.999
STAINED = 0.5  # share of the crops
SHARE = 0.6  # of the loss that comes from the large network in the end
SEEDS = 3
SHOWN = 400  # steps from one line to the next


class NarrowCrops(Crops):
    """Crops in fewer bytes, since they go from many processes to one: 8 bits, targets 16."""

    def __iter__(self) -> Iterator[Batch]:
        """Yield images, targets and weights."""
        for image, target, weight in super().__iter__():
            yield (255 * image).round().byte(), target.half(), weight.byte()


def share_at(done: float) -> float:
    """Return how much the large network counts once a part of the training is done, 0 at first."""
    return min(SHARE, max(0.0, 3 * (done - 0.1)))


class Lesson:
    """A step of the large network and of the small ones, each of which could run by itself.

    Attributes:
        learners: The large network and the small ones.
        losses: Sums of their losses.
    """

    def __init__(self, large: Learner, small: list[Learner], batch: Batch, device: str) -> None:
        self.learners = [large, *small]
        large.slow.eval()
        self._batch = [part.to(device) for part in batch]  # its memory is that of all batches
        self._share = torch.zeros((), device=device)
        self.losses = torch.zeros(len(self.learners), device=device)
        self._streams = [torch.cuda.Stream() for _ in self.learners] if device == "cuda" else []
        self._take = self._graph() if self._streams else self._step

    def take(self, batch: Batch, step: int, steps: int) -> None:
        """Learn from a batch."""
        for own, part in zip(self._batch, batch, strict=True):
            own.copy_(part, non_blocking=True)
        for learner in self.learners:
            learner.prepare(step, steps)
        self._share.fill_(share_at(step / steps))
        self._take()

    def _step(self) -> list[Tensor]:
        """Let all learn, and return what must not be freed before they have."""
        image, target, weight = (part.float() for part in self._batch)
        image = (image / 255).to(memory_format=torch.channels_last)
        with torch.no_grad():
            guide = self.learners[0].slow(image)
        losses, used = [], [image, target, weight, guide]
        for number, learner in enumerate(self.learners):
            with self._aside(number):
                output = learner.net(image)
                own = led = loss_of(output, target, weight)
                if number:
                    led = guided_loss(output, guide, target)
                    led = (1 - self._share) * own + self._share * led
                learner.learn(led)
                losses.append(own.detach())
                used += [output, own, led]
        for stream in self._streams:
            torch.cuda.current_stream().wait_stream(stream)
        self.losses += torch.stack(losses)
        return used

    def _aside(self, number: int) -> torch.cuda.StreamContext:
        """Return a context in which one network learns beside the others; without a GPU none."""
        stream = self._streams[number] if self._streams else None
        if stream:
            stream.wait_stream(torch.cuda.current_stream())
        return torch.cuda.stream(stream)

    def _graph(self) -> Callable[[], None]:
        """Return the step as a CUDA graph: its thousands of kernels start at once."""
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            for _ in range(3):  # a graph needs algorithms that were chosen
                self._step()
        torch.cuda.current_stream().wait_stream(aside)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self._used = self._step()
        replay: Callable[[], None] = graph.replay
        return replay


def teach(lesson: Lesson, batches: Iterable[Batch], steps: int, out: list[Path]) -> None:
    """Train all and write the running means of the small ones' weights now and then."""
    began = time.monotonic()
    for step, batch in enumerate(islice(batches, steps)):
        lesson.take(batch, step, steps)
        if step % SHOWN == SHOWN - 1 or step == steps - 1:
            mean = (lesson.losses / (step % SHOWN + 1)).tolist()
            losses = ", ".join(f"{value:.3f}" for value in mean)
            print(f"step {step + 1}: {losses}, {time.monotonic() - began:.0f} s", flush=True)
            lesson.losses.zero_()
            for path, learner in zip(out, lesson.learners[1:], strict=True):
                state = learner.slow.state_dict()
                torch.save({name: one.cpu() for name, one in state.items()}, path)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("out/net"), help="rendered frames")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--workers", type=int, default=15, help="processes that cut crops")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="how many small networks")
    parser.add_argument("--out", type=Path, default=Path("out/net"), help="for taught-SEED.pt")
    arguments = parser.parse_args()
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = True
    torch.backends.cudnn.benchmark = True
    frames = list(pictures(TRAINING_SEED, arguments.frames, arguments.cache))
    crops = NarrowCrops(frames, 0, STAINED, True, BATCH)
    pinned = arguments.device == "cuda"
    batches = iter(DataLoader(crops, None, num_workers=arguments.workers, pin_memory=pinned))
    first = next(batches)  # before CUDA: its processes are forks of this one

    def learner(plan: Plan, rate: float, seed: int) -> Learner:
        torch.manual_seed(seed)
        return Learner(CapNet(plan).to(arguments.device), rate, DECAY)

    seeds = range(arguments.seeds)
    small = [learner(SMALL, RATE, seed) for seed in seeds]
    lesson = Lesson(learner(LARGE, LARGE_RATE, 0), small, first, arguments.device)
    paths = [arguments.out / f"taught-{seed}.pt" for seed in seeds]
    teach(lesson, batches, arguments.steps, paths)


if __name__ == "__main__":
    main()
