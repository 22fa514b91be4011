"""Energy and forces of a lattice at rest on the ground: what every method of form-finding minimises.

Elastic and gravitational energy, the potential of dead loads, and a soft ground: a one-sided quadratic penalty. A mass that is
``held`` lies on the rigid ground at z = 0 instead. Works on one lattice, arrays [mass, component], or on lanes of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tensegrity_gym.core.energy import actuator_energy, bar_energy, cable_energy, gravitational_energy
from tensegrity_gym.core.forces import dot, lattice_forces
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import fma, load, load1, select, splat, sqrt, store, store1
from tensegrity_gym.core.tangent import axial_tensions, lattice_tangent
from tensegrity_gym.types import Structure


class Statics(NamedTuple):
    """A loaded lattice on the ground."""

    structure: Structure  #: masses and members
    gravity: np.ndarray  #: [m/s^2], shape (3,)
    dead_load: np.ndarray  #: forces that do not depend on positions [N], shape (n_masses, 3)
    actuator_length: np.ndarray  #: natural lengths of the actuated cables [m], shape (n_actuators[, lanes])
    still: np.ndarray  #: zero velocities, shape (n_masses, 3[, lanes])
    memory: np.ndarray  #: of damping forces, all zero, shape (n_axial_members[, lanes])
    held: np.ndarray  #: 1.0 where the rigid ground holds a mass at z = 0, shape (n_masses[, lanes])
    soft_ground: float  #: stiffness of the penalty [N/m]


@jit(forceinline=False)
def static_energy(statics, x):
    """Energy [J] of positions x."""
    structure = statics.structure
    total = bar_energy(structure, x) + cable_energy(structure, x) + actuator_energy(structure, statics.actuator_length, x)
    total = total + gravitational_energy(structure, statics.gravity, x)
    zero = total * 0.0
    for i in range(structure.mass.shape[0]):
        for c in range(3):
            total = fma(-statics.dead_load[i, c], load(x, i, c), total)
        sunk = load(x, i, 2)
        sunk = select(sunk < 0.0, sunk, zero)
        total = fma(0.5 * statics.soft_ground * sunk, sunk, total)
    return total


@jit(forceinline=False)
def static_forces(statics, x, f):
    """Fill f with all forces but the rigid ground's [N]. Returns the largest force on a mass that this does not take."""
    structure = statics.structure
    lattice_forces(structure, statics.actuator_length, statics.gravity, x, statics.still, f, statics.memory)
    zero = load(x, 0, 0) * 0.0
    worst = zero
    for i in range(structure.mass.shape[0]):
        sunk = load(x, i, 2)
        sunk = select(sunk < 0.0, sunk, zero)
        fx = load(f, i, 0) + statics.dead_load[i, 0]
        fy = load(f, i, 1) + statics.dead_load[i, 1]
        fz = fma(-statics.soft_ground, sunk, load(f, i, 2) + statics.dead_load[i, 2])
        store(f, i, 0, fx)
        store(f, i, 1, fy)
        store(f, i, 2, fz)
        fz = select(load1(statics.held, i) > 0.0, zero, fz)
        square = dot(fx, fy, fz, fx, fy, fz)
        worst = select(square > worst, square, worst)
    return sqrt(worst)


@jit(forceinline=False)
def free_forces(statics, x, f):
    """:func:`static_forces` with those zeroed that the rigid ground takes."""
    worst = static_forces(statics, x, f)
    for i in range(statics.structure.mass.shape[0]):
        fz = load(f, i, 2)
        store(f, i, 2, select(load1(statics.held, i) > 0.0, fz * 0.0, fz))
    return worst


@jit(forceinline=False)
def static_tangent(statics, pattern, x, tensions, h):
    """Fill h with the members' tangent stiffness [N/m], its geometric part made with ``tensions`` [N]."""
    lattice_tangent(statics.structure, pattern, statics.actuator_length, x, h, tensions)


@jit(forceinline=False)
def predict_tensions(statics, most_compression, x, d, tensions):
    """Tensions [N] of the axial members that the step d, linearised at x, leads to, bar segments at most ``most_compression``."""
    structure = statics.structure
    axial_tensions(structure, statics.actuator_length, x, d, tensions)
    for k in range(structure.bars.shape[0] * (structure.bars.shape[1] - 1)):
        pull = load1(tensions, k)
        most = splat(-most_compression, pull)
        store1(tensions, k, select(pull > most, pull, most))


@jit(forceinline=False)
def change_held_masses(held, x, f, tolerance, lane):
    """At an equilibrium of one lane: hold what sank, let go what is pulled up. Returns whether anything changed.

    ``held``, ``x`` and ``f`` have lanes; ``f`` as :func:`static_forces` leaves it.
    """
    changed = False
    for i in range(x.shape[0]):
        if held[i, lane] == 0.0 and x[i, 2, lane] < 0.0:
            held[i, lane] = 1.0
            x[i, 2, lane] = 0.0
            changed = True
        elif held[i, lane] > 0.0 and f[i, 2, lane] > tolerance:
            held[i, lane] = 0.0
            changed = True
    return changed
