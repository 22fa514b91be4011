"""Equilibria on the ground by first-order methods, a lattice in each lane: the baselines of form-finding.

Each starts at its given positions with the full load, first on a soft ground; then what sank is held on the rigid ground and
the search goes on, until gaps and contact forces have the right signs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tensegrity_gym.core.conjugate_gradient import conjugate_gradient
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.relaxation import relax
from tensegrity_gym.core.statics import Statics, change_held_masses, free_forces, static_energy, static_forces
from tensegrity_gym.types import Structure


class GroundSettings(NamedTuple):
    """How the ground is found."""

    soft_ground: float  #: stiffness of the penalty [N/m]
    release: float  #: upward force at which a held mass is let go [N]
    max_rounds: int  #: changes of the set of held masses
    tolerance: float  #: of the method: residual force at which an equilibrium counts as found [N]


class Loads(NamedTuple):
    """A structure and what loads it, the same for the whole batch."""

    structure: Structure  #: masses and members
    gravity: np.ndarray  #: [m/s^2], shape (3,)
    dead_load: np.ndarray  #: [N], shape (n_masses, 3)


class DescentCases(NamedTuple):
    """What the batch differs in."""

    stretches: np.ndarray  #: lambda [-], shape (n, n_actuators)
    mass: np.ndarray  #: of relaxation [N step^2/m], shape (n, n_masses); (n, 0) for conjugate gradients, which need none


class DescentRecords(NamedTuple):
    """What the search leaves behind."""

    positions: np.ndarray  #: start, then equilibrium [m], shape (n, n_masses, 3)
    forces: np.ndarray  #: of members and weight at the equilibrium [N], shape (n, n_masses, 3)
    residual: np.ndarray  #: largest unbalanced force on a mass [N], shape (n,)
    iterations: np.ndarray  #: directions or steps, shape (n,)
    evaluations: np.ndarray  #: of the energy, or of the forces for relaxation, shape (n,)
    converged: np.ndarray  #: truth, shape (n,)


class GroundLanes(NamedTuple):
    """Work arrays of one thread next to its method's, with whom they share ``x`` and ``mass``."""

    x: np.ndarray  #: positions [m], shape (n_masses, 3, lanes)
    f: np.ndarray  #: forces, those that the rigid ground takes among them [N], shape (n_masses, 3, lanes)
    still: np.ndarray  #: zeros, shape (n_masses, 3, lanes)
    memory: np.ndarray  #: zeros, shape (n_axial_members, lanes)
    held: np.ndarray  #: 1.0 where the rigid ground holds a mass at z = 0, shape (n_masses, lanes)
    actuator_length: np.ndarray  #: natural lengths [m], shape (n_actuators, lanes)
    mass: np.ndarray  #: as in DescentCases, shape (n_masses or 0, lanes)
    case: np.ndarray  #: which equilibrium each lane works on, -1 for none, shape (lanes,)
    rounds: np.ndarray  #: how often its held masses were chosen, shape (lanes,)
    queue: np.ndarray  #: the next case and the end of the share, shape (2,)


class Batch(NamedTuple):
    """All that :func:`next_lattice` needs."""

    ground: GroundSettings
    cases: DescentCases
    records: DescentRecords
    lanes: GroundLanes
    work: GroundLanes  #: the lanes, or a single one's without their lane axis
    progress: np.ndarray  #: lattices done, shape (1,)


@jit
def _statics(loads, ground, work):
    return Statics(
        loads.structure,
        loads.gravity,
        loads.dead_load,
        work.actuator_length,
        work.still,
        work.memory,
        work.held,
        ground.soft_ground,
    )


@jit(forceinline=False)
def _load_case(structure, cases, records, lanes, lane, n):
    lanes.case[lane] = n
    lanes.rounds[lane] = 0
    for i in range(lanes.x.shape[0]):
        lanes.held[i, lane] = 0.0
        for c in range(3):
            lanes.x[i, c, lane] = records.positions[n, i, c]
    for k in range(lanes.actuator_length.shape[0]):
        lanes.actuator_length[k, lane] = cases.stretches[n, k] * structure.actuator_length[k]
    for i in range(lanes.mass.shape[0]):
        lanes.mass[i, lane] = cases.mass[n, i]


@jit(forceinline=False)
def _store_case(records, lanes, lane, residual, found):
    n = lanes.case[lane]
    for i in range(lanes.x.shape[0]):
        found = found and (lanes.x[i, 2, lane] >= 0.0 or lanes.held[i, lane] > 0.0)
        for c in range(3):
            records.positions[n, i, c] = lanes.x[i, c, lane]
            records.forces[n, i, c] = lanes.f[i, c, lane]
    records.residual[n] = residual
    records.converged[n] = found


@jit(forceinline=False)
def next_lattice(statics, batch, lane, residual, iterations, evaluations):
    """At the end of a lane's search: the same lattice with other masses held, or the next one. Returns whether there is one."""
    lanes, records = batch.lanes, batch.records
    if lanes.case[lane] >= 0:
        records.iterations[lanes.case[lane]] += iterations
        records.evaluations[lanes.case[lane]] += evaluations
        static_forces(statics, batch.work.x, batch.work.f)
        found = residual <= batch.ground.tolerance
        if found and lanes.rounds[lane] < batch.ground.max_rounds:
            lanes.rounds[lane] += 1
            if change_held_masses(lanes.held, lanes.x, lanes.f, batch.ground.release, lane):
                return True
        _store_case(records, lanes, lane, residual, found)
        batch.progress[0] += 1
        lanes.case[lane] = -1
    if lanes.queue[0] == lanes.queue[1]:
        return False
    _load_case(statics.structure, batch.cases, records, lanes, lane, lanes.queue[0])
    lanes.queue[0] += 1
    return True


# Tuples of arrays are made one call below the entry points, where numba counts no references: what counts would free them.
@jit
def find_by_descent(loads, ground, settings, cases, records, ground_lanes, ground_work, lanes, work, progress):
    """The equilibria of ``ground_lanes.queue`` by conjugate gradients."""
    statics = _statics(loads, ground, ground_work)
    batch = Batch(ground, cases, records, ground_lanes, ground_work, progress)
    conjugate_gradient(static_energy, free_forces, next_lattice, statics, batch, settings, lanes, work)


@jit
def find_by_relaxation(loads, ground, settings, cases, records, ground_lanes, ground_work, lanes, work, progress):
    """The equilibria of ``ground_lanes.queue`` by dynamic relaxation."""
    statics = _statics(loads, ground, ground_work)
    batch = Batch(ground, cases, records, ground_lanes, ground_work, progress)
    relax(free_forces, next_lattice, statics, batch, settings, lanes, work)


@jit(cache=True)
def descend_equilibria(loads, ground, settings, cases, records, ground_lanes, ground_work, lanes, work, progress):
    """:func:`find_by_descent`, compiled once and cached."""
    find_by_descent(loads, ground, settings, cases, records, ground_lanes, ground_work, lanes, work, progress)


@jit(cache=True)
def relax_equilibria(loads, ground, settings, cases, records, ground_lanes, ground_work, lanes, work, progress):
    """:func:`find_by_relaxation`, compiled once and cached."""
    find_by_relaxation(loads, ground, settings, cases, records, ground_lanes, ground_work, lanes, work, progress)
