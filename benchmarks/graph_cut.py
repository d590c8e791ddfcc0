"""The exact minimum of the Chan-Vese energy for given means, for tests and benchmarks.

It shares no code with the solvers: a graph cut (Boykov & Kolmogorov 2003) by PyMaxflow.
"""

from __future__ import annotations

import math

import maxflow
import numpy as np

from mushpipe.core.arrays import Bools, Singles

ROUNDS = 4  # of alternation, at most
AXIAL = np.array([[0, 0, 0], [0, 0, 1], [0, 1, 0]])
DIAGONAL = np.array([[0, 0, 0], [0, 0, 0], [1, 0, 1]])


def graph_cut(gray: Singles, initial: Bools, mu: float) -> Bools:
    """Return the region of least energy, alternating with its means from an initial region on.

    Args:
        gray: (H, W) in 0..1.
        initial: (H, W).
        mu: Weight of the length.
    """
    region = initial
    for _ in range(ROUNDS):
        if region.all() or not region.any():
            break
        c1, c2 = gray[region].mean(), gray[~region].mean()
        graph = maxflow.Graph[float]()
        nodes = graph.add_grid_nodes(gray.shape)
        weight = mu * math.pi / 8
        graph.add_grid_edges(nodes, weight, structure=AXIAL, symmetric=True)
        graph.add_grid_edges(nodes, weight / math.sqrt(2), structure=DIAGONAL, symmetric=True)
        graph.add_grid_tedges(nodes, (gray - c2) ** 2, (gray - c1) ** 2)
        graph.maxflow()
        new = ~graph.get_grid_segments(nodes)
        if (new == region).all():
            break
        region = new
    return region
