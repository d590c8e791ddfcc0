"""Pairs of two sets: how far they are from each other, and which belong together."""

from __future__ import annotations

import numpy as np

from mushpipe.core.arrays import Floats, Rows
from mushpipe.core.jit import jit


@jit
def distances(a: Floats, b: Floats) -> Floats:
    """Return the distance (N, M) of each point in a (N, D) from each in b (M, D)."""
    apart = np.empty((len(a), len(b)))
    for i in range(len(a)):
        for j in range(len(b)):
            total = 0.0
            for k in range(a.shape[1]):
                total += (a[i, k] - b[j, k]) ** 2
            apart[i, j] = np.sqrt(total)
    return apart


@jit
def assigned(cost: Floats) -> Rows:
    """Return the column (N,) of each row of cost (N, M), M >= N, at the least total cost.

    By shortest augmenting paths (Jonker & Volgenant 1987): one row after the other takes the column
    to which the cheapest chain of exchanges leads. Infinite is the cost where a row and a column do
    not go together; there must be a way without.
    """
    n, m = cost.shape
    owner = np.full(m, -1)  # row of each column
    row_price, price = np.zeros(n), np.zeros(m)
    length, before = np.empty(m), np.empty(m, np.int64)  # of the cheapest chain to each column
    settled = np.empty(m, np.bool_)
    for first in range(n):
        for j in range(m):
            length[j], before[j], settled[j] = np.inf, -1, False
        row, column, so_far = first, -1, 0.0
        while row >= 0:
            nearest, least = -1, np.inf
            for j in range(m):
                if not settled[j]:
                    chain = so_far + cost[row, j] - row_price[row] - price[j]
                    if chain < length[j]:
                        length[j], before[j] = chain, column
                    if length[j] < least:
                        nearest, least = j, length[j]
            column, so_far = nearest, least
            settled[column] = True
            row = owner[column]
        row_price[first] += so_far
        for j in range(m):
            if settled[j] and j != column:
                row_price[owner[j]] += so_far - length[j]
                price[j] -= so_far - length[j]
        while before[column] >= 0:
            owner[column] = owner[before[column]]
            column = before[column]
        owner[column] = first
    columns = np.empty(n, np.int64)
    for j in range(m):
        if owner[j] >= 0:
            columns[owner[j]] = j
    return columns
