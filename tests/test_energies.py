"""Energies and member forces that results report, against the one-member-at-a-time twin."""

from __future__ import annotations

import naive
import numpy as np
import pytest

from tensegrity_gym import Design, Lattice
from tensegrity_gym.energies import (
    centre_of_mass,
    elastic_energies,
    gravitational_energy,
    hinge_angles,
    kinetic_energy,
    member_forces,
)
from tensegrity_gym.types import Structure

EPS = naive.EPS
GRAVITY = np.array([1.0, -2.0, -9.0])


def batch(segments: int) -> tuple[Structure, np.ndarray, np.ndarray, np.ndarray]:
    """(structure, positions (5, n, 3), velocities, actuator lengths (5, 2)) around the unloaded 2x1 lattice."""
    design, lattice, rng = Design(bar_segments=segments), Lattice(2, 1), np.random.default_rng(segments)
    structure = design.structure(lattice)
    noise = np.array([1e-6, 1e-4, 3e-3, 0.02, 0.06])[:, None, None]
    x = design.unloaded_positions(lattice) + noise * rng.normal(size=(5, len(structure.mass), 3))
    lengths = structure.actuator_length * rng.uniform(0.3, 1.1, size=(5, 2))
    return structure, x, rng.normal(size=x.shape), lengths


@pytest.mark.parametrize("segments", [1, 2, 3, 5])
def test_energies_and_member_forces_are_the_twins(segments: int) -> None:
    s, x, v, lengths = batch(segments)
    elastic, forces = elastic_energies(s, x, lengths), member_forces(s, x, lengths)
    kinetic, gravitational = kinetic_energy(s, v), gravitational_energy(s, GRAVITY, x)
    n_segments, n_cables = s.bars.shape[0] * segments, len(s.cables)
    for k in range(5):
        twin = naive.energies(s, lengths[k], GRAVITY, x[k], v[k])
        pulls = np.array(
            [naive.tension(m, float(np.linalg.norm(x[k, m.j] - x[k, m.i])), 0.0)[0] for m in naive.axial_members(s, lengths[k])]
        )
        # lengths are known to eps |x|: tensions to eps k |x|, energies to that times the stretch
        reach = np.abs(x[k]).max()
        blur = 4 * EPS * s.segment_stiffness.max() * reach
        work = blur * np.abs(pulls / s.segment_stiffness.max()).sum() + 1e3 * EPS * np.abs(twin[:3]).max()
        found = [elastic[name][k] for name in ("bars", "cables", "actuators")]
        np.testing.assert_allclose(found, twin[:3], rtol=0, atol=work + blur * EPS * reach * len(pulls))
        assert kinetic[k] == pytest.approx(twin[3], rel=100 * EPS)
        assert gravitational[k] == pytest.approx(twin[4], abs=100 * EPS * s.mass.sum() * 10 * reach)
        bars = -pulls[:n_segments].reshape(len(s.bars), segments).mean(axis=1)
        np.testing.assert_allclose(forces.bars[k], bars, rtol=0, atol=blur)
        np.testing.assert_allclose(forces.cables[k], pulls[n_segments : n_segments + n_cables], rtol=0, atol=blur)
        np.testing.assert_allclose(forces.actuators[k], pulls[n_segments + n_cables :], rtol=0, atol=blur)
        assert (forces.cables[k] >= 0).all()


def test_hinge_angles_are_the_angles_between_segments() -> None:
    for degrees in (0.0, 1e-4, 1.0, 45.0, 90.0, 135.0, 170.0, 180.0):
        theta = np.radians(degrees)
        x = np.array([[[0.0, 0, 0], [1, 0, 0], [1 + np.cos(theta), np.sin(theta), 0]]])
        # asin of a half chord: near 180 degrees its error is sqrt(eps)
        tolerance = 8 * EPS if degrees < 150 else 4 * np.sqrt(EPS)
        assert hinge_angles(x, np.array([[0, 1, 2]]))[0, 0, 0] == pytest.approx(theta, abs=tolerance)


def test_a_bar_of_one_segment_has_no_hinges() -> None:
    s, x, _, _ = batch(1)
    assert hinge_angles(x, s.bars).shape == (5, 24, 0)


@pytest.mark.filterwarnings("error")
def test_a_segment_without_a_direction_has_no_hinge_angles_and_says_nothing() -> None:
    x = np.array(
        [[[0.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0], [1.0, 1.0, 0]], [[0.0, 0, 0], [1.0, 0, 0], [1.0, 1.0, 0], [1.0, 2.0, 0]]]
    )
    angles = hinge_angles(x, np.array([[0, 1, 2, 3]]))[:, 0]
    assert np.isnan(angles[0]).all()
    np.testing.assert_allclose(angles[1], [np.pi / 2, 0.0], atol=1e-12)


def test_the_centre_of_mass_is_the_mass_weighted_mean() -> None:
    s, x, _, _ = batch(3)
    expected = [sum(m * p for m, p in zip(s.mass, one, strict=True)) / s.mass.sum() for one in x]
    found = centre_of_mass(s, x)
    assert found.shape == (5, 3)
    np.testing.assert_allclose(found, expected, rtol=0, atol=100 * EPS)
    np.testing.assert_allclose(centre_of_mass(s, np.stack([x, 2 * x], axis=1))[:, 1], 2 * found, rtol=8 * EPS, atol=100 * EPS)


def test_rigid_motions_change_no_elastic_energy() -> None:
    s, x, _, lengths = batch(3)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    moved = x @ turn.T + [0.3, -0.2, 0.1]
    before, after = elastic_energies(s, x, lengths), elastic_energies(s, moved, lengths)
    for name, energy in before.items():
        # dE = sum T dl, dl of eps: sqrt(2 k E) bounds a tension
        blur = 8 * EPS * (np.sqrt(2 * s.segment_stiffness.max() * energy) * len(s.cables) + energy * 100)
        assert (np.abs(after[name] - energy) <= blur + EPS).all()


@pytest.mark.parametrize("segments", [1, 3])
@pytest.mark.parametrize("cells", [(2, 1), (2, 2)])
def test_a_state_alone_has_the_bits_that_it_has_among_others(segments: int, cells: tuple[int, int]) -> None:
    design, lattice, rng = Design(bar_segments=segments), Lattice(*cells), np.random.default_rng(segments)
    s = design.structure(lattice)
    x = design.unloaded_positions(lattice) + 0.02 * rng.normal(size=(12, len(s.mass), 3))
    v = rng.normal(size=x.shape)
    lengths = s.actuator_length * rng.uniform(0.3, 1.1, size=(12, lattice.n_cells))

    def everything(rows: slice) -> dict[str, np.ndarray]:
        found = elastic_energies(s, x[rows], lengths[rows]) | member_forces(s, x[rows], lengths[rows])._asdict()
        found |= {"kinetic": kinetic_energy(s, v[rows]), "gravitational": gravitational_energy(s, GRAVITY, x[rows])}
        return found | {"centre": centre_of_mass(s, x[rows]), "hinges": hinge_angles(x[rows], s.bars)}

    together = everything(slice(None))
    for size in (1, 2, 5):
        for first in range(0, 12 - size, size):
            rows = slice(first, first + size)
            for name, alone in everything(rows).items():
                np.testing.assert_array_equal(alone, together[name][rows], err_msg=f"{name}, {size} states")
