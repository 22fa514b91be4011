"""Where methods stop working: each boundary predicted, met on both sides, and what the user sees there.

Figures and tables of the same boundaries: ``python -m benchmarks.accuracy stability limits drops rounding``.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import kernels
import naive
import numpy as np
import pytest

import tensegrity_gym
from benchmarks.accuracy.drops import drop
from tensegrity_gym import Design, Equilibria, HopStatus, InvalidParameterError, Lattice, Scene, form_find, simulate
from tensegrity_gym.events import flew
from tensegrity_gym.timestep import critical_time_step
from tensegrity_gym.types import Ground, Structure

SPACE, NOTHING = Ground(np.zeros(3), 0.0, 0.0), np.zeros(0)
CELL, DESIGN, EARTH = Lattice(1, 1), Design(), Scene()
G = EARTH.gravity
integrators = pytest.mark.parametrize("integrator", list(kernels.INTEGRATORS))


@lru_cache(maxsize=1)
def start() -> Equilibria:
    """Two compressed cells at rest on the ground."""
    return form_find([[0.35], [0.5]], lattice=CELL, threads=1)


def hop(equilibria: Equilibria | None = None, **options: object) -> object:
    """Short hops of the two cells."""
    options = {"scene": Scene(duration=0.1), "lattice": CELL, "threads": 1} | options
    return simulate([[0.35], [0.5]], equilibria=equilibria or start(), **options)  # type: ignore[arg-type]


# --- the step ----------------------------------------------------------------------------------------------------------


def limit(integrator: str, ratio: float) -> float:
    """Largest stable omega dt of a mode of damping ratio ``ratio`` [-].

    Leapfrog with lagged damping: 2 (sqrt(1 + z^2) - z). Runge-Kutta: |1 + z + z^2/2 + z^3/6 + z^4/24| = 1, by scanning.
    """
    if integrator != "runge_kutta":
        return 2 * (np.sqrt(1 + ratio**2) - ratio)
    eigenvalue = -ratio - np.emath.sqrt(ratio**2 - 1.0)
    steps = np.linspace(1e-3, 4, 40_000)
    z = eigenvalue * steps
    return float(steps[np.argmax(np.abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24) > 1 + 1e-9)])


@pytest.mark.parametrize("contrast", [1.0, 1e4])
@pytest.mark.parametrize("ratio", [0.0, 0.1, 1.0, 3.0])
@integrators
def test_two_springs_in_a_line_are_stable_below_the_limit_and_not_above(integrator: str, ratio: float, contrast: float) -> None:
    """omega^2 = (k + K + sqrt(k^2 + K^2 - k K)) / m; a per cent either side. However soft the other spring is."""
    mass, soft = 0.01, 1e5
    hard = contrast * soft
    omega = np.sqrt((soft + hard + np.sqrt(soft**2 + hard**2 - soft * hard)) / mass)
    stiffness = np.array([soft, hard])
    s = naive.make_structure(
        [mass] * 3,
        bars=[[0, 1], [1, 2]],
        segment_stiffness=stiffness,
        segment_length=0.2,
        segment_damping=2 * ratio / omega * stiffness,
    )
    at = np.arange(3)[:, None] * [0.2, 0.0, 0.0] + [0, 0, 5.0]
    for share, grows in ((0.99, False), (1.01, True)):
        x, v = at.copy(), np.zeros((3, 3))
        v[:, 0] = [4.3e-7, -1.07e-6, 6.4e-7]
        dt = share * limit(integrator, ratio) / omega
        kernels.advance(s, NOTHING, SPACE, dt, dt, 4000, x, v, np.zeros((3, 3)), np.zeros(2), np.zeros(3), integrator)
        with np.errstate(invalid="ignore"):
            assert (not np.abs(v).max() < 1e-3) == grows, (share, np.abs(v).max())


def test_postures_of_a_hop_change_the_critical_step_by_less_than_the_margin() -> None:
    """Axes turn while it moves, stiffnesses stay: no posture may need less than the default 0.8 of the unloaded lattice's."""
    structure = DESIGN.structure(CELL)
    r = hop(scene=Scene(duration=0.4), trajectory_rate=50.0)
    unloaded = critical_time_step(structure, DESIGN.unloaded_positions(CELL))
    frames = r.trajectory.positions[0, : r.trajectory.frames[0]]
    along = np.array([critical_time_step(structure, x) for x in frames]) / unloaded
    assert len(along) > 15
    assert 0.97 < along.min() < along.max() < 1.03


