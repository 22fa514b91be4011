"""Batches of rollouts: what the kernel needs of a scene and a fidelity, in lanes and over threads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tensegrity_gym.batch import Progress, dealt, run_shares, shares, thread_count
from tensegrity_gym.core import records as rec
from tensegrity_gym.core import rollout as kernel
from tensegrity_gym.core.flight import fly_rigidly
from tensegrity_gym.core.lanes import lane_count
from tensegrity_gym.design import Design
from tensegrity_gym.energies import centre_of_mass, elastic_energies, gravitational_energy, kinetic_energy
from tensegrity_gym.fidelity import Fidelity
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene
from tensegrity_gym.types import ENERGY_NAMES, Floats, Ground, HopStatus, Structure
from tensegrity_gym.workspaces import hop_lanes, without_lanes

#: Integrators: kernel, and by how much of a step velocities trail positions.
INTEGRATORS: dict[str, tuple[Any, float]] = {
    "symplectic_euler": (kernel.rollout_symplectic_euler, 0.5),
    "velocity_verlet": (kernel.rollout_velocity_verlet, 0.0),
    "runge_kutta": (kernel.rollout_runge_kutta, 0.0),
}
#: Steps between two looks at rest, blow-up and frames.
STRIDE = 32
#: A lattice is quiet below this kinetic energy over (total mass) g l: bars may tremble, but nothing can tip it over.
REST_ENERGY = 1e-3
#: It is at rest when quiet for this share of sqrt(l / g); what it still moves then is below 1 mm (docs/physics.md).
REST_TIME = 1.0
#: A take-off whose ballistic rise is below this share of l is no flight.
LEAST_RISE = 1e-3
#: Up to so many hops a thread are followed one after another, without lanes: eight at once cost as much as some alone.
ALONE = 1
#: Returns to the ground after touchdown whose times are kept.
N_IMPACTS = 8


@dataclass(frozen=True)
class Problem:
    """One batch's lattice, scene and fidelity, as the kernels see them."""

    structure: Structure
    ground: Ground
    scene: Scene
    fidelity: Fidelity
    cell_height: float  #: l [m]
    shape: Floats  #: the unloaded lattice about its centre of mass [m], shape (n_masses, 3)
    dt: float  #: step [s]
    frame_stride: int  #: steps between two frames, 0 for none

    @classmethod
    def of(cls, design: Design, scene: Scene, lattice: Lattice, fidelity: Fidelity, dt: float, rate: float) -> Problem:
        """``design`` is the fidelity's; ``rate`` of frames [Hz], 0 for none."""
        structure = design.structure(lattice)
        shape = design.unloaded_positions(lattice)
        ground = scene.ground
        if fidelity.contact == "nodes":
            ground = ground._replace(masses=lattice.n_nodes)
        return cls(
            structure=structure,
            ground=ground,
            scene=scene,
            fidelity=fidelity,
            cell_height=design.cell_height,
            shape=shape - centre_of_mass(structure, shape),
            dt=dt,
            frame_stride=max(1, round(1.0 / (rate * dt * STRIDE))) * STRIDE if rate else 0,
        )

    @property
    def trail(self) -> float:
        """By how much velocities trail positions [s]."""
        return INTEGRATORS[self.fidelity.integrator][1] * self.dt

    @property
    def max_steps(self) -> int:
        """Steps of the scene's duration, in whole strides."""
        return int(np.ceil(self.scene.duration / self.dt / STRIDE)) * STRIDE

    def settings(self, stop: int) -> rec.HopSettings:
        """How the kernel steps, watches and ends hops that are followed as far as ``stop``."""
        gravity, height = self.scene.gravity, self.cell_height
        return rec.HopSettings(
            dt=self.dt,
            lag=INTEGRATORS[self.fidelity.integrator][1],
            stride=STRIDE,
            rest_energy=REST_ENERGY * float(self.structure.mass.sum()) * gravity * height,
            rest_steps=int(np.ceil(REST_TIME * np.sqrt(height / gravity) / self.dt)),
            flight_speed=float(np.sqrt(2 * gravity * LEAST_RISE * height)),
            frame_stride=self.frame_stride,
            stop=stop,
            clearance=self.fidelity.clearance * height,
        )

    def energies(self, positions: Floats, velocities: Floats) -> dict[str, Floats]:
        """Elastic, kinetic and gravitational energies of unlocked lattices [J], shape (n,) each, by ENERGY_NAMES.

        Where velocities trail positions, potential energies are means over the two ends of the step in whose middle the state
        is, as in the kernel.
        """
        lengths = np.broadcast_to(self.structure.actuator_length, (len(positions), len(self.structure.actuator_length)))
        sums: dict[str, Floats] = {name: np.zeros(len(positions)) for name in ENERGY_NAMES[:5]}
        for end in (positions - self.trail * velocities, positions + self.trail * velocities):
            parts = elastic_energies(self.structure, end, lengths)
            parts["gravitational"] = gravitational_energy(self.structure, self.ground.gravity, end)
            for name, values in parts.items():
                sums[name] += 0.5 * values
        sums["kinetic"] = kinetic_energy(self.structure, velocities)
        return sums

    def total_energy(self, states: Floats) -> Floats:
        """Sum of :meth:`energies` of states (n, 2, n_masses, 3) [J], shape (n,)."""
        return np.sum(list(self.energies(states[:, 0], states[:, 1]).values()), axis=0)


