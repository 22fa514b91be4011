"""Forces of springs, hinges, cables and their material damping on the point masses of a batch of lattices.

Arrays are ``[mass, component]`` (one lattice) or ``[mass, component, lane]`` (a batch); see ``lanes.py``.

Every function returns the power [W] that damping takes, such that its sum over steps is the work that the damping forces
really do in a leapfrog step. A force D_n, made with the rate r_n of the half step before, acts between the half steps n and
n + 1 and does the work D_n (r_n + r_{n+1}) / 2 dt; gathered by rates that is (D_{n-1} + D_n) / 2 r_n dt. So each axial member
remembers its last damping force in ``memory``, one row a member: bar segments, cables, actuated cables. (With D_n r_n alone
the energy audit is off by percents where a mode turns in few steps.)
"""

from __future__ import annotations

from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import any_lane, fma, load, load1, select, splat, sqrt, stack_rows, store, store1
from tensegrity_gym.core.members import cable_tension, hinge_damping_factor, hinge_factor


@jit
def dot(ax, ay, az, bx, by, bz):
    """Scalar product of two vectors given by components."""
    return fma(ax, bx, fma(ay, by, az * bz))


@jit
def between(x, i, j):
    """Components of x_j - x_i."""
    return load(x, j, 0) - load(x, i, 0), load(x, j, 1) - load(x, i, 1), load(x, j, 2) - load(x, i, 2)


@jit
def add_force(f, i, fx, fy, fz):
    """f_i += (fx, fy, fz)."""
    store(f, i, 0, load(f, i, 0) + fx)
    store(f, i, 1, load(f, i, 1) + fy)
    store(f, i, 2, load(f, i, 2) + fz)


@jit
def gravity_forces(structure, gravity, f):
    """f_i = m_i g on every mass: the start of each force sum."""
    for i in range(structure.mass.shape[0]):
        like = load(f, i, 0)
        for c in range(3):
            store(f, i, c, splat(structure.mass[i] * gravity[c], like))


#: Rows of scratch for the segments of some bars: unit vector, its rate, 1 / length, pull, hinge factor, cosine.
SEGMENT_ROWS = 10
SCRATCH_ROWS = 320  # 20 KiB in 8 lanes of float64: stays in the first-level cache
UNIT, RATE, INVERSE, PULL, HINGE, COSINE = 0, 3, 6, 7, 8, 9
#: Bars of more segments do not fit into the scratch.
MAX_SEGMENTS = SCRATCH_ROWS // SEGMENT_ROWS