def test_a_hop_holds_just_below_the_critical_step_and_says_where_it_broke_just_above() -> None:
    """The limit is the unloaded lattice's; postures take 1 % of it (test above). At the step itself it may go either way."""
    critical = critical_time_step(DESIGN.structure(CELL), DESIGN.unloaded_positions(CELL))
    fine = hop(dt=0.97 * critical)
    assert flew(fine.status).all()
    total = fine.energies.sum(axis=2)
    assert (np.abs(total - total[:, :1]).max(axis=1) < 2e-3 * fine.stored_energy).all()
    with pytest.raises(InvalidParameterError, match=r"above the critical step of symplectic_euler"):
        hop(dt=1.03 * critical)
    broken = hop(dt=1.03 * critical, allow_unstable=True)
    assert (broken.status == HopStatus.UNSTABLE).all()
    assert all("use a smaller dt" in line and "at mass" in line for line in broken.describe_failures())


@pytest.mark.parametrize("factor", [10**-1.5, 10**1.5])
def test_the_step_follows_the_stiffness_over_three_decades(factor: float) -> None:
    """dt = (2/omega) (sqrt(1 + z^2) - z) with omega ~ sqrt(E) and z = bar_damping omega / 2 of the fastest mode."""
    steps = []
    for e in (1.0, factor):
        design = replace(DESIGN, bar_modulus=e * DESIGN.bar_modulus, cable_modulus=e * DESIGN.cable_modulus, cable_damping=0.0)
        undamped = replace(design, bar_damping=0.0)
        x = design.unloaded_positions(CELL)
        omega = 2 / critical_time_step(undamped.structure(CELL), x)
        z = 0.5 * design.bar_damping * omega
        # the fastest mode has some cable in it, which is not damped here: to 3 % of the share that damping takes
        expected = 2 / omega * (np.sqrt(1 + z**2) - z)
        share = z + 1e-5
        assert critical_time_step(design.structure(CELL), x) == pytest.approx(expected, rel=0.03 * share)
        steps.append(2 / omega)
    assert steps[1] == pytest.approx(steps[0] / np.sqrt(factor), rel=1e-3)  # bars shorten by their prestress strain


# --- gravity -----------------------------------------------------------------------------------------------------------


def test_gravity_from_a_hundredth_of_g_to_too_much() -> None:
    """Flies while its energy can lift it into its unloaded shape, v^2 <= 2 (U - m g h)/m; 30 g are too many."""
    structure = DESIGN.structure(CELL)
    mass, unloaded = structure.mass.sum(), DESIGN.unloaded_positions(CELL)
    speeds = []
    for gravity in (0.01 * G, 0.1 * G, G, 30 * G):
        scene = Scene(gravity=gravity, duration=0.1)
        found = form_find([[0.35]], lattice=CELL, scene=scene, threads=1)
        r = simulate([[0.35]], lattice=CELL, scene=scene, equilibria=found, threads=1)
        rise = (structure.mass @ (unloaded[:, 2] - unloaded[:, 2].min() - found.positions[0, :, 2])) / mass
        budget = r.stored_energy[0] - mass * gravity * rise
        assert flew(r.status)[0] == (budget > 0), gravity
        assert 0.5 * mass * r.takeoff_velocity[0, 2] ** 2 <= max(budget, 0.0) + 1e-9
        speeds.append(r.takeoff_velocity[0, 2])
    assert speeds[0] == pytest.approx(speeds[1], rel=0.03)  # weight does nothing next to the bars any more
    assert speeds[2] > 0.9 * speeds[1]
    assert speeds[3] == 0.0


# --- friction and restitution ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("friction", [0.0, 0.3, 1.0, 5.0])
@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_contact_of_any_kind_keeps_the_books_and_nothing_sinks(friction: float, restitution: float) -> None:
    """Two impacts: energy balances to 1e-3 of the stored one, contact never gives any, and no mass is deeper than v dt."""
    scene = Scene(friction=friction, restitution=restitution, duration=0.6)
    r = hop(scene=scene, trajectory_rate=200.0)
    total, lost = r.energies.sum(axis=2), r.energies[:, :, 5]
    assert (np.abs(total - total[:, :1]).max(axis=1) < 1e-3 * r.stored_energy).all()
    assert (np.diff(lost, axis=1) > -1e-9).all()
    fastest = np.sqrt(2 * r.stored_energy.max() / DESIGN.structure(CELL).mass.min())  # all of it in the lightest mass
    assert -r.trajectory.positions[..., 2].min() < fastest * r.dt
    if friction == 0.0:  # nothing pushes it sideways
        assert np.abs(r.rest).max() < 1e-9
    if friction == 0.0 and restitution == 1.0:
        assert lost.max() < 2e-2 * r.stored_energy.min()  # a step's m g dt |v| at every one of many impacts