def follow(
    problem: Problem,
    starts: Floats,
    phase: int,
    usable: np.ndarray,
    runaway: Floats,
    threads: int | None,
    progress: Progress | None,
) -> rec.HopRecords:
    """Follow hops from ``starts``, shape (n, 2, n_masses, 3) [m, m/s], as far and as finely as the fidelity says.

    ``phase`` is the kernel's STANDING or FLYING; hops that are not ``usable`` are not simulated; ``runaway`` is a kinetic
    energy that no sane hop reaches [J], shape (n,).
    """
    fidelity = problem.fidelity
    to_rest = fidelity.stop == "rest" or problem.scene.landing == "rest"
    last = rec.END if to_rest else rec.TOUCHDOWN
    records = _records(problem, starts, phase, usable, runaway)
    if fidelity.flight == "full":
        _roll_out(problem, last, records, threads, progress)
    else:
        _roll_out(problem, rec.TAKEOFF, records, threads, None if to_rest else progress)
        _fly(problem, records)
        if to_rest:
            _go_on(problem, records, runaway, threads, progress)
    # the kernel does not tell hops that have come down from those that have not: neither goes on
    records.status[(records.status == HopStatus.TIME_LIMIT) & (records.phase == rec.FLYING)] = HopStatus.IN_FLIGHT
    return records


def _records(problem: Problem, starts: Floats, phase: int, usable: np.ndarray, runaway: Floats) -> rec.HopRecords:
    n, m = starts.shape[0], starts.shape[2]
    frames = problem.max_steps // problem.frame_stride if problem.frame_stride else 0
    state = np.zeros((n, 4, 2, m, 3))
    state[:, rec.RELEASE] = starts
    if phase != rec.STANDING:
        state[:, rec.TAKEOFF] = starts
    return rec.HopRecords(
        phase=np.full(n, phase, dtype=np.int64),
        max_steps=np.full(n, problem.max_steps, dtype=np.int64),
        state=state,
        time=np.zeros((n, 4)),
        dissipated=np.zeros((n, 4, 2)),
        shift=np.zeros((n, 2)),
        impacts=np.full((n, N_IMPACTS), np.nan),
        impact_count=np.zeros(n, dtype=np.int64),
        height=np.zeros(n),
        steps=np.zeros(n, dtype=np.int64),
        runaway_energy=runaway,
        status=np.where(usable, -1, int(HopStatus.NOT_CONVERGED)),
        failed_mass=np.full(n, -1, dtype=np.int64),
        failed_member=np.full(n, -1, dtype=np.int64),
        frame_positions=np.zeros((n, frames, m, 3)),
        frame_times=np.zeros((n, frames)),
        frame_energies=np.zeros((n, frames, len(ENERGY_NAMES))),
        frame_count=np.zeros(n, dtype=np.int64),
    )


def _roll_out(problem: Problem, stop: int, records: rec.HopRecords, threads: int | None, progress: Progress | None) -> None:
    dtype = np.dtype(problem.fidelity.precision)
    typed = problem.structure.astype(dtype)
    ground = problem.ground._replace(gravity=problem.ground.gravity.astype(dtype))
    run, settings = INTEGRATORS[problem.fidelity.integrator][0], problem.settings(stop)
    n = len(records.status)
    count = 1 if n <= ALONE * thread_count(threads) else lane_count(dtype)

    # what stores least stays on the ground longest: begun first, it leaves no lanes idle at the end
    first_to_last = np.argsort(records.runaway_energy, kind="stable") if stop == rec.TAKEOFF else np.arange(n)
    order = dealt(first_to_last, len(shares(n, thread_count(threads), count)))

    def work(first: int, last: int, counter: np.ndarray) -> None:
        lanes = hop_lanes(typed, count)
        kernel_lanes = without_lanes(lanes) if count == 1 else lanes
        run(typed, ground, settings, typed.actuator_length, records, order, lanes, kernel_lanes, first, last, counter)

    run_shares(work, n, threads, count, progress)


