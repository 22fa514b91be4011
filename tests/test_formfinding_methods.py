"""Methods of form-finding: on analytic problems, against each other, against scipy, and on both sides of where they work."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from tensegrity_gym import Design, Equilibria, InvalidParameterError, InvalidStretchesError, Lattice, Scene, form_find
from tensegrity_gym.core.conjugate_gradient import DescentSettings, DescentWork, conjugate_gradient, parabola_minimum
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.newton import EquilibriumRecords, NewtonSettings, newton_equilibria
from tensegrity_gym.core.relaxation import RelaxationSettings, RelaxationWork, relax
from tensegrity_gym.elimination import block_pattern
from tensegrity_gym.searches import SearchOptions, fictitious_masses, newton_lanes
from tensegrity_gym.types import Structure

CELL = Lattice(1, 1)
DESIGN = Design()


@jit
def rosenbrock(problem, x):
    """(1 - a)^2 + 100 (b - a^2)^2 of x = [[a, b]]."""
    a, b = x[0, 0], x[0, 1]
    return (1.0 - a) ** 2 + 100.0 * (b - a * a) ** 2


@jit
def rosenbrock_forces(problem, x, f):
    """Minus its gradient; returns the norm."""
    a, b = x[0, 0], x[0, 1]
    f[0, 0] = 2.0 * (1.0 - a) + 400.0 * a * (b - a * a)
    f[0, 1] = -200.0 * (b - a * a)
    return np.sqrt(f[0, 0] ** 2 + f[0, 1] ** 2)


@jit
def quadratic(problem, x):
    """x . K x / 2 - b . x with problem = (K, b)."""
    total = 0.0
    for i in range(x.shape[0]):
        row = 0.0
        for j in range(x.shape[0]):
            row += problem[0][i, j] * x[j, 0]
        total += x[i, 0] * (0.5 * row - problem[1][i])
    return total


@jit
def quadratic_forces(problem, x, f):
    """b - K x; returns the largest entry."""
    worst = 0.0
    for i in range(x.shape[0]):
        f[i, 0] = problem[1][i]
        for j in range(x.shape[0]):
            f[i, 0] -= problem[0][i, j] * x[j, 0]
        worst = max(worst, abs(f[i, 0]))
    return worst


@jit(cache=False, forceinline=False, _nrt=True)
def run_rosenbrock(x, work, settings):
    """Conjugate gradients on Rosenbrock's valley."""
    return conjugate_gradient(rosenbrock, rosenbrock_forces, 0.0, x, work, settings)


@jit(cache=False, forceinline=False, _nrt=True)
def run_quadratic(problem, x, work, settings):
    """Conjugate gradients on a quadratic."""
    return conjugate_gradient(quadratic, quadratic_forces, problem, x, work, settings)


@jit(cache=False, forceinline=False, _nrt=True)
def run_relaxation(problem, mass, x, work, settings):
    """Relaxation of a quadratic."""
    return relax(quadratic_forces, problem, mass, x, work, settings)


def scratch(shape: tuple[int, int]) -> DescentWork:
    return DescentWork(*(np.zeros(shape) for _ in range(4)))


def descent(**changes: float) -> DescentSettings:
    base = DescentSettings(
        tolerance=1e-6, max_iterations=5000, line_tolerance=1e-3, line_cap=30, longest_step=1.0, sufficient=0.1
    )
    return base._replace(**changes)


def spd(n: int, condition: float) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(n).normal(size=(n, n)))
    return (q * np.geomspace(1.0, condition, n)) @ q.T


def test_parabola_minimum_is_exact_on_a_parabola() -> None:
    minimum = parabola_minimum.py_func(-1.0, 2.0 * 1.7**2 + 3, 0.5, 2 * 0.2**2 + 3, 2.0, 2 * 1.3**2 + 3)
    assert minimum == pytest.approx(0.7, abs=1e-14)


def test_conjugate_gradients_follow_rosenbrocks_valley() -> None:
    x = np.array([[-1.2, 1.0]])
    residual, directions, calls = run_rosenbrock(x, scratch((1, 2)), descent())
    assert residual <= 1e-6
    np.testing.assert_allclose(x, 1.0, atol=1e-5)
    assert directions < 200
    assert calls > directions


