"""The simulator's own forces and steps on one structure, without a hop around them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from tensegrity_gym.core.forces import lattice_forces
from tensegrity_gym.core.integrators import runge_kutta_step, symplectic_euler_step, velocity_verlet_step
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import load1, store1
from tensegrity_gym.types import Floats, Ground, Structure

#: Nothing but the members.
SPACE = Ground(np.zeros(3), 0.0, 0.0)


def only_bars(
    mass: Floats,
    bars: np.ndarray,
    *,
    stiffness: ArrayLike,
    length: ArrayLike,
    damping: ArrayLike = 0.0,
    hinge_stiffness: ArrayLike = 0.0,
) -> Structure:
    """Bars without cables; ``mass`` [kg], ``bars`` (n, segments + 1), of the segments [N/m, m, N s/m], of the hinges [N m]."""

    def each(value: ArrayLike) -> Floats:
        return np.broadcast_to(value, len(bars)).astype(np.float64)

    empty, pairs = np.zeros(0), np.zeros((0, 2), dtype=np.int64)
    return Structure(
        mass=mass,
        inverse_mass=1 / mass,
        cables=pairs,
        cable_stiffness=empty,
        cable_length=empty,
        cable_damping=empty,
        actuators=pairs,
        actuator_rigidity=empty,
        actuator_length=empty,
        actuator_damping=empty,
        bars=bars,
        segment_stiffness=each(stiffness),
        segment_length=each(length),
        segment_damping=each(damping),
        hinge_stiffness=each(hinge_stiffness),
        hinge_damping=each(0.0),
    )


@jit(cache=True)
def _forces(structure, actuator_length, gravity, x, v, f, memory):
    lattice_forces(structure, actuator_length, gravity, x, v, f, memory)


@jit(cache=True)
def _steps(method, structure, actuator_length, ground, dt, first_kick, steps, x, v, f, memory, work, losses):
    """Step 0 symplectic Euler, 1 velocity Verlet, 2 Runge-Kutta; ``first_kick`` [s] is of the first step."""
    kick = first_kick
    for _ in range(steps):
        if method == 0:
            done = symplectic_euler_step(lattice_forces, structure, actuator_length, ground, dt, kick, x, v, f, memory, work)
        elif method == 1:
            done = velocity_verlet_step(lattice_forces, structure, actuator_length, ground, dt, kick, x, v, f, memory, work)
        else:
            done = runge_kutta_step(lattice_forces, structure, actuator_length, ground, dt, kick, x, v, f, memory, work)
        store1(losses, 0, load1(losses, 0) + done[0] * dt)
        store1(losses, 1, load1(losses, 1) + done[1])
        kick = dt


METHODS = ("symplectic_euler", "velocity_verlet", "runge_kutta")


def forces(structure: Structure, x: Floats, v: Floats | None = None, gravity: Floats | None = None) -> Floats:
    """All forces but contact at x (and velocities v) with unlocked actuators, shape (n_masses, 3) [N]."""
    f, memory = np.zeros_like(x), np.zeros(structure.n_axial_members)
    still, none = np.zeros_like(x), np.zeros(3)
    _forces(structure, structure.actuator_length, none if gravity is None else gravity, x, still if v is None else v, f, memory)
    return f


@dataclass
class Motion:
    """One structure in motion; ``x`` [m] and ``v`` [m/s] change in place, v half a step behind with symplectic Euler."""

    structure: Structure
    ground: Ground
    dt: float
    x: Floats
    v: Floats
    method: str = "symplectic_euler"
    moved: bool = False
    f: Floats = field(init=False)
    memory: Floats = field(init=False)
    losses: Floats = field(default_factory=lambda: np.zeros(2))  #: to damping and to contact [J]

    def __post_init__(self) -> None:
        self.x, self.v = self.x.copy(), self.v.copy()
        self.f = forces(self.structure, self.x, self.v, self.ground.gravity)
        self.memory = np.zeros(self.structure.n_axial_members)

    def run(self, steps: int) -> None:
        """Take ``steps``."""
        work, first = np.zeros((4 * len(self.x), 3)), self.dt if self.moved else 0.5 * self.dt
        state = (self.x, self.v, self.f, self.memory, work, self.losses)
        lengths = self.structure.actuator_length
        _steps(METHODS.index(self.method), self.structure, lengths, self.ground, self.dt, first, steps, *state)
        self.moved = self.moved or steps > 0
