"""Velocity Verlet: positions and velocities at whole steps. One force a step; second order without damping.

The damping force takes the velocity of the half step, which keeps it explicit but of first order. Collisions come before the
first half kick, and resting contacts (e = 0) after each of the two. The second must not touch a mass that has only just come
down: it would stop it before its collision, and nothing would bounce.
"""

from __future__ import annotations

from tensegrity_gym.core.contact import contact_impulse, impulse_work
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import any_lane, fma, load, select, splat, store


@jit
def velocity_verlet_step(forces, structure, actuator_length, ground, dt, kick, x, v, f, memory, work):
    """Advance x [m] and v [m/s] by one step; ``f`` holds the forces at x [N] and leaves with those at the new x.

    ``kick`` and ``work`` are not used. Returns as described in the package.
    """
    half = splat(0.5 * dt, load(x, 0, 0))
    first = _half_kick(structure, ground, half, True, x, v, f)
    lowest = load(x, 0, 2) + 1e30
    for i in range(structure.mass.shape[0]):
        for c in range(3):
            store(x, i, c, fma(load(v, i, c), dt, load(x, i, c)))
        z = load(x, i, 2)
        if i < ground.masses:
            lowest = select(z < lowest, z, lowest)
    power = forces(structure, actuator_length, ground.gravity, x, v, f, memory)
    return power, first + _half_kick(structure, ground, half, False, x, v, f), lowest


@jit
def _half_kick(structure, ground, half, collide, x, v, f):
    """v += half f / m, between collisions (if ``collide``) and resting contacts; returns the energy these dissipate [J]."""
    dissipated = half * 0.0
    for i in range(structure.mass.shape[0]):
        inverse = half * structure.inverse_mass[i]
        vx, vy, vz = load(v, i, 0), load(v, i, 1), load(v, i, 2)
        ax, ay, az = load(f, i, 0) * inverse, load(f, i, 1) * inverse, load(f, i, 2) * inverse
        touching = load(x, i, 2) <= 0.0
        nx, ny, nz = vx + ax, vy + ay, vz + az
        if i < ground.masses and any_lane(touching):
            if collide:
                cx, cy, cz = contact_impulse(vx, vy, vz, touching, ground.friction, ground.restitution)
            else:
                cx, cy, cz = vx, vy, vz
            resting = touching & (cz >= 0.0)  # what comes down now collides at the start of the next step
            nx, ny, nz = contact_impulse(cx + ax, cy + ay, cz + az, resting, ground.friction, 0.0)
            done = impulse_work(structure.mass[i], vx, vy, vz, ax, ay, az, nx, ny, nz)
            dissipated = select(touching, dissipated - done, dissipated)
        store(v, i, 0, nx)
        store(v, i, 1, ny)
        store(v, i, 2, nz)
    return dissipated
