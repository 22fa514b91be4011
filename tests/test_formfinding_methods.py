"""Methods of form-finding: on analytic problems, against each other, against scipy, and on both sides of where they work."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from tensegrity_gym import Design, Equilibria, InvalidParameterError, InvalidStretchesError, Lattice, Scene, form_find
from tensegrity_gym.core.conjugate_gradient import DescentSettings, conjugate_gradient, parabola_minimum
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import load, select, splat, sqrt, store
from tensegrity_gym.core.newton import EquilibriumRecords, NewtonSettings, newton_equilibria
from tensegrity_gym.core.relaxation import RelaxationSettings, relax
from tensegrity_gym.elimination import block_pattern
from tensegrity_gym.searches import SearchOptions, fictitious_masses
from tensegrity_gym.types import Structure
from tensegrity_gym.workspaces import descent_lanes, lane_array, newton_lanes, relaxation_lanes, without_lanes

CELL = Lattice(1, 1)
DESIGN = Design()


@jit
def rosenbrock(problem, x):
    """(1 - a)^2 + 100 (b - a^2)^2 of x = [[a, b]]."""
    a, b = load(x, 0, 0), load(x, 0, 1)
    return (1.0 - a) * (1.0 - a) + 100.0 * (b - a * a) * (b - a * a)


@jit
def rosenbrock_forces(problem, x, f):
    """Minus its gradient; returns the norm."""
    a, b = load(x, 0, 0), load(x, 0, 1)
    along, across = 2.0 * (1.0 - a) + 400.0 * a * (b - a * a), -200.0 * (b - a * a)
    store(f, 0, 0, along)
    store(f, 0, 1, across)
    return sqrt(along * along + across * across)


@jit
def quadratic(problem, x):
    """x . K x / 2 - b . x with problem = (K, b)."""
    total = load(x, 0, 0) * 0.0
    for i in range(x.shape[0]):
        row = total * 0.0
        for j in range(x.shape[0]):
            row = row + problem[0][i, j] * load(x, j, 0)
        total = total + load(x, i, 0) * (0.5 * row - problem[1][i])
    return total


@jit
def quadratic_forces(problem, x, f):
    """b - K x; returns the largest entry."""
    worst = load(x, 0, 0) * 0.0
    for i in range(x.shape[0]):
        force = splat(problem[1][i], worst)
        for j in range(x.shape[0]):
            force = force - problem[0][i, j] * load(x, j, 0)
        store(f, i, 0, force)
        size = select(force < 0.0, -force, force)
        worst = select(size > worst, size, worst)
    return worst


class Starts(NamedTuple):
    """Where searches start and what they end with, in the order of the starts."""

    x: np.ndarray  #: shape (n, ...)
    lanes_x: np.ndarray  #: of the searches, shape (..., lanes)
    case: np.ndarray  #: which start each lane has, shape (lanes,)
    next: np.ndarray  #: start not yet taken, shape (1,)
    residual: np.ndarray  #: shape (n,)
    iterations: np.ndarray  #: shape (n,)
    evaluations: np.ndarray  #: shape (n,)


@jit
def copy_rows(source, target):
    """target = source, shape (n, k) each."""
    for i in range(source.shape[0]):
        for c in range(source.shape[1]):
            target[i, c] = source[i, c]


@jit(forceinline=False)
def next_start(problem, starts, lane, residual, iterations, evaluations):
    """Note what a lane's search ended with, and load the next start."""
    case = starts.case[lane]
    if case >= 0:
        copy_rows(starts.lanes_x[:, :, lane], starts.x[case])
        starts.residual[case] = residual
        starts.iterations[case] = iterations
        starts.evaluations[case] = evaluations
    starts.case[lane] = starts.next[0]
    if starts.next[0] == len(starts.x):
        starts.case[lane] = -1
        return False
    copy_rows(starts.x[starts.next[0]], starts.lanes_x[:, :, lane])
    starts.next[0] += 1
    return True


