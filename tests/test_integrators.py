"""Every integrator against analytic motion: its order, its stability limit, and what it conserves.

The steps take any force function, so they are tested on oscillators far above the ground before the lattice.
"""

from __future__ import annotations

import numpy as np
import pytest

from tensegrity_gym.core.forces import lattice_forces
from tensegrity_gym.core.integrators import runge_kutta_step, symplectic_euler_step, velocity_verlet_step
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import load, store
from tensegrity_gym.design import Design
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.timestep import critical_time_step
from tensegrity_gym.types import Ground, Structure

HEIGHT = 10.0  #: no oscillator here comes near the ground
OMEGA, DAMPING = 3.0, 0.8  #: [rad/s], [1/s]


def one_mass() -> Structure:
    """A free point mass of 1 kg without members."""
    empty, pairs = np.zeros(0), np.zeros((0, 2), dtype=np.int64)
    return Structure(
        mass=np.ones(1),
        inverse_mass=np.ones(1),
        cables=pairs,
        cable_stiffness=empty,
        cable_length=empty,
        cable_damping=empty,
        actuators=pairs,
        actuator_rigidity=empty,
        actuator_length=empty,
        actuator_damping=empty,
        bars=np.zeros((0, 4), dtype=np.int64),
        segment_stiffness=empty,
        segment_length=empty,
        segment_damping=empty,
        hinge_stiffness=empty,
        hinge_damping=empty,
    )


@jit
def pendulum_like(structure, actuator_length, gravity, x, v, f, memory):
    """A Duffing spring along x, f = -omega^2 (d + d^3), with viscous damping ``memory[0]``: smooth and not linear."""
    d = load(x, 0, 0)
    store(f, 0, 0, -9.0 * (d + d * d * d) - memory[0] * load(v, 0, 0))
    store(f, 0, 1, 0.0 * d)
    store(f, 0, 2, 0.0 * d)
    return memory[0] * load(v, 0, 0) * load(v, 0, 0)


@jit(forceinline=False, cache=True)
def run_oscillator(method, structure, ground, dt, steps, half_start, x, v, f, memory, work):
    """``steps`` of method 0 (symplectic Euler), 1 (velocity Verlet) or 2 (Runge-Kutta) on the Duffing spring."""
    pendulum_like(structure, structure.actuator_length, ground.gravity, x, v, f, memory)
    for k in range(steps):
        kick = 0.5 * dt if k == 0 and half_start else dt
        if method == 0:
            symplectic_euler_step(pendulum_like, structure, structure.actuator_length, ground, dt, kick, x, v, f, memory, work)
        elif method == 1:
            velocity_verlet_step(pendulum_like, structure, structure.actuator_length, ground, dt, kick, x, v, f, memory, work)
        else:
            runge_kutta_step(pendulum_like, structure, structure.actuator_length, ground, dt, kick, x, v, f, memory, work)


@jit(forceinline=False, cache=True)
def run_lattice(method, structure, ground, dt, steps, x, v, f, memory, work):
    """``steps`` of the lattice by one of the methods."""
    lattice_forces(structure, structure.actuator_length, ground.gravity, x, v, f, memory)
    for _ in range(steps):
        if method == 0:
            symplectic_euler_step(lattice_forces, structure, structure.actuator_length, ground, dt, dt, x, v, f, memory, work)
        elif method == 1:
            velocity_verlet_step(lattice_forces, structure, structure.actuator_length, ground, dt, dt, x, v, f, memory, work)
        else:
            runge_kutta_step(lattice_forces, structure, structure.actuator_length, ground, dt, dt, x, v, f, memory, work)


def _oscillate(method: int, dt: float, damping: float, time: float = 2.0) -> float:
    x, v = np.array([[1.0, 0.0, HEIGHT]]), np.zeros((1, 3))
    ground = Ground(np.zeros(3), 0.5, 0.0)
    work, memory = np.zeros((4, 3)), np.array([damping])
    run_oscillator(method, one_mass(), ground, dt, round(time / dt), method == 0, x, v, np.zeros((1, 3)), memory, work)
    return float(x[0, 0])


def _exact(damping: float, time: float = 2.0) -> float:
    from scipy.integrate import solve_ivp

    def rate(_t, y):
        return [y[1], -9.0 * (y[0] + y[0] ** 3) - damping * y[1]]

    found = solve_ivp(rate, (0, time), [1.0, 0.0], method="DOP853", rtol=1e-13, atol=1e-14)
    return float(found.y[0, -1])


@pytest.mark.parametrize(
    ("method", "damping", "order"),
    [
        # damping is taken at the last half step (first order) by symplectic Euler; Verlet's uses the same half step for
        # its two half kicks, an error of first order too; Runge-Kutta knows no difference
        (0, 0.0, 2),
        (1, 0.0, 2),
        (2, 0.0, 4),
        (0, DAMPING, 1),
        (2, DAMPING, 4),
    ],
)
def test_order(method, damping, order):
    exact = _exact(damping)
    steps = np.array([0.02, 0.01, 0.005, 0.0025])
    errors = np.array([abs(_oscillate(method, dt, damping) - exact) for dt in steps])
    slopes = np.diff(np.log(errors)) / np.diff(np.log(steps))
    # the slope tends to the order as dt -> 0; at these steps (omega dt from 0.1) the next term is worth under 0.1
    assert slopes[-1] == pytest.approx(order, abs=0.1), (errors, slopes)


