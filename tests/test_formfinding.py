"""Equilibria of the compressed lattice on the ground: statics, complementarity, symmetry, reproducibility, bad input."""

from __future__ import annotations

from functools import lru_cache

import naive
import numpy as np
import pytest
from scipy.optimize import minimize

from tensegrity_gym import (
    STRETCH_RANGE,
    Design,
    Equilibria,
    InvalidParameterError,
    InvalidStretchesError,
    Lattice,
    Scene,
    form_find,
)
from tensegrity_gym.formfinding import TOLERANCE, imperfection_forces, start_positions

EPS = naive.EPS
DESIGN, SCENE, LATTICE = Design(), Scene(), Lattice(2, 2)
STRUCTURE = DESIGN.structure(LATTICE)
WEIGHT = float(STRUCTURE.mass.sum()) * SCENE.gravity
SAMPLE = np.vstack(
    [
        np.full(4, 0.3),
        np.full(4, 0.7),
        np.random.default_rng(7).uniform(*STRETCH_RANGE, size=(8, 4)),
        [[0.2, 0.8, 0.2, 0.8]],
        [[0.2, 0.2, 0.8, 0.8]],
    ]
)


@lru_cache(maxsize=1)
def sample() -> Equilibria:
    """The equilibria most tests look at, found once."""
    return form_find(SAMPLE, threads=1)


def net_forces(e: Equilibria, k: int) -> np.ndarray:
    """Member forces, weight and the imperfection's dead load on every mass of equilibrium ``k`` by the twin [N]."""
    x = e.positions[k]
    lengths = e.stretches[k] * STRUCTURE.actuator_length
    gravity = np.array([0.0, 0.0, -SCENE.gravity])
    return naive.forces(STRUCTURE, lengths, gravity, x, np.zeros_like(x)).f + imperfection_forces(DESIGN, STRUCTURE)


def test_all_of_a_random_sample_converge() -> None:
    e = sample()
    assert e.converged.all()
    assert (e.residual < TOLERANCE * DESIGN.critical_load).all()
    assert (e.iterations > 0).all()


def test_every_mass_is_in_balance_with_the_ground_pushing_only_where_it_touches() -> None:
    """f + n = 0 with gap >= 0, n >= 0 and gap n = 0 (Signorini); the twin's rounding is 4 eps of what is summed."""
    e = sample()
    for k in range(len(SAMPLE)):
        x, n = e.positions[k], e.contact_force[k]
        assert (x[:, 2] >= 0.0).all()
        assert (n >= 0.0).all()
        assert (n[x[:, 2] > 0.0] == 0.0).all()
        residual = net_forces(e, k) + n[:, None] * [0, 0, 1.0]
        lengths = e.stretches[k] * STRUCTURE.actuator_length
        magnitude = naive.forces(STRUCTURE, lengths, np.zeros(3), x, np.zeros_like(x)).magnitude
        tolerance = TOLERANCE * DESIGN.critical_load + 4 * EPS * magnitude
        # the pose was turned after the search: positions moved by an eps, forces by k eps, as counted in the magnitude
        assert (np.linalg.norm(residual, axis=1) < tolerance).all()


def test_the_ground_carries_the_weight() -> None:
    """sum n = m g: internal forces and the self-balanced imperfection have no resultant; residuals may all add up."""
    e = sample()
    masses = len(STRUCTURE.mass)
    carried = e.contact_force.sum(axis=1)
    np.testing.assert_allclose(carried, WEIGHT, rtol=0, atol=masses * TOLERANCE * DESIGN.critical_load)
    np.testing.assert_allclose(carried, WEIGHT, rtol=1e-7)
    # moments about the centre of mass, at the origin: sum (n + imperfection) r = 0
    load = imperfection_forces(DESIGN, STRUCTURE)[:, 2]
    moment = np.einsum("nm,nmc->nc", e.contact_force + load, e.positions[:, :, :2])
    reach = np.linalg.norm(e.positions[:, :, :2], axis=2).sum(axis=1).max()
    assert np.abs(moment).max() < TOLERANCE * DESIGN.critical_load * reach


