"""The core's inlined functions as callables: each test compiles nothing of its own, and the cache keeps what is compiled here.

Every function works on scalar arrays ``[mass, component]`` and on lane arrays ``[mass, component, lane]``.
"""

from __future__ import annotations

import numpy as np

from tensegrity_gym.core.cholesky import factorise, solve
from tensegrity_gym.core.energy import actuator_energy, bar_energy, cable_energy, gravitational_energy, kinetic_energy
from tensegrity_gym.core.forces import lattice_forces
from tensegrity_gym.core.integrators import runge_kutta_step, symplectic_euler_step, velocity_verlet_step
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import any_lane, fma, lane_count, lanes_empty, load, load1, select, splat, sqrt, store, store1
from tensegrity_gym.core.members import angle_over_sine, angle_squared, cable_tension, hinge_damping_factor
from tensegrity_gym.core.tangent import angle_over_sine_derivative, lattice_tangent

#: Rows of ``out`` that :func:`lane_operations` fills.
OPERATIONS = (
    "add", "subtract", "multiply", "divide", "negate", "sqrt", "fma", "less", "less_equal", "greater", "greater_equal",
    "and", "or", "splat", "number_left", "number_right", "plain_index", "any_less",
)  # fmt: skip


def stack(arrays: list[np.ndarray]) -> np.ndarray:
    """A lane array whose lane k is ``arrays[k % len(arrays)]``."""
    lanes = lanes_empty(arrays[0].shape, arrays[0].dtype)
    for k in range(lanes.shape[-1]):
        lanes[..., k] = arrays[k % len(arrays)]
    return lanes


def lane_numbers(dtype: type = np.float64) -> int:
    """Lanes of ``dtype``."""
    return lane_count(dtype)


@jit(cache=True)
def lane_operations(values, out):
    """Every operation on (a, b, c) = values[0], shape (1, 3[, lanes]); ``out`` has a row for each of OPERATIONS."""
    a, b, c = load(values, 0, 0), load(values, 0, 1), load(values, 0, 2)
    one, zero = splat(1.0, a), splat(0.0, a)
    store1(out, 0, a + b)
    store1(out, 1, a - b)
    store1(out, 2, a * b)
    store1(out, 3, a / b)
    store1(out, 4, -a)
    store1(out, 5, sqrt(a))
    store1(out, 6, fma(a, b, c))
    store1(out, 7, select(a < b, one, zero))
    store1(out, 8, select(a <= b, one, zero))
    store1(out, 9, select(a > b, one, zero))
    store1(out, 10, select(a >= b, one, zero))
    store1(out, 11, select((a < b) & (b < c), one, zero))
    store1(out, 12, select((a < b) | (b < c), one, zero))
    store1(out, 13, splat(0.1, a))
    store1(out, 14, 0.5 * a)
    store1(out, 15, a - 2.0)
    store1(out, 16, load1(out, 0))
    store1(out, 17, zero)
    if any_lane(a < b):
        store1(out, 17, one)


@jit(cache=True)
def copy_shifted(source, target):
    """target[(i + 1) mod n, (c + 1) mod 3] = source[i, c] through load and store."""
    n = source.shape[0]
    for i in range(n):
        for c in range(3):
            store(target, (i + 1) % n, (c + 1) % 3, load(source, i, c))


@jit(cache=True)
def hinge_functions(s, out):
    """Rows of ``out``: theta / sin theta, theta^2 and d(theta / sin theta)/ds of the hinges ``s``, shape (n[, lanes])."""
    for i in range(s.shape[0]):
        value = load1(s, i)
        store(out, 0, i, angle_over_sine(value))
        store(out, 1, i, angle_squared(value))
        store(out, 2, i, angle_over_sine_derivative(value))


@jit(cache=True)
def cable_law(stiffness, damping, extension, rate, out):
    """out[i] = tension, damping part [N] of cables with ``extension`` [m] and ``rate`` [m/s], shape (n, 2)."""
    for i in range(extension.shape[0]):
        tension, drag = cable_tension(stiffness, damping, load1(extension, i), load1(rate, i))
        store(out, i, 0, tension)
        store(out, i, 1, drag)


