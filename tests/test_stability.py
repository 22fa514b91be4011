"""Second-order check: the sparse tangent, rigid motions, a stable cell, and straight bars past their Euler load."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import naive
import numpy as np
import pytest
from scipy.optimize import brentq

from tensegrity_gym import Design, Equilibria, Lattice, form_find
from tensegrity_gym.core.assembly import assemble_tangent
from tensegrity_gym.elimination import block_pattern, lattice_pattern
from tensegrity_gym.stability import check_stability, follow_load_path, last_share, rigid_motions, spin_motions, tangent_matrix
from tensegrity_gym.types import Structure

CELL, DESIGN = Lattice(1, 1), Design()
STRUCTURE = DESIGN.structure(CELL)
PATTERN = lattice_pattern(CELL, 3)


@lru_cache(maxsize=1)
def cells() -> Equilibria:
    return form_find([[0.3], [0.5], [0.75]], lattice=CELL)


def test_sparse_tangent_is_the_blocks_and_symmetric() -> None:
    e = cells()
    length = 0.3 * STRUCTURE.actuator_length
    matrix = tangent_matrix(STRUCTURE, PATTERN, length, e.positions[0]).toarray()
    h = np.zeros((PATTERN.n_slots, 9))
    assemble_tangent(STRUCTURE, PATTERN, length, e.positions[0], h)
    np.testing.assert_array_equal(matrix, naive.dense_tangent(PATTERN, h))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-6 * np.abs(matrix).max())


def test_motions_along_flat_ground_cost_nothing() -> None:
    """K r = 0: the forces turn with the lattice, and the ground's are vertical."""
    e = cells()
    matrix = tangent_matrix(STRUCTURE, PATTERN, 0.5 * STRUCTURE.actuator_length, e.positions[1])
    work = matrix @ rigid_motions(e.positions[1])
    assert np.abs(work).max() < 1e-12 * np.abs(matrix).max() + 1e-5


def test_equilibria_are_minima_with_bowed_bars_that_spin_softly() -> None:
    s = check_stability(cells(), design=DESIGN, lattice=CELL)
    assert s.stable.all()
    assert (s.eigenvalues > 0).all()
    assert (np.diff(s.eigenvalues, axis=1) >= 0).all()
    assert (s.spin_eigenvalues[:, 0] > 0).all()
    assert (s.load_ratio > 0).any()
    assert (s.past_critical == (s.load_ratio > 1).sum(axis=1)).all()
    assert (s.bending_strain[:-1] > s.bending_strain[1:]).all()  # more compression, more bending
    np.testing.assert_allclose(s.safety_margin, 0.012 / s.bending_strain - 1)


def test_spins_turn_bows_about_their_chords() -> None:
    x = cells().positions[0]
    spins = spin_motions(x, STRUCTURE.bars)
    assert spins.shape == (3 * len(x), len(STRUCTURE.bars))
    np.testing.assert_allclose(spins.T @ spins, np.eye(len(STRUCTURE.bars)), atol=1e-12)


@pytest.mark.parametrize(("share", "stable"), [(0.5, True), (2.0, False)])
def test_straight_bars_are_stable_below_their_euler_load_and_not_above(share: float, stable: bool) -> None:
    """The unloaded cell's closed form is an equilibrium at any prestrain; past the Euler load its straight bars are a saddle."""
    prestrain = share * DESIGN.critical_load / (DESIGN.prestress_load / DESIGN.prestrain)
    design = replace(DESIGN, prestrain=prestrain)
    e = form_find([[0.8]], lattice=CELL, design=design)
    free = replace(
        e,
        stretches=np.ones((1, 1)),
        positions=design.unloaded_positions(CELL)[None],
        contact_force=np.zeros_like(e.contact_force),
        converged=np.ones(1, dtype=bool),
    )
    s = check_stability(free, design=design, lattice=CELL, modes=3)
    np.testing.assert_allclose(s.load_ratio, share, rtol=1e-3)
    # in the air and with slack actuators some modes are zero: rounding of 1e7 N/m
    assert (s.eigenvalues[0, 0] > -1e-6) == stable


