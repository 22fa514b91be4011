"""Symplectic Euler with a leapfrog start: positions at whole steps, velocities at half steps. One force a step.

Second order without damping, first with: the damping force takes the rates of the half step before.

Within a step the order is collisions, velocities, contacts, positions: with any other a block at rest on an incline creeps
or bounces.
"""

from __future__ import annotations

from tensegrity_gym.core.contact import contact_impulse, impulse_work
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import any_lane, fma, load, select, store


@jit
def symplectic_euler_step(forces, structure, actuator_length, ground, dt, kick, x, v, f, memory, work):
    """Advance x [m] and v [m/s] by one step; ``kick`` [s] is dt, or dt/2 in a lane's first step from rest; ``work`` is not used.

    ``forces(structure, actuator_length, gravity, x, v, f, memory)`` fills f [N] and returns the power damping dissipates [W].
    Returns (that power, energy that contacts dissipated in this step [J], lowest z after it [m]).
    """
    power = forces(structure, actuator_length, ground.gravity, x, v, f, memory)
    dissipated = power * 0.0
    lowest = load(x, 0, 2) + 1e30
    for i in range(structure.mass.shape[0]):
        inverse = kick * structure.inverse_mass[i]
        vx, vy, vz = load(v, i, 0), load(v, i, 1), load(v, i, 2)
        px, py, pz = load(x, i, 0), load(x, i, 1), load(x, i, 2)
        ax, ay, az = load(f, i, 0) * inverse, load(f, i, 1) * inverse, load(f, i, 2) * inverse
        touching = pz <= 0.0
        if i < ground.masses and any_lane(touching):
            cx, cy, cz = contact_impulse(vx, vy, vz, touching, ground.friction, ground.restitution)
            kx, ky, kz = cx + ax, cy + ay, cz + az
            # the second pass only takes away what this step's forces push into the ground: a resting contact, e = 0
            nx, ny, nz = contact_impulse(kx, ky, kz, touching, ground.friction, 0.0)
            done = impulse_work(structure.mass[i], vx, vy, vz, ax, ay, az, nx, ny, nz)
            dissipated = select(touching, dissipated - done, dissipated)
            vx, vy, vz = nx, ny, nz
        else:
            vx, vy, vz = vx + ax, vy + ay, vz + az
        pz = fma(vz, dt, pz)
        store(v, i, 0, vx)
        store(v, i, 1, vy)
        store(v, i, 2, vz)
        store(x, i, 0, fma(vx, dt, px))
        store(x, i, 1, fma(vy, dt, py))
        store(x, i, 2, pz)
        if i < ground.masses:
            lowest = select(pz < lowest, pz, lowest)
    return power, dissipated, lowest