def _fly(problem: Problem, records: rec.HopRecords) -> None:
    """Take every hop that stopped in the air to its touchdown, which becomes its end for now.

    The energy of the vibration that is frozen counts as dissipated by damping.
    """
    limit = problem.max_steps * problem.dt
    aloft = np.flatnonzero((records.status == HopStatus.STOPPED) & (records.phase == rec.FLYING))
    if not len(aloft):
        return
    before = problem.total_energy(records.state[aloft, rec.END])
    seen = records.frame_count[aloft].copy()
    for hop in aloft:
        start = records.time[hop, rec.END]
        done, room = int(records.frame_count[hop]), records.frame_times.shape[1]
        times = problem.frame_stride * problem.dt * np.arange(done + 1, room + 1) - problem.trail - start
        frames = np.zeros((len(times), 2, *problem.shape.shape))
        flown, landed, count = fly_rigidly(
            problem.structure.mass,
            problem.shape,
            problem.ground.gravity,
            min(problem.ground.masses, len(problem.shape)),
            records.state[hop, rec.END],
            max(limit - start, 0.0),
            times,
            frames,
        )
        records.time[hop, rec.END] = start + flown
        _add_frames(problem, records, hop, start + times[:count], frames[:count])
        if landed:
            records.phase[hop] = rec.LANDED
        else:
            records.status[hop] = HopStatus.TIME_LIMIT
    frozen = before - problem.total_energy(records.state[aloft, rec.END])
    records.dissipated[aloft, rec.END, 1] += frozen
    for hop, first, energy in zip(aloft, seen, frozen, strict=True):
        records.frame_energies[hop, first : records.frame_count[hop], 6] += energy
    for name in ("state", "time", "dissipated"):
        getattr(records, name)[aloft, rec.TOUCHDOWN] = getattr(records, name)[aloft, rec.END]
    records.shift[aloft, 1] = 0.0


def _add_frames(problem: Problem, records: rec.HopRecords, hop: np.integer, times: Floats, states: Floats) -> None:
    """Append frames of a rigid flight, states (k, 2, n_masses, 3); what was dissipated is what it was at its start."""
    if not len(times):
        return
    frames = slice(records.frame_count[hop], records.frame_count[hop] + len(times))
    records.frame_times[hop, frames] = times
    records.frame_positions[hop, frames] = states[:, 0]
    for name, values in problem.energies(states[:, 0], states[:, 1]).items():
        records.frame_energies[hop, frames, ENERGY_NAMES.index(name)] = values
    records.frame_energies[hop, frames, 5:] = records.dissipated[hop, rec.END]
    records.frame_count[hop] = frames.stop


def _go_on(problem: Problem, records: rec.HopRecords, runaway: Floats, threads: int | None, progress: Progress | None) -> None:
    """Follow the hops that stopped after touchdown to their rest."""
    landed = (records.status == HopStatus.STOPPED) & (records.phase == rec.LANDED)
    rest = _records(problem, records.state[:, rec.END], rec.LANDED, landed, runaway)
    offset, dissipated = records.time[:, rec.END].copy(), records.dissipated[:, rec.END].copy()
    rest.max_steps[:] = np.maximum(STRIDE, (problem.max_steps - offset / problem.dt) // STRIDE * STRIDE)
    _roll_out(problem, rec.END, rest, threads, progress)
    records.state[landed, rec.END] = rest.state[landed, rec.END]
    records.time[landed, rec.END] = (offset + rest.time[:, rec.END])[landed]
    records.dissipated[landed, rec.END] += rest.dissipated[landed, rec.END]
    records.impacts[landed] = (offset[:, None] + rest.impacts)[landed]
    for name in ("impact_count", "status", "failed_mass", "failed_member"):
        getattr(records, name)[landed] = getattr(rest, name)[landed]
    records.steps[landed] += rest.steps[landed]
    for hop in np.flatnonzero(landed):
        done = records.frame_count[hop]
        count = min(rest.frame_count[hop], records.frame_times.shape[1] - done)
        records.frame_times[hop, done : done + count] = offset[hop] + rest.frame_times[hop, :count]
        records.frame_positions[hop, done : done + count] = rest.frame_positions[hop, :count]
        records.frame_energies[hop, done : done + count] = rest.frame_energies[hop, :count]
        records.frame_energies[hop, done : done + count, 5:] += dissipated[hop]
        records.frame_count[hop] = done + count
    failed = landed & (rest.status == HopStatus.UNSTABLE)
    records.state[failed, rec.END] = records.state[failed, rec.RELEASE]  # a finite number that its status disowns
