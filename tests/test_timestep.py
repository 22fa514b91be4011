"""Integrators' orders and the critical time step, against closed forms and by stepping."""

from __future__ import annotations

from dataclasses import replace

import kernels
import naive
import numpy as np
import pytest

from tensegrity_gym import Design, Lattice
from tensegrity_gym.timestep import MARGIN, critical_time_step, default_time_step
from tensegrity_gym.types import Ground, Structure

SPACE = Ground(np.zeros(3), 0.0, 0.0)
NOTHING = np.zeros(0)


def whirl(integrator: str, dt: float, duration: float, damping: float = 0.0) -> np.ndarray:
    """Positions after ``duration`` of two masses on a stretched spring that turns: nonlinear, smooth, no closed form [m]."""
    s = naive.make_structure([0.1, 0.3], bars=[[0, 1]], segment_stiffness=200.0, segment_length=0.3, segment_damping=damping)
    x = np.array([[0.0, 0, 5], [0.4, 0, 5]])
    v = np.array([[0.0, 0, 0], [0.1, 2.0, -0.5]])
    f = naive.forces(s, NOTHING, np.zeros(3), x, v).f
    kernels.advance(s, NOTHING, SPACE, dt, 0.5 * dt, round(duration / dt), x, v, f, np.zeros(1), np.zeros(3), integrator)
    return x


@pytest.mark.parametrize(
    ("integrator", "damping", "order"),
    [
        ("symplectic_euler", 0.0, 2),
        ("velocity_verlet", 0.0, 2),
        ("runge_kutta", 0.0, 4),
        ("symplectic_euler", 1.0, 1),
        ("velocity_verlet", 1.0, 1),
        ("runge_kutta", 1.0, 4),
    ],
)
def test_order(integrator: str, damping: float, order: int) -> None:
    """Error ~ dt^p, p seen on a halved step, up to the next order's share: dt omega = 0.025 to 0.1 of it, 10 % at most.

    Explicit leapfrog takes the damping force at the rate of half a step before: first order in the damping.
    """
    duration, dt = 0.64, 2.5e-4
    exact = whirl("runge_kutta", 2e-5, duration, damping)
    errors = [np.abs(whirl(integrator, step, duration, damping) - exact).max() for step in (2 * dt, dt)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, rel=0.1)


def test_leapfrog_and_velocity_verlet_are_one_method() -> None:
    """In exact arithmetic both give the same positions, damped or not; n steps round n^2 times."""
    for damping in (0.0, 1.0):
        two = [whirl(name, 1e-3, 0.64, damping) for name in ("symplectic_euler", "velocity_verlet")]
        np.testing.assert_allclose(two[0], two[1], rtol=0, atol=640**2 * naive.EPS)


def free_bar(length: float, area: float, modulus: float, density: float) -> tuple[Structure, np.ndarray]:
    """A free straight bar of thirds, masses m/8, 3m/8, springs 3EA/L; its structure and positions."""
    mass = density * area * length
    s = naive.make_structure(
        mass * np.array([1, 3, 3, 1]) / 8,
        bars=[[0, 1, 2, 3]],
        segment_stiffness=3 * modulus * area / length,
        segment_length=length / 3,
    )
    return s, np.linspace(0, 1, 4)[:, None] * [length, 0, 0] + [0, 0, 5.0]


@pytest.mark.parametrize(("length", "area", "modulus", "density"), [(0.58, 1.2e-5, 130e9, 1600.0), (2.0, 1e-4, 2e11, 7800.0)])
def test_critical_step_of_a_free_bar(length: float, area: float, modulus: float, density: float) -> None:
    """omega^2 = 8 k/m (1 + 1/sqrt 3), k = 3EA/L (antisymmetric mode): dt = 2/omega = 0.32506 L / sqrt(E/rho)."""
    s, x = free_bar(length, area, modulus, density)
    exact = 2 / np.sqrt(24 * (1 + 1 / np.sqrt(3))) * length / np.sqrt(modulus / density)
    assert exact == pytest.approx(0.325 * length / np.sqrt(modulus / density), rel=1e-3)
    assert critical_time_step(s, x) == pytest.approx(exact, rel=1e-5)  # twice the eigenvalue's tolerance of 1e-6, halved


