"""Slow, obvious NumPy twins of the kernels: one member after the other, one equation a line, no shared code with the core.

Forces come with the sum of the magnitudes that were added up on each mass; times a few eps it bounds what rounding can do.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from tensegrity_gym.types import Structure

EPS = float(np.finfo(np.float64).eps)
#: Below this sin^2(theta) bending damping fades, so that a straight hinge has no 0/0 (members.STRAIGHT).
STRAIGHT = 1e-12
#: The core's theta / sin theta is a polynomial of this relative error.
POLYNOMIAL_ERROR = 1e-13


def make_structure(mass: Any, **members: Any) -> Structure:
    """A Structure by hand: point masses and whatever members are given; absent ones have zero rows.

    Bars are index rows with ``segment_stiffness``, ``segment_length`` and optionally ``segment_damping``,
    ``hinge_stiffness``, ``hinge_damping`` (numbers or one a bar); cables and actuators likewise.
    """
    bars = np.array(members.pop("bars", np.zeros((0, 4))), dtype=np.int64)
    cables = np.array(members.pop("cables", np.zeros((0, 2))), dtype=np.int64)
    actuators = np.array(members.pop("actuators", np.zeros((0, 2))), dtype=np.int64)
    mass = np.array(mass, dtype=np.float64)
    counts = {"cable": len(cables), "actuator": len(actuators), "segment": len(bars), "hinge": len(bars)}
    fields: dict[str, Any] = {"mass": mass, "inverse_mass": 1.0 / mass, "bars": bars, "cables": cables, "actuators": actuators}
    for name in Structure._fields:
        if name not in fields:
            fields[name] = np.ones(counts[name.split("_")[0]]) * members.pop(name, 0.0)
    assert not members, f"unknown fields {sorted(members)}"
    return Structure(**fields)


class Member(NamedTuple):
    """One axial member: masses, stiffness [N/m], damping [N s/m], natural length [m], whether it can push."""

    i: int
    j: int
    stiffness: float
    damping: float
    natural: float
    pushes: bool


def axial_members(s: Structure, actuator_length: np.ndarray) -> list[Member]:
    """Bar segments, cables, actuated cables: the order of the core's damping memory."""
    found = []
    for b, bar in enumerate(s.bars):
        for i, j in pairwise(bar):
            found.append(Member(i, j, s.segment_stiffness[b], s.segment_damping[b], s.segment_length[b], True))
    for k, (i, j) in enumerate(s.cables):
        found.append(Member(i, j, s.cable_stiffness[k], s.cable_damping[k], s.cable_length[k], False))
    for k, (i, j) in enumerate(s.actuators):
        stiffness = s.actuator_rigidity[k] / actuator_length[k]  # k = EA / natural length
        found.append(Member(i, j, stiffness, s.actuator_damping[k] * stiffness, actuator_length[k], False))
    return found


def hinges(s: Structure) -> list[tuple[int, int, int, float, float]]:
    """(mass before, at, after, kappa [N m/rad], c [N m s/rad]) of every hinge."""
    found = []
    for b, bar in enumerate(s.bars):
        for i, j, k in zip(bar[:-2], bar[1:-1], bar[2:], strict=True):
            found.append((i, j, k, s.hinge_stiffness[b], s.hinge_damping[b]))
    return found


