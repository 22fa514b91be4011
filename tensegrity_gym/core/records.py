"""What a rollout works on and what it leaves behind: settings, lanes, records, and how lanes are written into records."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tensegrity_gym.core.energy import actuator_energy, bar_energy, cable_energy, gravitational_energy, kinetic_energy
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import fma, load, load1, store, store1

RESTED, TIME_LIMIT, NO_FLIGHT, UNSTABLE, STOPPED = 0, 1, 2, 3, 5  # as types.HopStatus; numba takes plain integers
RELEASE, TAKEOFF, TOUCHDOWN, END = 0, 1, 2, 3  # rows of HopRecords.state
STANDING, FLYING, LANDED = 0, 1, 2  # phases of a hop


class HopSettings(NamedTuple):
    """How hops are stepped, watched and ended."""

    dt: float  #: step [s]
    lag: float  #: by how much of a step velocities trail positions: 0.5 for leapfrog, else 0
    stride: int  #: steps between two looks at rest, blow-up and frames
    rest_energy: float  #: kinetic energy below which a lattice on the ground counts as quiet [J]
    rest_steps: int  #: how long it must stay quiet [steps]
    flight_speed: float  #: vertical speed of the centre of mass from which leaving the ground counts as take-off [m/s]
    frame_stride: int  #: steps between two frames, a multiple of ``stride``; 0 for no frames
    stop: int  #: event after which a hop is followed no further: END (rest), TOUCHDOWN, or TAKEOFF
    clearance: float  #: how high the lowest mass of a flying lattice must be for TAKEOFF to be over [m]


class HopRecords(NamedTuple):
    """What each hop starts from (state at release, phase, max_steps, runaway_energy) and what it leaves behind.

    Events are release, take-off, touchdown and end.
    """

    phase: np.ndarray  #: STANDING, FLYING or LANDED, at the start and then at the end, shape (n,)
    max_steps: np.ndarray  #: longest hop [steps], a multiple of ``stride``, shape (n,)
    state: np.ndarray  #: positions [m] and velocities [m/s] at the events, shape (n, 4, 2, n_masses, 3)
    time: np.ndarray  #: of the events [s], shape (n, 4)
    dissipated: np.ndarray  #: by contact and by damping until the events [J], shape (n, 4, 2)
    shift: np.ndarray  #: from the take-off and touchdown states to the instants that contact ended and began [s], shape (n, 2)
    impacts: np.ndarray  #: times of the returns to the ground after touchdown [s], shape (n, n_impacts)
    impact_count: np.ndarray  #: of them, also those past n_impacts, shape (n,)
    height: np.ndarray  #: highest z of the centre of mass [m], shape (n,)
    steps: np.ndarray  #: steps taken, shape (n,)
    runaway_energy: np.ndarray  #: kinetic energy that no sane hop reaches [J], shape (n,)
    status: np.ndarray  #: HopStatus, shape (n,)
    failed_mass: np.ndarray  #: the mass that ran away in an unstable hop, else -1, shape (n,)
    failed_member: np.ndarray  #: the axial member with the wildest strain in an unstable hop, else -1, shape (n,)
    frame_positions: np.ndarray  #: [m], shape (n, n_frames, n_masses, 3); n_frames is 0 without frames
    frame_times: np.ndarray  #: [s], shape (n, n_frames)
    frame_energies: np.ndarray  #: [J], columns types.ENERGY_NAMES, shape (n, n_frames, 7)
    frame_count: np.ndarray  #: valid frames, shape (n,)


class LaneState(NamedTuple):
    """State of the lanes of one thread; the last axis is the lane."""

    x: np.ndarray  #: positions [m], shape (n_masses, 3, lanes)
    v: np.ndarray  #: velocities, ``lag`` of a step before [m/s], shape (n_masses, 3, lanes)
    f: np.ndarray  #: forces [N], shape (n_masses, 3, lanes)
    memory: np.ndarray  #: last damping force of each axial member [N], shape (n_axial_members, lanes)
    mid: np.ndarray  #: scratch positions [m], shape (n_masses, 3, lanes)
    scratch: np.ndarray  #: of the integrator, shape (4 n_masses, 3, lanes)
    one: np.ndarray  #: scratch for one lattice: positions, velocities, forces, shape (3, n_masses, 3)
    one_memory: np.ndarray  #: scratch for one lattice, shape (n_axial_members,)
    actuator_length: np.ndarray  #: natural lengths [m], shape (n_actuators, lanes)
    scalars: np.ndarray  #: rows named below, shape (N_SCALARS, lanes)
    hop: np.ndarray  #: which hop each lane runs, -1 for none, shape (lanes,)
    step: np.ndarray  #: steps it has taken, shape (lanes,)
    quiet: np.ndarray  #: for how many steps it has been quiet on the ground, shape (lanes,)
    phase: np.ndarray  #: STANDING, FLYING or LANDED, shape (lanes,)


KICK, CONTACT_LOSS, DAMPING_LOSS, AIRBORNE, LOWEST, KINETIC, HEIGHT, WAS_AIRBORNE, WAS_LOWEST = 0, 1, 2, 3, 4, 5, 6, 7, 8
FRAME = 9  # five rows of frame energies start here
N_SCALARS = 14


@jit(forceinline=False)
def save_event(settings, lanes, lane, records, hop, event, time):
    """Store a lane's state where its positions and velocities are synchronous, ``lag`` of a step ago."""
    trail = settings.lag * settings.dt
    for i in range(lanes.x.shape[0]):
        for c in range(3):
            velocity = lanes.v[i, c, lane]
            records.state[hop, event, 0, i, c] = lanes.x[i, c, lane] - trail * velocity
            records.state[hop, event, 1, i, c] = velocity
    records.time[hop, event] = time - trail
    records.dissipated[hop, event, 0] = lanes.scalars[CONTACT_LOSS, lane]
    records.dissipated[hop, event, 1] = lanes.scalars[DAMPING_LOSS, lane]


