"""Images of simulated hops under the symmetries of lattice and scene: data for nothing, and marked as such."""

from __future__ import annotations

import numpy as np

from surrogate.hops import Configuration, HopData
from tensegrity_gym.types import Floats, Ints

#: Columns whose last axis starts with a horizontal vector.
HORIZONTAL = (
    *("landing", "rest", "touchdown", "rest_nodes", "touchdown_nodes", "takeoff_velocity"),
    *("node_positions", "trajectory"),
)


def with_images(data: HopData, configuration: Configuration) -> HopData:
    """Each hop followed by its images; a file of n hops then has n times ``configuration.rows_per_hop`` rows."""
    permutations, signs = configuration.symmetries
    parts = [_image(data, configuration, k, permutations[k], signs[k]) for k in range(len(signs))]
    order = np.arange(len(data) * len(parts)).reshape(len(parts), len(data)).T.ravel()
    columns = {name: np.concatenate([p[name] for p in parts])[order] for name in data.columns}
    return HopData(columns, data.configuration, data.seconds)


def _image(data: HopData, configuration: Configuration, number: int, permutation: Ints, signs: Ints) -> HopData:
    if number == 0:
        return data
    columns = dict(data.columns)
    columns["stretches"] = np.ascontiguousarray(data["stretches"][:, permutation])
    columns["image"] = np.full(len(data), number, dtype=data["image"].dtype)
    columns["cpu_seconds"] = np.zeros(len(data))
    for name in HORIZONTAL:
        if name in columns:
            values = columns[name].copy()
            values[..., :2] *= signs.astype(values.dtype)
            columns[name] = values
    if "node_positions" in columns:
        where = mass_permutation(configuration, signs)[: configuration.lattice.n_nodes]
        columns["node_positions"] = columns["node_positions"][:, where]
    if configuration.trajectory == "full" and "trajectory" in columns:
        columns["trajectory"] = columns["trajectory"][:, :, mass_permutation(configuration, signs)]
    return HopData(columns, data.configuration)


def mass_permutation(configuration: Configuration, signs: Ints) -> Ints:
    """For each mass, the one that lies at its mirror image in the unloaded lattice, shape (n_masses,)."""
    x: Floats = configuration.modelled.unloaded_positions(configuration.lattice)
    mirrored = x * np.array((*signs, 1.0))
    distance = np.linalg.norm(x[:, None] - mirrored[None], axis=2)
    nearest = distance.argmin(axis=1)
    assert distance.min(axis=1).max() < 1e-9 * configuration.design.cell_height, "the lattice has no such symmetry"
    return nearest
