"""Equilibria of the compressed lattice at rest on the ground: validate, minimise, report convergence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from tensegrity_gym.batch import Progress, run_shares
from tensegrity_gym.core.lanes import lane_count, lanes_empty
from tensegrity_gym.core.newton import N_SCALARS, EquilibriumRecords, NewtonLanes, NewtonSettings, newton_equilibria
from tensegrity_gym.design import Design
from tensegrity_gym.elimination import lattice_pattern
from tensegrity_gym.energies import elastic_energies, member_forces
from tensegrity_gym.errors import InvalidParameterError, InvalidStretchesError
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene
from tensegrity_gym.types import Floats, Structure

#: The stretches that the design is meant for, the paper's range.
STRETCH_RANGE = (0.2, 0.8)
METHODS = ("newton",)
#: The load that decides which way a bar bows, over the bar's Euler load: downwards, as a bar's own weight does on Earth.
IMPERFECTION = 1e-5
#: Residual force per mass at which an equilibrium counts as found, over the Euler load of a bar.
TOLERANCE = 1e-8


@dataclass(frozen=True)
class Equilibria:
    """Equilibria of a batch of compressed lattices on the ground; arrays are batch first."""

    stretches: Floats  #: lambda [-], shape (n, n_actuators)
    positions: Floats  #: of all masses, centre of mass above the origin [m], shape (n, n_masses, 3)
    converged: np.ndarray  #: whether the residual is below the tolerance, shape (n,)
    iterations: np.ndarray  #: of the method, shape (n,)
    residual: Floats  #: largest unbalanced force on a mass [N], shape (n,)
    energy: Floats  #: elastic plus gravitational energy [J], shape (n,)
    energies: dict[str, Floats]  #: its parts: "bars", "cables", "actuators", "gravitational" [J], shape (n,) each
    cable_tension: Floats  #: [N], shape (n, n_cables)
    actuator_tension: Floats  #: [N], shape (n, n_actuators)
    bar_load: Floats  #: compression, mean over the bar's segments [N], shape (n, n_bars)
    contact_force: Floats  #: normal force of the ground on each mass [N], shape (n, n_masses)
    method: str  #: how they were found

    @property
    def stored_energy(self) -> Floats:
        """Elastic energy [J], shape (n,)."""
        return self.energies["bars"] + self.energies["cables"] + self.energies["actuators"]


def as_stretches(stretches: ArrayLike, lattice: Lattice, low: float = STRETCH_RANGE[0], high: float = STRETCH_RANGE[1]) -> Floats:
    """Stretches as a float64 array of shape (n, n_actuators), every value in [low, high].

    Raises InvalidStretchesError, which names the first bad row.
    """
    try:
        values = np.array(stretches, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InvalidStretchesError(f"stretches: expected numbers, got {stretches!r}") from error
    n = lattice.n_cells
    values = values[None] if values.ndim == 1 else values
    if values.ndim != 2 or values.shape[1] != n:
        raise InvalidStretchesError(
            f"stretches: expected shape ({n},) or (batch, {n}) for a {lattice.nx}x{lattice.ny} lattice, got {np.shape(stretches)}"
        )
    slack = 1e-6  # float32 actions at the bounds
    bad = ~np.isfinite(values) | (values < low - slack) | (values > high + slack)
    if bad.any():
        row = int(np.argmax(bad.any(axis=1)))
        raise InvalidStretchesError(
            f"stretches: expected finite values in [{low:g}, {high:g}], got {values[row].tolist()} in row {row}; clip them first"
        )
    return np.clip(values, low, high)


def start_positions(design: Design, lattice: Lattice, bow: float = 1e-3) -> Floats:
    """The unloaded lattice standing on the ground, its bars bowed downwards by ``bow`` of their length, (n_masses, 3) [m]."""
    x = design.unloaded_positions(lattice)
    x[:, 2] -= x[:, 2].min()
    structure = design.structure(lattice)
    axis = x[structure.bars[:, -1]] - x[structure.bars[:, 0]]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    down = np.array((0.0, 0.0, -1.0)) + axis[:, 2:] * axis
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    x[structure.bars[:, 1:-1]] += bow * design.bar_length * down[:, None, :]
    x[x[:, 2] < 1e-9, 2] = 0.0
    return x


def imperfection_forces(design: Design, structure: Structure) -> Floats:
    """Self-balanced dead load that bows each bar downwards, shape (n_masses, 3) [N].

    Without gravity the bow of a pin-ended bar may point anywhere around its chord; this settles it and, pointing down,
    keeps every symmetry of the lattice on the ground.
    """
    forces = np.zeros((len(structure.mass), 3))
    inner = structure.bars[:, 1:-1]
    if inner.shape[1]:
        load = IMPERFECTION * design.critical_load
        forces[inner.ravel(), 2] -= load
        for end in (0, -1):
            np.add.at(forces[:, 2], structure.bars[:, end], load * inner.shape[1] / 2)
    return forces


def form_find(
    stretches: ArrayLike,
    *,
    design: Design | None = None,
    scene: Scene | None = None,
    lattice: Lattice | None = None,
    method: str = "newton",
    threads: int | None = None,
    progress: Progress | None = None,
) -> Equilibria:
    """Equilibria of the lattice compressed to ``stretches``, (n_actuators,) or (n, n_actuators), at rest on the ground.

    The energy is elastic plus gravitational, the ground a unilateral constraint without friction; on a slope the lattice is
    held against sliding until its release, so only gravity along the normal enters. Each equilibrium is the end of the load
    path on which all actuators shorten together from the unloaded lattice, so it does not depend on the rest of the batch.

    Raises InvalidStretchesError and InvalidParameterError. What did not converge says so in ``converged``; never use it.
    """
    design, scene, lattice = design or Design(), scene or Scene(), lattice or Lattice()
    values = as_stretches(stretches, lattice)
    if method not in METHODS:
        raise InvalidParameterError(f"form_find: expected method in {METHODS}, got {method!r}")
    structure = design.structure(lattice)
    records = _newton(values, design, scene, lattice, structure, threads, progress)
    positions = _canonical_pose(records.positions, design, lattice, structure)
    return _report(values, positions, records, scene, structure, method)


def _newton(
    values: Floats,
    design: Design,
    scene: Scene,
    lattice: Lattice,
    structure: Structure,
    threads: int | None,
    progress: Progress | None,
) -> EquilibriumRecords:
    n, m = len(values), len(structure.mass)
    pattern = lattice_pattern(lattice, int(design.bar_segments))
    normal_gravity = np.array((0.0, 0.0, scene.gravity_vector[2]))
    dead_load = imperfection_forces(design, structure)
    weight = structure.mass.sum() * abs(normal_gravity[2])
    settings = NewtonSettings(
        load_step=0.05,
        path_tolerance=0.02 * design.critical_load,
        tolerance=TOLERANCE * design.critical_load,
        max_iterations=2000,
        longest_step=0.03 * design.cell_height,
        least_shift=1e-5 * design.critical_load / design.bar_length,
        unload=1.0,
        soft_ground=weight / (1e-3 * design.cell_height),
        max_rounds=100,
    )
    records = EquilibriumRecords(
        positions=np.repeat(start_positions(design, lattice)[None], n, axis=0),
        forces=np.zeros((n, m, 3)),
        residual=np.zeros(n),
        iterations=np.zeros(n, dtype=np.int64),
        converged=np.zeros(n, dtype=np.bool_),
        least_pivot=np.zeros(n),
    )

    def work(first: int, last: int, counter: np.ndarray) -> None:
        lanes = newton_lanes(structure, pattern.n_slots)
        newton_equilibria(structure, pattern, normal_gravity, dead_load, settings, values, records, lanes, first, last, counter)

    run_shares(work, n, threads, lane_count(np.float64), progress)
    return records


def newton_lanes(structure: Structure, n_slots: int) -> NewtonLanes:
    """Work arrays of one thread."""
    count, n_masses = lane_count(np.float64), len(structure.mass)
    return NewtonLanes(
        *(lanes_empty((n_masses, 3)) for _ in range(4)),
        lanes_empty((structure.n_axial_members,)),
        lanes_empty((n_masses, 3)),
        lanes_empty((n_slots, 9)),
        lanes_empty((len(structure.actuators),)),
        lanes_empty((N_SCALARS,)),
        np.zeros(count, dtype=np.int64),
        np.zeros(count, dtype=np.int64),
        np.zeros(count),
        np.zeros(count, dtype=np.int64),
        lanes_empty((n_masses,)),
    )


def _canonical_pose(positions: Floats, design: Design, lattice: Lattice, structure: Structure) -> Floats:
    """Take out the rigid motions that cost no energy on flat ground: centre of mass over the origin, no mean yaw."""
    reference = design.unloaded_nodes(lattice)[:, :2]
    centre = np.einsum("m,nmc->nc", structure.mass, positions)[:, :2] / structure.mass.sum()
    x = positions.copy()
    x[:, :, :2] -= centre[:, None, :]
    nodes = x[:, : lattice.n_nodes, :2]
    cross = (reference[:, 0] * nodes[:, :, 1] - reference[:, 1] * nodes[:, :, 0]).sum(axis=1)
    along = (reference * nodes).sum(axis=(1, 2))
    yaw = np.arctan2(cross, along)
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    turned = x.copy()
    turned[:, :, 0] = c * x[:, :, 0] + s * x[:, :, 1]
    turned[:, :, 1] = c * x[:, :, 1] - s * x[:, :, 0]
    return turned


def _report(
    values: Floats, positions: Floats, records: EquilibriumRecords, scene: Scene, structure: Structure, method: str
) -> Equilibria:
    lengths = values * structure.actuator_length
    flat = replace(scene, slope=0.0, gravity=scene.gravity * np.cos(scene.slope))
    energies = elastic_energies(structure, positions, lengths)
    energies["gravitational"] = -np.einsum("m,nmc,c->n", structure.mass, positions, flat.gravity_vector)
    forces = member_forces(structure, positions, lengths)
    pressed = (positions[:, :, 2] <= 0.0) & (records.forces[:, :, 2] < 0.0)
    return Equilibria(
        stretches=values,
        positions=positions,
        converged=records.converged,
        iterations=records.iterations,
        residual=records.residual,
        energy=sum(energies.values()),
        energies=energies,
        cable_tension=forces.cables,
        actuator_tension=forces.actuators,
        bar_load=forces.bars,
        contact_force=np.where(pressed, -records.forces[:, :, 2], 0.0),
        method=method,
    )