@jit(forceinline=False)
def copy_state(records, hop, source, target):
    """The state of one event for another."""
    for k in range(2):
        for i in range(records.state.shape[3]):
            for c in range(3):
                records.state[hop, target, k, i, c] = records.state[hop, source, k, i, c]


@jit(forceinline=False)
def frame_energies(structure, settings, ground, lanes):
    """Fill the five FRAME rows [J] with all lanes' energies at the instant that ``save_event`` takes.

    With leapfrog, potential energies are means over the step's two ends: with the kinetic energy between them that is what
    it keeps.
    """
    for row in range(5):
        store1(lanes.scalars, FRAME + row, load1(lanes.scalars, FRAME) * 0.0)
    for back in range(2):
        for i in range(structure.mass.shape[0]):
            for c in range(3):
                store(lanes.mid, i, c, fma(load(lanes.v, i, c), -2.0 * back * settings.lag * settings.dt, load(lanes.x, i, c)))
        _add_half(lanes, FRAME, bar_energy(structure, lanes.mid))
        _add_half(lanes, FRAME + 1, cable_energy(structure, lanes.mid))
        _add_half(lanes, FRAME + 2, actuator_energy(structure, lanes.actuator_length, lanes.mid))
        _add_half(lanes, FRAME + 4, gravitational_energy(structure, ground.gravity, lanes.mid))
    store1(lanes.scalars, FRAME + 3, kinetic_energy(structure, lanes.v))


@jit
def _add_half(lanes, row, energy):
    store1(lanes.scalars, row, fma(0.5, energy, load1(lanes.scalars, row)))