@pytest.mark.parametrize(("method", "gain"), [(0, 1.0), (1, 1.0), (2, np.sqrt(2.0))])
def test_stability_ends_within_5_percent_of_the_predicted_step(method, gain):
    # |omega dt| < 2 for the symplectic methods, < 2 sqrt 2 for Runge-Kutta on an undamped oscillator of any frequency
    lattice = Lattice(1, 1)
    design = Design(bar_damping=0.0, cable_damping=0.0, hinge_damping=0.0)
    structure = design.structure(lattice)
    start = design.unloaded_positions(lattice) + np.array((0.0, 0.0, HEIGHT))
    critical = gain * critical_time_step(structure, start)
    ground = Ground(np.zeros(3), 0.5, 0.0)
    growth = {}
    for ratio in (0.5, 0.95, 1.05, 1.5):
        x, v = start.copy(), np.random.default_rng(0).normal(0, 1e-7, start.shape)
        before = float((v**2).sum())
        work = np.zeros((4 * len(x), 3))
        run_lattice(
            method,
            structure,
            ground,
            ratio * critical,
            400,
            x,
            v,
            np.zeros_like(x),
            np.zeros(structure.n_axial_members),
            work,
        )
        with np.errstate(over="ignore", invalid="ignore"):
            growth[ratio] = float((v**2).sum()) / before
    # 5 % past the limit the worst mode grows by exp(2 arccosh(2 * 1.05^2 - 1)) > 3 a step for the symplectic methods and by
    # |R(2 sqrt 2 * 1.05 i)| = 1.4 for Runge-Kutta: to overflow or at least 1e20 in 400 steps, until cables go slack
    for ratio in (0.5, 0.95):
        assert growth[ratio] < 100, (ratio, growth)
    for ratio in (1.05, 1.5):
        assert not growth[ratio] < 1e6, (ratio, growth)


@pytest.mark.parametrize("method", [0, 1])
def test_undamped_energy_does_not_drift(method):
    # symplectic: the energy error oscillates at O(dt^2) and does not grow with time
    lattice = Lattice(1, 1)
    design = Design(bar_damping=0.0, cable_damping=0.0, hinge_damping=0.0)
    structure = design.structure(lattice)
    start = design.unloaded_positions(lattice) + np.array((0.0, 0.0, HEIGHT))
    ground = Ground(np.zeros(3), 0.5, 0.0)
    rng = np.random.default_rng(1)
    x, v = start + rng.normal(0, 1e-3, start.shape), rng.normal(0, 0.05, start.shape)
    f, memory, work = np.zeros_like(x), np.zeros(structure.n_axial_members), np.zeros((4 * len(x), 3))
    dt = 0.2 * critical_time_step(structure, start)

    def energy() -> float:
        from tensegrity_gym.energies import elastic_energies, kinetic_energy

        def potential(at):
            return sum(float(e[0]) for e in elastic_energies(structure, at[None], structure.actuator_length[None]).values())

        kinetic = float(kinetic_energy(structure, v[None])[0])
        if method == 0:  # velocities trail by half a step: the mean of both ends' potential goes with them
            return kinetic + 0.5 * (potential(x) + potential(x - dt * v))
        return kinetic + potential(x)

    run_lattice(method, structure, ground, dt, 10, x, v, f, memory, work)
    values = []
    for _ in range(20):
        values.append(energy())
        run_lattice(method, structure, ground, dt, 2000, x, v, f, memory, work)
    values = np.array(values)
    spread = np.ptp(values) / values.mean()
    trend = abs(np.polyfit(np.arange(len(values)), values, 1)[0]) * len(values) / values.mean()
    # a mode's energy so measured alternates by +-(omega dt)^2 / 4 of itself; the stiffest has omega dt = 0.4
    assert spread < 2 * 0.4**2 / 4
    assert trend < 0.02


@pytest.mark.parametrize("method", [0, 1, 2])
def test_momentum_and_angular_momentum_in_flight(method):
    # internal forces, damping included, exert no total force and no torque: only rounding is left, eps times the turnover
    lattice, design = Lattice(2, 1), Design()
    structure = design.structure(lattice)
    start = design.unloaded_positions(lattice) + np.array((0.0, 0.0, 1.0))
    rng = np.random.default_rng(2)
    x, v = start + rng.normal(0, 2e-3, start.shape), rng.normal(0, 1.0, start.shape)
    v += np.cross(np.array((1.0, 2.0, 0.5)), x)
    mass = structure.mass[:, None]

    def momenta():
        return (mass * v).sum(axis=0), np.cross(x, mass * v).sum(axis=0)

    linear, angular = momenta()
    ground = Ground(np.zeros(3), 0.5, 0.0)
    dt = 0.5 * critical_time_step(structure, start)
    for _ in range(5):
        f, memory, work = np.zeros_like(x), np.zeros(structure.n_axial_members), np.zeros((4 * len(x), 3))
        run_lattice(method, structure, ground, dt, 400, x, v, f, memory, work)
    after, turned = momenta()
    scale = np.abs(mass * v).sum()
    np.testing.assert_allclose(after, linear, rtol=0, atol=1e-12 * scale)
    if method == 2:  # Runge-Kutta keeps angular momentum to its order only: (omega dt)^5 of the stiffest modes each step
        np.testing.assert_allclose(turned, angular, rtol=0, atol=1e-4 * scale)
    else:
        np.testing.assert_allclose(turned, angular, rtol=0, atol=1e-12 * scale)
