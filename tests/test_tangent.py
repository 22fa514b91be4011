"""Tangent stiffness against differences of the forces, and its sparse Cholesky solution against dense algebra."""

from __future__ import annotations

import kernels
import naive
import numpy as np
import pytest
from test_forces import NONE, Case, case, core_forces, distance_from_slack, eight_of_one_structure

from tensegrity_gym import Lattice
from tensegrity_gym.elimination import couplings, dissection, lattice_pattern, minimum_degree
from tensegrity_gym.types import BlockPattern

EPS = naive.EPS
CASES = [
    ((1, 1), 3, 3e-3),
    ((2, 1), 3, 3e-3),
    ((2, 2), 3, 0.01),
    ((1, 1), 1, 3e-3),
    ((1, 1), 2, 0.02),
    ((1, 1), 5, 3e-3),
    ((1, 1), 3, 0.06),
]
cases = pytest.mark.parametrize(("size", "segments", "noise"), CASES)


def core_tangent(c: Case, pattern: BlockPattern) -> np.ndarray:
    """Blocks of the tangent stiffness by the core, shape (n_slots, 9) [N/m]."""
    h = np.full((pattern.n_slots, 9), np.nan)
    kernels.tangent(c.structure, pattern, c.lengths, c.x, h)
    return h


def solved(pattern: BlockPattern, h: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, float]:
    """Solution of the factorised system and the smallest pivot."""
    worst, x = np.zeros(1), y.copy()
    kernels.cholesky(pattern, h.copy(), x, 0.0, worst)
    return x, float(worst[0])


@cases
def test_tangent_is_minus_the_derivative_of_the_forces(size: tuple[int, int], segments: int, noise: float) -> None:
    """H = -dF/dx; the five-point difference errs by h^4/30 F^(5) and by the rounding of F over h."""
    c = case(size, segments, noise, seed=21)
    pattern, h = lattice_pattern(Lattice(*size), segments), 2e-5
    matrix = naive.dense_tangent(pattern, core_tangent(c, pattern))
    still, difference = np.zeros_like(c.x), np.zeros_like(matrix)
    for k, place in enumerate(np.ndindex(c.x.shape)):
        for step, weight in {1: 8.0, -1: -8.0, 2: -1.0, -2: 1.0}.items():
            x = c.x.copy()
            x[place] += step * h
            difference[:, k] -= weight * core_forces(c._replace(x=x), NONE, still)[0].ravel() / (12 * h)
    twin = naive.forces(c.structure, c.lengths, NONE, c.x, still)
    assert distance_from_slack(c) > 2 * h  # no kink within the stencil
    rounding = 18 / (12 * h) * 4 * EPS * twin.magnitude.max()
    # of all members the shortest curves most: k (h / l)^4, with the (2n)!! of the derivatives of a length, 45 / 30
    segment = c.x[c.structure.bars]
    shortest = np.linalg.norm(np.diff(segment, axis=1), axis=2).min()
    truncation = 2 * 45 / 30 * c.structure.segment_stiffness.max() * (h / shortest) ** 4
    tolerance = rounding + truncation
    assert tolerance < 1e-6 * np.abs(matrix).max()
    np.testing.assert_allclose(matrix, difference, atol=tolerance, rtol=0)
    np.testing.assert_allclose(matrix, matrix.T, atol=16 * EPS * np.abs(matrix).max(), rtol=0)


@cases
def test_sparse_solution_is_that_of_dense_algebra(size: tuple[int, int], segments: int, noise: float) -> None:
    """Backward stability of Cholesky: |H x - y| <= c n eps |H| |x|, whatever the conditioning."""
    c = case(size, segments, noise, seed=22)
    pattern = lattice_pattern(Lattice(*size), segments)
    h = core_tangent(c, pattern)
    n = len(c.x)
    lowest = np.linalg.eigvalsh(naive.dense_tangent(pattern, h))[0]
    shift = 10.0 + max(0.0, -1.5 * lowest)
    h[:n, [0, 4, 8]] += shift
    matrix, y = naive.dense_tangent(pattern, h), np.random.default_rng(0).normal(size=(n, 3))
    x, pivot = solved(pattern, h, y)
    assert pivot >= shift * (1 - 1e-6) - max(0.0, -1.5 * lowest)  # a pivot is no smaller than the lowest eigenvalue
    residual = np.abs(matrix @ x.ravel() - y.ravel()).max()
    assert residual < 3 * n * EPS * np.abs(matrix).sum(axis=1).max() * np.abs(x).max()
    expected = np.linalg.solve(matrix, y.ravel())
    condition = np.linalg.cond(matrix)
    np.testing.assert_allclose(x.ravel(), expected, rtol=0, atol=4 * EPS * condition * np.abs(expected).max())