@jit(forceinline=False)
def save_frame(settings, lanes, lane, records, hop, time):
    """Append one frame of a lane; ``frame_energies`` must be fresh."""
    frame = records.frame_count[hop]
    if frame >= records.frame_times.shape[1]:
        return
    trail = settings.lag * settings.dt
    records.frame_times[hop, frame] = time - trail
    for i in range(lanes.x.shape[0]):
        for c in range(3):
            records.frame_positions[hop, frame, i, c] = lanes.x[i, c, lane] - trail * lanes.v[i, c, lane]
    for k in range(5):
        records.frame_energies[hop, frame, k] = lanes.scalars[FRAME + k, lane]
    records.frame_energies[hop, frame, 5] = lanes.scalars[CONTACT_LOSS, lane]
    records.frame_energies[hop, frame, 6] = lanes.scalars[DAMPING_LOSS, lane]
    records.frame_count[hop] = frame + 1


@jit(forceinline=False)
def runaway_mass(lanes, lane):
    """The first mass whose velocity is not finite, else the fastest."""
    fastest, found = -1.0, 0
    for i in range(lanes.v.shape[0]):
        square = lanes.v[i, 0, lane] ** 2 + lanes.v[i, 1, lane] ** 2 + lanes.v[i, 2, lane] ** 2
        if not square < 1e300:
            return i
        if square > fastest:
            fastest, found = square, i
    return found


@jit(forceinline=False)
def runaway_member(structure, lanes, lane):
    """The first axial member whose length is not finite, else the one of the largest strain; numbered as in ``memory``."""
    largest, found = -1.0, 0
    segments = structure.bars.shape[1] - 1
    n_segments, n_cables = structure.bars.shape[0] * segments, structure.cables.shape[0]
    for member in range(n_segments + n_cables + structure.actuators.shape[0]):
        if member < n_segments:
            bar, place = member // segments, member % segments
            i, j, natural = structure.bars[bar, place], structure.bars[bar, place + 1], structure.segment_length[bar]
        elif member < n_segments + n_cables:
            k = member - n_segments
            i, j, natural = structure.cables[k, 0], structure.cables[k, 1], structure.cable_length[k]
        else:
            k = member - n_segments - n_cables
            i, j, natural = structure.actuators[k, 0], structure.actuators[k, 1], structure.actuator_length[k]
        square = 0.0
        for c in range(3):
            square += (lanes.x[j, c, lane] - lanes.x[i, c, lane]) ** 2
        strain = abs(square**0.5 / natural - 1.0)
        if member >= n_segments and square < natural * natural:
            strain = 0.0  # slack
        if not strain < 1e30:
            return member
        if strain > largest:
            largest, found = strain, member
    return found


@jit(forceinline=False)
def end_hop(structure, settings, lanes, lane, records, hop, status, step, phase):
    """Store how a hop ended. A blown-up one ends where it started: a finite number that its status disowns."""
    records.status[hop] = status
    records.phase[hop] = phase
    records.steps[hop] = step
    records.height[hop] = lanes.scalars[HEIGHT, lane]
    if status == UNSTABLE:
        records.failed_mass[hop] = runaway_mass(lanes, lane)
        records.failed_member[hop] = runaway_member(structure, lanes, lane)
        copy_state(records, hop, RELEASE, END)
        records.height[hop] = 0.0
        records.time[hop, END] = step * settings.dt
    else:
        save_event(settings, lanes, lane, records, hop, END, step * settings.dt)
    if phase != LANDED:
        # still in flight: there was a take-off, and touchdown is as far as it got; no flight: neither was
        in_flight = phase == FLYING and (status == TIME_LIMIT or status == STOPPED)
        for event in range(TOUCHDOWN if in_flight else TAKEOFF, END):
            copy_state(records, hop, END, event)
            records.time[hop, event] = records.time[hop, END]
            records.dissipated[hop, event, 0] = records.dissipated[hop, END, 0]
            records.dissipated[hop, event, 1] = records.dissipated[hop, END, 1]
            records.shift[hop, event - TAKEOFF] = 0.0
