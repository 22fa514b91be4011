"""Searches for equilibria: each method's settings, work arrays and threads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from tensegrity_gym.batch import Progress, run_shares
from tensegrity_gym.core.conjugate_gradient import DescentSettings
from tensegrity_gym.core.descent import DescentCases, DescentRecords, GroundSettings, Loads, descend_equilibria, relax_equilibria
from tensegrity_gym.core.newton import EquilibriumRecords, NewtonSettings, newton_equilibria
from tensegrity_gym.core.relaxation import RelaxationSettings
from tensegrity_gym.design import Design
from tensegrity_gym.elimination import lattice_pattern
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene
from tensegrity_gym.types import Floats, Structure
from tensegrity_gym.workspaces import descent_lanes, ground_lanes, lanes_for, newton_lanes, relaxation_lanes, without_lanes

#: The load that decides which way a bar bows, over the bar's Euler load: downwards, as a bar's own weight does on Earth.
IMPERFECTION = 1e-5
#: Residual force per mass at which Newton's equilibria count as found, over the Euler load of a bar.
TOLERANCE = 1e-8
#: Load paths, each with half the step of the one before, that Newton tries.
TRIES = 3
#: Fictitious masses of relaxation over the sum of the stiffnesses at them; 1/2 is the limit of linear stability.
MASS_MARGIN = 0.55


@dataclass(frozen=True)
class SearchOptions:
    """How hard a method tries; what is None is the method's default."""

    tolerance: float | None = None
    """Residual force per mass at which an equilibrium counts as found, over a bar's Euler load [-]: 1e-8 for Newton, whose
    last step is quadratic, and at least what rounding leaves; 2e-6 for relaxation; 1e-5 for conjugate gradients, whose energies
    cannot tell more."""
    max_iterations: int | None = None
    """Factorisations (2000, on each load path tried), directions (200 000) or steps (2 000 000) that one lattice may take."""
    load_step: float = 0.1
    """Newton: largest change of a stretch in one step along the load path, the first one tried [-]."""
    line_tolerance: float = 0.1
    """Conjugate gradients: change of the best step, over it, at which a line search ends [-]."""
    line_cap: int = 10
    """Conjugate gradients: parabolas per line search."""
    damping: str = "viscous"
    """Relaxation: "viscous" or "kinetic"."""


def _rounding(design: Design) -> float:
    """Force [N] that members' lengths, which float64 rounds, leave unbalanced however long one searches."""
    return 16 * float(np.finfo(np.float64).eps) * max(design.bar_rigidity, design.cable_rigidity)


class Built(NamedTuple):
    """What depends on design and lattice alone; shared between searches, so never written to."""

    lattice: Lattice  #: whose cached arrays are there already
    structure: Structure  #: the lattice built to the design
    start: Floats  #: :func:`start_positions` [m], shape (n_masses, 3)
    reference: Floats  #: the unloaded nodes seen from above, which tell yaw [m], shape (n_nodes, 2)


@lru_cache(maxsize=32)
def built(design: Design, lattice: Lattice) -> Built:
    """Structure and start of a lattice, computed once: for a single equilibrium they take as long as the search."""
    start = start_positions(design, lattice)
    return Built(lattice, design.structure(lattice), start, np.ascontiguousarray(design.unloaded_nodes(lattice)[:, :2]))


class Problem(NamedTuple):
    """Equilibria to find."""

    stretches: Floats  #: lambda [-], shape (n, n_actuators)
    start: Floats | None  #: positions to start from at full load [m], shape (n, n_masses, 3); None for the unloaded lattice
    design: Design  #: materials and sizes
    scene: Scene  #: gravity
    lattice: Lattice  #: topology
    structure: Structure  #: the lattice built to the design

    @property
    def normal_gravity(self) -> Floats:
        """Gravity along the ground's normal [m/s^2], shape (3,): friction holds the rest until the release."""
        return np.array((0.0, 0.0, self.scene.gravity_vector[2]))

    @property
    def soft_ground(self) -> float:
        """Stiffness [N/m] of the ground on the way: the whole weight on one mass sinks it by 0.001 of the cell's height."""
        return float(self.structure.mass.sum() * -self.normal_gravity[2] / (1e-3 * self.design.cell_height))

    def start_positions(self) -> Floats:
        """Where the search starts [m], shape (n, n_masses, 3), a fresh array."""
        if self.start is not None:
            return np.array(self.start, dtype=np.float64, order="C")
        return np.repeat(built(self.design, self.lattice).start[None], len(self.stretches), axis=0)