@pytest.mark.parametrize("n", [2, 5, 12])
def test_conjugate_gradients_end_a_quadratic_in_its_dimension(n: int) -> None:
    """With exact line searches conjugate directions are done in n; rounding of energies (1e-16 of them) costs a few more."""
    k, b = spd(n, 30.0), np.arange(1.0, n + 1)
    x = np.zeros((n, 1))
    residual, directions, _ = run_quadratic(
        (k, b), x, scratch((n, 1)), descent(tolerance=1e-5, line_tolerance=1e-9, longest_step=1e3)
    )
    assert residual <= 1e-5
    assert directions <= n + 3
    np.testing.assert_allclose(x[:, 0], np.linalg.solve(k, b), atol=1e-4)


@pytest.mark.parametrize("kinetic", [False, True])
def test_relaxation_rests_at_the_minimum_of_a_quadratic(kinetic: bool) -> None:
    k, b = spd(6, 100.0), np.ones(6)
    mass = np.full(6, 0.26 * 100.0)  # stable while mass > stiffness / 4
    x = np.zeros((6, 1))
    work = RelaxationWork(*(np.zeros((6, 1)) for _ in range(3)))
    settings = RelaxationSettings(tolerance=1e-8, max_iterations=5000, kinetic=kinetic, softest=1e-3, longest_step=10.0)
    residual, steps = run_relaxation((k, b), mass, x, work, settings)
    assert residual <= 1e-8
    assert steps < 2000
    np.testing.assert_allclose(x[:, 0], np.linalg.solve(k, b), atol=1e-7)


def test_relaxation_with_less_than_a_quarter_of_the_stiffness_runs_away() -> None:
    k, b = spd(6, 100.0), np.ones(6)
    x = np.zeros((6, 1))
    work = RelaxationWork(*(np.zeros((6, 1)) for _ in range(3)))
    settings = RelaxationSettings(tolerance=1e-8, max_iterations=3000, kinetic=False, softest=1e-3, longest_step=10.0)
    residual, _ = run_relaxation((k, b), np.full(6, 0.2 * 100.0), x, work, settings)
    assert residual > 1.0


def test_fictitious_masses_bound_a_quarter_of_the_stiffness() -> None:
    """The pair (stiffness, mass) of one bar's chain and a cable: omega < 2 per step, from the dense matrices."""
    structure = DESIGN.structure(CELL)
    mass = fictitious_masses(structure, np.full((1, 1), 0.5), 0.0)[0]
    segments = np.stack([structure.bars[:, :-1], structure.bars[:, 1:]], -1).reshape(-1, 2)
    pairs = np.concatenate([structure.cables, structure.actuators, segments])
    stiffness = np.concatenate(
        [
            structure.cable_stiffness,
            structure.actuator_rigidity / (0.5 * structure.actuator_length),
            np.repeat(structure.segment_stiffness, 3),
        ]
    )
    k = np.zeros((len(mass), len(mass)))
    for (i, j), s in zip(pairs, stiffness, strict=True):
        k[[i, j], [i, j]] += s
        k[[i, j], [j, i]] -= s
    omega = np.sqrt(np.linalg.eigvalsh(k / np.sqrt(np.outer(mass, mass)))[-1])
    assert 1.0 < omega < 2.0


STRETCHES = [[0.35], [0.6]]


@lru_cache(maxsize=1)
def reference() -> Equilibria:
    return form_find(STRETCHES, lattice=CELL, options=SearchOptions(tolerance=1e-10))


@pytest.mark.parametrize(
    ("method", "options"),
    [
        pytest.param("cg", SearchOptions(), marks=pytest.mark.slow),
        ("relaxation", SearchOptions(damping="viscous")),
        ("relaxation", SearchOptions(damping="kinetic")),
        ("newton", SearchOptions(load_step=0.03)),
    ],
)
def test_methods_agree_on_a_cell(method: str, options: SearchOptions) -> None:
    """A residual r leaves an energy error of at most r^2 / 2k: below 1e-6 J for 5e-4 N on any mode stiffer than 0.1 N/m."""
    found = form_find(STRETCHES, lattice=CELL, method=method, options=options)
    assert found.converged.all(), found.hints
    np.testing.assert_allclose(found.energy, reference().energy, atol=2e-6)
    np.testing.assert_allclose(found.positions[:, :24], reference().positions[:, :24], atol=2e-3)
    assert (found.residual <= found.tolerance).all()
    assert found.hints == ["", ""]


def test_same_bits_whatever_batch_order_or_threads() -> None:
    stretches = np.random.default_rng(3).uniform(0.2, 0.8, size=(11, 1))
    one = form_find(stretches, lattice=CELL, threads=1)
    other = form_find(stretches[::-1], lattice=CELL, threads=2)
    np.testing.assert_array_equal(one.positions, other.positions[::-1])
    for k in (0, 7):
        np.testing.assert_array_equal(form_find(stretches[k], lattice=CELL).positions[0], one.positions[k])