@pytest.mark.parametrize("restitution", [0.0, 0.9])
def test_a_lattice_stays_on_an_incline_up_to_the_angle_of_friction(restitution: float) -> None:
    """Sticks iff tan(theta) <= mu, else slides with g (sin - mu cos); mu = 0.2, as a cell tips over at some 20 degrees.

    Let go unloaded it sways, and its feet slip by millimetres until that is damped away (here 10 times the default damping);
    what is left is a creep of some micrometres a second while bars tremble.
    """
    design = replace(DESIGN, hinge_damping=10 * DESIGN.hinge_damping)
    structure, x0 = design.structure(CELL), design.unloaded_positions(CELL)
    x0[:, 2] -= x0[:, 2].min()
    dt, mu, lengths = 0.8 * critical_time_step(structure, x0), 0.2, structure.actuator_length
    moved = {}
    for factor in (0.5, 1.3):
        angle = np.arctan(mu * factor)
        ground = Ground(G * np.array([np.sin(angle), 0.0, -np.cos(angle)]), mu, restitution)
        x, v, memory = x0.copy(), np.zeros_like(x0), np.zeros(structure.n_axial_members)
        means = []
        for first, time in ((0.5 * dt, 1.2), (dt, 0.5)):
            kernels.advance(structure, lengths, ground, dt, first, round(time / dt), x, v, 0 * x, memory, np.zeros(3))
            means.append(x[x0[:, 2] < 1e-6, 0].mean())
        moved[factor] = means[1] - means[0]
    slide = G * (np.sin(np.arctan(1.3 * mu)) - mu * np.cos(np.arctan(1.3 * mu))) * (1.7**2 - 1.2**2) / 2
    assert abs(moved[0.5]) < 1e-4
    assert moved[1.3] == pytest.approx(slide, rel=0.2)


# --- drops -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("speed", "fold"), [(1.0, (0, 10)), (10.0, (20, 60)), (30.0, (30, 120))])
def test_a_dropped_cell_buckles_and_springs_back_with_its_energy_accounted_for(speed: float, fold: tuple[float, float]) -> None:
    """Below the critical step the audit closes to 1e-3 of the energy at impact, hinges folding by up to ``fold`` degrees.

    Above it the same drop blows up: no posture of the crushed lattice needs a smaller step by more than a per cent.
    """
    found = drop(speed, 0.9, 0.06, CELL)
    assert found["audit"] < 1e-3
    assert fold[0] < np.degrees(found["fold"]) < fold[1]
    assert found["critical"] > 0.98
    assert np.isnan(drop(speed, 1.05, 0.06, CELL)["audit"])


@pytest.mark.parametrize("speed", [1.0, 30.0])
def test_what_the_user_sees_of_a_drop(speed: float) -> None:
    """A landing with its energy accounted for below the critical step, a refusal with both numbers above it."""
    critical = critical_time_step(DESIGN.structure(CELL), DESIGN.unloaded_positions(CELL))
    scene = Scene(duration=0.1)
    r = tensegrity_gym.drop([0.0, 0.0, -speed], lattice=CELL, scene=scene, threads=1)
    assert r.status.tolist() == [HopStatus.TIME_LIMIT]
    total = r.energies.sum(axis=2)[0]
    assert np.abs(total - total[0]).max() < 1e-3 * r.energies[0, 0, 3]
    with pytest.raises(InvalidParameterError, match="above the critical step"):
        tensegrity_gym.drop([0.0, 0.0, -speed], lattice=CELL, scene=scene, dt=1.05 * critical, threads=1)


# --- degenerate geometry -----------------------------------------------------------------------------------------------


def one_bar(*points: tuple[float, float, float]) -> tuple[Structure, np.ndarray]:
    """A bar of thirds with damped springs and hinges through ``points``."""
    s = naive.make_structure(
        [0.01, 0.03, 0.03, 0.01],
        bars=[[0, 1, 2, 3]],
        segment_stiffness=1e6,
        segment_length=0.1,
        segment_damping=1.0,
        hinge_stiffness=9.0,
        hinge_damping=4e-3,
    )
    return s, np.array(points)


