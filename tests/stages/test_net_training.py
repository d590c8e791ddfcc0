"""How `cap-net` learns: what Muon does to the weights it is given."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from training.net.model import CapNet  # noqa: E402
from training.net.muon import Muon, orthogonal  # noqa: E402
from training.net.train import optimizers  # noqa: E402


@pytest.mark.parametrize("shape", [(3, 8, 27), (2, 64, 32), (1, 96, 96)])
def test_an_update_keeps_the_directions_of_the_gradient_and_evens_their_sizes(
    shape: tuple[int, ...],
) -> None:
    gradient = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    u, size, v = torch.linalg.svd(gradient, full_matrices=False)
    found = u.mT @ orthogonal(gradient) @ v.mT  # diagonal, were it exactly so
    sizes = torch.diagonal(found, dim1=1, dim2=2)
    assert size.max() / size.min() > 1.5
    assert ((sizes > 0.5) & (sizes < 1.3)).all()
    assert (found - torch.diag_embed(sizes)).abs().max() < 1e-4


def test_a_step_turns_filters_and_matrices_alike_and_finds_a_least_square() -> None:
    torch.manual_seed(0)
    wanted = torch.randn(16, 4, 3, 3)
    weights = [
        torch.nn.Parameter(torch.zeros(16, 4, 3, 3)),
        torch.nn.Parameter(torch.zeros(16, 36)),
    ]
    optimizer = Muon(weights, 0.05)
    for _ in range(200):
        optimizer.zero_grad()
        sum(((each.reshape(wanted.shape) - wanted) ** 2).sum() for each in weights).backward()
        optimizer.step()
    for each in weights:
        assert (each.reshape(wanted.shape) - wanted).abs().max() < 0.2


def test_every_weight_has_one_optimizer() -> None:
    net = CapNet()
    muon, adam = (
        [id(p) for g in each.param_groups for p in g["params"]] for each in optimizers(net)
    )
    assert sorted(muon + adam) == sorted(id(p) for p in net.parameters())
    assert id(net.head[-1].weight) in adam
    assert id(net.head[-1].bias) in adam
    assert muon
