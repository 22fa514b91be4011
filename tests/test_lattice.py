"""Topology against closed formulas: n cells, s shared square faces, chi alternating."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.lattice import Lattice, cell_bars, cell_nodes

SIZES = [(1, 1), (2, 1), (1, 2), (2, 2), (3, 2)]
sizes = st.tuples(st.integers(1, 4), st.integers(1, 4))


def shared_faces(nx: int, ny: int) -> int:
    return (nx - 1) * ny + nx * (ny - 1)


def components(pairs: np.ndarray, count: int) -> np.ndarray:
    """Label of the connected component of each of ``count`` things, shape (count,)."""
    label = np.arange(count)
    for _ in range(count):
        before = label.copy()
        for a, b in pairs:
            label[[a, b]] = min(label[a], label[b])
        if (before == label).all():
            return label
    raise AssertionError("labels did not settle")


@pytest.mark.parametrize(("nx", "ny"), SIZES)
def test_counts_follow_closed_formulas(nx: int, ny: int) -> None:
    lattice, n, s = Lattice(nx, ny), nx * ny, shared_faces(nx, ny)
    assert lattice.n_cells == n
    assert lattice.nodes.shape == (24 * n - 4 * s, 3)
    assert lattice.bars.shape == (12 * n, 2)
    assert lattice.edges.shape == (36 * n - 4 * s, 2)
    assert lattice.cables.shape == (44 * n - 4 * s, 2)
    assert lattice.actuators.shape == (n, 2)
    # nodes, two masses per actuator, two inner masses per bar
    assert lattice.n_masses == (24 * n - 4 * s) + 2 * n + 2 * 12 * n


@pytest.mark.parametrize(
    ("nx", "ny", "nodes", "bars", "cables", "actuators", "masses"),
    [(1, 1, 24, 12, 44, 1, 50), (2, 1, 44, 24, 84, 2, 96), (2, 2, 80, 48, 160, 4, 184)],
)
def test_counts_of_the_published_lattices(
    nx: int, ny: int, nodes: int, bars: int, cables: int, actuators: int, masses: int
) -> None:
    lattice = Lattice(nx, ny)
    found = (lattice.n_nodes, len(lattice.bars), len(lattice.cables), len(lattice.actuators), lattice.n_masses)
    assert found == (nodes, bars, cables, actuators, masses)


@pytest.mark.parametrize("chirality", [1, -1])
def test_each_node_of_a_cell_carries_exactly_one_bar(chirality: int) -> None:
    ends = [end for bar in cell_bars(chirality) for end in bar]
    assert sorted(ends) == cell_nodes()


def test_bars_have_the_nominal_length_and_the_chiralities_are_mirror_images() -> None:
    left, right = ({frozenset(bar) for bar in cell_bars(chi)} for chi in (1, -1))
    assert {sum((a - b) ** 2 for a, b in zip(*bar, strict=True)) for bar in cell_bars(1)} == {12}
    assert frozenset({(0, 1, 2), (2, -1, 0)}) in left | right
    assert {frozenset((-x, y, z) for x, y, z in bar) for bar in left} == right
    assert not left & right


@settings(max_examples=16, deadline=None)
@given(sizes)
def test_chirality_alternates_between_neighbours(size: tuple[int, int]) -> None:
    lattice = Lattice(*size)
    for (a, chi_a), (b, chi_b) in pairwise(zip(lattice.cells, lattice.chirality, strict=True)):
        assert np.abs(a - b).sum() == 1  # a snake: consecutive cells are neighbours
        assert chi_a == -chi_b
    assert lattice.chirality[0] == 1


@settings(max_examples=16, deadline=None)
@given(sizes)
def test_nodes_carry_a_bar_per_cell_they_belong_to(size: tuple[int, int]) -> None:
    lattice = Lattice(*size)
    cells_of = np.zeros(lattice.n_nodes, dtype=int)
    for cell in range(lattice.n_cells):
        np.add.at(cells_of, lattice.cell_node_indices(cell), 1)
    assert (np.bincount(lattice.bars.ravel(), minlength=lattice.n_nodes) == cells_of).all()
    assert (cells_of == 2).sum() == 4 * shared_faces(*size)
    assert cells_of.max() <= 2


@settings(max_examples=16, deadline=None)
@given(sizes)
def test_shared_nodes_join_bars_into_loops_of_at_most_four(size: tuple[int, int]) -> None:
    lattice = Lattice(*size)
    label = components(lattice.bars, lattice.n_nodes)
    bars_in = np.bincount(label[lattice.bars[:, 0]])
    assert bars_in.max() <= 4


@pytest.mark.parametrize(("nx", "ny"), SIZES)
def test_edges_of_shared_faces_are_there_once_and_known_as_shared(nx: int, ny: int) -> None:
    lattice, n, s = Lattice(nx, ny), nx * ny, shared_faces(nx, ny)
    sharing = np.bincount(lattice.edge_cells_sharing, minlength=3)
    assert sharing.tolist() == [12 * n, 24 * n - 2 * 4 * s, 4 * s]
    pairs = {frozenset(map(int, edge)) for edge in lattice.edges}
    assert len(pairs) == len(lattice.edges)
    length = np.linalg.norm(lattice.nodes[lattice.edges[:, 0]] - lattice.nodes[lattice.edges[:, 1]], axis=1)
    np.testing.assert_allclose(length, np.sqrt(2), rtol=1e-15)


def test_ties_join_each_actuator_mass_to_its_own_square() -> None:
    lattice = Lattice(2, 2)
    for (lower, upper), (i, j) in zip(lattice.actuators, lattice.cells, strict=True):
        for mass, height in ((lower, -2), (upper, 2)):
            square = lattice.nodes[lattice.ties[lattice.ties[:, 0] == mass, 1]]
            assert square.shape == (4, 3)
            np.testing.assert_array_equal(square.mean(axis=0), (4 * i, 4 * j, height))


@pytest.mark.parametrize(("nx", "ny"), SIZES)
def test_symmetries_map_the_lattice_onto_itself(nx: int, ny: int) -> None:
    lattice = Lattice(nx, ny)
    middle = np.array((2 * (nx - 1), 2 * (ny - 1), 0))
    index = {tuple(map(int, node)): k for k, node in enumerate(lattice.nodes)}
    bars = {frozenset(map(int, bar)) for bar in lattice.bars}
    assert lattice.symmetries[0].tolist() == list(range(lattice.n_cells))
    for signs in lattice.symmetry_signs:
        image = (lattice.nodes - middle) * np.append(signs, 1) + middle
        moved = np.array([index[tuple(map(int, node))] for node in image])
        assert {frozenset(map(int, moved[bar])) for bar in lattice.bars} == bars


def test_the_two_by_two_lattice_has_four_symmetries() -> None:
    assert sorted(map(tuple, Lattice(2, 2).symmetry_signs.tolist())) == [(-1, -1), (-1, 1), (1, -1), (1, 1)]


@pytest.mark.parametrize("nx", [0, -1, 1.5, "2", None, True, float("nan")])
def test_a_lattice_of_no_such_size_is_refused_by_name(nx: object) -> None:
    with pytest.raises(InvalidParameterError, match=r"Lattice\.nx: expected an integer >= 1, got"):
        Lattice(nx, 2)  # type: ignore[arg-type]
