"""Distances between bars: closed forms, bounded least squares, and which pairs count."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from tensegrity_gym.clearance import centreline_distance, segment_distances


@pytest.mark.parametrize(
    ("a", "b", "c", "d", "distance"),
    [
        ((-1, 0, 0), (1, 0, 0), (0, -1, 0.5), (0, 1, 0.5), 0.5),  # crossing above each other
        ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), 0.0),  # through each other
        ((0, 0, 0), (1, 0, 0), (0.5, 2, 0), (3, 2, 0), 2.0),  # parallel, side by side
        ((0, 0, 0), (1, 0, 0), (4, 4, 0), (9, 4, 0), 5.0),  # parallel, end to end: 3, 4, 5
        ((0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0), 1.0),  # in line
        ((0, 0, 0), (1, 0, 0), (0.5, 0.2, 0), (0.5, 3, 0), 0.2),  # an end above the middle
        ((0, 0, 0), (0, 0, 0), (1, -1, 0), (1, 1, 0), 1.0),  # a point
    ],
)
def test_closed_forms(a: tuple, b: tuple, c: tuple, d: tuple, distance: float) -> None:
    points = [np.array(p, dtype=float) for p in (a, b, c, d)]
    assert segment_distances(*points) == pytest.approx(distance, abs=1e-12)
    assert segment_distances(*points[2:], *points[:2]) == pytest.approx(distance, abs=1e-12)


def test_random_segments_against_bounded_least_squares() -> None:
    ends = np.random.default_rng(0).normal(size=(4, 40, 3))
    found = segment_distances(*ends)
    for k in range(40):
        a, b, c, d = ends[:, k]
        best = lsq_linear(np.stack([b - a, c - d], axis=1), c - a, bounds=(0, 1), tol=1e-14)
        assert found[k] ** 2 == pytest.approx(2 * best.cost, abs=1e-9)


def test_bars_that_share_a_node_do_not_count() -> None:
    x = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 2.0], [1, 0, 2.0], [0.5, 0, 0], [1, 0.5, 0], [0.5, 0, 2.0]]])
    meeting = np.array([[0, 5, 1], [1, 6, 2]])
    assert centreline_distance(x, meeting)[0] == np.inf
    assert centreline_distance(x, np.vstack([meeting, [3, 7, 4]]))[0] == 2.0
