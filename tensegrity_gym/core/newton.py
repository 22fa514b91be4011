"""Newton for minima of any energy on the half-space z >= 0, a batch at a time: mixed steps, sparse Cholesky, active set.

Each lane is a state machine of its own. It follows its load path from the unloaded lattice (all stretches 1) to its target
stretches on a soft ground (a one-sided quadratic penalty); then it polishes on the rigid ground: the masses that sank are held
at z = 0, the rest is free, and only at an equilibrium does the set change, by the sign of gap and contact force.

A step solves (H + mu I) d = -g and is cut to a trust length. The geometric stiffness in H is made with the tensions that the
step before predicted, k (l + n . d - l0), not with those that its second-order error in the lengths of stiff members leaves
behind: tensions are unknowns of their own, as in a mixed formulation (Magisano, Leonetti and Garcea 2017, "mixed integration
point" Newton), and a step may bend bars far. Energies then fall only every few steps: a lane keeps going for ``patience`` steps
before it goes back to its anchor, the last positions of lowest energy, with a larger mu.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tensegrity_gym.core.cholesky import factorise, solve
from tensegrity_gym.core.forces import dot
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import load, load1, select, splat, sqrt, store, store1
from tensegrity_gym.core.statics import (
    Statics,
    change_held_masses,
    predict_tensions,
    static_energy,
    static_forces,
    static_tangent,
)


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
    most_compression: float  #: of a bar's segment in the tangent: no bar carries much more than its critical load [N]
    patience: int  #: steps without a fall of energy before going back
    first_shift: float  #: mu after the first failure [N/m]
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
    """Work arrays of one thread.

    Kernels take them as they are, or a single lattice's without their lane axis: the same numbers, an eighth of the work.
    """

    x: np.ndarray  #: positions [m], shape (n_masses, 3, lanes)
    anchor: np.ndarray  #: the last positions of falling energy, shape (n_masses, 3, lanes)
    still: np.ndarray  #: zero velocities, shape (n_masses, 3, lanes)
    f: np.ndarray  #: forces [N], shape (n_masses, 3, lanes)
    memory: np.ndarray  #: of damping forces, all zero here, shape (n_axial_members, lanes)
    d: np.ndarray  #: step [m], shape (n_masses, 3, lanes)
    h: np.ndarray  #: tangent, then its factor [N/m], shape (n_slots, 9, lanes)
    actuator_length: np.ndarray  #: natural lengths [m], shape (n_actuators, lanes)
    unloaded_length: np.ndarray  #: natural lengths at stretch 1 [m], shape (n_actuators,)
    scalars: np.ndarray  #: rows named below, shape (N_SCALARS, lanes)
    case: np.ndarray  #: which equilibrium each lane works on, -1 for none, shape (lanes,)
    iterations: np.ndarray  #: factorisations taken for it, shape (lanes,)
    share: np.ndarray  #: progress along its load path, 0 to 1, shape (lanes,)
    rounds: np.ndarray  #: how often its held masses were chosen, shape (lanes,)
    tension: np.ndarray  #: of axial members, independent of positions [N], shape (n_axial_members, lanes)
    anchor_tension: np.ndarray  #: that of the anchor, shape (n_axial_members, lanes)
    strayed: np.ndarray  #: steps since the anchor, -1 for none yet, shape (lanes,)
    held: np.ndarray  #: 1.0 where the rigid ground holds a mass at z = 0, shape (n_masses, lanes)


ENERGY, SHIFT, RESIDUAL, PIVOT, ANCHOR, SLOPE, CUT = 0, 1, 2, 3, 4, 5, 6
N_SCALARS = 7
FIXED = 1e15  #: added to the tangent of a coordinate held by the ground [N/m]


@jit(forceinline=False)
def newton_direction(pattern, settings, lanes):
    """Solve (H + mu I) d = f on the free coordinates; sets PIVOT, SLOPE = f . d and CUT, which keeps d to the trust length."""
    shift = load1(lanes.scalars, SHIFT)
    zero = shift * 0.0
    for i in range(lanes.x.shape[0]):
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
    for i in range(lanes.x.shape[0]):
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
def cut_step(lanes):
    """d *= CUT, and zero where the factor was void."""
    cut = load1(lanes.scalars, CUT)
    cut = select((load1(lanes.scalars, PIVOT) > 0.0) & (load1(lanes.scalars, SLOPE) >= 0.0), cut, cut * 0.0)
    for i in range(lanes.x.shape[0]):
        for c in range(3):
            store(lanes.d, i, c, select(cut > 0.0, cut * load(lanes.d, i, c), cut * 0.0))


@jit(forceinline=False)
def take_step(lanes):
    """x += d."""
    for i in range(lanes.x.shape[0]):
        for c in range(3):
            store(lanes.x, i, c, load(lanes.x, i, c) + load(lanes.d, i, c))


@jit(forceinline=False)
def set_anchor(lanes, lane):
    """Remember the positions and tensions of a lane."""
    for i in range(lanes.x.shape[0]):
        for c in range(3):
            lanes.anchor[i, c, lane] = lanes.x[i, c, lane]
    for k in range(lanes.tension.shape[0]):
        lanes.anchor_tension[k, lane] = lanes.tension[k, lane]
    lanes.scalars[ANCHOR, lane] = lanes.scalars[ENERGY, lane]
    lanes.strayed[lane] = 0


@jit(forceinline=False)
def go_back(lanes, lane):
    """Return a lane to its anchor."""
    for i in range(lanes.x.shape[0]):
        for c in range(3):
            lanes.x[i, c, lane] = lanes.anchor[i, c, lane]
    for k in range(lanes.tension.shape[0]):
        lanes.tension[k, lane] = lanes.anchor_tension[k, lane]
    lanes.strayed[lane] = 0


@jit(forceinline=False)
def set_load(lanes, lane, stretches, progress):
    """Natural lengths of a lane's actuated cables at ``progress`` from unloaded (0) to the target stretches (1)."""
    for k in range(stretches.shape[0]):
        stretch = 1.0 + progress * (stretches[k] - 1.0)
        lanes.actuator_length[k, lane] = stretch * lanes.unloaded_length[k]


