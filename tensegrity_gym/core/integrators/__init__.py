"""Integrators: each file has one step function that takes the force function it advances.

All steps have one signature, ``step(forces, structure, actuator_length, ground, dt, kick, x, v, f, memory, work)``, and return
(power that damping dissipates [W], energy that contacts dissipated in the step [J], lowest z after it [m]). ``f`` enters with
the forces at x; ``kick`` [s] is dt, or dt/2 in a lane's first step; ``work`` has four more arrays like x, stacked by rows.
"""

from tensegrity_gym.core.integrators.runge_kutta import runge_kutta_step
from tensegrity_gym.core.integrators.symplectic_euler import symplectic_euler_step
from tensegrity_gym.core.integrators.velocity_verlet import velocity_verlet_step

__all__ = ["runge_kutta_step", "symplectic_euler_step", "velocity_verlet_step"]
