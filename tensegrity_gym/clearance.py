"""How near bars come to each other: the model's bars are lines that pass through one another, real ones are not."""

from __future__ import annotations

import numpy as np

from tensegrity_gym.types import Floats, Ints


def segment_distances(a: Floats, b: Floats, c: Floats, d: Floats) -> Floats:
    """Distances between the segments from a to b and from c to d, shape (..., 3) each -> (...) [their unit].

    The distance of two points on the lines is a convex quadratic of the two parameters: where its minimum lies outside the unit
    square, the least distance is that of one of the four ends to the other segment (Ericson 2005, section 5.1.9).
    """
    u, v, w = b - a, d - c, a - c
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    uw, vw = _dot(u, w), _dot(v, w)
    determinant = uu * vv - uv * uv
    crossing = determinant > 1e-14 * uu * vv
    safe = np.where(crossing, determinant, 1.0)
    s, t = (uv * vw - vv * uw) / safe, (uu * vw - uv * uw) / safe
    inside = crossing & (s > 0) & (s < 1) & (t > 0) & (t < 1)
    between = np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
    ends = [_point_distances(a, c, d), _point_distances(b, c, d), _point_distances(c, a, b), _point_distances(d, a, b)]
    return np.where(inside, between, np.min(ends, axis=0))


def _point_distances(p: Floats, a: Floats, b: Floats) -> Floats:
    """Distances of points p from the segments from a to b."""
    along = b - a
    share = np.clip(_dot(p - a, along) / np.maximum(_dot(along, along), 1e-300), 0.0, 1.0)
    return np.linalg.norm(p - a - share[..., None] * along, axis=-1)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.einsum("...c,...c->...", a, b)


def centreline_distance(positions: Floats, bars: Ints) -> Floats:
    """Least distance [m] between the centrelines of two bars that share no node, of each lattice of (n, n_masses, 3); shape (n,).

    inf where every two bars meet at a node.
    """
    segments = bars.shape[1] - 1
    first, second = np.triu_indices(len(bars), 1)
    ends = bars[:, [0, -1]]
    apart = (ends[first][:, :, None] != ends[second][:, None, :]).all(axis=(1, 2))
    first, second = first[apart], second[apart]
    near, far = bars[:, :-1], bars[:, 1:]
    pairs = [(near[first, j], far[first, j], near[second, k], far[second, k]) for j in range(segments) for k in range(segments)]
    least = np.full(len(positions), np.inf)
    for row, x in enumerate(positions):
        for a, b, c, d in pairs:
            least[row] = min(least[row], segment_distances(x[a], x[b], x[c], x[d]).min(initial=np.inf))
    return least
