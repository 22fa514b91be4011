"""Equilibria on the ground by first-order methods, one lattice after another: the baselines of form-finding.

Each starts at its given positions with the full load, first on a soft ground; then what sank is held on the rigid ground and
the search goes on, until gaps and contact forces have the right signs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tensegrity_gym.core.conjugate_gradient import DescentWork, conjugate_gradient
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.relaxation import RelaxationWork, relax
from tensegrity_gym.core.statics import Statics, change_held_masses, free_forces, static_energy, static_forces


class GroundSettings(NamedTuple):
    """How the ground is found."""

    soft_ground: float  #: stiffness of the penalty [N/m]
    release: float  #: upward force at which a held mass is let go [N]
    max_rounds: int  #: changes of the set of held masses


class DescentRecords(NamedTuple):
    """What the search leaves behind."""

    positions: np.ndarray  #: start, then equilibrium [m], shape (n, n_masses, 3)
    forces: np.ndarray  #: of members and weight at the equilibrium [N], shape (n, n_masses, 3)
    residual: np.ndarray  #: largest unbalanced force on a mass [N], shape (n,)
    iterations: np.ndarray  #: directions or steps, shape (n,)
    evaluations: np.ndarray  #: of the energy, or of the forces for relaxation, shape (n,)
    converged: np.ndarray  #: truth, shape (n,)


class DescentScratch(NamedTuple):
    """Work arrays of one thread."""

    f: np.ndarray  #: shape (n_masses, 3)
    old: np.ndarray  #: shape (n_masses, 3)
    d: np.ndarray  #: shape (n_masses, 3)
    trial: np.ndarray  #: shape (n_masses, 3)
    still: np.ndarray  #: zeros, shape (n_masses, 3)
    memory: np.ndarray  #: zeros, shape (n_axial_members,)
    held: np.ndarray  #: shape (n_masses,)
    actuator_length: np.ndarray  #: shape (n_actuators,)


@jit
def _statics(structure, gravity, dead_load, ground, scratch, stretches):
    for k in range(stretches.shape[0]):
        scratch.actuator_length[k] = stretches[k] * structure.actuator_length[k]
    for i in range(scratch.held.shape[0]):
        scratch.held[i] = 0.0
    return Statics(
        structure,
        gravity,
        dead_load,
        scratch.actuator_length,
        scratch.still,
        scratch.memory,
        scratch.held,
        ground.soft_ground,
    )


@jit
def _finish(statics, x, scratch, ground, records, n, rounds, residual, tolerance):
    """Change the held masses at an equilibrium; True where the search must go on."""
    found = residual <= tolerance
    changed = False
    if found and rounds < ground.max_rounds:
        static_forces(statics, x, scratch.f)
        changed = change_held_masses(statics, x, scratch.f, ground.release)
    if changed:
        return True
    for i in range(x.shape[0]):
        found = found and (x[i, 2] >= 0.0 or statics.held[i] > 0.0)
    records.residual[n] = static_forces(statics, x, scratch.f)
    records.converged[n] = found
    for i in range(x.shape[0]):
        for c in range(3):
            records.forces[n, i, c] = scratch.f[i, c]
    return False


@jit
def find_by_descent(structure, gravity, dead_load, ground, settings, stretches, records, scratch, first, last, progress):
    """Equilibria ``first`` to ``last`` by conjugate gradients."""
    work = DescentWork(scratch.f, scratch.old, scratch.d, scratch.trial)
    for n in range(first, last):
        statics = _statics(structure, gravity, dead_load, ground, scratch, stretches[n])
        x = records.positions[n]
        rounds, more = 0, True
        while more:
            residual, iterations, calls = conjugate_gradient(static_energy, free_forces, statics, x, work, settings)
            records.iterations[n] += iterations
            records.evaluations[n] += calls
            more = _finish(statics, x, scratch, ground, records, n, rounds, residual, settings.tolerance)
            rounds += 1
        progress[0] += 1


@jit
def find_by_relaxation(structure, gravity, dead_load, ground, settings, stretches, mass, records, scratch, first, last, progress):
    """Equilibria ``first`` to ``last`` by dynamic relaxation with fictitious ``mass``, shape (n, n_masses)."""
    work = RelaxationWork(scratch.f, scratch.old, scratch.d)
    for n in range(first, last):
        statics = _statics(structure, gravity, dead_load, ground, scratch, stretches[n])
        x = records.positions[n]
        rounds, more = 0, True
        while more:
            residual, iterations = relax(free_forces, statics, mass[n], x, work, settings)
            records.iterations[n] += iterations
            records.evaluations[n] += iterations + 1
            more = _finish(statics, x, scratch, ground, records, n, rounds, residual, settings.tolerance)
            rounds += 1
        progress[0] += 1


@jit(cache=True)
def descend_equilibria(structure, gravity, dead_load, ground, settings, stretches, records, scratch, first, last, progress):
    """:func:`find_by_descent`, compiled once and cached."""
    find_by_descent(structure, gravity, dead_load, ground, settings, stretches, records, scratch, first, last, progress)


@jit(cache=True)
def relax_equilibria(structure, gravity, dead_load, ground, settings, stretches, mass, records, scratch, first, last, progress):
    """:func:`find_by_relaxation`, compiled once and cached."""
    find_by_relaxation(structure, gravity, dead_load, ground, settings, stretches, mass, records, scratch, first, last, progress)
