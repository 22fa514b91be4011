"""Collision and contact impulses of point masses on the ground z = 0, with Coulomb friction."""

from __future__ import annotations

from tensegrity_gym.core.forces import dot
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import fma, select, splat, sqrt


@jit
def contact_impulse(vx, vy, vz, touching, friction, restitution):
    """Velocity after the impulse of the ground on a mass that touches it (gap <= 0), where it moves into it (v_n < 0).

    J_n = m (1 + e) |v_n| along the normal and J_t = min(m |v_t|, mu J_n) against v_t; the mass cancels out. A mass
    sticks if and only if |v_t| <= mu (1 + e) |v_n|. Velocities elsewhere come back unchanged, bit for bit.
    """
    active = touching & (vz < 0.0)
    normal = -(1.0 + restitution) * vz
    limit = friction * normal
    speed = sqrt(fma(vx, vx, vy * vy))
    slides = speed > limit
    zero = splat(0.0, vz)
    keep = select(slides, 1.0 - limit / select(slides, speed, splat(1.0, vz)), zero)
    return select(active, keep * vx, vx), select(active, keep * vy, vy), select(active, vz + normal, vz)


@jit
def impulse_work(mass, vx, vy, vz, ax, ay, az, nx, ny, nz):
    """Work [J] of the contact impulse that took a mass from v, with a kick a of the other forces, to n.

    The impulse m (n - v - a) counts at the mean of the velocities before and after, so that a resting contact does none.
    """
    return 0.5 * mass * dot(nx - vx - ax, ny - vy - ay, nz - vz - az, vx + nx, vy + ny, vz + nz)
