"""Symbolic Cholesky factorisation of a lattice's tangent stiffness: done once per topology, in plain Python.

The tangent is sparse in 3x3 blocks, one block row per point mass. A minimum-degree order takes the bars' inner masses first,
which condenses every bar onto its two nodes, and then the nodes.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations

import numpy as np

from tensegrity_gym.lattice import Lattice
from tensegrity_gym.types import BlockPattern, Ints


def couplings(cables: Ints, actuators: Ints, bars: Ints) -> set[tuple[int, int]]:
    """Pairs of masses that some member couples in the tangent: a hinge couples three masses in a row."""
    pairs = {(int(a), int(b)) for a, b in np.concatenate([cables, actuators])}
    for bar in bars:
        for reach in (1, 2):
            pairs |= {(int(a), int(b)) for a, b in zip(bar[:-reach], bar[reach:], strict=True)}
    return {(min(p), max(p)) for p in pairs}


def minimum_degree(n: int, pairs: set[tuple[int, int]]) -> tuple[list[int], list[list[int]]]:
    """Elimination order of ``n`` vertices and, for each, its neighbours at elimination (the column's filled structure)."""
    neighbours: list[set[int]] = [set() for _ in range(n)]
    for a, b in pairs:
        neighbours[a].add(b)
        neighbours[b].add(a)
    left = set(range(n))
    order, columns = [], []
    while left:
        vertex = min(left, key=lambda v: (len(neighbours[v]), v))
        around = sorted(neighbours[vertex])
        order.append(vertex)
        columns.append(around)
        left.remove(vertex)
        for a in around:
            neighbours[a].discard(vertex)
        for a, b in combinations(around, 2):
            neighbours[a].add(b)
            neighbours[b].add(a)
    return order, columns


def block_pattern(cables: Ints, actuators: Ints, bars: Ints, n_masses: int) -> BlockPattern:
    """Slots of the factor's blocks and the list of updates that a right-looking factorisation makes."""
    order, columns = minimum_degree(n_masses, couplings(cables, actuators, bars))
    position = np.empty(n_masses, dtype=np.int64)
    position[order] = np.arange(n_masses)
    rows = [sorted(column, key=lambda v: position[v]) for column in columns]
    starts = np.concatenate([[0], np.cumsum([len(r) for r in rows])]).astype(np.int64) + n_masses
    slot = {(v, v): v for v in range(n_masses)}
    for k, vertex in enumerate(order):
        for offset, row in enumerate(rows[k]):
            slot[row, vertex] = int(starts[k]) + offset
    targets = [slot[b, a] for k in range(n_masses) for i, b in enumerate(rows[k]) for a in rows[k][: i + 1]]

    def located(a: int, b: int) -> tuple[int, int]:
        return (slot[a, b], 0) if (a, b) in slot else (slot[b, a], 1)

    return BlockPattern(
        order=np.array(order, dtype=np.int64),
        starts=starts,
        rows=np.array([r for column in rows for r in column], dtype=np.int64),
        targets=np.array(targets, dtype=np.int64),
        cable_slots=np.array([located(int(a), int(b))[0] for a, b in cables], dtype=np.int64),
        actuator_slots=np.array([located(int(a), int(b))[0] for a, b in actuators], dtype=np.int64),
        near_slots=_bar_slots(bars, 1, located),
        far_slots=_bar_slots(bars, 2, located),
    )


def _bar_slots(bars: Ints, reach: int, located) -> Ints:  # type: ignore[no-untyped-def]
    """(slot, transposed) of the block between masses j and j + reach of each bar, shape (n_bars, segments - reach + 1, 2)."""
    found = [[located(int(a), int(b)) for a, b in zip(bar[:-reach], bar[reach:], strict=True)] for bar in bars]
    return np.array(found, dtype=np.int64).reshape(len(bars), -1, 2)


@lru_cache(maxsize=32)
def lattice_pattern(lattice: Lattice, bar_segments: int) -> BlockPattern:
    """Block pattern of a lattice with bars of ``bar_segments`` segments, computed once."""
    first = lattice.n_nodes + 2 * lattice.n_cells
    inner = first + np.arange((bar_segments - 1) * len(lattice.bars), dtype=np.int64).reshape(len(lattice.bars), -1)
    bars = np.column_stack([lattice.bars[:, 0], inner, lattice.bars[:, 1]])
    return block_pattern(lattice.cables, lattice.actuators, bars, lattice.mass_count(bar_segments))