@jit(cache=False, forceinline=False, _nrt=True)
def run_rosenbrock(starts, settings, lanes, work):
    """Conjugate gradients on Rosenbrock's valley."""
    conjugate_gradient(rosenbrock, rosenbrock_forces, next_start, 0.0, starts, settings, lanes, work)


@jit(cache=False, forceinline=False, _nrt=True)
def run_quadratic(problem, starts, settings, lanes, work):
    """Conjugate gradients on a quadratic."""
    conjugate_gradient(quadratic, quadratic_forces, next_start, problem, starts, settings, lanes, work)


@jit(cache=False, forceinline=False, _nrt=True)
def run_relaxation(problem, starts, settings, lanes, work):
    """Relaxation of a quadratic."""
    relax(quadratic_forces, next_start, problem, starts, settings, lanes, work)


def queue_of(x: np.ndarray, lanes_x: np.ndarray) -> Starts:
    n, count = len(x), lanes_x.shape[-1]
    case, first = np.full(count, -1), np.zeros(1, np.int64)
    return Starts(x.copy(), lanes_x, case, first, np.zeros(n), np.zeros(n, np.int64), np.zeros(n, np.int64))


def by_gradients(run: Callable[..., None], x: np.ndarray, settings: DescentSettings, count: int = 1) -> Starts:
    """Conjugate gradients from ``x``, (n, m, k), in ``count`` lanes (8), or without (1)."""
    lanes = descent_lanes(lane_array(count, *x.shape[1:]))
    starts = queue_of(x, lanes.x)
    run(starts, settings, lanes, lanes if count > 1 else without_lanes(lanes))
    return starts


def by_relaxation(
    problem: tuple[np.ndarray, np.ndarray], x: np.ndarray, mass: float, settings: RelaxationSettings, count: int = 1
) -> Starts:
    """Relaxation of a quadratic from ``x``, (n, m, 1), in ``count`` lanes (8), or without (1)."""
    masses = lane_array(count, x.shape[1])
    masses[:] = mass
    lanes = relaxation_lanes(lane_array(count, *x.shape[1:]), masses)
    starts = queue_of(x, lanes.x)
    run_relaxation(problem, starts, settings, lanes, lanes if count > 1 else without_lanes(lanes))
    return starts


