"""Symbolic Cholesky factorisation of a lattice's tangent stiffness: done once per topology, in plain Python.

The tangent is sparse in 3x3 blocks, one block row per point mass. A minimum-degree order takes the bars' inner masses first,
which condenses every bar onto its two nodes, and then the nodes. Beyond ``WHOLE`` cells nested dissection cuts the lattice into
such blocks (George 1973): their columns stay in the processor's cache, and the blocks between them fill less.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations

import numpy as np

from tensegrity_gym.lattice import Lattice
from tensegrity_gym.types import BlockPattern, Ints

#: Cells that are eliminated in one minimum-degree order.
WHOLE = 4


def couplings(cables: Ints, actuators: Ints, bars: Ints) -> set[tuple[int, int]]:
    """Pairs of masses that some member couples in the tangent: a hinge couples three masses in a row."""
    pairs = {(int(a), int(b)) for a, b in np.concatenate([cables, actuators])}
    for bar in bars:
        for reach in (1, 2):
            pairs |= {(int(a), int(b)) for a, b in zip(bar[:-reach], bar[reach:], strict=True)}
    return {(min(p), max(p)) for p in pairs}


def minimum_degree(
    n: int, pairs: set[tuple[int, int]], parts: list[list[int]] | None = None
) -> tuple[list[int], list[list[int]]]:
    """Elimination order of ``n`` vertices and, for each, its neighbours at elimination (the column's filled structure).

    ``parts``, a partition of the vertices, is eliminated part after part; the default is one part.
    """
    neighbours: list[set[int]] = [set() for _ in range(n)]
    for a, b in pairs:
        neighbours[a].add(b)
        neighbours[b].add(a)
    order, columns = [], []
    for part in parts or [list(range(n))]:
        left = set(part)
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


def dissection(lattice: Lattice, bar_segments: int) -> list[list[int]]:
    """Masses in the parts that nested dissection eliminates one after another: blocks of cells, each cut after its halves.

    A cut along cells separates, because every member lies in one cell: its masses are those that cells on both sides share.
    """
    low = np.full((lattice.mass_count(bar_segments), 2), np.iinfo(np.int64).max)
    high = np.full_like(low, -1)
    inner = _inner_masses(lattice, bar_segments).reshape(lattice.n_cells, -1)
    for cell, place in enumerate(lattice.cells):
        for masses in (lattice.cell_node_indices(cell), lattice.actuators[cell], inner[cell]):
            low[masses], high[masses] = np.minimum(low[masses], place), np.maximum(high[masses], place)

    def cut(masses: Ints, corner: tuple[int, int], size: tuple[int, int]) -> list[list[int]]:
        if size[0] * size[1] <= WHOLE:
            return [masses.tolist()]
        axis = int(size[1] > size[0])
        half = size[axis] // 2
        middle = corner[axis] + half
        first, second = high[masses, axis] < middle, low[masses, axis] >= middle
        far_corner = (middle, corner[1]) if axis == 0 else (corner[0], middle)
        sizes = [(s, size[1]) if axis == 0 else (size[0], s) for s in (half, size[axis] - half)]
        return [
            *cut(masses[first], corner, sizes[0]),
            *cut(masses[second], far_corner, sizes[1]),
            masses[~first & ~second].tolist(),
        ]

    return cut(np.arange(len(low), dtype=np.int64), (0, 0), (lattice.nx, lattice.ny))


def block_pattern(cables: Ints, actuators: Ints, bars: Ints, n_masses: int, parts: list[list[int]] | None = None) -> BlockPattern:
    """Slots of the factor's blocks and the list of updates that a right-looking factorisation makes.

    ``parts`` of the masses are eliminated one after another, each in minimum-degree order.
    """
    order, columns = minimum_degree(n_masses, couplings(cables, actuators, bars), parts)
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


def _inner_masses(lattice: Lattice, bar_segments: int) -> Ints:
    """The masses between each bar's ends, shape (n_bars, bar_segments - 1)."""
    first = lattice.n_nodes + 2 * lattice.n_cells
    return first + np.arange((bar_segments - 1) * len(lattice.bars), dtype=np.int64).reshape(len(lattice.bars), -1)


@lru_cache(maxsize=32)
def lattice_pattern(lattice: Lattice, bar_segments: int) -> BlockPattern:
    """Block pattern of a lattice with bars of ``bar_segments`` segments, computed once."""
    bars = np.column_stack([lattice.bars[:, 0], _inner_masses(lattice, bar_segments), lattice.bars[:, 1]])
    parts = dissection(lattice, bar_segments)
    return block_pattern(lattice.cables, lattice.actuators, bars, lattice.mass_count(bar_segments), parts)