def test_the_ground_lets_go_of_feet_that_would_be_pulled() -> None:
    """On the Moon one in ten searches first holds a foot that the lattice then lifts; the sum of pushes would miss m g."""
    moon = Scene.preset("moon")
    e = form_find(np.random.default_rng(1).uniform(*STRETCH_RANGE, size=(40, 4)), scene=moon, threads=1)
    assert e.converged.all()
    np.testing.assert_allclose(e.contact_force.sum(axis=1), WEIGHT * moon.gravity / SCENE.gravity, rtol=1e-6)


def test_at_least_three_feet_stand_on_the_ground() -> None:
    feet = sample().contact_force > 1e-3 * WEIGHT
    assert (feet.sum(axis=1) >= 3).all()


def test_reported_energies_and_member_forces_are_the_twins() -> None:
    e = sample()
    gravity = np.array([0.0, 0.0, -SCENE.gravity])
    for k in (0, 5):
        x, lengths = e.positions[k], e.stretches[k] * STRUCTURE.actuator_length
        twin = naive.energies(STRUCTURE, lengths, gravity, x, np.zeros_like(x))
        found = [e.energies[name][k] for name in ("bars", "cables", "actuators", "gravitational")]
        np.testing.assert_allclose(found, twin[[0, 1, 2, 4]], rtol=1e-11)
        assert e.energy[k] == pytest.approx(sum(found), rel=4 * EPS)
        assert e.stored_energy[k] == pytest.approx(sum(found[:3]), rel=4 * EPS)
        members = naive.axial_members(STRUCTURE, lengths)
        pulls = np.array([naive.tension(m, float(np.linalg.norm(x[m.j] - x[m.i])), 0.0)[0] for m in members])
        atol = 16 * EPS * STRUCTURE.segment_stiffness.max()
        np.testing.assert_allclose(e.bar_load[k], -pulls[:144].reshape(48, 3).mean(axis=1), atol=atol)
        np.testing.assert_allclose(e.cable_tension[k], pulls[144:304], atol=atol)
        np.testing.assert_allclose(e.actuator_tension[k], pulls[304:], atol=atol)


def test_tight_actuators_buckle_bars_and_carry_tension() -> None:
    e = sample()
    assert (e.actuator_tension[0] > 0).all()
    x = e.positions[0][STRUCTURE.bars]
    middle = np.linalg.norm(x[:, 2] - x[:, 1], axis=1)
    load = STRUCTURE.segment_stiffness * (STRUCTURE.segment_length - middle)
    # on the post-buckling path P = P_cr theta / sin(theta) > P_cr along the chord, as the middle segment of a bar of thirds lies
    assert load.max() > DESIGN.critical_load
    assert load.min() > 0
    angles = [
        naive.hinge_angle(e.positions[0][j] - e.positions[0][i], e.positions[0][k] - e.positions[0][j])
        for i, j, k, *_ in naive.hinges(STRUCTURE)
    ]
    assert max(angles) > np.radians(20)
    assert e.stored_energy[0] > e.stored_energy[1] > 0


def test_no_lower_energy_nearby() -> None:
    """L-BFGS-B on the twin's potential, from 0.1 mm off and with z >= 0, finds nothing lower by 1e-6 J: it is a minimum."""
    e, k = form_find([0.45], lattice=Lattice(1, 1), threads=1), 0
    structure, load = DESIGN.structure(Lattice(1, 1)), imperfection_forces(DESIGN, DESIGN.structure(Lattice(1, 1)))
    lengths, gravity = e.stretches[k] * structure.actuator_length, np.array([0.0, 0.0, -SCENE.gravity])
    shape = e.positions[k].shape

    def potential(flat: np.ndarray) -> tuple[float, np.ndarray]:
        x = flat.reshape(shape)
        still = np.zeros_like(x)
        value = naive.energies(structure, lengths, gravity, x, still).sum() - (load * x).sum()
        return float(value), -(naive.forces(structure, lengths, gravity, x, still).f + load).ravel()

    start = e.positions[k] + np.random.default_rng(0).normal(size=shape) * 1e-4
    start[:, 2] = np.maximum(start[:, 2], 0.0)
    bounds = [(0.0, None) if c == 2 else (None, None) for _ in range(shape[0]) for c in range(3)]
    at_equilibrium, at_start = potential(e.positions[k].ravel())[0], potential(start.ravel())[0]
    found = minimize(
        potential, start.ravel(), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 400, "maxfun": 500}
    )
    assert at_start - at_equilibrium > 1e-2  # it had a hill to come down from
    assert found.fun < at_equilibrium + 0.1 * (at_start - at_equilibrium)  # and it did
    assert found.fun > at_equilibrium - 1e-6