def same_searches(one: Starts, other: Starts) -> None:
    for name in ("x", "residual", "iterations", "evaluations"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


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
    """From 13 starts, in lanes, which take their next start when they are done, and one after another: the same bits."""
    x = np.concatenate([[[[-1.2, 1.0]]], np.random.default_rng(0).uniform(-2.0, 2.0, size=(12, 1, 2))])
    found = by_gradients(run_rosenbrock, x, descent(), 8)
    assert (found.residual <= 1e-6).all()
    np.testing.assert_allclose(found.x, 1.0, atol=1e-5)
    assert (found.iterations < 200).all()
    assert (found.evaluations > found.iterations).all()
    assert len(np.unique(found.evaluations)) > 5  # lanes go their own ways
    same_searches(found, by_gradients(run_rosenbrock, x, descent()))


@pytest.mark.parametrize("n", [2, 5, 12])
def test_conjugate_gradients_end_a_quadratic_in_its_dimension(n: int) -> None:
    """With exact line searches conjugate directions are done in n; rounding of energies (1e-16 of them) costs a few more."""
    k, b = spd(n, 30.0), np.arange(1.0, n + 1)
    settings = descent(tolerance=1e-5, line_tolerance=1e-9, longest_step=1e3)
    found = by_gradients(partial(run_quadratic, (k, b)), np.zeros((1, n, 1)), settings)
    assert found.residual[0] <= 1e-5
    assert found.iterations[0] <= n + 3
    np.testing.assert_allclose(found.x[0, :, 0], np.linalg.solve(k, b), atol=1e-4)


def test_conjugate_gradients_end_at_their_caps() -> None:
    """Of directions: exactly so many. Of precision: no tolerance, so the search ends where no energy is lower."""
    x = np.array([[[-1.2, 1.0]], [[1.0, 1.0]], [[2.0, -1.0]]])
    found = by_gradients(run_rosenbrock, x, descent(max_iterations=7), 8)
    np.testing.assert_array_equal(found.iterations, (7, 0, 7))
    assert (found.residual[[0, 2]] > 1e-6).all()
    stuck = by_gradients(run_rosenbrock, x, descent(tolerance=0.0), 8)
    assert (stuck.iterations < 5000).all()
    np.testing.assert_allclose(stuck.x, 1.0, atol=1e-6)
    same_searches(stuck, by_gradients(run_rosenbrock, x, descent(tolerance=0.0)))


def relaxing(**changes: float) -> RelaxationSettings:
    base = RelaxationSettings(tolerance=1e-8, max_iterations=5000, kinetic=False, softest=1e-3, longest_step=10.0)
    return base._replace(**changes)


@pytest.mark.parametrize("kinetic", [False, True])
def test_relaxation_rests_at_the_minimum_of_a_quadratic(kinetic: bool) -> None:
    """From 11 starts, in lanes and one after another: the same bits."""
    k, b = spd(6, 100.0), np.ones(6)
    mass = 0.26 * 100.0  # stable while mass > stiffness / 4
    x = np.concatenate([np.zeros((1, 6, 1)), np.random.default_rng(0).normal(size=(10, 6, 1))])
    found = by_relaxation((k, b), x, mass, relaxing(kinetic=kinetic), 8)
    assert (found.residual <= 1e-8).all()
    assert (found.iterations < 2000).all()
    np.testing.assert_array_equal(found.evaluations, found.iterations + 1)
    np.testing.assert_allclose(found.x[:, :, 0], np.linalg.solve(k, b)[None].repeat(11, 0), atol=1e-7)
    same_searches(found, by_relaxation((k, b), x, mass, relaxing(kinetic=kinetic)))


def test_relaxation_with_less_than_a_quarter_of_the_stiffness_runs_away() -> None:
    k, b = spd(6, 100.0), np.ones(6)
    found = by_relaxation((k, b), np.zeros((1, 6, 1)), 0.2 * 100.0, relaxing(max_iterations=3000))
    assert found.residual[0] > 1.0
    assert found.iterations[0] == 3000


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


@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("cg", SearchOptions(tolerance=1e-3)),
        ("cg", SearchOptions(max_iterations=50)),
        ("relaxation", SearchOptions(tolerance=1e-4, damping="viscous")),
        ("relaxation", SearchOptions(tolerance=1e-3, damping="kinetic")),
    ],
)
def test_first_order_methods_give_the_same_bits_in_lanes_and_alone(method: str, options: SearchOptions) -> None:
    """Eleven cells in eight lanes, reversed over two threads, and one at a time, which kernels search without lanes."""
    stretches = np.random.default_rng(4).uniform(0.2, 0.8, size=(11, 1))
    whole = form_find(stretches, lattice=CELL, method=method, options=options, threads=1)
    other = form_find(stretches[::-1], lattice=CELL, method=method, options=options, threads=2)
    assert whole.converged.all() == (options.max_iterations is None)
    alone = [form_find(row, lattice=CELL, method=method, options=options) for row in stretches]
    for name in ("positions", "converged", "iterations", "evaluations", "residual", "contact_force"):
        values = getattr(whole, name)
        np.testing.assert_array_equal(getattr(other, name)[::-1], values, err_msg=name)
        for k in range(11):
            np.testing.assert_array_equal(getattr(alone[k], name)[0], values[k], err_msg=f"{name} {k}")


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
    for name in ("tolerance", "max_iterations", "load_step", "line_tolerance", "line_cap"):
        with pytest.raises(InvalidParameterError, match=rf"SearchOptions\.{name}: expected a finite number > 0, got 'x'"):
            form_find(STRETCHES, lattice=CELL, options=SearchOptions(**{name: "x"}))  # type: ignore[arg-type]
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