def test_bows_on_the_ground_lie_on_their_canonical_side() -> None:
    """Symmetric stretches give a symmetric lattice although bows rest on the ground: the x mirror maps it onto itself."""
    lattice = Lattice(2, 2)
    e = form_find([[0.3] * 4], lattice=lattice)
    inner = e.contact_force[0, lattice.n_nodes + 2 * lattice.n_cells :] > 0
    assert inner.any()
    x = e.positions[0]
    mirrored = x * np.array((-1.0, 1.0, 1.0))
    gap = np.linalg.norm(mirrored[:, None] - x[None], axis=-1).min(axis=1)
    assert gap.max() < 1e-6


def test_start_at_an_equilibrium_stays_there() -> None:
    again = form_find(STRETCHES, lattice=CELL, start=reference().positions)
    assert again.converged.all()
    assert (again.iterations <= 40).all()
    np.testing.assert_allclose(again.energy, reference().energy, atol=1e-11)


def test_what_does_not_converge_says_why() -> None:
    e = form_find(STRETCHES, lattice=CELL, options=SearchOptions(max_iterations=3))
    assert not e.converged.any()
    assert (e.iterations == 3).all()
    assert all("cap is 3" in hint and "residual" in hint for hint in e.hints)
    assert (e.residual > e.tolerance).all()


@pytest.mark.parametrize("stretch", [0.1, 0.95, 1.0, 1.1])
def test_outside_the_range_is_refused_unless_asked_for(stretch: float) -> None:
    with pytest.raises(InvalidStretchesError, match="expected finite values"):
        form_find([stretch], lattice=CELL)
    e = form_find([stretch], lattice=CELL, outside=True)
    assert e.converged.all() or "leave [0.2, 0.8]" in e.hints[0]


def test_a_lattice_lost_on_its_load_path_is_found_on_a_finer_one() -> None:
    """The lattice weighs 2.7 Euler loads of these soft bars; the path of steps of 0.1 loses this one."""
    design, stretches = Design(bar_modulus=1e10), np.random.default_rng(1).uniform(0.2, 0.8, size=(4, 4))[3]
    e = form_find(stretches, design=design)
    fine = form_find(stretches, design=design, options=SearchOptions(load_step=0.02))
    assert e.converged.all()
    assert e.evaluations[0] > 2000 > e.iterations[0]
    assert e.energy[0] == pytest.approx(fine.energy[0], abs=1e-9)


@pytest.mark.parametrize(("diameter", "found"), [(2e-3, True), (1e-3, False)])
def test_bars_too_thin_for_the_lattices_weight_are_not_found(diameter: float, found: bool) -> None:
    """It weighs 1.9 Euler loads of 2 mm bars, and 25 of 1 mm bars, which let it lie down flat."""
    stretches = np.random.default_rng(1).uniform(0.2, 0.8, size=(8, 4))
    e = form_find(stretches, design=Design(bar_diameter=diameter))
    assert e.converged.all() == found
    assert all(("residual" in hint) != ok for hint, ok in zip(e.hints, e.converged, strict=True))


def test_bad_options_are_refused() -> None:
    with pytest.raises(InvalidParameterError, match="damping"):
        form_find(STRETCHES, lattice=CELL, method="relaxation", options=SearchOptions(damping="air"))
    with pytest.raises(InvalidParameterError, match="tolerance"):
        form_find(STRETCHES, lattice=CELL, options=SearchOptions(tolerance=-1.0))
    with pytest.raises(InvalidParameterError, match="expected start"):
        form_find(STRETCHES, lattice=CELL, start=np.zeros((2, 3, 3)))


@pytest.mark.parametrize("prestrain", [0.0, 2e-3])
@pytest.mark.parametrize("segments", [1, 2, 3, 4])
def test_converges_with_any_prestrain_and_bar_model(prestrain: float, segments: int) -> None:
    """Bars of one segment cannot buckle: they take the load, the cell hardly shortens, and the cable carries kilonewtons."""
    design = Design(prestrain=prestrain, bar_segments=segments)
    e = form_find([0.5], design=design, lattice=CELL)
    if segments > 1:
        assert e.converged.all(), e.hints
        assert e.bar_load.max() < 1.6 * design.critical_load
    elif e.converged.all():
        assert e.bar_load.max() > 3 * design.critical_load


