"""A hop by somebody else's integrator: SciPy's DOP853 between contact events, with forces of its own in NumPy.

Nothing here comes from the core: forces are written from docs/physics.md with another formula for the hinge, and contact
as rigid constraints that are found and left at their instants instead of impulses at the end of steps. Because contacts
are point masses, the reaction on each is known from the force on it alone: a resting mass sticks while |F_t| <= mu |F_n|,
slides against mu F_n otherwise, and leaves when F_n turns. Impacts are plastic (e = 0).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import DOP853

from tensegrity_gym.types import Floats, Ground, Structure

#: sin^2 below which bending damping fades, the model's own (docs/physics.md, section 3).
STRAIGHT = 1e-12
FREE, STICK, SLIP = 0, 1, 2
#: A sliding mass that its own friction would hold sticks below this speed [m/s]: its last 1e-7 s.
HOLD = 1e-4


class Witness:
    """Forces of a structure (without contact) as a function of positions and velocities, (n_masses, 3)."""

    def __init__(self, s: Structure, gravity: Floats | None = None, actuator_length: Floats | None = None) -> None:
        length = s.actuator_length if actuator_length is None else actuator_length
        actuator_stiffness = s.actuator_rigidity / length
        segments = np.stack([s.bars[:, :-1], s.bars[:, 1:]], axis=-1).reshape(-1, 2)
        per_bar = s.bars.shape[1] - 1
        self.pairs = np.concatenate([segments, s.cables, s.actuators])
        self.stiffness = np.concatenate(
            [np.repeat(s.segment_stiffness, per_bar), s.cable_stiffness, s.actuator_rigidity / length]
        )
        drag = s.actuator_damping * actuator_stiffness
        self.damping = np.concatenate([np.repeat(s.segment_damping, per_bar), s.cable_damping, drag])
        self.natural = np.concatenate([np.repeat(s.segment_length, per_bar), s.cable_length, length])
        self.pulls_only = np.arange(len(self.pairs)) >= len(segments)
        rows = np.arange(len(segments)).reshape(-1, per_bar)
        self.before, self.after = rows[:, :-1].ravel(), rows[:, 1:].ravel()
        self.kappa = np.repeat(s.hinge_stiffness, per_bar - 1)
        self.hinge_drag = np.repeat(s.hinge_damping, per_bar - 1)
        self.mass, self.n = s.mass, len(s.mass)
        self.weight = np.zeros((self.n, 3)) if gravity is None else s.mass[:, None] * gravity
        # sums what members do to masses: row of a mass, +1 for a member's first end and -1 for its second
        from scipy.sparse import csr_matrix

        ends = np.concatenate([np.ones(len(self.pairs)), -np.ones(len(self.pairs))])
        place = (self.pairs.T.ravel(), np.tile(np.arange(len(self.pairs)), 2))
        self.gather = csr_matrix((ends, place), shape=(self.n, len(self.pairs)))

    def __call__(self, x: Floats, v: Floats) -> Floats:
        """Forces [N]."""
        d, w = x[self.pairs[:, 1]] - x[self.pairs[:, 0]], v[self.pairs[:, 1]] - v[self.pairs[:, 0]]
        length = np.sqrt((d * d).sum(axis=1))
        unit = d / length[:, None]
        stretch = length - self.natural
        tension = self.stiffness * stretch + self.damping * (unit * w).sum(axis=1)
        tension = np.where(self.pulls_only & ((stretch <= 0) | (tension < 0)), 0.0, tension)
        pull = tension[:, None] * unit
        if len(self.before):
            self._bend(unit, w, length, pull)
        return self.weight + self.gather @ pull

    def _bend(self, unit: Floats, w: Floats, length: Floats, pull: Floats) -> None:
        """Add to ``pull`` the couples of hinges: a moment M turns its two segments against each other, M/l at their ends."""
        a, b = unit[self.before], unit[self.after]
        normal = _cross(a, b)
        sine = np.sqrt((normal * normal).sum(axis=1))
        theta = np.arctan2(sine, (a * b).sum(axis=1))
        normal /= np.where(sine > 0, sine, 1.0)[:, None]
        # directions across each segment, in the bending plane; d theta/dt from the ends' relative speeds
        across_a = _cross(normal, a) / length[self.before, None]
        across_b = _cross(normal, b) / length[self.after, None]
        rate = (across_b * w[self.after]).sum(axis=1) - (across_a * w[self.before]).sum(axis=1)
        moment = self.kappa * theta + self.hinge_drag * rate * sine**2 / (sine**2 + STRAIGHT)
        # U's gradient by a segment's end-to-end vector is what the segment does to its first end
        np.add.at(pull, self.before, -moment[:, None] * across_a)
        np.add.at(pull, self.after, moment[:, None] * across_b)


def _cross(a: Floats, b: Floats) -> Floats:
    """Cross products row by row; np.cross spends its time on axes."""
    return np.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=1,
    )


@dataclass
class WitnessedHop:
    """Where and when DOP853 takes off and comes down; centre of mass displacements from the start."""

    takeoff_time: float  #: [s]
    takeoff_velocity: Floats  #: [m/s], shape (3,)
    touchdown_time: float  #: [s]
    touchdown: Floats  #: [m], shape (2,)
    positions: Floats  #: of all masses at touchdown [m], shape (n_masses, 3)
    events: int  #: contact events handled
    evaluations: int  #: of the forces


class EventHop:
    """One hop from a start at rest to its first touchdown, event by event."""

    def __init__(self, structure: Structure, ground: Ground, start: Floats, tightness: float = 1.0) -> None:
        self.force, self.ground, self.n = Witness(structure, ground.gravity), ground, len(start)
        self.mass, self.tightness = structure.mass, tightness
        self.x, self.v = start.copy(), np.zeros_like(start)
        self.mode = np.where(start[:, 2] <= 1e-9, STICK, FREE)
        self.x[self.mode == STICK, 2] = 0.0
        self.start = self._centre(self.x)
        self.t, self.events, self.evaluations, self.h = 0.0, 0, 0, 1e-7
        self._settle()

    def _centre(self, values: Floats) -> Floats:
        return self.mass @ values / self.mass.sum()

    def _total(self, x: Floats, v: Floats) -> Floats:
        """Forces and reactions in the present modes."""
        self.evaluations += 1
        f = self.force(x, v)
        held, slides = self.mode == STICK, np.flatnonzero(self.mode == SLIP)
        f[held] = 0.0
        if len(slides):
            speed = np.hypot(v[slides, 0], v[slides, 1])
            push = np.hypot(f[slides, 0], f[slides, 1])
            moving = speed > 1e-9
            towards = np.where(moving[:, None], v[slides, :2], f[slides, :2])
            towards = towards / np.where(moving, speed, np.where(push > 0, push, 1.0))[:, None]
            normal = np.maximum(-f[slides, 2], 0.0)
            f[slides, :2] -= self.ground.friction * normal[:, None] * towards
            f[slides, 2] = 0.0
        return f

    def _rhs(self, _t: float, y: Floats) -> Floats:
        x, v = y.reshape(2, self.n, 3)
        return np.concatenate([v.ravel(), (self._total(x, v) / self.mass[:, None]).ravel()])

    def _violations(self, y: Floats) -> Floats:
        """Which masses are past an event, shape (n_masses,)."""
        x, v = y.reshape(2, self.n, 3)
        f = self.force(x, v)
        normal, push = -f[:, 2], np.hypot(f[:, 0], f[:, 1])
        speed = np.hypot(v[:, 0], v[:, 1])
        hold = (speed < HOLD) & (push <= self.ground.friction * normal)
        return np.select(
            [self.mode == FREE, self.mode == STICK],
            [x[:, 2] < 0.0, (normal < 0) | (push > self.ground.friction * normal * (1 + 1e-9) + 1e-12)],
            (normal < 0) | (hold & (v[:, :2] != 0).any(axis=1)),
        )

    def _settle(self) -> None:
        """New modes for all masses at an event."""
        for _ in range(5):  # a mass may come down and slide, or leave, at one instant
            past = np.flatnonzero(self._violations(self._state()))
            if len(past) == 0:
                break
            f = self.force(self.x, self.v)
            for i in past:
                self._switch(i, f[i, 2])

    def _switch(self, i: int, normal_force: float) -> None:
        """The new mode of a mass at its event, with the impulse of a plastic impact if it comes down."""
        self.events += 1
        if self.mode[i] == FREE:
            normal, slip = max(-self.v[i, 2], 0.0), np.hypot(*self.v[i, :2])
            self.v[i, :2] *= max(0.0, 1 - self.ground.friction * normal / slip) if slip > 0 else 0.0
            self.x[i, 2] = self.v[i, 2] = 0.0
            self.mode[i] = SLIP if self.v[i, :2].any() else STICK
        elif normal_force > 0:
            self.mode[i] = FREE
        elif self.mode[i] == STICK:
            self.mode[i] = SLIP
        else:
            self.v[i, :2] = 0.0
            self.mode[i] = STICK

    def _state(self) -> Floats:
        return np.concatenate([self.x.ravel(), self.v.ravel()])

    def _tolerances(self) -> dict[str, Any]:
        """In flight the fast vibration matters to nobody: there the stability of DOP853 sets its step, not its error."""
        loose = 10.0 if (self.mode == FREE).all() else 1.0
        atol = np.repeat([1e-10, 1e-7], 3 * self.n)
        return {"rtol": 1e-7 * loose / self.tightness, "atol": atol * loose / self.tightness}

    def _advance(self, limit: float) -> None:
        """Up to the next event, or ``limit`` [s]."""
        solver = DOP853(self._rhs, self.t, self._state(), limit, first_step=min(self.h, limit - self.t), **self._tolerances())
        while solver.status == "running":
            message = solver.step()
            if solver.status == "failed":
                raise RuntimeError(f"EventHop: expected a step, got {message!r} at t = {solver.t:.6g} s")
            if self._violations(solver.y).any():
                dense, low, high = solver.dense_output(), solver.t_old, solver.t
                while high - low > 1e-13:
                    middle = 0.5 * (low + high)
                    low, high = (low, middle) if self._violations(dense(middle)).any() else (middle, high)
                self.h = max(1e-9, 0.1 * (solver.t - solver.t_old))
                self.t, y = high, dense(high) if high < solver.t else solver.y
                break
        else:
            self.t, y = solver.t, solver.y
        self.x, self.v = y.reshape(2, self.n, 3).copy()

    def run(self, duration: float, flight_speed: float) -> WitnessedHop:
        """Follow the hop to its first contact in descent after a take-off (``flight_speed`` [m/s] upwards at least)."""
        takeoff: tuple[float, Floats] | None = None
        while self.t < duration:
            aloft = bool((self.mode == FREE).all())
            self._advance(duration)
            velocity, shift = self._centre(self.v), self._centre(self.x) - self.start
            if aloft and takeoff is not None and velocity[2] < 0 and self.t < duration:
                return WitnessedHop(*takeoff, self.t, shift[:2], self.x, self.events, self.evaluations)
            self._settle()
            if not aloft and (self.mode == FREE).all() and velocity[2] > flight_speed:
                takeoff = (self.t, velocity)
        raise RuntimeError(f"EventHop: expected a touchdown within {duration} s, got none after {self.events} events")