def hinge_angle(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two segment vectors [rad], well conditioned from 0 to pi."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def hinge_angle_gradient(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """d theta/da, d theta/db [rad/m]: perpendicular to the segment, in the plane of both, away from the other, 1/length."""
    u, v = a / np.linalg.norm(a), b / np.linalg.norm(b)
    normal = np.cross(u, v)
    if np.linalg.norm(normal) == 0.0:
        return np.zeros(3), np.zeros(3)
    normal = normal / np.linalg.norm(normal)
    return np.cross(u, normal) / np.linalg.norm(a), -np.cross(v, normal) / np.linalg.norm(b)


def tension(member: Member, length: float, rate: float) -> tuple[float, float]:
    """Tension of an axial member and the part of it that is damping [N]: T = k (l - l0) + c dl/dt, cables T >= 0, taut only."""
    elastic = member.stiffness * (length - member.natural)
    total = elastic + member.damping * rate
    if not member.pushes:
        if length <= member.natural:
            return 0.0, 0.0
        total = max(total, 0.0)
    return total, total - elastic


class Forces(NamedTuple):
    """Forces [N], the magnitudes they were summed from [N], damping's power [W] and its magnitudes, axial damping forces [N]."""

    f: np.ndarray
    magnitude: np.ndarray
    power: float
    power_magnitude: float
    drags: np.ndarray


def forces(s: Structure, actuator_length: Any, gravity: Any, x: Any, v: Any, memory: Any = None) -> Forces:
    """All forces but contact: m g, axial members along their axis, hinges M d theta/dx with M = kappa theta + c dtheta/dt."""
    f = s.mass[:, None] * np.asarray(gravity)
    magnitude = np.linalg.norm(f, axis=1)
    power = power_magnitude = 0.0
    members = axial_members(s, actuator_length)
    memory = np.zeros(len(members)) if memory is None else memory
    drags = np.zeros(len(members))
    for row, member in enumerate(members):
        d, w = x[member.j] - x[member.i], v[member.j] - v[member.i]
        length = np.linalg.norm(d)
        rate = (d / length) @ w
        pull, drags[row] = tension(member, length, rate)
        f[member.i] += pull * d / length
        f[member.j] -= pull * d / length
        taut = member.pushes or length > member.natural
        power += 0.5 * (memory[row] + drags[row]) * rate if taut else 0.0
        # positions of magnitude |x| are known to eps |x|, so the tension to eps k |x|, and the rate to eps |v| (|x|/l)
        reach = max(np.linalg.norm(x[member.i]), np.linalg.norm(x[member.j]), length)
        speed = max(np.linalg.norm(v[member.i]), np.linalg.norm(v[member.j])) * reach / length
        size = (member.stiffness * reach + member.damping * speed) if taut else 0.0
        magnitude[member.i] += size
        magnitude[member.j] += size
        power_magnitude += (abs(memory[row]) + size) * speed
    for i, j, k, kappa, c in hinges(s):
        a, b = x[j] - x[i], x[k] - x[j]
        theta = hinge_angle(a, b)
        da, db = hinge_angle_gradient(a, b)
        rate = da @ (v[j] - v[i]) + db @ (v[k] - v[j])
        fade = np.sin(theta) ** 2 / (np.sin(theta) ** 2 + STRAIGHT)
        moment = kappa * theta + c * rate * fade
        f[i] += moment * da
        f[j] += moment * (db - da)
        f[k] -= moment * db
        power += c * rate**2 * fade
        reach = max(np.linalg.norm(x[m]) for m in (i, j, k))
        shortest = min(np.linalg.norm(a), np.linalg.norm(b))
        speed = max(np.linalg.norm(v[m]) for m in (i, j, k))
        # theta is known to eps |x|/l; near straight its rate is the rate of a tiny vector's length, known to eps |v|/l / theta
        blur = reach / shortest * (1 + POLYNOMIAL_ERROR / EPS)
        size = (kappa * (theta + 1) + c * speed / shortest / max(np.sin(theta), 1e-6)) * blur / shortest
        magnitude[[i, j, k]] += 2 * size
        power_magnitude += size * speed
    return Forces(f, magnitude, power, power_magnitude, drags)


def energies(s: Structure, actuator_length: Any, gravity: Any, x: Any, v: Any) -> np.ndarray:
    """Bars, cables, actuators, kinetic, gravitational [J], shape (5,)."""
    members = axial_members(s, actuator_length)
    n_segments, n_cables = s.bars.shape[0] * (s.bars.shape[1] - 1), len(s.cables)
    parts = np.zeros(5)
    for row, member in enumerate(members):
        stretch = np.linalg.norm(x[member.j] - x[member.i]) - member.natural
        if member.pushes or stretch > 0:
            column = 0 if row < n_segments else 1 if row < n_segments + n_cables else 2
            parts[column] += 0.5 * member.stiffness * stretch**2
    for i, j, k, kappa, _ in hinges(s):
        parts[0] += 0.5 * kappa * hinge_angle(x[j] - x[i], x[k] - x[j]) ** 2
    parts[3] = sum(0.5 * m * (u @ u) for m, u in zip(s.mass, v, strict=True))
    parts[4] = -sum(m * (np.asarray(gravity) @ p) for m, p in zip(s.mass, x, strict=True))
    return parts


def contact_impulse(velocity: np.ndarray, friction: float, restitution: float) -> np.ndarray:
    """Velocity of a mass on the ground after J_n = m (1 + e) |v_n| and J_t = min(m |v_t|, mu J_n), if it moves into it."""
    after = velocity.copy()
    if velocity[2] < 0.0:
        normal = (1 + restitution) * -velocity[2]
        slip = np.hypot(velocity[0], velocity[1])
        after[2] += normal
        if slip > 0.0:
            after[:2] -= min(slip, friction * normal) * velocity[:2] / slip
    return after


def step(
    s: Structure, actuator_length: Any, ground: Any, dt: float, kick: float, x: np.ndarray, v: np.ndarray, memory: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(x, v, memory) after one step: collisions, velocities, contacts (e = 0), positions."""
    total = forces(s, actuator_length, ground.gravity, x, v, memory)
    on_ground = x[:, 2] <= 0.0
    moved = v.copy()
    for i in np.flatnonzero(on_ground):
        moved[i] = contact_impulse(v[i], ground.friction, ground.restitution)
    moved += kick * total.f / s.mass[:, None]
    for i in np.flatnonzero(on_ground):
        moved[i] = contact_impulse(moved[i], ground.friction, 0.0)
    return x + dt * moved, moved, total.drags


def tangent_of_forces(s: Structure, actuator_length: Any, x: np.ndarray, h: float) -> np.ndarray:
    """-dF/dx by central differences of the naive forces, shape (3n, 3n) [N/m]."""
    n = x.size
    matrix = np.zeros((n, n))
    still = np.zeros_like(x)
    for k in range(n):
        shift = np.zeros(n)
        shift[k] = h
        ahead = forces(s, actuator_length, np.zeros(3), x + shift.reshape(x.shape), still).f
        behind = forces(s, actuator_length, np.zeros(3), x - shift.reshape(x.shape), still).f
        matrix[:, k] = -(ahead - behind).ravel() / (2 * h)
    return matrix


def dense_tangent(pattern: Any, h: np.ndarray) -> np.ndarray:
    """The symmetric matrix whose blocks a BlockPattern places in ``h``, shape (3n, 3n)."""
    n = len(pattern.order)
    matrix = np.zeros((3 * n, 3 * n))
    for i in range(n):
        matrix[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = h[i].reshape(3, 3)
    for k in range(n):
        column = pattern.order[k]
        for slot in range(pattern.starts[k], pattern.starts[k + 1]):
            row = pattern.rows[slot - n]
            block = h[slot].reshape(3, 3)
            matrix[3 * row : 3 * row + 3, 3 * column : 3 * column + 3] = block
            matrix[3 * column : 3 * column + 3, 3 * row : 3 * row + 3] = block.T
    return matrix