@jit
def bar_forces(structure, x, v, f, memory):
    """Add the forces of all bars: axial springs, hinges and the damping of both. Returns the power dissipated [W].

    Some bars at a time go through three stages, each a loop whose turns do not wait for each other: segments, hinges, sums.
    """
    segments = structure.bars.shape[1] - 1
    like = load(x, 0, 0)
    scratch = stack_rows(SCRATCH_ROWS, like)
    power = like * 0.0
    some = max(1, MAX_SEGMENTS // segments)
    for first in range(0, structure.bars.shape[0], some):
        last = min(first + some, structure.bars.shape[0])
        power = power + _segment_stage(structure, x, v, memory, scratch, first, last)
        power = power + _hinge_stage(structure, scratch, first, last, power)
        _bar_sum_stage(structure, f, scratch, first, last, power)
    return power


@jit
def _segment_stage(structure, x, v, memory, scratch, first, last):
    """Unit vectors, their rates, and axial forces of the segments of some bars; returns the axial damping's power [W]."""
    segments = structure.bars.shape[1] - 1
    power = load(x, 0, 0) * 0.0
    row = 0
    for b in range(first, last):
        for j in range(segments):
            near, far = structure.bars[b, j], structure.bars[b, j + 1]
            dx, dy, dz = between(x, near, far)
            ex, ey, ez = between(v, near, far)
            length = sqrt(dot(dx, dy, dz, dx, dy, dz))
            inverse = 1.0 / length
            nx, ny, nz = dx * inverse, dy * inverse, dz * inverse
            rate = dot(nx, ny, nz, ex, ey, ez)
            drag = structure.segment_damping[b] * rate
            member = b * segments + j
            power = fma(0.5 * (load1(memory, member) + drag), rate, power)
            store1(memory, member, drag)
            store1(scratch, row + UNIT, nx)
            store1(scratch, row + UNIT + 1, ny)
            store1(scratch, row + UNIT + 2, nz)
            store1(scratch, row + RATE, fma(-rate, nx, ex) * inverse)
            store1(scratch, row + RATE + 1, fma(-rate, ny, ey) * inverse)
            store1(scratch, row + RATE + 2, fma(-rate, nz, ez) * inverse)
            store1(scratch, row + INVERSE, inverse)
            store1(scratch, row + PULL, fma(structure.segment_stiffness[b], length - structure.segment_length[b], drag))
            row += SEGMENT_ROWS
    return power


@jit
def _hinge_stage(structure, scratch, first, last, like):
    """The factor of d(u . n) and the cosine u . n of the hinges of some bars; returns the bending damping's power [W]."""
    segments = structure.bars.shape[1] - 1
    power = like * 0.0
    row = 0
    for b in range(first, last):
        for _ in range(segments - 1):
            after = row + SEGMENT_ROWS
            bx = load1(scratch, row + UNIT) - load1(scratch, after + UNIT)
            by = load1(scratch, row + UNIT + 1) - load1(scratch, after + UNIT + 1)
            bz = load1(scratch, row + UNIT + 2) - load1(scratch, after + UNIT + 2)
            wx = load1(scratch, row + RATE) - load1(scratch, after + RATE)
            wy = load1(scratch, row + RATE + 1) - load1(scratch, after + RATE + 1)
            wz = load1(scratch, row + RATE + 2) - load1(scratch, after + RATE + 2)
            s = 0.25 * dot(bx, by, bz, bx, by, bz)
            added, lost = hinge_damping_factor(structure.hinge_damping[b], s, dot(bx, by, bz, wx, wy, wz))
            power = power + lost
            store1(scratch, row + HINGE, hinge_factor(structure.hinge_stiffness[b], s) + added)
            store1(scratch, row + COSINE, fma(-2.0, s, 1.0))
            row += SEGMENT_ROWS
        row += SEGMENT_ROWS
    return power


@jit
def _bar_sum_stage(structure, f, scratch, first, last, like):
    """Add what the segments of some bars do to their masses.

    Segment j, of unit vector n and length l, pulls its near end with A = T n + (G - (G . n) n) / l and its far end with -A;
    G = dU/dn (damping in it) = -sum over its two hinges of (factor) x (the neighbour's unit vector).
    """
    segments = structure.bars.shape[1] - 1
    zero = like * 0.0
    row = 0
    for b in range(first, last):
        px = py = pz = ux = uy = uz = factor = cosine = zero  # of the segment before: A, unit vector; of the hinge before
        for j in range(segments):
            nx, ny, nz = load1(scratch, row + UNIT), load1(scratch, row + UNIT + 1), load1(scratch, row + UNIT + 2)
            hx, hy, hz, along = factor * ux, factor * uy, factor * uz, factor * cosine  # -G and -G . n
            if j < segments - 1:
                after = row + SEGMENT_ROWS
                factor, cosine = load1(scratch, row + HINGE), load1(scratch, row + COSINE)
                hx = fma(factor, load1(scratch, after + UNIT), hx)
                hy = fma(factor, load1(scratch, after + UNIT + 1), hy)
                hz = fma(factor, load1(scratch, after + UNIT + 2), hz)
                along = fma(factor, cosine, along)
            inverse = load1(scratch, row + INVERSE)
            along = fma(inverse, along, load1(scratch, row + PULL))
            ax, ay, az = fma(along, nx, -(hx * inverse)), fma(along, ny, -(hy * inverse)), fma(along, nz, -(hz * inverse))
            add_force(f, structure.bars[b, j], ax - px, ay - py, az - pz)
            px, py, pz = ax, ay, az
            ux, uy, uz = nx, ny, nz
            row += SEGMENT_ROWS
        add_force(f, structure.bars[b, segments], -px, -py, -pz)


@jit
def cable_forces(structure, x, v, f, memory):
    """Add the forces of the unactuated, tension-only cables. Returns the power dissipated [W]."""
    power = load(x, 0, 0) * 0.0
    row = structure.bars.shape[0] * (structure.bars.shape[1] - 1)
    for k in range(structure.cables.shape[0]):
        power = power + _one_cable(
            structure.cables[k, 0],
            structure.cables[k, 1],
            structure.cable_stiffness[k],
            structure.cable_damping[k],
            structure.cable_length[k],
            x,
            v,
            f,
            memory,
            row + k,
        )
    return power


@jit
def actuator_forces(structure, actuator_length, x, v, f, memory):
    """Add the forces of the actuated cables of natural length ``actuator_length[k]`` [m] (a number or lanes each)."""
    power = load(x, 0, 0) * 0.0
    row = structure.bars.shape[0] * (structure.bars.shape[1] - 1) + structure.cables.shape[0]
    for k in range(structure.actuators.shape[0]):
        natural = load1(actuator_length, k)
        stiffness = structure.actuator_rigidity[k] / natural
        power = power + _one_cable(
            structure.actuators[k, 0],
            structure.actuators[k, 1],
            stiffness,
            structure.actuator_damping[k] * stiffness,
            natural,
            x,
            v,
            f,
            memory,
            row + k,
        )
    return power


@jit
def _one_cable(i, j, stiffness, damping, natural, x, v, f, memory, row):
    """Add one cable's tension to its two ends; returns the power dissipated [W]. Slack in all lanes costs only a length."""
    dx, dy, dz = between(x, i, j)
    square = dot(dx, dy, dz, dx, dy, dz)
    power = square * 0.0
    if any_lane(square > natural * natural):
        length = sqrt(square)
        positive = select(length > 0.0, length, splat(1.0, length))
        inv = 1.0 / positive
        ex, ey, ez = between(v, i, j)
        rate = dot(dx, dy, dz, ex, ey, ez) * inv
        tension, drag = cable_tension(stiffness, damping, length - natural, rate)
        # a slack cable forgets: what a lane remembers must not hang on its neighbours
        power = select(length > natural, 0.5 * (load1(memory, row) + drag) * rate, power)
        store1(memory, row, drag)
        q = tension * inv
        fx, fy, fz = q * dx, q * dy, q * dz
        add_force(f, i, fx, fy, fz)
        add_force(f, j, -fx, -fy, -fz)
    else:
        store1(memory, row, power)
    return power


@jit
def lattice_forces(structure, actuator_length, gravity, x, v, f, memory):
    """f = all forces but contact [N]. Returns the power that material damping dissipates [W] (a number or lanes)."""
    gravity_forces(structure, gravity, f)
    power = bar_forces(structure, x, v, f, memory)
    power = power + cable_forces(structure, x, v, f, memory)
    return power + actuator_forces(structure, actuator_length, x, v, f, memory)
