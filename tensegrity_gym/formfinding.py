"""Equilibria of the compressed lattice at rest on the ground: validate, search, report convergence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from tensegrity_gym.batch import Progress
from tensegrity_gym.checks import is_number, or_default
from tensegrity_gym.design import Design
from tensegrity_gym.energies import elastic_energies, member_forces
from tensegrity_gym.errors import InvalidParameterError, InvalidStretchesError
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene
from tensegrity_gym.searches import (
    SEARCHES,
    TOLERANCE,
    Found,
    Problem,
    SearchOptions,
    built,
    imperfection_forces,
    start_positions,
)
from tensegrity_gym.types import Floats, Structure

__all__ = [
    "METHODS",
    "STRETCH_RANGE",
    "TOLERANCE",
    "Equilibria",
    "SearchOptions",
    "as_stretches",
    "form_find",
    "imperfection_forces",
    "start_positions",
]
#: The stretches that the design is meant for, the paper's range.
STRETCH_RANGE = (0.2, 0.8)
#: What can be asked of form-finding with ``outside=True``: a cable has a length, and slack ones need not be longer than this.
WIDEST_RANGE = (0.01, 2.0)
METHODS = tuple(SEARCHES)
DAMPINGS = ("viscous", "kinetic")
#: Offset of a bar's bow from the vertical plane through its ends, over the bar's length, above which it has a side.
SIDEWAYS = 1e-6


@dataclass(frozen=True)
class Equilibria:
    """Equilibria of a batch of compressed lattices on the ground; arrays are batch first."""

    stretches: Floats  #: lambda [-], shape (n, n_actuators)
    positions: Floats  #: of all masses, centre of mass above the origin [m], shape (n, n_masses, 3)
    converged: np.ndarray  #: whether the residual is below the tolerance, shape (n,)
    iterations: np.ndarray  #: of the method, of Newton on the last load path tried, shape (n,)
    residual: Floats  #: largest unbalanced force on a mass [N], shape (n,)
    energy: Floats  #: elastic plus gravitational energy [J], shape (n,)
    energies: dict[str, Floats]  #: its parts: "bars", "cables", "actuators", "gravitational" [J], shape (n,) each
    cable_tension: Floats  #: [N], shape (n, n_cables)
    actuator_tension: Floats  #: [N], shape (n, n_actuators)
    bar_load: Floats  #: compression, mean over the bar's segments [N], shape (n, n_bars)
    contact_force: Floats  #: normal force of the ground on each mass [N], shape (n, n_masses)
    method: str  #: how they were found
    evaluations: np.ndarray  #: of the energy or of the forces, on all load paths tried, shape (n,)
    tolerance: float  #: residual asked for [N]
    max_iterations: int  #: cap of the method
    design: Design  #: what the lattice was built to
    lattice: Lattice  #: its topology
    gravity: float  #: along the ground's normal [m/s^2]

    @property
    def stored_energy(self) -> Floats:
        """Elastic energy [J], shape (n,)."""
        return self.energies["bars"] + self.energies["cables"] + self.energies["actuators"]

    @property
    def hints(self) -> list[str]:
        """Why each equilibrium was not found and what to try; empty where it was found."""
        return [self._hint(row) for row in range(len(self.stretches))]

    def _hint(self, row: int) -> str:
        if self.converged[row]:
            return ""
        low, high = STRETCH_RANGE
        found = f"{self.method}: residual {self.residual[row]:.3g} N after {self.iterations[row]} iterations"
        asked = f"expected at most {self.tolerance:.3g} N"
        values = self.stretches[row]
        if (values < low - 1e-6).any() or (values > high + 1e-6).any():
            fix = (
                f"stretches {values.tolist()} leave [{low:g}, {high:g}], where the lattice may collapse or hang slack: clip them"
            )
        elif not np.isfinite(self.residual[row]):
            fix = "the search ran away: check the design's stiffnesses, or start from given positions (start=...)"
        elif self.iterations[row] >= self.max_iterations:
            fix = f"the cap is {self.max_iterations}: raise max_iterations, or take a smaller load_step (method 'newton')"
        else:
            fix = (
                "the energy's rounding hides the slope, or masses chatter on the ground: loosen tolerance or use method 'newton'"
            )
        return f"{found}, {asked}; {fix}"


def as_stretches(stretches: ArrayLike, lattice: Lattice, low: float = STRETCH_RANGE[0], high: float = STRETCH_RANGE[1]) -> Floats:
    """Stretches as a float64 array of shape (n, n_actuators), every value in [low, high].

    Raises InvalidStretchesError, which names the first bad row.
    """
    try:
        given = np.asarray(stretches)
        if given.dtype.kind == "c":
            raise TypeError("complex")  # numpy would drop the imaginary part
        values = np.array(given, dtype=np.float64, order="C")
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


def form_find(
    stretches: ArrayLike,
    *,
    design: Design | None = None,
    scene: Scene | None = None,
    lattice: Lattice | None = None,
    method: str = "newton",
    options: SearchOptions | None = None,
    start: Floats | None = None,
    outside: bool = False,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Equilibria:
    """Equilibria of the lattice compressed to ``stretches``, (n_actuators,) or (n, n_actuators), at rest on the ground.

    The energy is elastic plus gravitational, the ground a unilateral constraint without friction; on a slope the lattice is
    held against sliding until its release, so only gravity along the normal enters. With ``method`` "newton" each equilibrium
    is the end of the load path on which all actuators shorten together from the unloaded lattice, so it does not depend on the
    rest of the batch. "cg" and "relaxation" are the baselines of the literature: they start unloaded under the full load and
    may end in another equilibrium. ``start`` (n, n_masses, 3) [m] replaces the start of any method, load path included.
    ``outside=True`` also takes stretches outside the paper's range, where equilibria may be lost.

    Raises InvalidStretchesError and InvalidParameterError. What did not converge says so in ``converged``, and why in
    ``hints``; never use it.
    """
    design, scene = or_default(design, Design, "form_find"), Scene.of(scene, "form_find")
    lattice = or_default(lattice, Lattice, "form_find")
    values = as_stretches(stretches, lattice, *(WIDEST_RANGE if outside else STRETCH_RANGE))
    if method not in METHODS:
        raise InvalidParameterError(f"form_find: expected method in {METHODS}, got {method!r}")
    lattice, structure, _, reference = built(design, lattice)
    begin = None if start is None else _as_start(start, len(values), len(structure.mass))
    problem = Problem(values, begin, design, scene, lattice, structure)
    found = SEARCHES[method](problem, _as_options(options), threads, progress)
    positions = _canonical_pose(_canonical_bows(found.positions, lattice, design), reference, structure)
    return _report(values, positions, found, problem, method)


def _as_start(start: Floats, n: int, n_masses: int) -> Floats:
    try:
        positions = np.asarray(start, dtype=np.float64)
    except (TypeError, ValueError):
        positions = np.full(1, np.nan)
    positions = positions[None] if positions.ndim == 2 else positions
    if positions.shape != (n, n_masses, 3) or not np.isfinite(positions).all():
        raise InvalidParameterError(
            f"form_find: expected start of {n} x {n_masses} x 3 finite positions, got shape {np.shape(start)}"
        )
    return positions


def _as_options(options: SearchOptions | None) -> SearchOptions:
    options = or_default(options, SearchOptions, "form_find")
    for name in ("tolerance", "max_iterations", "load_step", "line_tolerance", "line_cap"):
        value = getattr(options, name)
        if value is not None and not (is_number(value) and value > 0):
            raise InvalidParameterError(f"SearchOptions.{name}: expected a finite number > 0, got {value!r}")
    if options.damping not in DAMPINGS:
        raise InvalidParameterError(f"SearchOptions.damping: expected one of {DAMPINGS}, got {options.damping!r}")
    return options


def _canonical_bows(positions: Floats, lattice: Lattice, design: Design) -> Floats:
    """Bows that lie sideways on the ground, mirrored to point towards their cell's axis.

    The mirror image of a bow in the vertical plane through its bar's ends has the same energy and the same forces on the ends:
    a lattice with k bows on the ground has 2^k equilibria of one energy, of which this picks one.
    """
    x = positions.copy()
    first = lattice.n_nodes + 2 * lattice.n_cells
    per_bar = int(design.bar_segments) - 1
    if per_bar == 0:
        return x
    inner = first + np.arange(per_bar * len(lattice.bars)).reshape(len(lattice.bars), per_bar)
    near, far = x[:, lattice.bars[:, 0]], x[:, lattice.bars[:, 1]]
    chord = far - near
    normal = np.stack([-chord[:, :, 1], chord[:, :, 0]], axis=-1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    cells = np.stack([x[:, lattice.cell_node_indices(cell), :2].mean(axis=1) for cell in range(lattice.n_cells)], axis=1)
    own = np.repeat(np.arange(lattice.n_cells), len(lattice.bars) // lattice.n_cells)
    outwards = np.einsum("nbc,nbc->nb", normal, 0.5 * (near + far)[:, :, :2] - cells[:, own])
    offset = np.einsum("nbc,nbkc->nbk", normal, x[:, inner, :2] - near[:, :, None, :2])
    mean = offset.mean(axis=2)
    flip = (mean * outwards > 0.0) & (np.abs(mean) > SIDEWAYS * design.bar_length)
    shift = np.where(flip[:, :, None, None], -2.0 * offset[..., None] * normal[:, :, None, :], 0.0)
    x[:, inner, :2] += shift
    return x


def _canonical_pose(positions: Floats, reference: Floats, structure: Structure) -> Floats:
    """Take out the rigid motions that cost no energy on flat ground: centre of mass over the origin, no mean yaw."""
    centre = np.einsum("m,nmc->nc", structure.mass, positions)[:, :2] / structure.mass.sum()
    x = positions.copy()
    x[:, :, :2] -= centre[:, None, :]
    nodes = x[:, : len(reference), :2]
    cross = (reference[:, 0] * nodes[:, :, 1] - reference[:, 1] * nodes[:, :, 0]).sum(axis=1)
    along = (reference * nodes).sum(axis=(1, 2))
    yaw = np.arctan2(cross, along)
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    turned = x.copy()
    turned[:, :, 0] = c * x[:, :, 0] + s * x[:, :, 1]
    turned[:, :, 1] = c * x[:, :, 1] - s * x[:, :, 0]
    return turned


def _report(values: Floats, positions: Floats, found: Found, problem: Problem, method: str) -> Equilibria:
    design, scene, lattice, structure = problem.design, problem.scene, problem.lattice, problem.structure
    lengths = values * structure.actuator_length
    flat = replace(scene, slope=0.0, gravity=scene.gravity * np.cos(scene.slope))
    energies = elastic_energies(structure, positions, lengths)
    energies["gravitational"] = -np.einsum("m,nmc,c->n", structure.mass, positions, flat.gravity_vector)
    forces = member_forces(structure, positions, lengths)
    pressed = (positions[:, :, 2] <= 0.0) & (found.forces[:, :, 2] < 0.0)
    return Equilibria(
        stretches=values,
        positions=positions,
        converged=found.converged,
        iterations=found.iterations,
        residual=found.residual,
        energy=np.sum(list(energies.values()), axis=0),
        energies=energies,
        cable_tension=forces.cables,
        actuator_tension=forces.actuators,
        bar_load=forces.bars,
        contact_force=np.where(pressed, -found.forces[:, :, 2], 0.0),
        method=method,
        evaluations=found.evaluations,
        tolerance=found.tolerance,
        max_iterations=found.max_iterations,
        design=design,
        lattice=lattice,
        gravity=-float(scene.gravity_vector[2]),
    )
