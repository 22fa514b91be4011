"""Damped Newton for equilibria on the ground, a batch at a time: exact tangent, sparse Cholesky, active set for z >= 0.

Each lane is a state machine of its own. It follows its load path from the unloaded lattice (all stretches 1) to its target
stretches on a soft ground (a one-sided quadratic penalty); then it polishes on the rigid ground: the masses that sank are held
at z = 0, the rest is free, and only at an equilibrium does the set change, by the sign of gap and contact force. A step solves
(H + mu I) d = -g, is cut to a trust length, and is taken if the energy falls as predicted; mu rises and falls with that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tensegrity_gym.core.cholesky import factorise, solve
from tensegrity_gym.core.energy import actuator_energy, bar_energy, cable_energy, gravitational_energy
from tensegrity_gym.core.forces import dot, lattice_forces
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import fma, load, load1, select, splat, sqrt, store, store1
from tensegrity_gym.core.tangent import lattice_tangent


class NewtonSettings(NamedTuple):
    """When a load step and the whole search end, and how bold steps are."""

    load_step: float  #: largest change of any stretch in one load step [-]
    path_tolerance: float  #: residual force at which the load goes on [N]
    tolerance: float  #: residual force per mass at which an equilibrium counts as found [N]
    max_iterations: int  #: factorisations a lattice may take
    longest_step: float  #: no mass moves further in one step [m]
    least_shift: float  #: smallest mu [N/m]: holds the rigid motions, far below the softest real stiffness
    unload: float  #: 1 where the path starts unloaded; 0 to start from the given positions at full load
    soft_ground: float  #: stiffness of the penalty on the way [N/m]
    max_rounds: int  #: changes of the set of held masses


class EquilibriumRecords(NamedTuple):
    """What the search leaves behind."""

    positions: np.ndarray  #: start, then equilibrium [m], shape (n, n_masses, 3)
    forces: np.ndarray  #: of members and weight at the equilibrium [N], shape (n, n_masses, 3)
    residual: np.ndarray  #: largest unbalanced force on a mass [N], shape (n,)
    iterations: np.ndarray  #: factorisations taken, shape (n,)
    converged: np.ndarray  #: truth, shape (n,)
    least_pivot: np.ndarray  #: smallest pivot of the last factorisation [N/m], shape (n,)


class NewtonLanes(NamedTuple):
    """Work arrays of one thread."""

    x: np.ndarray  #: positions [m], shape (n_masses, 3, lanes)
    trial: np.ndarray  #: positions tried, shape (n_masses, 3, lanes)
    still: np.ndarray  #: zero velocities, shape (n_masses, 3, lanes)
    f: np.ndarray  #: forces [N], shape (n_masses, 3, lanes)
    memory: np.ndarray  #: of damping forces, all zero here, shape (n_axial_members, lanes)
    d: np.ndarray  #: step [m], shape (n_masses, 3, lanes)
    h: np.ndarray  #: tangent, then its factor [N/m], shape (n_slots, 9, lanes)
    actuator_length: np.ndarray  #: natural lengths [m], shape (n_actuators, lanes)
    scalars: np.ndarray  #: rows named below, shape (N_SCALARS, lanes)
    case: np.ndarray  #: which equilibrium each lane works on, -1 for none, shape (lanes,)
    iterations: np.ndarray  #: factorisations taken for it, shape (lanes,)
    share: np.ndarray  #: progress along its load path, 0 to 1, shape (lanes,)
    rounds: np.ndarray  #: how often its held masses were chosen, shape (lanes,)
    held: np.ndarray  #: 1.0 where the rigid ground holds a mass at z = 0, shape (n_masses, lanes)


ENERGY, SHIFT, RESIDUAL, PIVOT, TRIAL, SLOPE, CUT = 0, 1, 2, 3, 4, 5, 6
N_SCALARS = 7
FIXED = 1e15  #: added to the tangent of a coordinate held by the ground [N/m]


@jit(forceinline=False)
def static_energy(structure, settings, gravity, load_forces, lanes, x):
    """Elastic and gravitational energy, the potential of dead loads and of the soft ground [J]."""
    total = bar_energy(structure, x) + cable_energy(structure, x) + actuator_energy(structure, lanes.actuator_length, x)
    total = total + gravitational_energy(structure, gravity, x)
    zero = total * 0.0
    for i in range(structure.mass.shape[0]):
        for c in range(3):
            total = fma(-load_forces[i, c], load(x, i, c), total)
        sunk = load(x, i, 2)
        sunk = select(sunk < 0.0, sunk, zero)
        total = fma(0.5 * settings.soft_ground * sunk, sunk, total)
    return total


@jit(forceinline=False)
def free_forces(structure, settings, gravity, load_forces, lanes):
    """Fill f with all forces but the rigid ground's; set RESIDUAL to the largest force on a mass that it does not take."""
    lattice_forces(structure, lanes.actuator_length, gravity, lanes.x, lanes.still, lanes.f, lanes.memory)
    zero = load(lanes.x, 0, 0) * 0.0
    worst = zero
    for i in range(structure.mass.shape[0]):
        sunk = load(lanes.x, i, 2)
        sunk = select(sunk < 0.0, sunk, zero)
        fx = load(lanes.f, i, 0) + load_forces[i, 0]
        fy = load(lanes.f, i, 1) + load_forces[i, 1]
        fz = fma(-settings.soft_ground, sunk, load(lanes.f, i, 2) + load_forces[i, 2])
        store(lanes.f, i, 0, fx)
        store(lanes.f, i, 1, fy)
        store(lanes.f, i, 2, fz)
        fz = select(load1(lanes.held, i) > 0.0, zero, fz)
        square = dot(fx, fy, fz, fx, fy, fz)
        worst = select(square > worst, square, worst)
    store1(lanes.scalars, RESIDUAL, sqrt(worst))