def mass_permutation(lattice: Lattice, signs: np.ndarray) -> np.ndarray:
    """For each mass, the mass at its image under x -> sx x, y -> sy y in the unloaded lattice."""
    x = DESIGN.unloaded_positions(lattice)
    image = x * np.append(signs, 1)
    distance = np.linalg.norm(image[:, None] - x[None], axis=2)
    assert distance.min(axis=1).max() < 1e-12
    return distance.argmin(axis=1)


@pytest.mark.parametrize("element", [1, 2, 3])
def test_permuted_stretches_give_the_image(element: int) -> None:
    """The lattice with stretches s moves as the image of that with s[symmetry]: x[p(i)] = S x_symmetric[i].

    Both end on the same side of every bifurcation; positions agree as far as residuals over the softest stiffness let them.
    """
    stretches = SAMPLE[4]
    permuted = stretches[LATTICE.symmetries[element]]
    assert not np.array_equal(stretches, permuted)
    e = form_find(np.stack([stretches, permuted]), threads=1)
    signs = LATTICE.symmetry_signs[element]
    p = mass_permutation(LATTICE, signs)
    image = e.positions[1] * np.append(signs, 1)
    np.testing.assert_allclose(e.positions[0][p], image, rtol=0, atol=1e-8)
    assert e.energy[0] == pytest.approx(e.energy[1], rel=1e-10)
    np.testing.assert_allclose(e.contact_force[0][p], e.contact_force[1], atol=1e-5 * WEIGHT)


def test_equal_stretches_give_a_symmetric_equilibrium() -> None:
    x = sample().positions[0]
    for signs in LATTICE.symmetry_signs:
        np.testing.assert_allclose(x[mass_permutation(LATTICE, signs)], x * np.append(signs, 1), rtol=0, atol=1e-8)


def same_bits(a: Equilibria, rows_a: list[int], b: Equilibria, rows_b: list[int]) -> None:
    for name in ("stretches", "positions", "converged", "iterations", "residual", "contact_force", "bar_load"):
        np.testing.assert_array_equal(getattr(a, name)[rows_a], getattr(b, name)[rows_b], err_msg=name)
    # NumPy sums the reported energies in an order that depends on the batch
    np.testing.assert_allclose(a.energy[rows_a], b.energy[rows_b], rtol=16 * EPS)


def test_an_equilibrium_does_not_depend_on_its_batch() -> None:
    """Bit for bit: alone or a pair, which kernels solve without lanes, in another order, split over two threads."""
    whole = sample()
    alone = form_find(SAMPLE[3], threads=1)
    same_bits(alone, [0], whole, [3])
    pair = form_find(SAMPLE[[10, 0]], threads=1)
    same_bits(pair, [0, 1], whole, [10, 0])
    rows = list(range(len(SAMPLE)))[::-1]
    same_bits(form_find(SAMPLE[::-1], threads=2), list(range(len(SAMPLE))), whole, rows)


def test_other_lattices_scenes_and_segment_numbers_converge() -> None:
    cases = [
        (Lattice(1, 1), DESIGN, SCENE),
        (Lattice(2, 1), DESIGN, Scene.preset("moon")),
        (Lattice(1, 1), Design(bar_segments=2), SCENE),
        (Lattice(1, 1), Design(bar_segments=5), SCENE),
    ]
    for lattice, design, scene in cases:
        e = form_find(np.full(lattice.n_cells, 0.5), lattice=lattice, design=design, scene=scene, threads=1)
        assert e.converged.all()
        weight = design.structure(lattice).mass.sum() * scene.gravity
        assert e.contact_force.sum() == pytest.approx(weight, rel=1e-6)