def test_every_lane_of_tangent_factor_and_solution_has_the_bits_of_the_scalar() -> None:
    group = eight_of_one_structure([0.0, 1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.06, 0.09])
    pattern = lattice_pattern(Lattice(1, 1), 3)
    rng = np.random.default_rng(3)
    right = [rng.normal(size=c.x.shape) for c in group]
    h, y = kernels.stack([np.zeros((pattern.n_slots, 9))]), kernels.stack(right)
    worst = kernels.stack([np.zeros(1)])
    kernels.tangent(
        group[0].structure, pattern, kernels.stack([c.lengths for c in group]), kernels.stack([c.x for c in group]), h
    )
    for lane, c in enumerate(group):
        np.testing.assert_array_equal(h[..., lane], core_tangent(c, pattern))
    alone = [(np.ascontiguousarray(h[..., lane]), y[..., lane].copy()) for lane in range(8)]
    kernels.cholesky(pattern, h, y, 0.0, worst)
    for lane, (blocks, one) in enumerate(alone):
        solution, pivot = solved(pattern, blocks, one)
        np.testing.assert_array_equal(y[..., lane], solution)
        assert worst[0, lane] == pivot


@pytest.mark.parametrize("mass", [0, 23, 25, 49])
def test_an_indefinite_matrix_is_reported_by_its_pivot(mass: int) -> None:
    """By Sylvester's law of inertia a negative eigenvalue shows as a pivot <= 0; its neighbours in other lanes see nothing."""
    c, pattern = case((1, 1)), lattice_pattern(Lattice(1, 1), 3)
    h = core_tangent(c, pattern)
    h[: len(c.x), [0, 4, 8]] += 1e7
    y = np.ones_like(c.x)
    good, pivot = solved(pattern, h, y)
    assert pivot > 0
    bad = h.copy()
    bad[mass, 4] -= np.linalg.eigvalsh(naive.dense_tangent(pattern, h))[-1]
    assert np.linalg.eigvalsh(naive.dense_tangent(pattern, bad))[0] < 0
    both, right, worst = kernels.stack([h, bad]), kernels.stack([y]), kernels.stack([np.zeros(1)])
    kernels.cholesky(pattern, both, right, 0.0, worst)
    assert (worst[0, 0::2] == pivot).all()
    assert (worst[0, 1::2] <= 0).all()
    np.testing.assert_array_equal(right[..., 0], good)


def test_the_pattern_has_a_slot_for_every_coupling_and_the_count_of_updates() -> None:
    lattice = Lattice(2, 2)
    pattern = lattice_pattern(lattice, 3)
    n = lattice.n_masses
    assert sorted(pattern.order) == list(range(n))
    heights = np.diff(pattern.starts)
    assert len(pattern.targets) == (heights * (heights + 1) // 2).sum()
    assert len(pattern.rows) == heights.sum() == pattern.n_slots - n
    position = np.empty(n, dtype=int)
    position[pattern.order] = np.arange(n)
    for k, column in enumerate(pattern.order):
        rows = pattern.rows[pattern.starts[k] - n : pattern.starts[k + 1] - n]
        assert (position[rows] > position[column]).all()


@pytest.mark.parametrize(("size", "segments"), [((3, 2), 3), ((2, 4), 1), ((4, 3), 2)])
def test_dissection_cuts_the_lattice_into_blocks_that_no_member_joins(size: tuple[int, int], segments: int) -> None:
    """A partition; two parts touch only where the later one is a cut; and the sparse solution is the dense one's."""
    lattice = Lattice(*size)
    c = case(size, segments, 3e-3, seed=5)
    parts = dissection(lattice, segments)
    assert len(parts) > 1
    where = {mass: k for k, part in enumerate(parts) for mass in part}
    assert sorted(where) == list(range(len(c.x)))
    assert sum(map(len, parts)) == len(c.x)
    blocks = [k for k, part in enumerate(parts) if any(mass >= lattice.n_nodes for mass in part)]  # a cut is of nodes alone
    pairs = couplings(c.structure.cables, c.structure.actuators, c.structure.bars)
    joined = {(min(where[a], where[b]), max(where[a], where[b])) for a, b in pairs}
    assert not {(k, m) for k, m in joined if k != m and m in blocks}
    pattern = lattice_pattern(lattice, segments)
    h = core_tangent(c, pattern)
    h[: len(c.x), [0, 4, 8]] += 1e6
    matrix, y = naive.dense_tangent(pattern, h), np.random.default_rng(0).normal(size=c.x.shape)
    found, pivot = solved(pattern, h, y)
    assert pivot > 0
    np.testing.assert_allclose(found.ravel(), np.linalg.solve(matrix, y.ravel()), rtol=0, atol=1e-10 * np.abs(found).max())


def test_dissection_updates_fewer_blocks_and_leaves_small_lattices_whole() -> None:
    assert len(dissection(Lattice(2, 2), 3)) == 1
    lattice = Lattice(4, 4)
    cut = lattice_pattern(lattice, 3)
    c = case((4, 4), 3, 0.0, seed=1)
    _, columns = minimum_degree(len(c.x), couplings(c.structure.cables, c.structure.actuators, c.structure.bars))
    whole = sum(len(column) * (len(column) + 1) // 2 for column in columns)
    assert len(cut.targets) < 0.85 * whole