def test_load_path_has_no_bifurcation_near_the_target() -> None:
    path = follow_load_path([0.5], lattice=CELL, points=8)
    assert path.critical.shape == (0,)
    assert path.distance == np.inf
    assert np.isfinite(path.lowest).all()
    assert (np.diff(path.energy) > 0).all()
    assert (path.clearance < path.clearance[0]).sum() == len(path.clearance) - 1  # bars come nearer


def straight_bar() -> Structure:
    """A bar of thirds, its ends masses 0 and 1; the cable and the actuator hang slack."""
    stiffness = np.array([3 * DESIGN.bar_rigidity / DESIGN.bar_length])
    return Structure(
        mass=np.ones(4),
        inverse_mass=np.ones(4),
        cables=np.array([[0, 1]]),
        cable_stiffness=np.ones(1),
        cable_length=np.array([2.0]),
        cable_damping=np.zeros(1),
        actuators=np.array([[0, 1]]),
        actuator_rigidity=np.ones(1),
        actuator_length=np.array([2.0]),
        actuator_damping=np.zeros(1),
        bars=np.array([[0, 2, 3, 1]]),
        segment_stiffness=stiffness,
        segment_length=np.array([DESIGN.bar_length / 3]),
        segment_damping=np.zeros(1),
        hinge_stiffness=np.array([DESIGN.hinge_stiffness]),
        hinge_damping=np.zeros(1),
    )


def test_bisection_closes_in_on_the_euler_load_of_one_bar() -> None:
    """Bent by y, the chain stores kappa y^2 / l^2 and its ends come nearer by y^2 / l: P l = kappa at the load where it buckles.

    l = (L / 3)(1 - P / EA), so P (1 - P / EA) = pi^2 E I / L^2.
    """
    structure = straight_bar()
    pattern = block_pattern(structure.cables, structure.actuators, structure.bars, 4)

    def straight(load: float, _: float) -> float | None:
        x = np.zeros((4, 3))
        x[[0, 2, 3, 1], 0] = np.linspace(0.0, DESIGN.bar_length * (1 - load / DESIGN.bar_rigidity), 4)
        inner = tangent_matrix(structure, pattern, structure.actuator_length, x).toarray()[6:, 6:]
        return load if np.linalg.eigvalsh(inner)[0] > 0 else None

    euler, rigidity = DESIGN.critical_load, DESIGN.bar_rigidity
    expected = brentq(lambda p: p * (1 - p / rigidity) - euler, 0.5 * euler, 2 * euler, xtol=1e-12)
    found = last_share(straight, lambda a, b: True, 0.0, 0.0, 2 * euler, 1e-6 * euler)
    assert found == pytest.approx(expected, abs=1e-6 * euler)
    assert found == pytest.approx(euler, rel=1e-4)


def test_a_path_without_an_end_is_followed_to_the_top() -> None:
    assert last_share(lambda share, state: state, lambda a, b: True, 0.0, 0.0, 1.0, 1e-3) == pytest.approx(1.0, abs=1e-3)


def test_a_jump_ends_a_path_though_every_search_finds_an_equilibrium() -> None:
    """A hysteresis loop: up to 0.7 the state stays 0, above it becomes 1 and never comes back."""
    found = last_share(lambda share, state: 1.0 if share > 0.7 else state, lambda a, b: a == b, 0.0, 0.0, 1.0, 1e-6)
    assert found == pytest.approx(0.7, abs=1e-6)


@pytest.mark.parametrize(("stretch", "touch"), [(0.7, False), (0.4, True)])
def test_bars_that_reach_through_each_other_are_reported(stretch: float, touch: bool) -> None:
    s = check_stability(form_find([[stretch]], lattice=CELL), lattice=CELL, modes=1)
    assert s.bars_touch[0] == touch
    assert (s.bar_clearance[0] < 0) == touch
