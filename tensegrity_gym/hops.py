"""Hops and drops at a given fidelity: from a start to what is reported of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tensegrity_gym.batch import Progress
from tensegrity_gym.checks import is_number
from tensegrity_gym.core import records as rec
from tensegrity_gym.design import Design
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.events import measure
from tensegrity_gym.fidelity import STABLE_STEPS, Fidelity
from tensegrity_gym.formfinding import Equilibria
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.rollouts import Problem, follow
from tensegrity_gym.scene import Scene
from tensegrity_gym.timestep import MARGIN, default_time_step
from tensegrity_gym.types import Floats, HopStatus, Structure
from tensegrity_gym.version import MODEL_VERSION

#: The critical step in the stiffest posture of a hop or drop over that of the unloaded lattice (docs/accuracy.md).
POSTURES = 0.99
#: Hops rolled out at once: bounds the memory for events to about 35 KB a hop.
CHUNK = 512


@dataclass(frozen=True)
class Trajectory:
    """Frames of hops; those past ``frames[i]`` are zero."""

    times: Floats  #: since release [s], shape (n, n_frames)
    positions: Floats  #: [m], shape (n, n_frames, n_masses, 3)
    energies: Floats  #: [J], columns ENERGY_NAMES, shape (n, n_frames, 7)
    frames: np.ndarray  #: valid frames, shape (n,)


@dataclass(frozen=True)
class HopResult:
    """A batch of hops; arrays are batch first. Displacements are horizontal, from the start of the hop."""

    stretches: Floats  #: lambda [-], shape (n, n_actuators)
    landing: Floats  #: displacement of the centre of mass, where ``scene.landing`` says [m], shape (n, 2)
    rest: Floats  #: at the end of the hop, not a number where it was not followed so far [m], shape (n, 2)
    touchdown: Floats  #: at the first impact after flight [m], shape (n, 2)
    rest_nodes: Floats  #: displacement of the mean of the nodes at the end (the paper's) [m], shape (n, 2)
    touchdown_nodes: Floats  #: likewise at touchdown [m], shape (n, 2)
    apex: Floats  #: highest rise of the centre of mass above its start [m], shape (n,)
    apex_time: Floats  #: since release, not a number without flight [s], shape (n,)
    takeoff_time: Floats  #: since release [s], shape (n,)
    takeoff_velocity: Floats  #: of the centre of mass [m/s], shape (n, 3)
    touchdown_time: Floats  #: since release [s], shape (n,)
    flight_time: Floats  #: from take-off to touchdown, 0 without flight [s], shape (n,)
    impacts: Floats  #: times of the first returns to the ground after touchdown, padded by not-a-number [s], shape (n, 8)
    impact_count: np.ndarray  #: of all returns to the ground after touchdown, shape (n,)
    end_time: Floats  #: since release [s], shape (n,)
    status: np.ndarray  #: HopStatus, shape (n,)
    failed_mass: np.ndarray  #: the mass that ran away in an unstable hop, else -1, shape (n,)
    failed_member: np.ndarray  #: the most strained axial member of an unstable hop, else -1, shape (n,)
    energies: Floats  #: at release, take-off, touchdown, end [J], columns ENERGY_NAMES, shape (n, 4, 7)
    stored_energy: Floats  #: elastic energy at release, in the locked lattice [J], shape (n,)
    start_positions: Floats = field(repr=False)  #: [m], shape (n, n_masses, 3)
    end_nodes: Floats = field(repr=False)  #: where the nodes are at the end, no answer in a failed hop [m], shape (n, n_nodes, 3)
    equilibria: Equilibria  #: what the hops started from; None for drops
    structure: Structure = field(repr=False)  #: the lattice as it was simulated
    fidelity: Fidelity  #: how it was simulated and why so; ``str`` of it is one line
    dt: float  #: time step [s]
    steps: np.ndarray  #: steps taken, shape (n,)
    trajectory: Trajectory | None  #: frames, if asked for
    model_version: str = MODEL_VERSION  #: version of the physics

    def describe_failures(self) -> list[str]:
        """One line for each failed hop: which, when, where and why; see ``Structure`` for the order of masses."""
        lines = []
        for hop in np.flatnonzero(self.failed):
            stretches = np.array2string(self.stretches[hop], precision=4)
            if self.status[hop] == HopStatus.NOT_CONVERGED:
                residual = np.nan if self.equilibria is None else self.equilibria.residual[hop]
                lines.append(f"hop {hop}, stretches {stretches}: no equilibrium to start from, residual force {residual:.3g} N")
            else:
                lines.append(
                    f"hop {hop}, stretches {stretches}: the integration blew up by t = {self.end_time[hop]:.4g} s at mass "
                    f"{self.failed_mass[hop]} and {self.structure.member_name(int(self.failed_member[hop]))} (kinetic energy out "
                    f"of all bounds or not finite) with dt = {self.dt:.4g} s; use a smaller dt"
                )
        return lines

    @property
    def failed(self) -> np.ndarray:
        """Hops whose landing is no answer (unstable or never started), shape (n,)."""
        return np.isin(self.status, (HopStatus.UNSTABLE, HopStatus.NOT_CONVERGED))


def run(
    starts: Floats,
    usable: np.ndarray,
    stored_energy: Floats,
    stretches: Floats,
    *,
    phase: int = rec.STANDING,
    design: Design,
    scene: Scene,
    lattice: Lattice,
    fidelity: Fidelity,
    dt: float,
    rate: float = 0.0,
    threads: int | None = None,
    progress: Progress | None = None,
    equilibria: Equilibria | None = None,
) -> HopResult:
    """Follow lattices from ``starts``, positions [m] and velocities [m/s] of shape (n, 2, n_masses, 3).

    ``design`` is as the fidelity models it, ``phase`` the kernel's STANDING or FLYING, ``rate`` that of frames [Hz].
    """
    problem = Problem.of(design, scene, lattice, fidelity, dt, rate)
    # whatever the bars give back, kinetic energy stays below it plus the fall; ten times that is no physics
    mass = problem.structure.mass
    moving = 0.5 * np.einsum("m,nmc,nmc->n", mass, starts[:, 1], starts[:, 1])
    weight = mass.sum() * scene.gravity
    runaway = 10.0 * (stored_energy + moving + weight * (design.cell_height + scene.gravity * scene.duration**2))
    finite = np.isfinite(starts).all(axis=(1, 2, 3)) & np.isfinite(runaway)
    usable = usable & finite
    # a hop without a start is not simulated, but what is reported of it must be finite
    spare = np.zeros((1, *starts.shape[1:]))
    spare[0, 0] = design.unloaded_positions(lattice)
    starts = np.where(finite[:, None, None, None], starts, spare)
    parts = []
    for first in range(0, max(1, len(starts)), CHUNK):  # no hops are one part too, of empty columns
        part = slice(first, first + CHUNK)
        records = follow(problem, starts[part], phase, usable[part], runaway[part], threads, progress)
        parts.append(measure(records, problem, lattice))
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    frames = Trajectory(**{k[6:]: columns.pop(k) for k in list(columns) if k.startswith("frame_")})
    return HopResult(
        stretches=stretches,
        landing=columns[scene.landing].copy(),
        stored_energy=stored_energy,
        start_positions=starts[:, 0] if equilibria is None else equilibria.positions,
        equilibria=equilibria,  # type: ignore[arg-type]
        structure=problem.structure,
        fidelity=fidelity,
        dt=dt,
        trajectory=frames if rate else None,
        **columns,  # type: ignore[arg-type]
    )


def hop(
    equilibria: Equilibria,
    *,
    design: Design,
    scene: Scene,
    lattice: Lattice,
    fidelity: Fidelity,
    dt: float | None = None,
    allow_unstable: bool = False,
    rate: float = 0.0,
    threads: int | None = None,
    progress: Progress | None = None,
) -> HopResult:
    """Hops from ``equilibria`` of ``fidelity.design(design)``; the rest as for :func:`tensegrity_gym.simulate`."""
    modelled = fidelity.design(design)
    step = time_step(dt, modelled, lattice, fidelity, allow_unstable)
    return run(
        np.stack([equilibria.positions, np.zeros_like(equilibria.positions)], axis=1),
        equilibria.converged,
        equilibria.stored_energy,
        equilibria.stretches,
        design=modelled,
        scene=scene,
        lattice=lattice,
        fidelity=fidelity,
        dt=step,
        rate=rate,
        threads=threads,
        progress=progress,
        equilibria=equilibria,
    )


def time_step(
    dt: float | None,
    design: Design,
    lattice: Lattice,
    fidelity: Fidelity,
    allow_unstable: bool = False,
    caller: str = "simulate",
) -> float:
    """``dt`` if it is stable, or the fidelity's step [s]; ``design`` is as the fidelity models it.

    Raises InvalidParameterError for an unstable step unless ``allow_unstable``.
    """
    step = default_time_step(design, lattice, fidelity.step) if dt is None else positive("dt", dt, caller)
    critical = POSTURES * STABLE_STEPS[fidelity.integrator] * default_time_step(design, lattice) / MARGIN
    if step > critical and not allow_unstable:
        study = " or, to study the instability, allow_unstable=True" if caller == "simulate" else ""
        raise InvalidParameterError(
            f"{caller}: dt = {step:.4g} s is above the critical step of {fidelity.integrator}, {critical:.4g} s; "
            f"use dt <= {MARGIN * critical:.4g}{study}"
        )
    return step


def positive(name: str, value: float, caller: str = "simulate") -> float:
    """``value`` as a float; InvalidParameterError if it is no finite number > 0."""
    if not is_number(value) or value <= 0:
        raise InvalidParameterError(f"{caller}: expected {name} to be a finite number > 0, got {value!r}")
    return float(value)