@jit(forceinline=False)
def newton_direction(structure, pattern, settings, lanes):
    """Solve (H + mu I) d = f on the free coordinates; sets PIVOT, SLOPE = f . d and CUT, which keeps d to the trust length."""
    lattice_tangent(structure, pattern, lanes.actuator_length, lanes.x, lanes.h)
    shift = load1(lanes.scalars, SHIFT)
    zero = shift * 0.0
    for i in range(structure.mass.shape[0]):
        held = load1(lanes.held, i) > 0.0
        below = select(load(lanes.x, i, 2) < 0.0, shift + settings.soft_ground, shift)
        store(lanes.h, i, 0, load(lanes.h, i, 0) + shift)
        store(lanes.h, i, 4, load(lanes.h, i, 4) + shift)
        store(lanes.h, i, 8, load(lanes.h, i, 8) + select(held, splat(FIXED, shift), below))
        store(lanes.d, i, 0, load(lanes.f, i, 0))
        store(lanes.d, i, 1, load(lanes.f, i, 1))
        store(lanes.d, i, 2, select(held, zero, load(lanes.f, i, 2)))
    store1(lanes.scalars, PIVOT, factorise(pattern, lanes.h, 0.0))
    solve(pattern, lanes.h, lanes.d)
    slope, longest = zero, zero
    for i in range(structure.mass.shape[0]):
        dx, dy = load(lanes.d, i, 0), load(lanes.d, i, 1)
        dz = select(load1(lanes.held, i) > 0.0, zero, load(lanes.d, i, 2))
        store(lanes.d, i, 2, dz)
        slope = slope + dot(dx, dy, dz, load(lanes.f, i, 0), load(lanes.f, i, 1), load(lanes.f, i, 2))
        square = dot(dx, dy, dz, dx, dy, dz)
        longest = select(square > longest, square, longest)
    longest = sqrt(longest)
    store1(lanes.scalars, SLOPE, slope)
    too_long = longest > settings.longest_step
    store1(lanes.scalars, CUT, select(too_long, settings.longest_step / select(too_long, longest, zero + 1.0), zero + 1.0))


