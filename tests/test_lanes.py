"""SIMD lanes against scalars and NumPy: IEEE operations, so every lane must have the scalar's bits."""

from __future__ import annotations

from fractions import Fraction

import kernels
import numpy as np
import pytest

DTYPES = [np.float64, np.float32]
SPECIAL = [0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, 1e-310, 1e300, 0.1, -3.7, 1e-8]


def triples(dtype: type) -> list[np.ndarray]:
    """Ordinary and extreme (a, b, c), each of shape (1, 3)."""
    rng = np.random.default_rng(1)
    ordinary = rng.normal(size=(40, 3)) * 10.0 ** rng.integers(-6, 6, size=(40, 3))
    extreme = rng.choice(SPECIAL, size=(88, 3))
    with np.errstate(over="ignore"):  # float32 has no 1e300
        return [t.reshape(1, 3).astype(dtype) for t in np.concatenate([ordinary, extreme])]


def scalar_results(values: np.ndarray) -> np.ndarray:
    out = np.zeros(len(kernels.OPERATIONS), values.dtype)
    kernels.lane_operations(values, out)
    return out


def same_bits(a: np.ndarray, b: np.ndarray) -> None:
    """Equal including signs of zero; a NaN equals any NaN, whose payload IEEE leaves open."""
    np.testing.assert_array_equal(a, b)
    finite = ~np.isnan(a)
    np.testing.assert_array_equal(np.signbit(a[finite]), np.signbit(b[finite]))


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_lane_has_the_bits_of_the_scalar(dtype: type) -> None:
    cases, count = triples(dtype), kernels.lane_numbers(dtype)
    for first in range(0, len(cases), count):
        group = [cases[k % len(cases)] for k in range(first, first + count)]
        out = kernels.stack([np.zeros(len(kernels.OPERATIONS), dtype)])
        kernels.lane_operations(kernels.stack(group), out)
        expected = np.stack([scalar_results(case) for case in group], axis=-1)
        expected[-1] = any(case[0, 0] < case[0, 1] for case in group)  # any_lane looks across lanes, and alone does
        same_bits(out, expected)


@pytest.mark.parametrize("dtype", DTYPES)
def test_scalars_have_the_bits_of_numpy(dtype: type) -> None:
    for values in triples(dtype):
        a, b, c = values[0]
        with np.errstate(all="ignore"):
            expected = [a + b, a - b, a * b, a / b, -a, np.sqrt(a), None]
            expected += [a < b, a <= b, a > b, a >= b, (a < b) and (b < c), (a < b) or (b < c)]
            expected += [dtype(0.1), dtype(0.5) * a, a - dtype(2), a + b, a < b]
        found = scalar_results(values)
        keep = [k for k, e in enumerate(expected) if e is not None]
        same_bits(found[keep], np.array([expected[k] for k in keep], dtype))


def test_fma_is_rounded_once() -> None:
    """fma(a, b, c) = round(a b + c); multiplying first would lose all of this result."""
    for values in triples(np.float64)[:40]:
        a, b, c = (float(number) for number in values[0])
        exact = Fraction(a) * Fraction(b) + Fraction(c)
        assert scalar_results(values)[6] == float(exact)
    small = 2.0**-30
    cancelling = np.array([[1 + small, 1 - small, -1.0]])
    assert scalar_results(cancelling)[6] == -(small**2) != (1 + small) * (1 - small) - 1.0


@pytest.mark.parametrize("operation", ["less", "less_equal", "greater", "greater_equal", "and", "any_less"])
@pytest.mark.parametrize("where", [0, 1])
def test_no_comparison_with_nan_holds(operation: str, where: int) -> None:
    values = np.array([[1.0, 1.0, 1.0]])
    values[0, where] = np.nan
    out = kernels.stack([np.ones(len(kernels.OPERATIONS))])
    kernels.lane_operations(kernels.stack([values]), out)
    assert (out[kernels.OPERATIONS.index(operation)] == 0.0).all()


@pytest.mark.parametrize("lane", range(8))
def test_any_lane_sees_a_single_lane(lane: int) -> None:
    values = kernels.stack([np.array([[2.0, 1.0, 0.0]])])
    out = kernels.stack([np.zeros(len(kernels.OPERATIONS))])
    kernels.lane_operations(values, out)
    assert (out[-1] == 0.0).all()
    values[0, 0, lane] = 0.0
    kernels.lane_operations(values, out)
    assert (out[-1] == 1.0).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("lanes", [False, True])
def test_load_and_store_reach_the_element_they_name(dtype: type, lanes: bool) -> None:
    shape = (5, 3, kernels.lane_numbers(dtype)) if lanes else (5, 3)
    source = np.arange(np.prod(shape), dtype=dtype).reshape(shape)
    target = np.full_like(source, -1)
    kernels.copy_shifted(source, target)
    np.testing.assert_array_equal(target, np.roll(source, (1, 1), axis=(0, 1)))


def test_lane_arrays_start_on_a_cache_line_and_count_the_lanes_of_512_bits() -> None:
    for dtype, count in ((np.float64, 8), (np.float32, 16)):
        array = kernels.stack([np.zeros((3, 2), dtype)])
        assert array.shape == (3, 2, count)
        assert array.ctypes.data % 64 == 0
        assert array.flags.c_contiguous