def test_on_a_slope_the_ground_carries_the_normal_weight() -> None:
    """The lattice is held against sliding until its release: sum n = m g cos(slope)."""
    scene = Scene(slope=0.3)
    e = form_find(SAMPLE[0], scene=scene, threads=1)
    assert e.converged.all()
    assert e.contact_force.sum() == pytest.approx(WEIGHT * np.cos(0.3), rel=1e-7)


def test_the_pose_is_centred_and_not_turned() -> None:
    e = sample()
    centre = np.einsum("m,nmc->nc", STRUCTURE.mass, e.positions)[:, :2] / STRUCTURE.mass.sum()
    assert np.abs(centre).max() < 1e-14
    reference = DESIGN.unloaded_nodes(LATTICE)[:, :2]
    nodes = e.positions[:, : LATTICE.n_nodes, :2]
    turn = (reference[:, 0] * nodes[..., 1] - reference[:, 1] * nodes[..., 0]).sum(axis=1)
    assert np.abs(turn).max() < 1e-12


def test_the_search_starts_on_the_ground() -> None:
    x = start_positions(DESIGN, LATTICE)
    assert (x[:, 2] >= 0).all()
    assert (x[:, 2] == 0).sum() >= 3


def test_the_imperfection_is_balanced_and_small() -> None:
    load = imperfection_forces(DESIGN, STRUCTURE)
    assert np.abs(load.sum(axis=0)).max() < 1e-12 * DESIGN.critical_load
    assert 0 < np.abs(load).max() < 1e-3 * DESIGN.critical_load


def test_progress_counts_every_equilibrium() -> None:
    seen: list[int] = []
    form_find(SAMPLE[:3], threads=1, progress=seen.append)
    assert sum(seen) == 3


@pytest.mark.parametrize(
    ("stretches", "message"),
    [
        ([0.3, 0.3, 0.3], r"expected shape \(4,\) or \(batch, 4\) for a 2x2 lattice, got \(3,\)"),
        (np.full((2, 3, 4), 0.5), r"expected shape"),
        ([[0.3, 0.3, 0.3, 0.3], [0.3, 0.3, 0.9, 0.3]], r"expected finite values in \[0.2, 0.8\], got .* in row 1"),
        ([0.1, 0.3, 0.3, 0.3], r"expected finite values in \[0.2, 0.8\], got .* in row 0"),
        ([np.nan, 0.3, 0.3, 0.3], r"expected finite values"),
        ([np.inf, 0.3, 0.3, 0.3], r"expected finite values"),
        (["a", "b", "c", "d"], r"expected numbers"),
        ([[0.3], [0.3, 0.4]], r"expected numbers"),
        (0.3, r"expected shape"),
    ],
)
def test_bad_stretches_are_refused_by_name(stretches: object, message: str) -> None:
    with pytest.raises(InvalidStretchesError, match=message):
        form_find(stretches)  # type: ignore[arg-type]


def test_an_unknown_method_is_refused_by_name() -> None:
    with pytest.raises(InvalidParameterError, match=r"expected method in .*newton.* got 'annealing'"):
        form_find(np.full(4, 0.5), method="annealing")


def test_an_empty_batch_is_an_empty_answer() -> None:
    e = form_find(np.zeros((0, 4)))
    assert e.positions.shape == (0, LATTICE.n_masses, 3)
    assert e.converged.shape == (0,)


def test_soft_rods_are_found_as_far_as_rounding_lets_them_be() -> None:
    """A hundred-millionth of such a bar's Euler load is less than float64 keeps of the forces of stiff cables."""
    found = form_find([[0.3, 0.5, 0.4, 0.6]], design=Design(bar_modulus=7e6), threads=1)
    assert found.converged.all(), found.hints
    assert found.residual.max() < 1e-9
    assert form_find([[0.3, 0.5, 0.4, 0.6]], threads=1).tolerance == pytest.approx(TOLERANCE * Design().critical_load)
