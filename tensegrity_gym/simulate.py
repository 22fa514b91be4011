"""Hops: find the equilibrium, unlock the actuators, roll out, report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tensegrity_gym.batch import Progress, run_shares
from tensegrity_gym.core import rollout as kernel
from tensegrity_gym.core.lanes import lane_count, lanes_empty
from tensegrity_gym.design import Design
from tensegrity_gym.energies import centre_of_mass, elastic_energies, gravitational_energy, kinetic_energy
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.formfinding import Equilibria, form_find
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene
from tensegrity_gym.timestep import MARGIN, default_time_step
from tensegrity_gym.types import ENERGY_NAMES, Floats, HopStatus, Structure
from tensegrity_gym.version import MODEL_VERSION

#: Integrators: kernel, by how much of a step velocities trail positions, critical step over symplectic Euler's.
INTEGRATORS = {
    "symplectic_euler": (kernel.rollout_symplectic_euler, 0.5, 1.0),
    "velocity_verlet": (kernel.rollout_velocity_verlet, 0.0, 1.0),
    "runge_kutta": (kernel.rollout_runge_kutta, 0.0, float(np.sqrt(2.0))),
}
PRECISIONS = ("float64", "float32")
#: Steps between two looks at rest, blow-up and frames.
STRIDE = 32
#: A lattice is quiet below this kinetic energy over (total mass) g l: bars may tremble, but nothing can tip it over.
REST_ENERGY = 1e-3
#: It is at rest when quiet for this share of sqrt(l / g); what it still moves then is below 1 mm (docs/physics.md).
REST_TIME = 1.0
#: A take-off whose ballistic rise is below this share of l is no flight.
LEAST_RISE = 1e-3
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
    rest: Floats  #: at the end of the hop [m], shape (n, 2)
    touchdown: Floats  #: at the first impact after flight [m], shape (n, 2)
    rest_nodes: Floats  #: displacement of the mean of the nodes at the end (the paper's) [m], shape (n, 2)
    touchdown_nodes: Floats  #: likewise at touchdown [m], shape (n, 2)
    apex: Floats  #: highest rise of the centre of mass above its start [m], shape (n,)
    takeoff_time: Floats  #: since release [s], shape (n,)
    takeoff_velocity: Floats  #: of the centre of mass [m/s], shape (n, 3)
    touchdown_time: Floats  #: since release [s], shape (n,)
    flight_time: Floats  #: from take-off to touchdown, 0 without flight [s], shape (n,)
    end_time: Floats  #: since release [s], shape (n,)
    status: np.ndarray  #: HopStatus, shape (n,)
    failed_mass: np.ndarray  #: the mass that ran away in an unstable hop, else -1, shape (n,)
    energies: Floats  #: at release, take-off, touchdown, end [J], columns ENERGY_NAMES, shape (n, 4, 7)
    stored_energy: Floats  #: elastic energy at release, in the locked lattice [J], shape (n,)
    equilibria: Equilibria  #: what the hops started from
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
                residual = self.equilibria.residual[hop]
                lines.append(f"hop {hop}, stretches {stretches}: no equilibrium to start from, residual force {residual:.3g} N")
            else:
                lines.append(
                    f"hop {hop}, stretches {stretches}: the integration blew up by t = {self.end_time[hop]:.4g} s at mass "
                    f"{self.failed_mass[hop]} (kinetic energy out of all bounds or not finite) with dt = {self.dt:.4g} s; "
                    "use a smaller dt"
                )
        return lines

    @property
    def failed(self) -> np.ndarray:
        """Hops whose landing is no answer (unstable or never started), shape (n,)."""
        return self.status >= HopStatus.UNSTABLE


def simulate(
    stretches: ArrayLike,
    *,
    design: Design | None = None,
    scene: Scene | None = None,
    lattice: Lattice | None = None,
    dt: float | None = None,
    integrator: str = "symplectic_euler",
    precision: str = "float64",
    allow_unstable: bool = False,
    trajectory_rate: float | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
    equilibria: Equilibria | None = None,
) -> HopResult:
    """Hops of the lattice from the equilibria of ``stretches``, (n_actuators,) or (n, n_actuators).

    All actuators are unlocked at once at time 0 and the hop is followed to rest, at most for ``scene.duration``.

    * ``dt`` [s] defaults to 0.8 of the critical step and may not exceed that one unless ``allow_unstable``.
    * ``integrator`` is one of ``INTEGRATORS``.
    * ``precision`` "float32" runs 16 lanes instead of 8 and rounds positions to about 1e-7 m.
    * ``trajectory_rate`` [Hz] asks for frames; it changes nothing else.
    * ``equilibria`` of the same ``stretches`` save finding them again.
    * ``progress`` is called with the number of hops newly ended.

    A hop that fails says so in ``status`` (see ``describe_failures``); its neighbours go on.

    Raises InvalidStretchesError and InvalidParameterError.
    """
    design, scene, lattice = design or Design(), scene or Scene(), lattice or Lattice()
    if equilibria is None:
        equilibria = form_find(stretches, design=design, scene=scene, lattice=lattice, threads=threads)
    elif np.shape(np.atleast_2d(stretches)) != equilibria.stretches.shape or not np.allclose(stretches, equilibria.stretches):
        raise InvalidParameterError("simulate: expected the stretches that the equilibria were found for, got others")
    if integrator not in INTEGRATORS:
        raise InvalidParameterError(f"simulate: expected integrator in {sorted(INTEGRATORS)}, got {integrator!r}")
    if precision not in PRECISIONS:
        raise InvalidParameterError(f"simulate: expected precision in {PRECISIONS}, got {precision!r}")
    step = _time_step(dt, design, lattice, integrator, allow_unstable)
    rate = 0.0 if trajectory_rate is None else _positive("trajectory_rate", trajectory_rate)
    structure = design.structure(lattice)
    settings = _settings(structure, scene, design, step, INTEGRATORS[integrator][1], rate)
    # whatever the bars give back, kinetic energy stays below it plus the fall; ten times that is no physics
    weight = structure.mass.sum() * scene.gravity
    runaway = 10.0 * (equilibria.stored_energy + weight * (design.cell_height + scene.gravity * scene.duration**2))
    finite = np.isfinite(equilibria.positions).all(axis=(1, 2)) & np.isfinite(runaway)
    usable = equilibria.converged & finite
    # a hop without a start is not simulated, but what is reported of it must be finite
    starts = np.where(finite[:, None, None], equilibria.positions, design.unloaded_positions(lattice))
    parts = []
    for first in range(0, len(equilibria.stretches), CHUNK):
        chunk = slice(first, first + CHUNK)
        records = _records(starts[chunk], usable[chunk], runaway[chunk], settings)
        _roll_out(INTEGRATORS[integrator][0], structure, scene, settings, records, threads, progress, np.dtype(precision))
        parts.append(_measure(records, structure, scene, lattice, settings.lag * settings.dt))
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    frames = Trajectory(**{k[6:]: columns.pop(k) for k in list(columns) if k.startswith("frame_")})
    return HopResult(
        stretches=equilibria.stretches,
        landing=columns[scene.landing].copy(),
        stored_energy=equilibria.stored_energy,
        equilibria=equilibria,
        dt=step,
        trajectory=frames if rate else None,
        **columns,  # type: ignore[arg-type]
    )


def _time_step(dt: float | None, design: Design, lattice: Lattice, integrator: str, allow_unstable: bool) -> float:
    """``dt`` if it is stable, or the default step [s]."""
    gain = INTEGRATORS[integrator][2]
    default = default_time_step(design, lattice)
    if dt is None:
        return default
    step = _positive("dt", dt)
    critical = gain * default / MARGIN
    if step > critical and not allow_unstable:
        raise InvalidParameterError(
            f"simulate: dt = {step:.4g} s is above the critical step of {integrator}, {critical:.4g} s; "
            f"use dt <= {MARGIN * critical:.4g} or, to study the instability, allow_unstable=True"
        )
    return step


def _positive(name: str, value: float) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not np.isfinite(value) or value <= 0:
        raise InvalidParameterError(f"simulate: expected {name} to be a finite number > 0, got {value!r}")
    return float(value)


def _settings(structure: Structure, scene: Scene, design: Design, dt: float, lag: float, rate: float) -> kernel.HopSettings:
    weight_height = structure.mass.sum() * scene.gravity * design.cell_height
    blocks = int(np.ceil(scene.duration / dt / STRIDE))
    return kernel.HopSettings(
        dt=dt,
        lag=lag,
        max_steps=blocks * STRIDE,
        stride=STRIDE,
        rest_energy=REST_ENERGY * weight_height,
        rest_steps=int(np.ceil(REST_TIME * np.sqrt(design.cell_height / scene.gravity) / dt)),
        flight_speed=float(np.sqrt(2 * scene.gravity * LEAST_RISE * design.cell_height)),
        frame_stride=max(1, round(1.0 / (rate * dt * STRIDE))) * STRIDE if rate else 0,
    )


def _records(positions: Floats, usable: np.ndarray, runaway_energy: Floats, settings: kernel.HopSettings) -> kernel.HopRecords:
    n, m = positions.shape[:2]
    frames = settings.max_steps // settings.frame_stride if settings.frame_stride else 0
    state = np.zeros((n, 4, 2, m, 3))
    state[:, kernel.RELEASE, 0] = positions
    return kernel.HopRecords(
        state=state,
        time=np.zeros((n, 4)),
        dissipated=np.zeros((n, 4, 2)),
        touchdown_shift=np.zeros(n),
        height=np.zeros(n),
        steps=np.zeros(n, dtype=np.int64),
        runaway_energy=runaway_energy,
        status=np.where(usable, -1, int(HopStatus.NOT_CONVERGED)),
        failed_mass=np.full(n, -1, dtype=np.int64),
        frame_positions=np.zeros((n, frames, m, 3)),
        frame_times=np.zeros((n, frames)),
        frame_energies=np.zeros((n, frames, len(ENERGY_NAMES))),
        frame_count=np.zeros(n, dtype=np.int64),
    )


def hop_lanes(structure: Structure) -> kernel.LaneState:
    """Work arrays of one thread."""
    dtype = structure.mass.dtype
    count, n = lane_count(dtype), len(structure.mass)
    return kernel.LaneState(
        x=lanes_empty((n, 3), dtype),
        v=lanes_empty((n, 3), dtype),
        f=lanes_empty((n, 3), dtype),
        memory=lanes_empty((structure.n_axial_members,), dtype),
        mid=lanes_empty((n, 3), dtype),
        work=lanes_empty((4 * n, 3), dtype),
        one=np.zeros((3, n, 3), dtype),
        one_memory=np.zeros(structure.n_axial_members, dtype),
        actuator_length=lanes_empty((len(structure.actuators),), dtype),
        scalars=lanes_empty((kernel.N_SCALARS,), dtype),
        hop=np.zeros(count, dtype=np.int64),
        step=np.zeros(count, dtype=np.int64),
        quiet=np.zeros(count, dtype=np.int64),
        flown=np.zeros(count, dtype=np.bool_),
    )


def _roll_out(
    run: Callable[..., None],
    structure: Structure,
    scene: Scene,
    settings: kernel.HopSettings,
    records: kernel.HopRecords,
    threads: int | None,
    progress: Progress | None,
    dtype: np.dtype,
) -> None:
    n = len(records.status)
    typed = structure.astype(dtype)
    ground = scene.ground._replace(gravity=scene.gravity_vector.astype(dtype))

    def work(first: int, last: int, counter: np.ndarray) -> None:
        run(
            typed,
            ground,
            settings,
            typed.actuator_length,
            records,
            hop_lanes(typed),
            first,
            last,
            counter,
        )

    run_shares(work, n, threads, lane_count(dtype), progress)


def _measure(
    records: kernel.HopRecords, structure: Structure, scene: Scene, lattice: Lattice, trail: float
) -> dict[str, np.ndarray]:
    """What the events say: displacements, speeds, times and energies of a chunk of hops."""
    centre = centre_of_mass(structure, records.state)  # (n, 4, 2, 3)
    nodes = records.state[:, :, :, : lattice.n_nodes].mean(axis=3)
    start, end = kernel.RELEASE, kernel.END
    shift = records.touchdown_shift[:, None]
    flew = records.status <= HopStatus.TIME_LIMIT

    def touchdown(mean: Floats) -> Floats:
        at = mean[:, kernel.TOUCHDOWN, 0, :2] + shift * mean[:, kernel.TOUCHDOWN, 1, :2]
        return at - mean[:, start, 0, :2]

    touchdown_time = records.time[:, kernel.TOUCHDOWN] + records.touchdown_shift
    takeoff_time = records.time[:, kernel.TAKEOFF]
    takeoff_velocity = np.where(flew[:, None], centre[:, kernel.TAKEOFF, 1], 0.0)
    normal_gravity = -scene.gravity_vector[2]
    ballistic = centre[:, kernel.TAKEOFF, 0, 2] + takeoff_velocity[:, 2] ** 2 / (2 * normal_gravity)
    apex = np.where(flew, ballistic, np.maximum(records.height, centre[:, start, 0, 2])) - centre[:, start, 0, 2]
    return {
        "rest": centre[:, end, 0, :2] - centre[:, start, 0, :2],
        "touchdown": touchdown(centre),
        "rest_nodes": nodes[:, end, 0, :2] - nodes[:, start, 0, :2],
        "touchdown_nodes": touchdown(nodes),
        "apex": apex,
        "takeoff_time": takeoff_time,
        "takeoff_velocity": takeoff_velocity,
        "touchdown_time": touchdown_time,
        "flight_time": np.where(flew, touchdown_time - takeoff_time, 0.0),
        "end_time": records.time[:, end],
        "status": records.status,
        "failed_mass": records.failed_mass,
        "steps": records.steps,
        "energies": _event_energies(records, structure, scene, trail),
        "frame_times": records.frame_times,
        "frame_positions": records.frame_positions,
        "frame_energies": records.frame_energies,
        "frame_frames": records.frame_count,
    }


def _event_energies(records: kernel.HopRecords, structure: Structure, scene: Scene, trail: float) -> Floats:
    """Energies at the four events [J], columns ENERGY_NAMES, shape (n, 4, 7).

    Where velocities trail positions by ``trail`` [s], potential energies are means over the two ends of the step in whose
    middle the event's state is, as in the kernel.
    """
    n = len(records.status)
    energies = np.zeros((n, 4, len(ENERGY_NAMES)))
    lengths = np.broadcast_to(structure.actuator_length, (n, len(structure.actuator_length)))
    for event in range(4):
        positions, velocities = records.state[:, event, 0], records.state[:, event, 1]
        for end in (positions - trail * velocities, positions + trail * velocities):
            parts = elastic_energies(structure, end, lengths)
            parts["gravitational"] = gravitational_energy(structure, scene.gravity_vector, end)
            for name, values in parts.items():
                energies[:, event, ENERGY_NAMES.index(name)] += 0.5 * values
        energies[:, event, ENERGY_NAMES.index("kinetic")] = kinetic_energy(structure, velocities)
    energies[:, :, 5:] = records.dissipated
    return energies