@jit(forceinline=False)
def load_increment(stretches, settings):
    """Share of the load path that one step may take."""
    largest = 1e-9
    for k in range(stretches.shape[0]):
        largest = max(largest, abs(stretches[k] - 1.0))
    return min(1.0, settings.load_step / largest)


ITERATE, MOVED, FOUND, GIVEN_UP = 0, 1, 2, 3


@jit(forceinline=False)
def next_stage(settings, lanes, lane, stretches):
    """Advance a lane's load or ground if its residual allows; says what to do with the lane."""
    residual = lanes.scalars[RESIDUAL, lane]
    if lanes.iterations[lane] >= settings.max_iterations or not residual < 1e300:
        return GIVEN_UP
    if lanes.share[lane] < 1.0:
        if residual > settings.path_tolerance:
            return ITERATE
        lanes.share[lane] = min(1.0, lanes.share[lane] + load_increment(stretches, settings))
        set_load(lanes, lane, stretches, lanes.share[lane])
        return MOVED
    if residual > (settings.path_tolerance if lanes.rounds[lane] == 0 else settings.tolerance):
        return ITERATE
    if lanes.rounds[lane] >= settings.max_rounds:
        return GIVEN_UP
    if change_held_masses(lanes.held, lanes.x, lanes.f, settings.tolerance, lane):
        lanes.rounds[lane] += 1
        return MOVED
    return FOUND if residual < settings.tolerance else ITERATE


