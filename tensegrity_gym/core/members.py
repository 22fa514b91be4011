"""One cable, one hinge: the elastic and damping laws that forces, energies and tangents share.

All functions take and return scalars or lanes (see ``lanes.py``). Equations: docs/physics.md.
"""

from __future__ import annotations

from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import any_lane, fma, select, splat, sqrt

# theta / sin(theta) = asin(sqrt s) / sqrt(s (1 - s)) as a polynomial in s = (1 - cos theta) / 2, Chebyshev-interpolated on
# [0, 1/2] (angles to 90 degrees) in 60 digits; relative error below 5e-14 there. Regenerate: benchmarks/hinge_polynomial.py.
HINGE_COEFFICIENTS = (
    1.0000000000000346,
    0.66666666662661,
    0.5333333409914811,
    0.4571422796447217,
    0.406372040556651,
    0.36886290200550215,
    0.3495433293743911,
    0.2255997681082823,
    1.0170549171520857,
    -3.767948450681974,
    17.121271818863818,
    -51.37265857048379,
    115.57338742119396,
    -182.86613846168385,
    196.8449019047799,
    -128.72560985611793,
    39.88271696278116,
)
_C = HINGE_COEFFICIENTS
#: Beyond this s (a hinge folded past 90 degrees) the half-angle identity takes over.
HALF_ANGLE_ABOVE = 0.5
#: Keeps the force of a hinge folded flat (180 degrees) finite: cos^2(theta/2) is taken as at least this.
FLAT_FOLD = 1e-12
#: sin^2(theta) below which bending damping fades, so that a straight hinge has no 0/0: angles of about 1e-6 rad.
STRAIGHT = 1e-12


@jit
def _hinge_polynomial(s):
    """theta / sin(theta) for s in [0, 1/2], by Estrin's scheme: short dependency chains."""
    s2 = s * s
    s4 = s2 * s2
    s8 = s4 * s4
    p0 = fma(fma(_C[3], s, _C[2]), s2, fma(_C[1], s, _C[0]))
    p1 = fma(fma(_C[7], s, _C[6]), s2, fma(_C[5], s, _C[4]))
    p2 = fma(fma(_C[11], s, _C[10]), s2, fma(_C[9], s, _C[8]))
    p3 = fma(fma(_C[15], s, _C[14]), s2, fma(_C[13], s, _C[12]))
    high = fma(fma(_C[16], s4, p3), s4, p2)
    return fma(high, s8, fma(p1, s4, p0))


@jit
def angle_over_sine(s):
    """theta / sin(theta) [-] of a hinge from s = |u - v|^2 / 4 = sin^2(theta / 2), s in [0, 1]."""
    value = _hinge_polynomial(s)
    folded = s > HALF_ANGLE_ABOVE
    if any_lane(folded):
        # with phi = theta / 2: theta / sin theta = (phi / sin phi) / cos phi, and phi <= 90 degrees
        cos2 = 1.0 - s
        cosine = sqrt(select(cos2 > FLAT_FOLD, cos2, splat(FLAT_FOLD, s)))
        value = select(folded, _hinge_polynomial(s / (2.0 * (1.0 + cosine))) / cosine, value)
    return value


@jit
def angle_squared(s):
    """theta^2 [rad^2] of a hinge from s = sin^2(theta / 2)."""
    ratio = angle_over_sine(s)
    cos2 = 1.0 - s
    return 4.0 * s * select(cos2 > FLAT_FOLD, cos2, splat(FLAT_FOLD, s)) * ratio * ratio


@jit
def hinge_factor(stiffness, s):
    """g = kappa theta / sin(theta) [N m]: the hinge's generalised force is +g d(u . v), from U = kappa theta^2 / 2."""
    return stiffness * angle_over_sine(s)


@jit
def hinge_damping_factor(damping, s, closing):
    """The factor that damping adds to g [N m] and the power it dissipates [W].

    ``closing`` = -d(u . v)/dt = sin(theta) dtheta/dt. The damping moment is c dtheta/dt: objective (a rigid rotation has
    none), unlike damping of d(u - v)/dt, which would brake a tumbling bent bar and lose angular momentum.
    """
    sine2 = 4.0 * s * (1.0 - s) + STRAIGHT
    factor = damping * closing / sine2
    return factor, factor * closing


@jit
def cable_tension(stiffness, damping, extension, rate):
    """Tension [N] of a tension-only Kelvin-Voigt cable, never negative, and the part of it that is damping."""
    elastic = stiffness * extension
    total = fma(damping, rate, elastic)
    zero = splat(0.0, extension)
    total = select(total > 0.0, total, zero)
    taut = extension > 0.0
    return select(taut, total, zero), select(taut, total - elastic, zero)
