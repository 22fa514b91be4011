"""The laws of one hinge and one cable, against closed forms."""

from __future__ import annotations

import kernels
import naive
import numpy as np
import pytest

EPS = naive.EPS


def hinge(s: np.ndarray) -> np.ndarray:
    """Rows theta / sin theta, theta^2, d(theta / sin theta)/ds for an array of s = sin^2(theta / 2)."""
    out = np.zeros((3, len(s)))
    kernels.hinge_functions(s, out)
    return out


def closed_form(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """theta and theta / sin theta from the very same s: phi = theta / 2 = atan(sqrt(s / (1 - s))), 1 - s exact for s >= 1/2."""
    phi = np.arctan2(np.sqrt(s), np.sqrt(1 - s))
    return 2 * phi, phi / np.sqrt(s * (1 - s))


def s_of_degrees(low: float, high: float, n: int = 4001) -> np.ndarray:
    return np.sin(np.radians(np.linspace(low, high, n)) / 2) ** 2


def test_angle_over_sine_is_theta_over_sin_theta_to_1e_12_up_to_175_degrees() -> None:
    s = s_of_degrees(0.05, 175.0)
    np.testing.assert_allclose(hinge(s)[0], closed_form(s)[1], rtol=1e-12)


def test_angle_over_sine_agrees_with_40_digits() -> None:
    mpmath = pytest.importorskip("mpmath")  # comes with torch
    degrees = [0.0, 1e-6, 0.01, 1, 30, 60, 89, 89.999999, 90.000001, 91, 120, 150, 170, 175]
    s = np.sin(np.radians(degrees) / 2) ** 2
    with mpmath.workdps(40):
        root = [mpmath.sqrt(mpmath.mpf(float(value))) for value in s]
        exact = [float(mpmath.asin(r) / (r * mpmath.sqrt(1 - r**2))) if r else 1.0 for r in root]
    np.testing.assert_allclose(hinge(s)[0], exact, rtol=1e-12)


def test_a_straight_hinge_has_the_limit_one_and_no_energy() -> None:
    ratio, square, slope = hinge(np.array([0.0]))[:, 0]
    assert abs(ratio - 1.0) < naive.POLYNOMIAL_ERROR
    assert square == 0.0
    assert abs(slope - 2.0 / 3.0) < 1e-9  # theta / sin theta = 1 + 2 s / 3 + ...


def test_no_jump_where_the_half_angle_identity_takes_over() -> None:
    """Across s = 1/2 the exact functions move by eps; what jumps is the polynomial's error, 5e-14 a side and doubled in theta^2.

    The derivative's polynomial is a derivative: worse by the square of its 17 terms on an interval of 1/2 (Markov).
    """
    below, above = 0.5, np.nextafter(0.5, 1.0)
    ratio = hinge(np.array([below, above]))
    for row, bound in ((0, 2 * 5e-14), (1, 4 * 5e-14), (2, 4 * 17**2 * 5e-14)):
        assert abs(ratio[row, 1] - ratio[row, 0]) <= bound * abs(ratio[row, 0])


def test_angle_squared_is_the_square_of_the_angle() -> None:
    s = s_of_degrees(0.01, 175.0)
    np.testing.assert_allclose(hinge(s)[1], closed_form(s)[0] ** 2, rtol=2e-12, atol=0)


def test_a_hinge_folded_flat_stays_finite() -> None:
    assert np.isfinite(hinge(np.array([1.0 - 1e-15, 1.0, 1.0 + 4 * EPS]))[:2]).all()


def test_force_and_energy_are_of_the_same_hinge() -> None:
    """d(theta^2)/ds = 2 theta dtheta/ds = 2 theta / sqrt(s (1 - s)) = 4 theta / sin theta."""
    s, h = s_of_degrees(5.0, 170.0, 200), 1e-5
    s = s[np.abs(s - 0.5) > 2 * h]
    difference = (hinge(s + h)[1] - hinge(s - h)[1]) / (2 * h)
    # error of central differences h^2/6 f''' (f''' of 4 theta/sin theta: its second derivative) plus rounding / h
    third = 4 * np.abs(closed_form(s + 1e-4)[1] - 2 * closed_form(s)[1] + closed_form(s - 1e-4)[1]) / 1e-8
    tolerance = h**2 / 6 * 2 * third + 10 * 1e-12 / h
    assert (np.abs(difference - 4 * hinge(s)[0]) <= tolerance).all()


def test_derivative_of_angle_over_sine() -> None:
    """d(theta / sin theta)/ds = (1 - (1 - 2s) theta / sin theta) / (2 s (1 - s)), from theta / sin theta = asin / sqrt."""
    s = s_of_degrees(20.0, 175.0)  # at smaller angles the closed form cancels: error eps / s
    exact = (1 - (1 - 2 * s) * closed_form(s)[1]) / (2 * s * (1 - s))
    # the derivative of a polynomial of 17 terms that is 5e-14 right is 17^2 times worse on its range (Markov), / 0.5
    np.testing.assert_allclose(hinge(s)[2], exact, rtol=4 * 17**2 * 5e-14 + 16 * EPS / s.min())


def cable(extension: float, rate: float, stiffness: float = 2e5, damping: float = 30.0) -> tuple[float, float]:
    out = np.zeros((1, 2))
    kernels.cable_law(stiffness, damping, np.array([extension]), np.array([rate]), out)
    return float(out[0, 0]), float(out[0, 1])


def test_a_slack_cable_has_no_force_however_fast_it_moves() -> None:
    for rate in (-5.0, 0.0, 5.0):
        assert cable(-1e-9, rate) == (0.0, 0.0)
        assert cable(0.0, rate) == (0.0, 0.0)


def test_a_taut_cable_is_hookes_and_newtons() -> None:
    """T = k (l - l0) + c dl/dt."""
    tension, drag = cable(1e-3, 0.5)
    assert tension == pytest.approx(2e5 * 1e-3 + 30.0 * 0.5, rel=2 * EPS)
    assert drag == pytest.approx(30.0 * 0.5, rel=200.0 / 15.0 * 2 * EPS)  # difference of total and elastic


def test_a_cable_never_pushes() -> None:
    """Shortening fast enough, Kelvin-Voigt would push; the cable then has no force, and damping takes off all elastic force."""
    tension, drag = cable(1e-3, -100.0)
    assert tension == 0.0
    assert drag == -2e5 * 1e-3
    rng = np.random.default_rng(0)
    for extension, rate in zip(rng.normal(size=200) * 1e-3, rng.normal(size=200) * 20, strict=True):
        tension, drag = cable(extension, rate)
        assert tension >= 0.0
        assert tension == 0.0 or extension > 0.0
        assert drag * rate >= 0.0  # damping never feeds energy in


def test_bending_damping_is_a_moment_against_the_angles_rate() -> None:
    """closing = sin(theta) dtheta/dt; factor sin(theta) = c dtheta/dt and power = c (dtheta/dt)^2."""
    theta, rate, c = np.radians([1.0, 30.0, 90.0, 150.0]), 3.0, 0.02
    out = np.zeros((4, 2))
    kernels.hinge_damping(c, np.sin(theta / 2) ** 2, np.sin(theta) * rate, out)
    fade = naive.STRAIGHT / np.sin(theta) ** 2  # what the guard against 0/0 takes away
    np.testing.assert_allclose(out[:, 0] * np.sin(theta), c * rate, rtol=fade.max() + 16 * EPS)
    np.testing.assert_allclose(out[:, 1], c * rate**2, rtol=fade.max() + 16 * EPS)


def test_bending_damping_of_a_straight_hinge_is_finite_and_none() -> None:
    out = np.ones((1, 2))
    kernels.hinge_damping(0.02, np.zeros(1), np.zeros(1), out)
    assert (out == 0.0).all()