@jit
def find_minima(
    energy, forces, tangent, predict, problem, pattern, settings, stretches, records, lanes, work, first, last, progress
):
    """Minima ``first`` to ``last`` of ``records`` for ``stretches`` (n, n_actuators) in one thread's lanes.

    ``work`` is ``lanes``, or of a single lane the same memory without its axis: kernels then compute one lattice only.
    """
    count = lanes.x.shape[2]
    case = lanes.case
    queue = first
    running = 0
    for lane in range(count):
        case[lane] = -1
        source = min(first + lane, last - 1)
        _load_case(settings, lanes, lane, stretches[source], records.positions[source])
        if queue < last:
            case[lane] = queue
            queue += 1
            running += 1
    while running > 0:
        evaluate(energy, forces, problem, work)
        moved = False
        for lane in range(count):
            if case[lane] < 0:
                continue
            stage = next_stage(settings, lanes, lane, stretches[case[lane]])
            if stage == ITERATE:
                moved = _judge(settings, lanes, lane) or moved
                continue
            moved = True
            lanes.strayed[lane] = -1
            if stage == FOUND or stage == GIVEN_UP:
                _store_case(lanes, lane, records, case[lane], stage == FOUND)
                progress[0] += 1
                case[lane] = -1
                running -= 1
                if queue < last:
                    case[lane] = queue
                    queue += 1
                    running += 1
                    _load_case(settings, lanes, lane, stretches[case[lane]], records.positions[case[lane]])
        if moved:
            evaluate(energy, forces, problem, work)
            for lane in range(count):
                if lanes.strayed[lane] < 0:
                    set_anchor(lanes, lane)
        tangent(problem, pattern, work.x, work.tension, work.h)
        newton_direction(pattern, settings, work)
        cut_step(work)
        predict(problem, settings.most_compression, work.x, work.d, work.tension)
        take_step(work)
        for lane in range(count):
            lanes.iterations[lane] += 1


@jit  # inlined: numba does not cache what hands functions on to calls that stay calls
def evaluate(energy, forces, problem, lanes):
    """Fill f, set RESIDUAL and ENERGY."""
    store1(lanes.scalars, RESIDUAL, forces(problem, lanes.x, lanes.f))
    store1(lanes.scalars, ENERGY, energy(problem, lanes.x))


@jit(forceinline=False)
def _load_case(settings, lanes, lane, stretches, positions):
    for i in range(lanes.x.shape[0]):
        for c in range(3):
            lanes.x[i, c, lane] = positions[i, c]
        lanes.held[i, lane] = 0.0
    lanes.iterations[lane] = 0
    lanes.rounds[lane] = 0
    lanes.share[lane] = load_increment(stretches, settings) if settings.unload > 0.0 else 1.0
    set_load(lanes, lane, stretches, lanes.share[lane])
    lanes.scalars[SHIFT, lane] = settings.least_shift
    for k in range(lanes.tension.shape[0]):
        lanes.tension[k, lane] = 0.0
    lanes.strayed[lane] = -1


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
def _judge(settings, lanes, lane):
    """Keep a lane's last step, or after ``settings.patience`` steps without a fall of energy go back; adapt its shift mu.

    Returns whether the lane went back.
    """
    s = lanes.scalars
    if lanes.strayed[lane] < 0:
        set_anchor(lanes, lane)
        return False
    if not (s[PIVOT, lane] > 0.0 and s[SLOPE, lane] >= 0.0):  # not positive definite: no step was taken
        s[SHIFT, lane] = max(10.0 * s[SHIFT, lane], settings.first_shift)
        return False
    if s[ENERGY, lane] <= s[ANCHOR, lane] + 1e-13 * abs(s[ANCHOR, lane]):
        set_anchor(lanes, lane)
        s[SHIFT, lane] = max(0.1 * s[SHIFT, lane], settings.least_shift)
        return False
    lanes.strayed[lane] += 1
    if lanes.strayed[lane] < settings.patience and s[ENERGY, lane] < 1e300:
        return False
    go_back(lanes, lane)
    s[SHIFT, lane] = max(10.0 * s[SHIFT, lane], settings.first_shift)
    return True


@jit
def find_equilibria(structure, pattern, gravity, dead_load, settings, stretches, records, lanes, work, first, last, progress):
    """:func:`find_minima` of lattices on the ground."""
    statics = Statics(
        structure,
        gravity,
        dead_load,
        work.actuator_length,
        work.still,
        work.memory,
        work.held,
        settings.soft_ground,
    )
    find_minima(
        static_energy,
        static_forces,
        static_tangent,
        predict_tensions,
        statics,
        pattern,
        settings,
        stretches,
        records,
        lanes,
        work,
        first,
        last,
        progress,
    )


@jit(cache=True)
def newton_equilibria(structure, pattern, gravity, dead_load, settings, stretches, records, lanes, work, first, last, progress):
    """:func:`find_equilibria`, compiled once and cached."""
    find_equilibria(structure, pattern, gravity, dead_load, settings, stretches, records, lanes, work, first, last, progress)