def buckled_bar(shortening: float) -> tuple[float, float]:
    """(compression over the Euler load, end-shortening over length) of one bar between the ends of a much stiffer cable.

    No gravity: minimised by Newton, 8 lanes of it, from a bow.
    """
    segments = 3
    length, kappa = DESIGN.bar_length, DESIGN.hinge_stiffness
    third = length / segments
    axial = np.array([3 * DESIGN.bar_rigidity / length])
    pairs, chain = np.array([[0, 1]]), np.array([[0, 4, 5, 1]])
    structure = Structure(
        mass=np.ones(6),
        inverse_mass=np.ones(6),
        cables=pairs,
        cable_stiffness=np.array([1e7]),
        cable_length=np.array([(1 - shortening) * length]),
        cable_damping=np.zeros(1),
        actuators=np.array([[2, 3]]),
        actuator_rigidity=np.ones(1),
        actuator_length=np.ones(1),
        actuator_damping=np.zeros(1),
        bars=chain,
        segment_stiffness=axial,
        segment_length=np.array([third]),
        segment_damping=np.zeros(1),
        hinge_stiffness=np.array([kappa]),
        hinge_damping=np.zeros(1),
    )
    x = np.zeros((1, 6, 3))
    x[0, :, 2] = 1.0
    x[0, [0, 4, 5, 1], 0] = np.linspace(0, (1 - shortening) * length, 4)
    x[0, [4, 5], 1] = 0.5 * third * np.sqrt(3 * shortening)
    x[0, 3, 0] = 0.5
    pattern = block_pattern(structure.cables, structure.actuators, structure.bars, 6)
    settings = NewtonSettings(0.1, 1.0, 1e-7, 500, 0.02, 1e-3, 0.0, 0.0, 1e9, 12, 1.0, 10)
    records = EquilibriumRecords(x, np.zeros((1, 6, 3)), np.zeros(1), np.zeros(1, np.int64), np.zeros(1, np.bool_), np.zeros(1))
    lanes = newton_lanes(6, structure.n_axial_members, structure.actuator_length, pattern.n_slots, 8)
    count = np.zeros(1, np.int64)
    zero = np.zeros((6, 3))
    newton_equilibria(structure, pattern, zero[0], zero, settings, np.ones((1, 1)), records, lanes, lanes, 0, 1, count)
    assert records.converged[0]
    found = records.positions[0]
    chord = np.linalg.norm(found[1] - found[0])
    return 1e7 * (chord - (1 - shortening) * length) / DESIGN.critical_load, 1 - chord / length


@pytest.mark.parametrize("shortening", [1e-4, 0.01, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5])
def test_one_bar_found_statically_follows_its_closed_form_from_the_euler_load_on(shortening: float) -> None:
    """P/Pcr = theta / sin(theta) where delta/L = (2/3)(1 - cos theta) for rigid segments; compression P/EA shortens them too."""
    load, delta = buckled_bar(shortening)
    squeeze = load * DESIGN.critical_load / DESIGN.bar_rigidity
    # chord = (L/3)(middle + 2 outer cos theta), the outer segments being squeezed by P cos(theta) alone
    middle, theta = 1 - squeeze, 0.0
    for _ in range(50):
        outer = 1 - squeeze * np.cos(theta)
        cosine = (3 * (1 - delta) - middle) / (2 * outer)
        theta = np.arccos(min(cosine, 1.0))
    # hinge moment kappa theta = P times the bow (L / 3) outer sin(theta)
    expected = theta / (np.sin(theta) * outer)
    assert load == pytest.approx(expected, rel=1e-6)


def test_elastica_and_the_chain_of_thirds() -> None:
    """The reduced bar's distance to the elastica at seven shortenings: 0.00, 0.00, 0.02, 0.09, 0.24, 0.49, 0.88 %."""
    published = {0.01: 0, 0.05: 0, 0.1: 2e-4, 0.2: 9e-4, 0.3: 2.4e-3, 0.4: 4.9e-3, 0.5: 8.8e-3}
    for delta, distance in published.items():
        k2 = brentq(lambda m, d=delta: 2 - 2 * ellipe(m) / ellipk(m) - d, 1e-9, 0.9)
        elastica = (2 * ellipk(k2) / np.pi) ** 2
        theta = np.arccos(1 - 1.5 * delta)
        assert abs(theta / np.sin(theta) / elastica - 1) == pytest.approx(distance, abs=6e-5)


def test_gravity_and_scene_enter() -> None:
    earth = form_find([0.5], lattice=CELL)
    moon = form_find([0.5], lattice=CELL, scene=Scene.preset("moon"))
    weight = DESIGN.structure(CELL).mass.sum()
    assert earth.contact_force.sum() == pytest.approx(weight * 9.80665, rel=1e-6)
    assert moon.contact_force.sum() == pytest.approx(weight * 1.625, rel=1e-6)
