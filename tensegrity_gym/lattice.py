"""Topology of lattices of truncated-octahedron tensegrity cells, built by reflection.

Source: Garanger et al. 2020 (arXiv 2003.10999), section II. A cell has the 24 permutations of (0, +-1, +-2) as nodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import permutations, product

import numpy as np
from numpy.typing import ArrayLike

from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.types import Floats, Ints

Node = tuple[int, int, int]

#: Outward unit normals of the six square faces.
FACES: tuple[Node, ...] = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))


def cell_nodes() -> list[Node]:
    """The 24 nominal nodes of one cell, sorted: all permutations of (0, +-1, +-2)."""
    return sorted({(x, y, z) for s, t in product((1, -1), repeat=2) for x, y, z in permutations((0, s, 2 * t))})


def cell_bars(chirality: int) -> list[tuple[Node, Node]]:
    """The 12 bars of one cell: for adjacent square faces a, b, from 2a + chi (a x b) to 2b - chi (a x b)."""
    bars = []
    for i, a in enumerate(FACES):
        for b in FACES[i + 1 :]:
            if np.dot(a, b) == 0:
                side = chirality * np.cross(a, b)
                ends = (2 * np.array(a) + side, 2 * np.array(b) - side)
                bars.append(tuple(tuple(int(c) for c in end) for end in ends))
    return bars  # type: ignore[return-value]


@dataclass(frozen=True)
class Lattice:
    """A flat lattice of ``nx`` by ``ny`` cells; neighbours are mirror images through the square face they share.

    Cells are numbered along a snake (0,0), (1,0), ..., then back through the next row, so that consecutive cells are
    neighbours and chirality alternates with the number: the 2x2 lattice is numbered around its square.
    """

    nx: int = 2
    ny: int = 2

    def __post_init__(self) -> None:
        for name in ("nx", "ny"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
                raise InvalidParameterError(f"Lattice.{name}: expected an integer >= 1, got {value!r}; e.g. Lattice(2, 2)")

    @cached_property
    def cells(self) -> Ints:
        """Grid position (i, j) of each cell in snake order, shape (n_cells, 2)."""
        order = [(i if j % 2 == 0 else self.nx - 1 - i, j) for j in range(self.ny) for i in range(self.nx)]
        return np.array(order, dtype=np.int64)

    @cached_property
    def chirality(self) -> Ints:
        """chi = +1 or -1 of each cell, shape (n_cells,); a reflection flips it."""
        return 1 - 2 * (self.cells.sum(axis=1) % 2)

    @cached_property
    def nodes(self) -> Ints:
        """Nominal integer coordinates of the nodes, cells centred at (4i, 4j, 0), shape (n_nodes, 3)."""
        return np.array(list(self._node_index), dtype=np.int64)

    @cached_property
    def _node_index(self) -> dict[Node, int]:
        index: dict[Node, int] = {}
        for i, j in self.cells:
            for x, y, z in cell_nodes():
                index.setdefault((x + 4 * int(i), y + 4 * int(j), z), len(index))
        return index

    def cell_node_indices(self, cell: int) -> Ints:
        """Indices of a cell's 24 nodes, in the order of :func:`cell_nodes`, shape (24,)."""
        i, j = (int(c) for c in self.cells[cell])
        return np.array([self._node_index[(x + 4 * i, y + 4 * j, z)] for x, y, z in cell_nodes()], dtype=np.int64)

    @cached_property
    def bars(self) -> Ints:
        """End nodes of each bar, 12 per cell in cell order, shape (n_bars, 2)."""
        ends = []
        for (i, j), chi in zip(self.cells, self.chirality, strict=True):
            shift = np.array((4 * i, 4 * j, 0))
            for a, b in cell_bars(int(chi)):
                ends.append([self._node_index[_key(np.array(p) + shift)] for p in (a, b)])
        return np.array(ends, dtype=np.int64)

    @cached_property
    def edges(self) -> Ints:
        """Node pairs of the truncated octahedra's edges (nominal length sqrt 2), each once, shape (n_edges, 2)."""
        pairs: dict[tuple[int, int], None] = {}
        for cell in range(self.n_cells):
            ids = self.cell_node_indices(cell)
            where = self.nodes[ids]
            square = ((where[:, None] - where[None]) ** 2).sum(axis=2)
            for a, b in zip(*np.nonzero(np.triu(square == 2)), strict=True):
                first, second = sorted((int(ids[a]), int(ids[b])))
                pairs.setdefault((first, second))
        return np.array(list(pairs), dtype=np.int64)

    @cached_property
    def edge_is_square(self) -> np.ndarray:
        """True where an edge lies on a square face, False where it joins two squares, shape (n_edges,)."""
        return self.edge_cells_sharing > 0

    @cached_property
    def edge_cells_sharing(self) -> Ints:
        """How many cells' square faces carry each edge: 0 for the edges between squares, shape (n_edges,)."""
        count = np.zeros(len(self.edges), dtype=np.int64)
        middle = self.nodes[self.edges].sum(axis=1)  # twice the mid-point
        for i, j in self.cells:
            local = middle - 2 * np.array((4 * i, 4 * j, 0))
            # a square edge's mid-point is (+-2, +-1/2, +-1/2) up to order; one between squares is (+-3/2, +-3/2, 0)
            count += (np.sort(np.abs(local), axis=1) == (1, 1, 4)).all(axis=1)
        return count

    @cached_property
    def ties(self) -> Ints:
        """Unactuated cables that tie each actuator mass to its square's four nodes, shape (8 n_cells, 2)."""
        ties = []
        for cell in range(self.n_cells):
            ids = self.cell_node_indices(cell)
            height = self.nodes[ids, 2]
            for mass, level in zip(self.actuators[cell], (-2, 2), strict=True):
                ties += [(int(mass), int(node)) for node in ids[height == level]]
        return np.array(ties, dtype=np.int64)

    @cached_property
    def cables(self) -> Ints:
        """Mass indices of the unactuated cables: the edges, then the ties, shape (n_cables, 2)."""
        return np.concatenate([self.edges, self.ties])

    @cached_property
    def actuators(self) -> Ints:
        """Mass indices (lower, upper) that each actuated cable joins, one per cell, shape (n_cells, 2)."""
        return self.n_nodes + np.arange(2 * self.n_cells, dtype=np.int64).reshape(-1, 2)

    @property
    def n_cells(self) -> int:
        """Number of cells, and of actuators."""
        return self.nx * self.ny

    @property
    def n_nodes(self) -> int:
        """Number of nodes where bars end."""
        return len(self._node_index)

    @property
    def n_masses(self) -> int:
        """Point masses with the paper's bars of four masses: nodes, two per actuator, two inner ones per bar."""
        return self.mass_count(bar_segments=3)

    def mass_count(self, bar_segments: int) -> int:
        """Point masses when each bar has ``bar_segments`` equal segments."""
        return self.n_nodes + 2 * self.n_cells + (bar_segments - 1) * len(self.bars)

    @cached_property
    def symmetries(self) -> Ints:
        """Permutations of the cells by the lattice's symmetry group {E, C2(z), sigma_x, sigma_y}, shape (4, n_cells).

        Row g holds, for each cell, the cell that its stretch goes to: the lattice with stretches ``s`` moves as the image
        of the lattice with stretches ``s[symmetries[g]]``. The rows go with the sign pairs of ``symmetry_signs``.
        Reflections map a cell onto one of the right chirality only if the grid's even; odd grids keep those that do.
        """
        return np.array([perm for _, perm in self._symmetry_list], dtype=np.int64)

    @cached_property
    def symmetry_signs(self) -> Ints:
        """What each symmetry does to horizontal displacements: x -> sx x, y -> sy y, shape (n_symmetries, 2)."""
        return np.array([signs for signs, _ in self._symmetry_list], dtype=np.int64)

    def symmetries_keeping(self, directions: ArrayLike) -> tuple[Ints, Ints]:
        """Those of ``symmetries`` (g, n_cells) and ``symmetry_signs`` (g, 2) that leave horizontal directions as they are.

        ``directions`` are of order one or zero, shape (2,) or (k, 2); the identity, which comes first, leaves all.
        """
        rows = np.atleast_2d(np.asarray(directions, dtype=np.float64))
        keep = np.abs(self.symmetry_signs[:, None] * rows - rows).max(axis=(1, 2)) < 1e-12
        return self.symmetries[keep], self.symmetry_signs[keep]

    @property
    def _symmetry_list(self) -> list[tuple[tuple[int, int], list[int]]]:
        number = {(int(i), int(j)): n for n, (i, j) in enumerate(self.cells)}
        found = []
        for sx, sy in ((1, 1), (-1, -1), (-1, 1), (1, -1)):
            image = [(i if sx > 0 else self.nx - 1 - i, j if sy > 0 else self.ny - 1 - j) for i, j in number]
            perm = [number[cell] for cell in image]
            # the image of a cell has chirality sx*sy*chi; it must be the chirality of the cell that lies there
            if all(self.chirality[p] == sx * sy * self.chirality[n] for n, p in enumerate(perm)):
                found.append(((sx, sy), perm))
        return found

    def positions(self, cell_node_positions: Floats, spacing: float) -> Floats:
        """Place a chi = +1 cell's 24 node positions (order of :func:`cell_nodes`) at every cell by reflection.

        ``spacing`` [m] is the distance between opposed square faces. Returns shape (n_nodes, 3) [m], centred on z = 0
        with the lattice's middle above the origin.
        """
        order = {node: n for n, node in enumerate(cell_nodes())}
        placed = np.zeros((self.n_nodes, 3))
        middle = spacing * np.array(((self.nx - 1) / 2, (self.ny - 1) / 2, 0.0))
        for cell, (i, j) in enumerate(self.cells):
            mirror = np.array((1 - 2 * (i % 2), 1 - 2 * (j % 2), 1))
            centre = spacing * np.array((i, j, 0)) - middle
            for node, index in zip(cell_nodes(), self.cell_node_indices(cell), strict=True):
                source = order[_key(mirror * np.array(node))]
                placed[index] = mirror * cell_node_positions[source] + centre
        return placed


def _key(point: np.ndarray) -> Node:
    return (int(point[0]), int(point[1]), int(point[2]))