@jit(cache=True)
def hinge_damping(damping, s, closing, out):
    """out[i] = factor [N m], power [W] of bending damping, shape (n, 2)."""
    for i in range(s.shape[0]):
        factor, power = hinge_damping_factor(damping, load1(s, i), load1(closing, i))
        store(out, i, 0, factor)
        store(out, i, 1, power)


@jit(cache=True)
def forces(structure, actuator_length, gravity, x, v, f, memory, power):
    """Fill f [N]; power[0] = what damping dissipates [W]."""
    store1(power, 0, lattice_forces(structure, actuator_length, gravity, x, v, f, memory))


@jit(cache=True)
def energies(structure, actuator_length, gravity, x, v, out):
    """out = bars, cables, actuators, kinetic, gravitational [J], shape (5[, lanes])."""
    store1(out, 0, bar_energy(structure, x))
    store1(out, 1, cable_energy(structure, x))
    store1(out, 2, actuator_energy(structure, actuator_length, x))
    store1(out, 3, kinetic_energy(structure, v))
    store1(out, 4, gravitational_energy(structure, gravity, x))


@jit(cache=True)
def tangent(structure, pattern, actuator_length, x, h):
    """Fill h with the blocks of the tangent stiffness [N/m]."""
    lattice_tangent(structure, pattern, actuator_length, x, h)


@jit(cache=True)
def cholesky(pattern, h, y, floor, worst):
    """Factorise h in place and solve for y in place; worst[0] = smallest pivot."""
    store1(worst, 0, factorise(pattern, h, floor))
    solve(pattern, h, y)


@jit
def run_steps(step, structure, actuator_length, ground, dt, first_kick, steps, x, v, f, memory, losses, work):
    """The loop of the functions below, for one step function."""
    kick = load1(losses, 0) * 0.0 + first_kick
    for _ in range(steps):
        power, lost, lowest = step(lattice_forces, structure, actuator_length, ground, dt, kick, x, v, f, memory, work)
        store1(losses, 0, fma(power, dt, load1(losses, 0)))
        store1(losses, 1, load1(losses, 1) + lost)
        store1(losses, 2, lowest)
        kick = splat(dt, kick)


@jit(cache=True)
def symplectic_euler(structure, actuator_length, ground, dt, first_kick, steps, x, v, f, memory, losses, work):
    """See :func:`advance`."""
    run_steps(symplectic_euler_step, structure, actuator_length, ground, dt, first_kick, steps, x, v, f, memory, losses, work)


@jit(cache=True)
def velocity_verlet(structure, actuator_length, ground, dt, first_kick, steps, x, v, f, memory, losses, work):
    """See :func:`advance`."""
    run_steps(velocity_verlet_step, structure, actuator_length, ground, dt, first_kick, steps, x, v, f, memory, losses, work)


@jit(cache=True)
def runge_kutta(structure, actuator_length, ground, dt, first_kick, steps, x, v, f, memory, losses, work):
    """See :func:`advance`."""
    run_steps(runge_kutta_step, structure, actuator_length, ground, dt, first_kick, steps, x, v, f, memory, losses, work)


INTEGRATORS = {"symplectic_euler": symplectic_euler, "velocity_verlet": velocity_verlet, "runge_kutta": runge_kutta}


def advance(structure, actuator_length, ground, dt, first_kick, steps, x, v, f, memory, losses, integrator="symplectic_euler"):
    """Step ``steps`` times in place; losses[0] += damping's, losses[1] += contact's [J], losses[2] = lowest z after the last [m].

    ``first_kick`` [s] is for symplectic Euler: dt / 2 where x and v are synchronous, dt where v is half a step behind.
    ``f`` must hold the forces at x for velocity Verlet.
    """
    work = np.zeros((4 * x.shape[0], *x.shape[1:]))
    INTEGRATORS[integrator](structure, actuator_length, ground, dt, first_kick, steps, x, v, f, memory, losses, work)