@jit(forceinline=False)
def try_step(structure, settings, gravity, load_forces, lanes):
    """trial = x + CUT d; sets TRIAL to its energy."""
    cut = load1(lanes.scalars, CUT)
    for i in range(structure.mass.shape[0]):
        for c in range(3):
            store(lanes.trial, i, c, fma(cut, load(lanes.d, i, c), load(lanes.x, i, c)))
    store1(lanes.scalars, TRIAL, static_energy(structure, settings, gravity, load_forces, lanes, lanes.trial))


@jit(forceinline=False)
def take(lanes, lane):
    """x = trial in one lane."""
    for i in range(lanes.x.shape[0]):
        for c in range(3):
            lanes.x[i, c, lane] = lanes.trial[i, c, lane]
    lanes.scalars[ENERGY, lane] = lanes.scalars[TRIAL, lane]


@jit(forceinline=False)
def set_load(structure, lanes, lane, stretches, progress):
    """Natural lengths of a lane's actuated cables at ``progress`` from unloaded (0) to the target stretches (1)."""
    for k in range(stretches.shape[0]):
        stretch = 1.0 + progress * (stretches[k] - 1.0)
        lanes.actuator_length[k, lane] = stretch * structure.actuator_length[k]


@jit(forceinline=False)
def load_increment(stretches, settings):
    """Share of the load path that one step may take."""
    largest = 1e-9
    for k in range(stretches.shape[0]):
        largest = max(largest, abs(stretches[k] - 1.0))
    return min(1.0, settings.load_step / largest)


@jit(forceinline=False)
def change_held(settings, lanes, lane):
    """At an equilibrium: hold what sank, let go what is pulled up. Returns whether anything changed."""
    changed = False
    for i in range(lanes.x.shape[0]):
        if lanes.held[i, lane] == 0.0 and lanes.x[i, 2, lane] < 0.0:
            lanes.held[i, lane] = 1.0
            lanes.x[i, 2, lane] = 0.0
            changed = True
        elif lanes.held[i, lane] > 0.0 and lanes.f[i, 2, lane] > settings.tolerance:
            lanes.held[i, lane] = 0.0
            changed = True
    if changed:
        lanes.rounds[lane] += 1
    return changed


ITERATE, MOVED, FOUND, GIVEN_UP = 0, 1, 2, 3


@jit(forceinline=False)
def next_stage(structure, settings, lanes, lane, stretches):
    """Advance a lane's load or ground if its residual allows; says what to do with the lane."""
    residual = lanes.scalars[RESIDUAL, lane]
    if lanes.iterations[lane] >= settings.max_iterations or not residual < 1e300:
        return GIVEN_UP
    if lanes.share[lane] < 1.0:
        if residual > settings.path_tolerance:
            return ITERATE
        lanes.share[lane] = min(1.0, lanes.share[lane] + load_increment(stretches, settings))
        set_load(structure, lanes, lane, stretches, lanes.share[lane])
        return MOVED
    if residual > (settings.path_tolerance if lanes.rounds[lane] == 0 else settings.tolerance):
        return ITERATE
    if lanes.rounds[lane] >= settings.max_rounds:
        return GIVEN_UP
    if change_held(settings, lanes, lane):
        return MOVED
    return FOUND if residual < settings.tolerance else ITERATE