@pytest.mark.parametrize("damping_ratio", [0.0, 0.05, 0.5, 2.0])
def test_critical_step_with_lagged_damping(damping_ratio: float) -> None:
    """dt = (2/omega) (sqrt(1 + zeta^2) - zeta) for one mode: two equal masses on a spring, omega^2 = 2k/m, c = 2 zeta k/omega."""
    mass, stiffness = 0.2, 5e4
    omega = np.sqrt(2 * stiffness / mass)
    s = naive.make_structure(
        [mass, mass],
        bars=[[0, 1]],
        segment_stiffness=stiffness,
        segment_length=0.3,
        segment_damping=2 * damping_ratio * stiffness / omega,
    )
    x = np.array([[0.0, 0, 5], [0.3, 0, 5]])
    exact = 2 / omega * (np.sqrt(1 + damping_ratio**2) - damping_ratio)
    assert critical_time_step(s, x) == pytest.approx(exact, rel=1e-5)
    for factor, grows in ((0.995, False), (1.005, True)):
        assert (growth(s, NOTHING, x, factor * exact, 4000) > 1e3) == grows


@pytest.mark.parametrize("damping_ratio", [0.0, 0.3, 1.0])
def test_critical_step_of_a_hinge(damping_ratio: float) -> None:
    """Three masses m, two segments l that hardly resist stretching: theta = (u1 - 2 u2 + u3)/l, so omega^2 = 6 kappa/(m l^2).

    Springs of a thousandth of kappa/l^2 along the axis leave this mode alone. Damping acts on the rate of the angle: moving in
    one plane it is linear, at angles well above the 1e-6 rad below which it fades.
    """
    mass, length, hinge = 0.2, 0.3, 9.0
    omega = np.sqrt(6 * hinge / mass) / length
    s = naive.make_structure(
        [mass] * 3,
        bars=[[0, 1, 2]],
        segment_stiffness=1e-3 * hinge / length**2,
        segment_length=length,
        hinge_stiffness=hinge,
        hinge_damping=2 * damping_ratio * hinge / omega,
    )
    x = np.arange(3)[:, None] * [length, 0, 0] + [0, 0, 5.0]
    exact = 2 / omega * (np.sqrt(1 + damping_ratio**2) - damping_ratio)
    assert critical_time_step(s, x) == pytest.approx(exact, rel=1e-5)
    in_plane = 1e-4 * np.array([[0.0, 0, 1], [0, 0, -2], [0, 0, 1]])
    for factor, grows in ((0.99, False), (1.01, True)):
        assert (growth(s, NOTHING, x, factor * exact, 120, in_plane) > 10) == grows


def growth(s: Structure, lengths: np.ndarray, at: np.ndarray, dt: float, steps: int, v: np.ndarray | None = None) -> float:
    """Largest speed after ``steps`` over that of the start ``v``, else a small random one [-]; infinite if it overflowed."""
    v = np.random.default_rng(0).normal(size=at.shape) * 1e-6 if v is None else v.copy()
    v -= (s.mass[:, None] * v).sum(axis=0) / s.mass.sum()
    x, f, start = at.copy(), np.zeros_like(at), np.abs(v).max()
    memory, losses = np.zeros(s.n_axial_members), np.zeros(3)
    kernels.advance(s, lengths, SPACE, dt, dt, steps, x, v, f, memory, losses)
    return float(np.abs(v).max() / start) if np.isfinite(v).all() else np.inf


@pytest.mark.parametrize("size", [(1, 1), (2, 1)])
@pytest.mark.parametrize("damped", [False, True])
def test_a_lattice_is_stable_below_the_critical_step_and_not_above(size: tuple[int, int], damped: bool) -> None:
    """Stepped within 2 % on either side; geometric and bending stiffness, which the estimate leaves out, are 1e-3 of axial."""
    design = Design() if damped else Design(bar_damping=0.0, cable_damping=0.0, hinge_damping=0.0)
    lattice = Lattice(*size)
    s, x = design.structure(lattice), design.unloaded_positions(lattice) + [0, 0, 5.0]
    critical = critical_time_step(s, x)
    # speeds of a stable lattice stay within the ratio of its masses and mode shapes, an unstable mode grows 1.2 to 1.5 a step
    assert growth(s, s.actuator_length, x, 0.98 * critical, 20_000) < 30
    assert growth(s, s.actuator_length, x, 1.02 * critical, 400) > 1e3


def test_the_default_step_is_the_critical_one_with_a_margin() -> None:
    design, lattice = Design(), Lattice(2, 2)
    critical = critical_time_step(design.structure(lattice), design.unloaded_positions(lattice))
    assert 0.99 * MARGIN * critical < default_time_step(design, lattice) <= MARGIN * critical * (1 + 1e-5)  # cut to three digits
    assert 0.5 < MARGIN < 1.0
    # stiffer bars and cables, smaller steps: dt ~ 1 / sqrt(E)
    soft = Design(bar_damping=0.0, cable_damping=0.0)
    stiff = replace(soft, bar_modulus=4 * soft.bar_modulus, cable_modulus=4 * soft.cable_modulus)
    steps = [critical_time_step(d.structure(lattice), d.unloaded_positions(lattice)) for d in (stiff, soft)]
    assert steps[0] == pytest.approx(0.5 * steps[1], rel=1e-5)
