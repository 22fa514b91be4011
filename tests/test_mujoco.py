"""MuJoCo as a differential oracle: the same springs, the same Euler steps, flown by somebody else's code."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tensegrity_gym.core.forces import bar_forces, lattice_forces
from tensegrity_gym.core.integrators import symplectic_euler_step
from tensegrity_gym.core.jit import jit
from tensegrity_gym.design import Design
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.mjcf import to_mjcf
from tensegrity_gym.types import Ground

mujoco = pytest.importorskip("mujoco")

STEPS = 1000
UNDAMPED = Design(bar_damping=0.0, cable_damping=0.0, hinge_damping=0.0)


@jit(forceinline=False)
def _fly(structure, actuator_length, ground, dt, steps, x, v, f, memory, work):
    for _ in range(steps):
        symplectic_euler_step(lattice_forces, structure, actuator_length, ground, dt, dt, x, v, f, memory, work)


@jit(forceinline=False)
def _hinge_forces(structure, x, v, f, memory):
    bar_forces(structure, x, v, f, memory)


def _start(lattice: Lattice, design: Design) -> tuple[np.ndarray, np.ndarray]:
    """A posture above the ground with bars and cables well out of balance, and velocities."""
    rng = np.random.default_rng(7)
    x = design.unloaded_positions(lattice) + np.array((0.0, 0.0, 1.0))
    return x + rng.normal(0, 2e-3, x.shape), rng.normal(0, 0.3, x.shape)


def _ours(design: Design, lattice: Lattice, structure, x, v, dt, gravity):
    x, v, f = x.copy(), v.copy(), np.zeros_like(x)
    memory, work = np.zeros(structure.n_axial_members), np.zeros((4 * len(x), 3))
    ground = Ground(gravity, 0.5, 0.0)
    _fly(structure, structure.actuator_length, ground, dt, STEPS, x, v, f, memory, work)
    return x, v


@pytest.mark.parametrize("hinges", [False, True])
def test_flight_agrees_with_mujoco_to_1e_minus_10(hinges):
    # both do v += dt f/m, x += dt v: only rounding differs, 1e-16 m of 1 m a step, grown by at most a few hundred in
    # 1 000 steps of a non-linear structure
    lattice, gravity, dt = Lattice(2, 2), np.array((0.3, 0.0, -9.8)), 1e-5
    structure = UNDAMPED.structure(lattice)
    if not hinges:
        structure = structure._replace(hinge_stiffness=0.0 * structure.hinge_stiffness)
    x, v = _start(lattice, UNDAMPED)
    model = mujoco.MjModel.from_xml_string(to_mjcf(lattice, UNDAMPED, x, gravity=gravity, dt=dt))
    data = mujoco.MjData(model)
    data.qvel[:] = v.reshape(-1)
    bending_only = structure._replace(segment_stiffness=0.0 * structure.segment_stiffness)
    f, memory = np.zeros_like(x), np.zeros(structure.n_axial_members)
    for _ in range(STEPS):
        if hinges:
            here = x + data.qpos.reshape(-1, 3)
            f[:] = 0.0
            _hinge_forces(bending_only, here, np.zeros_like(x), f, memory)
            data.qfrc_applied[:] = f.reshape(-1)
        mujoco.mj_step(model, data)
    ours_x, ours_v = _ours(UNDAMPED, lattice, structure, x, v, dt, gravity)
    assert np.abs(ours_x - x).max() > 2e-3  # something did move
    np.testing.assert_allclose(x + data.qpos.reshape(-1, 3), ours_x, rtol=0, atol=1e-10)
    np.testing.assert_allclose(data.qvel.reshape(-1, 3), ours_v, rtol=0, atol=1e-6)


def test_a_wrong_stiffness_would_be_seen():
    # the oracle must be able to say no: one part in a million of one class of members moves masses by far more than 1e-10
    lattice, gravity, dt = Lattice(1, 1), np.array((0.0, 0.0, -9.8)), 1e-5
    x, v = _start(lattice, UNDAMPED)
    right = UNDAMPED.structure(lattice)
    wrong = replace(UNDAMPED, cable_modulus=UNDAMPED.cable_modulus * (1 + 1e-6)).structure(lattice)
    a, _ = _ours(UNDAMPED, lattice, right, x, v, dt, gravity)
    b, _ = _ours(UNDAMPED, lattice, wrong, x, v, dt, gravity)
    assert np.abs(a - b).max() > 1e-9


def test_export_counts_and_masses():
    lattice = Lattice(2, 1)
    x = UNDAMPED.unloaded_positions(lattice)
    model = mujoco.MjModel.from_xml_string(to_mjcf(lattice, UNDAMPED, x, gravity=np.zeros(3), dt=1e-5))
    structure = UNDAMPED.structure(lattice)
    assert (model.nv, model.ntendon) == (3 * lattice.n_masses, structure.n_axial_members)
    np.testing.assert_allclose(model.body_mass[1:], structure.mass, rtol=1e-12)
