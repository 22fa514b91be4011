"""Ground contact of single masses, stepped by the integrator, against closed forms.

Mechanics of a point on a plane with Coulomb friction mu and Newton restitution e.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import kernels
import naive
import numpy as np
import pytest

from tensegrity_gym.types import Ground

EPS = naive.EPS
G = 9.80665
FLAT = np.array([0.0, 0.0, -G])


def incline(angle: float, azimuth: float = 0.0) -> np.ndarray:
    """Gravity in the frame of a ground inclined by ``angle`` whose downhill direction is ``azimuth`` [rad]."""
    return G * np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), -np.cos(angle)])


@dataclass
class Point:
    """One mass and its history-free state; velocities are half a step behind after the first step."""

    ground: Ground
    dt: float
    x: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))
    v: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))
    mass: float = 0.3
    integrator: str = "symplectic_euler"
    started: bool = False
    losses: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def run(self, steps: int) -> None:
        structure = naive.make_structure([self.mass])
        first = self.dt if self.started else 0.5 * self.dt
        nothing = np.zeros(0)
        force = self.mass * self.ground.gravity[None]
        state = (self.x, self.v, force.copy(), nothing, self.losses)
        kernels.advance(structure, nothing, self.ground, self.dt, first, steps, *state, self.integrator)
        self.started = True


integrators = pytest.mark.parametrize("integrator", list(kernels.INTEGRATORS))


def collide(velocity: np.ndarray, friction: float, restitution: float) -> Point:
    """A mass on the ground with ``velocity``, one step later, without gravity."""
    point = Point(Ground(np.zeros(3), friction, restitution), 1e-3, v=velocity[None].copy())
    point.run(1)
    return point


def test_impulses_match_the_twin() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        velocity = rng.normal(size=3) * rng.choice([0.0, 1e-3, 1.0], size=3)
        friction, restitution = rng.choice([0.0, 0.3, 1.5]), rng.choice([0.0, 0.5, 1.0])
        after = collide(velocity, friction, restitution).v[0]
        np.testing.assert_allclose(after, naive.contact_impulse(velocity, friction, restitution), rtol=8 * EPS, atol=8 * EPS)


@pytest.mark.parametrize("restitution", [0.0, 0.6, 1.0])
def test_an_impact_sticks_if_and_only_if_the_speed_is_within_the_cone(restitution: float) -> None:
    """Sticks iff |v_t| <= mu (1 + e) |v_n|; else slips on with |v_t| - mu (1 + e) |v_n| in the same direction."""
    friction, normal, direction = 0.4, 2.0, np.array([0.6, -0.8])
    edge = friction * (1 + restitution) * normal
    for factor in (0.0, 0.5, 1 - 1e-9):
        after = collide(np.append(factor * edge * direction, -normal), friction, restitution).v[0]
        assert after[:2].tolist() == [0.0, 0.0]
        assert after[2] == pytest.approx(restitution * normal, abs=4 * EPS * normal)
    for factor in (1 + 1e-9, 1.5, 10.0):
        after = collide(np.append(factor * edge * direction, -normal), friction, restitution).v[0]
        np.testing.assert_allclose(after[:2], (factor - 1) * edge * direction, rtol=0, atol=8 * EPS * factor * edge)


def test_the_ground_only_takes_the_energy_that_the_mass_loses() -> None:
    """Without gravity dissipation is the loss of kinetic energy, and an impulse never adds any."""
    rng = np.random.default_rng(1)
    for _ in range(100):
        velocity = rng.normal(size=3)
        point = collide(velocity, rng.uniform(0, 1), rng.uniform(0, 1))
        lost = 0.5 * point.mass * (velocity @ velocity - point.v[0] @ point.v[0])
        assert lost >= -8 * EPS
        assert point.losses[1] == pytest.approx(lost, abs=8 * EPS * (velocity @ velocity))


@pytest.mark.parametrize(("height", "vertical"), [(1e-12, -1.0), (0.0, 0.0), (0.0, 1.0), (-1e-4, 0.5)])
def test_the_ground_leaves_alone_what_does_not_touch_or_moves_away(height: float, vertical: float) -> None:
    velocity = np.array([[0.3, -0.2, vertical]])
    point = Point(Ground(np.zeros(3), 10.0, 0.5), 1e-3, x=np.array([[0.0, 0.0, height]]), v=velocity.copy())
    point.run(1)
    np.testing.assert_array_equal(point.v, velocity)
    assert point.losses[1] == 0.0


@pytest.mark.parametrize("friction", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("restitution", [0.0, 1.0])
@integrators
def test_a_block_sticks_on_an_incline_up_to_the_angle_of_friction(friction: float, restitution: float, integrator: str) -> None:
    """Sticks iff tan(theta) <= mu: for 10 s not one bit of creep, at either restitution."""
    for angle, azimuth in ((0.0, 0.0), (0.5 * np.arctan(friction), 2.0), (np.arctan(friction * (1 - 1e-9)), 2.0)):
        point = Point(Ground(incline(angle, azimuth), friction, restitution), 1e-3, integrator=integrator)
        point.run(10_000)
        assert point.x.tolist() == [[0.0, 0.0, 0.0]]
        assert point.losses[1] == 0.0


@pytest.mark.parametrize("factor", [1 + 1e-6, 1.2, 3.0])
@pytest.mark.parametrize("restitution", [0.0, 1.0])
@integrators
def test_a_block_slides_down_a_steeper_incline_with_g_sin_minus_mu_cos(
    factor: float, restitution: float, integrator: str
) -> None:
    """x = a t^2/2 with a = g (sin(theta) - mu cos(theta)); leapfrog is exact for a constant acceleration.

    Runge-Kutta moves a mass in contact with its speed at the end of the step: ahead by a t dt/2.
    """
    friction, steps, dt, azimuth = 0.5, 2000, 1e-3, 0.7
    angle = np.arctan(friction * factor)
    point = Point(Ground(incline(angle, azimuth), friction, restitution), dt, integrator=integrator)
    point.run(steps)
    acceleration = G * (np.sin(angle) - friction * np.cos(angle))
    distance = 0.5 * acceleration * (steps * dt) ** 2
    distance *= 1 + 1 / steps if integrator == "runge_kutta" else 1
    along = point.x[0, 0] * np.cos(azimuth) + point.x[0, 1] * np.sin(azimuth)
    # each step rounds g dt and the speed once, and sums
    tolerance = 4 * EPS * (steps * dt) ** 2 * G * steps
    assert tolerance < 1e-4 * distance
    assert abs(along - distance) < tolerance
    assert abs(point.x[0, 0] * np.sin(azimuth) - point.x[0, 1] * np.cos(azimuth)) < tolerance
    assert point.x[0, 2] == 0.0


@pytest.mark.parametrize("friction", [0.3, 0.8])
@pytest.mark.parametrize("dt", [1e-3, 1e-4])
@integrators
def test_a_block_on_the_flat_stops_after_v_squared_over_2_mu_g(friction: float, dt: float, integrator: str) -> None:
    """Work of friction mu m g d = m v^2/2. Only the last, cut step is inexact: it is shorter than mu g dt^2.

    Runge-Kutta moves a mass in contact with its speed at the end of the step: behind by v dt/2.
    """
    speed, direction = 2.0, np.array([0.6, 0.8])
    point = Point(Ground(FLAT, friction, 0.0), dt, v=np.array([[*(speed * direction), 0.0]]), integrator=integrator)
    point.run(int(2 * speed / (friction * G) / dt))
    assert point.v.tolist() == [[0.0, 0.0, 0.0]]
    distance = speed**2 / (2 * friction * G) - (0.5 * speed * dt if integrator == "runge_kutta" else 0.0)
    tolerance = friction * G * dt**2 + 1e5 * EPS
    np.testing.assert_allclose(point.x[0], [*(distance * direction), 0.0], rtol=0, atol=tolerance)
    # all of its energy went into the ground; the first half kick's share included
    assert point.losses[1] == pytest.approx(0.5 * point.mass * speed**2, abs=2 * point.mass * friction * G * dt * speed)


def bounces(restitution: float, dt: float, count: int, integrator: str) -> tuple[list[float], Point]:
    """Heights of the first ``count`` bounces of a ball let fall from 1 m, and the ball [m]."""
    ball = Point(Ground(FLAT, 0.5, restitution), dt, x=np.array([[0.0, 0.0, 1.0]]), integrator=integrator)
    heights: list[float] = []
    highest, rising = 0.0, False
    for _ in range(int(np.sqrt(2 / G) * (1 + 2 * count) / dt)):  # as long as perfect bounces would take
        ball.run(1)
        up = ball.v[0, 2] > 0
        highest = max(highest, ball.x[0, 2]) if up else highest
        if rising and not up:
            heights.append(highest)
            if len(heights) == count:
                break
            highest = 0.0
        rising = up
    return heights, ball


@pytest.mark.parametrize("restitution", [0.5, 0.8])
@integrators
def test_a_ball_bounces_to_e_to_the_2n_of_its_height(restitution: float, integrator: str) -> None:
    """h_n = e^(2n) h_0. An impact is seen up to dt late: its speed is off by g dt, so its height by v dt at most, twice."""
    dt = 2e-4
    tolerance = 0.0
    heights = bounces(restitution, dt, 4, integrator)[0]
    assert len(heights) == 4
    for n, height in enumerate(heights, start=1):
        impact = restitution ** (n - 1) * np.sqrt(2 * G)
        tolerance = restitution**2 * tolerance + 2 * impact * dt
        exact = restitution ** (2 * n)
        assert tolerance < 0.2 * exact
        assert abs(height - exact) < tolerance


def test_a_ball_comes_to_rest_after_the_sum_of_its_bounces() -> None:
    """T = sqrt(2 h_0/g) (1 + e)/(1 - e). Each of N bounces is dt late and starts with e/(1 - e) g dt too little or too much."""
    restitution, dt = 0.8, 1e-5
    ball = Point(Ground(FLAT, 0.5, restitution), dt, x=np.array([[0.0, 0.0, 1.0]]))
    exact = np.sqrt(2 / G) * (1 + restitution) / (1 - restitution)
    n = np.log(np.sqrt(2 * G) / (G * dt)) / np.log(1 / restitution)  # until a bounce lasts a step
    tolerance = n * dt * (1 + 2 * restitution / (1 - restitution)) + 2 * dt / (1 - restitution) ** 2
    assert tolerance < 2e-3 * exact
    ball.run(int((exact - tolerance) / dt))
    assert ball.v[0, 2] != 0.0
    ball.run(int(2 * tolerance / dt))
    assert ball.v[0, 2] == 0.0
    at_rest = ball.x.copy()
    ball.run(100_000)
    np.testing.assert_array_equal(ball.x, at_rest)
    # it has lost m g (h_0 - h): the first step's half kick is the only work not in the book
    assert ball.losses[1] == pytest.approx(ball.mass * G * (1.0 - at_rest[0, 2]), rel=1e-9)


def test_a_superball_keeps_its_height_and_the_audit_books_what_the_step_takes() -> None:
    """e = 1: h_n = h_0. The step takes at most g dt |v| m a bounce (v dt of height), first order; it is in the audit."""
    dt, count = 2e-4, 6
    heights, ball = bounces(1.0, dt, count, "symplectic_euler")
    assert len(heights) == count
    for n, height in enumerate(heights, start=1):
        assert abs(height - 1.0) < 2 * n * np.sqrt(2 * G) * dt
    energy = ball.mass * (0.5 * ball.v[0, 2] ** 2 + G * (ball.x[0, 2] - 0.5 * dt * ball.v[0, 2]))
    assert energy + ball.losses[1] == pytest.approx(ball.mass * G, abs=ball.mass * G * dt**2 * G + 1e5 * EPS)


def test_without_friction_a_block_slides_freely() -> None:
    point = Point(Ground(FLAT, 0.0, 0.0), 1e-3, v=np.array([[1.5, -0.5, 0.0]]))
    point.run(1000)
    np.testing.assert_array_equal(point.v, [[1.5, -0.5, 0.0]])
    np.testing.assert_allclose(point.x, [[1.5, -0.5, 0.0]], rtol=2000 * EPS)