class Found(NamedTuple):
    """What a search found."""

    positions: Floats  #: [m], shape (n, n_masses, 3)
    forces: Floats  #: of members and weight [N], shape (n, n_masses, 3)
    residual: Floats  #: largest unbalanced force on a mass [N], shape (n,)
    iterations: np.ndarray  #: shape (n,)
    evaluations: np.ndarray  #: of the energy or the forces, shape (n,)
    converged: np.ndarray  #: shape (n,)
    tolerance: float  #: [N]
    max_iterations: int  #: cap


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


def newton_search(problem: Problem, options: SearchOptions, threads: int | None, progress: Progress | None) -> Found:
    """Newton along the load path, or from given positions.

    A lattice that got lost on its load path is searched again with half the load step, ``TRIES`` times in all: soft bars under
    their own weight lose one in sixteen, and on the finer path they arrive where the others do.
    """
    settings = newton_settings(problem, options)
    records = newton_run(problem, settings, threads, progress)
    evaluations = records.iterations.copy()
    for _ in range(TRIES - 1 if problem.start is None else 0):
        lost = np.flatnonzero(~records.converged)
        settings = settings._replace(load_step=0.5 * settings.load_step)
        again = newton_run(problem._replace(stretches=problem.stretches[lost]), settings, threads, None)
        evaluations[lost] += again.iterations
        for kept, new in zip(records, again, strict=True):
            kept[lost] = new
    return Found(
        records.positions,
        records.forces,
        records.residual,
        records.iterations,
        evaluations,
        records.converged,
        settings.tolerance,
        settings.max_iterations,
    )


def newton_settings(problem: Problem, options: SearchOptions) -> NewtonSettings:
    """Newton's lengths, forces and stiffnesses, as shares of the design's."""
    design = problem.design
    return NewtonSettings(
        load_step=options.load_step,
        path_tolerance=0.02 * design.critical_load,
        tolerance=max((options.tolerance or TOLERANCE) * design.critical_load, _rounding(design)),
        max_iterations=options.max_iterations or 2000,
        longest_step=0.05 * design.cell_height,
        least_shift=1e-4 * design.critical_load / design.bar_length,
        unload=1.0 if problem.start is None else 0.0,
        soft_ground=problem.soft_ground,
        most_compression=1.2 * design.critical_load,
        patience=12,
        first_shift=0.01 * design.critical_load / design.bar_length,
        max_rounds=100,
    )


def newton_run(problem: Problem, settings: NewtonSettings, threads: int | None, progress: Progress | None) -> EquilibriumRecords:
    """One search for each of the problem's stretches, 8 lattices at a time in each thread's lanes, up to ``ALONE`` without."""
    structure = problem.structure
    n, m = len(problem.stretches), len(structure.mass)
    pattern = lattice_pattern(problem.lattice, int(problem.design.bar_segments))
    dead_load, gravity = imperfection_forces(problem.design, structure), problem.normal_gravity
    records = EquilibriumRecords(
        positions=problem.start_positions(),
        forces=np.zeros((n, m, 3)),
        residual=np.zeros(n),
        iterations=np.zeros(n, dtype=np.int64),
        converged=np.zeros(n, dtype=np.bool_),
        least_pivot=np.zeros(n),
    )
    count = lanes_for(n)

    def work(first: int, last: int, counter: np.ndarray) -> None:
        lanes = newton_lanes(m, structure.n_axial_members, structure.actuator_length, pattern.n_slots, count)
        kernel = without_lanes(lanes) if count == 1 else lanes
        newton_equilibria(
            structure, pattern, gravity, dead_load, settings, problem.stretches, records, lanes, kernel, first, last, counter
        )

    run_shares(work, n, threads, count, progress)
    return records


def cg_search(problem: Problem, options: SearchOptions, threads: int | None, progress: Progress | None) -> Found:
    """The paper's conjugate gradients from the unloaded lattice."""
    design, n = problem.design, len(problem.stretches)
    settings = DescentSettings(
        tolerance=(options.tolerance or 1e-5) * design.critical_load,
        max_iterations=options.max_iterations or 200_000,
        line_tolerance=options.line_tolerance,
        line_cap=options.line_cap,
        longest_step=0.05 * design.cell_height,
        sufficient=0.1,
    )
    cases = DescentCases(problem.stretches, np.zeros((n, 0)))
    loads, ground = _loads(problem), _ground(problem, settings.tolerance)
    records, count = _descent_records(problem), lanes_for(n)

    def work(first: int, last: int, counter: np.ndarray) -> None:
        own = ground_lanes(problem.structure, cases, count, first, last)
        lanes = descent_lanes(own.x)
        own_work, lanes_work = (own, lanes) if count > 1 else (without_lanes(own), without_lanes(lanes))
        descend_equilibria(loads, ground, settings, cases, records, own, own_work, lanes, lanes_work, counter)

    run_shares(work, n, threads, count, progress)
    return Found(*records, settings.tolerance, settings.max_iterations)