@jit
def find_equilibria(structure, pattern, gravity, load_forces, settings, stretches, records, lanes, first, last, progress):
    """Equilibria ``first`` to ``last`` of ``records`` for ``stretches`` (n, n_actuators) in one thread's lanes."""
    count = lanes.x.shape[2]
    case = lanes.case
    queue = first
    running = 0
    for lane in range(count):
        case[lane] = -1
        source = min(first + lane, last - 1)
        _load_case(structure, settings, lanes, lane, stretches[source], records.positions[source])
        if queue < last:
            case[lane] = queue
            queue += 1
            running += 1
    while running > 0:
        free_forces(structure, settings, gravity, load_forces, lanes)
        moved = False
        for lane in range(count):
            if case[lane] < 0:
                continue
            stage = next_stage(structure, settings, lanes, lane, stretches[case[lane]])
            moved = moved or stage != ITERATE
            if stage == FOUND or stage == GIVEN_UP:
                _store_case(lanes, lane, records, case[lane], stage == FOUND)
                progress[0] += 1
                case[lane] = -1
                running -= 1
                if queue < last:
                    case[lane] = queue
                    queue += 1
                    running += 1
                    _load_case(structure, settings, lanes, lane, stretches[case[lane]], records.positions[case[lane]])
        if moved:
            free_forces(structure, settings, gravity, load_forces, lanes)
        store1(lanes.scalars, ENERGY, static_energy(structure, settings, gravity, load_forces, lanes, lanes.x))
        newton_direction(structure, pattern, settings, lanes)
        try_step(structure, settings, gravity, load_forces, lanes)
        for lane in range(count):
            lanes.iterations[lane] += 1
            _judge_step(settings, lanes, lane)


@jit(forceinline=False)
def _load_case(structure, settings, lanes, lane, stretches, positions):
    for i in range(lanes.x.shape[0]):
        for c in range(3):
            lanes.x[i, c, lane] = positions[i, c]
        lanes.held[i, lane] = 0.0
    lanes.iterations[lane] = 0
    lanes.rounds[lane] = 0
    lanes.share[lane] = load_increment(stretches, settings) if settings.unload > 0.0 else 1.0
    set_load(structure, lanes, lane, stretches, lanes.share[lane])
    lanes.scalars[SHIFT, lane] = settings.least_shift


@jit(forceinline=False)
def _store_case(lanes, lane, records, case, found):
    for i in range(lanes.x.shape[0]):
        for c in range(3):
            records.positions[case, i, c] = lanes.x[i, c, lane]
            records.forces[case, i, c] = lanes.f[i, c, lane]
    records.residual[case] = lanes.scalars[RESIDUAL, lane]
    records.iterations[case] = lanes.iterations[lane]
    records.converged[case] = found
    records.least_pivot[case] = lanes.scalars[PIVOT, lane]


@jit(forceinline=False)
def _judge_step(settings, lanes, lane):
    """Take or refuse the trial of one lane and adapt its shift mu."""
    s = lanes.scalars
    if s[PIVOT, lane] <= 0.0:  # not positive definite: the factor is void
        s[SHIFT, lane] = max(10.0 * s[SHIFT, lane], 1.0)
        return
    cut = s[CUT, lane]
    predicted = s[SLOPE, lane] * cut * (1.0 - 0.5 * cut)
    gained = s[ENERGY, lane] - s[TRIAL, lane]
    noise = 1e-13 * abs(s[ENERGY, lane])
    if predicted < noise:  # too close for energies to tell
        take(lanes, lane)
        s[SHIFT, lane] = max(0.1 * s[SHIFT, lane], settings.least_shift)
        return
    ratio = gained / predicted
    if ratio > 1e-3:
        take(lanes, lane)
    if ratio > 0.7:
        s[SHIFT, lane] = max(0.1 * s[SHIFT, lane], settings.least_shift)
    elif not ratio > 0.2:
        s[SHIFT, lane] = max(5.0 * s[SHIFT, lane], 1.0)


@jit(cache=True)
def newton_equilibria(structure, pattern, gravity, load_forces, settings, stretches, records, lanes, first, last, progress):
    """:func:`find_equilibria`, compiled once and cached."""
    find_equilibria(structure, pattern, gravity, load_forces, settings, stretches, records, lanes, first, last, progress)