def force(s: Structure, x: np.ndarray, v: np.ndarray | None = None) -> np.ndarray:
    f = np.zeros_like(x)
    kernels.forces(s, NOTHING, np.zeros(3), x, np.zeros_like(x) if v is None else v, f, np.zeros(s.n_axial_members), np.zeros(1))
    return f


@pytest.mark.parametrize("folds", [1, 2])
def test_a_bar_folded_flat_has_finite_forces_that_sum_to_nothing(folds: int) -> None:
    """At 180 degrees the direction to unfold is undefined: exactly there the hinge does nothing that is not finite."""
    s, x = one_bar((0, 0, 5.0), (0.1, 0, 5.0), (0, 0, 5.0), (0.1 if folds == 2 else -0.1, 0, 5.0))
    rng = np.random.default_rng(0)
    flat = force(s, x, rng.normal(size=x.shape))
    assert np.isfinite(flat).all()
    np.testing.assert_allclose(flat.sum(axis=0), 0.0, atol=1e-6)


def test_unfolding_from_flat_starts_with_the_moment_kappa_pi() -> None:
    """M = kappa theta -> kappa pi: each end of the fold is pushed by M / a, to the angle's own 1e-4."""
    bend = 1e-4
    s, x = one_bar((-0.1, 0, 5.0), (0, 0, 5.0), (0.1, 0, 5.0), (0.1 - 0.1 * np.cos(bend), 0, 5.0 + 0.1 * np.sin(bend)))
    f = force(s, x)
    assert np.linalg.norm(f[3]) == pytest.approx(9.0 * np.pi / 0.1, rel=1e-3)
    assert f[3, 2] > 0  # away from flat


def test_coincident_masses_of_a_bar_are_an_error_that_a_cable_survives() -> None:
    """A cable of no length pulls with nothing; a bar segment of no length has no direction: not a number, at once."""
    cable = naive.make_structure([1.0, 1.0], cables=[[0, 1]], cable_stiffness=1e5, cable_length=0.1, cable_damping=1.0)
    assert force(cable, np.zeros((2, 3))).tolist() == np.zeros((2, 3)).tolist()
    s, x = one_bar((0, 0, 5.0), (0.1, 0, 5.0), (0.1, 0, 5.0), (0.2, 0, 5.0))
    with np.errstate(all="ignore"):
        assert not np.isfinite(force(s, x)).all()


def test_a_hop_from_coincident_masses_is_unstable_and_its_neighbour_is_not() -> None:
    """What the user sees: status UNSTABLE, the mass, a finite landing; and the hop beside it has its own bits."""
    positions = start().positions.copy()
    inner = CELL.n_nodes + 2 * CELL.n_cells
    positions[0, inner] = positions[0, inner + 1]
    broken, whole = hop(replace(start(), positions=positions)), hop()
    assert broken.status.tolist() == [HopStatus.UNSTABLE, whole.status[1]]
    assert broken.failed_mass[0] >= 0
    assert np.isfinite(broken.landing).all()
    assert "kinetic energy out of all bounds or not finite" in broken.describe_failures()[0]
    np.testing.assert_array_equal(broken.rest[1], whole.rest[1])


# --- single precision over long flights --------------------------------------------------------------------------------


def test_float32_on_the_moon_keeps_the_parabola_to_what_rounding_of_steps_can_do() -> None:
    """A step moves a mass by v dt, rounded to half an ulp of its position: to 2^-24 |x| each step, and random over many.

    Over n steps of a flight the sum of such roundings is sqrt(n) half ulps if they are independent, n if all go one way; the
    measured distance from float64 lies between nothing and the worst case, and far below it.
    """
    scene = Scene.preset("moon", duration=6.5, landing="touchdown")
    found = form_find([[0.4]], lattice=CELL, scene=scene, threads=1)
    r = {
        p: simulate([[0.4]], lattice=CELL, scene=scene, equilibria=found, threads=1, precision=p) for p in ("float64", "float32")
    }
    flight, height = r["float64"].flight_time[0], r["float64"].apex[0]
    assert flight > 2.0
    worst = flight / r["float64"].dt * 2.0**-24 * height
    apart = abs(r["float32"].touchdown_time[0] - r["float64"].touchdown_time[0]) * scene.gravity * flight / 2
    assert worst > 2e-2
    assert apart < 0.05 * worst
    assert abs(r["float32"].apex[0] - height) < 0.05 * worst