def relaxation_search(
    problem: Problem, options: SearchOptions, threads: int | None, progress: Progress | None, mass: Floats | None = None
) -> Found:
    """Dynamic relaxation from the unloaded lattice.

    ``mass`` (n, n_masses) [N step^2/m] replaces the :func:`fictitious_masses`; real ones over the square of a time step relax as
    a simulation does.
    """
    structure, design, n = problem.structure, problem.design, len(problem.stretches)
    settings = RelaxationSettings(
        tolerance=(options.tolerance or 2e-6) * design.critical_load,
        max_iterations=options.max_iterations or 2_000_000,
        kinetic=options.damping == "kinetic",
        softest=1e-4,
        longest_step=0.05 * design.cell_height,
    )
    mass = fictitious_masses(structure, problem.stretches, problem.soft_ground) if mass is None else mass
    cases = DescentCases(problem.stretches, mass)
    loads, ground = _loads(problem), _ground(problem, settings.tolerance)
    records, count = _descent_records(problem), lanes_for(n)

    def work(first: int, last: int, counter: np.ndarray) -> None:
        own = ground_lanes(structure, cases, count, first, last)
        lanes = relaxation_lanes(own.x, own.mass)
        own_work, lanes_work = (own, lanes) if count > 1 else (without_lanes(own), without_lanes(lanes))
        relax_equilibria(loads, ground, settings, cases, records, own, own_work, lanes, lanes_work, counter)

    run_shares(work, n, threads, count, progress)
    return Found(*records, settings.tolerance, settings.max_iterations)


def fictitious_masses(structure: Structure, stretches: Floats, soft_ground: float) -> Floats:
    """Masses [N step^2/m] for which dynamic relaxation with unit step is stable, shape (n, n_masses).

    (a - b)^2 <= 2 a^2 + 2 b^2 bounds the stiffness by twice the sum of the members' at each mass, and stability asks for a
    quarter of that; ``MASS_MARGIN`` is more than 1/2 for geometric stiffness.
    """
    mass = np.full((len(structure.mass), len(stretches)), 0.25 * soft_ground)
    actuators = structure.actuator_rigidity / (stretches * structure.actuator_length)
    for end in (0, 1):
        np.add.at(mass, structure.cables[:, end], MASS_MARGIN * structure.cable_stiffness[:, None])
        np.add.at(mass, structure.actuators[:, end], MASS_MARGIN * actuators.T)
    segments = structure.bars.shape[1] - 1
    for k in range(segments):
        for end in (0, 1):
            np.add.at(mass, structure.bars[:, k + end], MASS_MARGIN * structure.segment_stiffness[:, None])
    bending = structure.hinge_stiffness / structure.segment_length**2
    for k in range(segments - 1):
        for offset, share in enumerate((1.1, 2.2, 1.1)):
            np.add.at(mass, structure.bars[:, k + offset], share * bending[:, None])
    return np.ascontiguousarray(mass.T)


def _loads(problem: Problem) -> Loads:
    return Loads(problem.structure, problem.normal_gravity, imperfection_forces(problem.design, problem.structure))


def _ground(problem: Problem, tolerance: float) -> GroundSettings:
    release = 1e-6 * problem.design.critical_load
    return GroundSettings(soft_ground=problem.soft_ground, release=release, max_rounds=100, tolerance=tolerance)


def _descent_records(problem: Problem) -> DescentRecords:
    n, m = len(problem.stretches), len(problem.structure.mass)
    return DescentRecords(
        positions=problem.start_positions(),
        forces=np.zeros((n, m, 3)),
        residual=np.zeros(n),
        iterations=np.zeros(n, dtype=np.int64),
        evaluations=np.zeros(n, dtype=np.int64),
        converged=np.zeros(n, dtype=np.bool_),
    )


Search = Callable[[Problem, SearchOptions, "int | None", "Progress | None"], Found]
#: Methods of form-finding by name.
SEARCHES: dict[str, Search] = {"newton": newton_search, "cg": cg_search, "relaxation": relaxation_search}
