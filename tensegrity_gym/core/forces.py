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
from tensegrity_gym.core.lanes import any_lane, fma, load, load1, select, splat, sqrt, store, store1
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


@jit
def bar_forces(structure, x, v, f, memory):
    """Add the forces of all bars: axial springs, hinges and the damping of both. Returns the power dissipated [W].

    Runs along each bar once with the last segment in registers. Segment j of unit vector u and length l pulls its near end
    with A = T u + P G / l, P = I - u u^T, and its far end with -A; G is dU/du (with damping) of its two hinges.
    """
    bars = structure.bars
    segments = bars.shape[1] - 1
    zero = load(x, 0, 0) * 0.0
    power = zero
    for b in range(bars.shape[0]):
        stiffness = structure.segment_stiffness[b]
        natural = structure.segment_length[b]
        damping = structure.segment_damping[b]
        kappa = structure.hinge_stiffness[b]
        hinge_c = structure.hinge_damping[b]
        # the segment before: unit vector, its rate, 1/length, tension, G so far, and what its near end already carries
        ux = uy = uz = wx = wy = wz = inverse = tension = gx = gy = gz = cx = cy = cz = zero
        for j in range(segments):
            near, far = bars[b, j], bars[b, j + 1]
            dx, dy, dz = between(x, near, far)
            ex, ey, ez = between(v, near, far)
            length = sqrt(dot(dx, dy, dz, dx, dy, dz))
            inv = 1.0 / length
            nx, ny, nz = dx * inv, dy * inv, dz * inv
            rate = dot(nx, ny, nz, ex, ey, ez)
            drag = damping * rate
            pull = fma(stiffness, length - natural, drag)
            power = fma(0.5 * (load1(memory, b * segments + j) + drag), rate, power)
            store1(memory, b * segments + j, drag)
            rx, ry, rz = (ex - rate * nx) * inv, (ey - rate * ny) * inv, (ez - rate * nz) * inv
            hx = hy = hz = zero
            if j > 0:
                bx, by, bz = ux - nx, uy - ny, uz - nz
                s = 0.25 * dot(bx, by, bz, bx, by, bz)
                closing = dot(bx, by, bz, wx - rx, wy - ry, wz - rz)
                added, lost = hinge_damping_factor(hinge_c, s, closing)
                factor = hinge_factor(kappa, s) + added
                power = power + lost
                # U depends on u . n with dU = -factor d(u . n)
                gx, gy, gz = gx - factor * nx, gy - factor * ny, gz - factor * nz
                hx, hy, hz = -factor * ux, -factor * uy, -factor * uz
                ax, ay, az = _segment_force(ux, uy, uz, inverse, tension, gx, gy, gz)
                add_force(f, bars[b, j - 1], ax - cx, ay - cy, az - cz)
                cx, cy, cz = ax, ay, az
            ux, uy, uz, wx, wy, wz = nx, ny, nz, rx, ry, rz
            inverse, tension = inv, pull
            gx, gy, gz = hx, hy, hz
        ax, ay, az = _segment_force(ux, uy, uz, inverse, tension, gx, gy, gz)
        add_force(f, bars[b, segments - 1], ax - cx, ay - cy, az - cz)
        add_force(f, bars[b, segments], -ax, -ay, -az)
    return power


@jit
def _segment_force(ux, uy, uz, inverse, tension, gx, gy, gz):
    """A = T u + (G - (G . u) u) / l: the force on the near end of a segment."""
    along = fma(-inverse, dot(gx, gy, gz, ux, uy, uz), tension)
    return fma(along, ux, gx * inverse), fma(along, uy, gy * inverse), fma(along, uz, gz * inverse)


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
