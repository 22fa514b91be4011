"""The classical Runge-Kutta method: fourth order between impacts, four forces a step, not symplectic.

Contacts are impulses on the velocity before and after the step, as in the other methods; a mass that touches the ground
moves with its velocity after the impulse, so that it cannot sink into the ground.
"""

from __future__ import annotations

from tensegrity_gym.core.contact import contact_impulse, impulse_work
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import any_lane, fma, load, select, splat, store


@jit
def runge_kutta_step(forces, structure, actuator_length, ground, dt, kick, x, v, f, memory, work):
    """Advance x [m] and v [m/s] by one step of four stages; ``work`` has four arrays like x, ``kick`` is not used.

    Returns as described in the package; the power is the weighted mean of the stages'.
    """
    n = structure.mass.shape[0]
    start_x, start_v, sum_x, sum_v = 0, n, 2 * n, 3 * n  # row offsets into work
    struck = _collide(structure, ground, x, v, work, start_x, start_v)
    power = splat(0.0, load(x, 0, 0))
    for stage in range(4):
        share = 2.0 if stage == 1 or stage == 2 else 1.0
        ahead = 1.0 if stage == 2 else 0.5
        power = fma(share / 6.0, forces(structure, actuator_length, ground.gravity, x, v, f, memory), power)
        for i in range(n):
            for c in range(3):
                velocity, acceleration = load(v, i, c), load(f, i, c) * structure.inverse_mass[i]
                zero = velocity * 0.0
                before_x = select(stage > 0, load(work, sum_x + i, c), zero)
                before_v = select(stage > 0, load(work, sum_v + i, c), zero)
                store(work, sum_x + i, c, fma(share / 6.0, velocity, before_x))
                store(work, sum_v + i, c, fma(share / 6.0, acceleration, before_v))
                store(x, i, c, fma(velocity, ahead * dt, load(work, start_x + i, c)))
                store(v, i, c, fma(acceleration, ahead * dt, load(work, start_v + i, c)))
    power, lost, lowest = _finish(structure, ground, dt, power, x, v, work, start_x, start_v, sum_x, sum_v)
    return power, struck + lost, lowest


@jit
def _touches(ground, i, height):
    """Where mass i is on the ground, if it is one that meets it."""
    return height <= 0.0 if i < ground.masses else height < -1e30


@jit
def _collide(structure, ground, x, v, work, start_x, start_v):
    """Keep the start of the step in ``work``, v after collisions; returns the energy that these dissipate [J]."""
    zero = load(x, 0, 0) * 0.0
    dissipated = zero
    for i in range(structure.mass.shape[0]):
        vx, vy, vz = load(v, i, 0), load(v, i, 1), load(v, i, 2)
        touching = _touches(ground, i, load(x, i, 2))
        nx, ny, nz = contact_impulse(vx, vy, vz, touching, ground.friction, ground.restitution)
        store(work, start_v + i, 0, nx)
        store(work, start_v + i, 1, ny)
        store(work, start_v + i, 2, nz)
        for c in range(3):
            store(work, start_x + i, c, load(x, i, c))
            store(v, i, c, load(work, start_v + i, c))
        done = impulse_work(structure.mass[i], vx, vy, vz, zero, zero, zero, nx, ny, nz)
        dissipated = select(touching, dissipated - done, dissipated)
    return dissipated


@jit
def _finish(structure, ground, dt, power, x, v, work, start_x, start_v, sum_x, sum_v):
    """Put the stages together, then the resting contacts; returns (power, dissipated, lowest)."""
    dissipated = power * 0.0
    lowest = power * 0.0 + 1e30
    for i in range(structure.mass.shape[0]):
        vx, vy, vz = load(work, start_v + i, 0), load(work, start_v + i, 1), load(work, start_v + i, 2)
        ax, ay, az = dt * load(work, sum_v + i, 0), dt * load(work, sum_v + i, 1), dt * load(work, sum_v + i, 2)
        touching = _touches(ground, i, load(work, start_x + i, 2))
        nx, ny, nz = contact_impulse(vx + ax, vy + ay, vz + az, touching, ground.friction, 0.0)
        if any_lane(touching):
            done = impulse_work(structure.mass[i], vx, vy, vz, ax, ay, az, nx, ny, nz)
            dissipated = select(touching, dissipated - done, dissipated)
        store(v, i, 0, nx)
        store(v, i, 1, ny)
        store(v, i, 2, nz)
        for c in range(3):
            speed = select(touching, load(v, i, c), load(work, sum_x + i, c))
            store(x, i, c, fma(speed, dt, load(work, start_x + i, c)))
        z = load(x, i, 2)
        if i < ground.masses:
            lowest = select(z < lowest, z, lowest)
    return power, dissipated, lowest
