"""A hop that fails says so and leaves its neighbours alone, bit for bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tensegrity_gym import HopStatus, InvalidParameterError, Scene, form_find, simulate

STRETCHES = np.random.default_rng(5).uniform(0.2, 0.8, (9, 4))
SCENE = Scene(duration=0.12)  # release, take-off and some flight
FIELDS = ("rest", "touchdown", "apex", "takeoff_velocity", "energies", "status", "steps")


@pytest.fixture(scope="module")
def sane():
    equilibria = form_find(STRETCHES)
    return equilibria, simulate(STRETCHES, equilibria=equilibria, scene=SCENE)


@pytest.mark.parametrize(
    ("poison", "status"),
    [(np.nan, HopStatus.NOT_CONVERGED), (np.inf, HopStatus.NOT_CONVERGED), (1e6, HopStatus.UNSTABLE), (30.0, HopStatus.UNSTABLE)],
)
def test_blow_up_in_one_lane_leaves_the_others_bits(sane, poison, status):
    equilibria, expected = sane
    positions = equilibria.positions.copy()
    positions[3, 100, 0] += poison  # one mass of one hop thrown far away
    hops = simulate(STRETCHES, equilibria=replace(equilibria, positions=positions), scene=SCENE)
    assert hops.status[3] == status
    assert np.isfinite(hops.landing).all()
    assert hops.failed.tolist() == [hop == 3 for hop in range(9)]
    others = np.arange(9) != 3
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(hops, field)[others], getattr(expected, field)[others], err_msg=field)


def test_a_failed_hop_tells_when_where_and_why(sane):
    equilibria, _ = sane
    positions = equilibria.positions.copy()
    positions[3, 100] += 1e6
    hops = simulate(STRETCHES, equilibria=replace(equilibria, positions=positions), scene=SCENE)
    (line,) = hops.describe_failures()
    assert "hop 3" in line
    assert "blew up by t = " in line
    assert f"mass {hops.failed_mass[3]}" in line
    assert hops.structure.member_name(int(hops.failed_member[3])) in line
    assert "smaller dt" in line
    assert np.isfinite(hops.landing).all()
    assert (hops.landing[3] == 0).all()
    # found within one look (32 steps) of the first step
    assert hops.end_time[3] <= 32 * hops.dt * (1 + 1e-12)


def test_blow_up_from_the_step_is_found_within_bounded_time(sane):
    equilibria, expected = sane
    hops = simulate(STRETCHES, equilibria=equilibria, scene=SCENE, dt=1.5 * expected.dt, allow_unstable=True)
    assert (hops.status == HopStatus.UNSTABLE).all()
    # 1.5 * 0.8 = 1.2 dt_crit: the stiffest mode grows by exp(2 arccosh(1.2)) = 3.5 a step; from rounding, 1e-16, to 1e3 times the
    # stored energy takes about 20 decades of energy, 20 / log10(3.5^2) = 18 steps, plus at most 64 steps to the look after
    assert (hops.end_time <= 128 * hops.dt).all()


def test_a_step_above_the_critical_one_is_refused_with_the_number_that_would_do(sane):
    equilibria, expected = sane
    with pytest.raises(
        InvalidParameterError, match=r"critical step of symplectic_euler, 2\.3.*use dt <= 1\.9.*allow_unstable=True"
    ):
        simulate(STRETCHES, equilibria=equilibria, dt=1.5 * expected.dt)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dt": -1e-5}, "dt to be a finite number > 0, got -1e-05"),
        ({"dt": np.nan}, "dt to be a finite number > 0, got nan"),
        ({"integrator": "euler"}, "integrator: expected one of"),
        ({"precision": "float16"}, "precision: expected one of"),
        ({"trajectory_rate": 0}, "trajectory_rate to be a finite number > 0"),
    ],
)
def test_bad_options_are_named(sane, change, message):
    equilibria, _ = sane
    with pytest.raises(InvalidParameterError, match=message):
        simulate(STRETCHES, equilibria=equilibria, scene=SCENE, **change)


def test_equilibria_of_other_stretches_are_refused(sane):
    equilibria, _ = sane
    with pytest.raises(InvalidParameterError, match="expected the stretches that the equilibria were found for"):
        simulate(STRETCHES[::-1], equilibria=equilibria, scene=SCENE)


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet", "runge_kutta"])
def test_integrators_agree_on_take_off(sane, integrator):
    # three methods of second order or better at omega dt <= 1.6 of the stiffest mode, which carries next to no energy:
    # take-off speeds (5 m/s) agree to a share of the floor, 2e-3 m/s
    _, expected = sane
    hops = simulate(STRETCHES[:2], equilibria=form_find(STRETCHES[:2]), scene=SCENE, integrator=integrator)
    np.testing.assert_allclose(hops.takeoff_velocity, expected.takeoff_velocity[:2], rtol=0, atol=2e-2)


def test_float32_lanes_agree_with_float64(sane):
    # rounding of positions to 1e-7 m through 3 000 steps: 0.01 to 0.4 mm at touchdown (docs/speed.md), less at take-off
    equilibria, expected = sane
    hops = simulate(STRETCHES, equilibria=equilibria, scene=SCENE, precision="float32")
    assert not np.array_equal(hops.apex, expected.apex)
    np.testing.assert_allclose(hops.apex, expected.apex, rtol=0, atol=2e-3)
    np.testing.assert_array_equal(hops.status, expected.status)
