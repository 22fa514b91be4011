"""A batch of hops: each lane runs one hop from release to rest and then takes the next one from the queue.

Lanes never see each other, so a hop gives the same bits whatever its lane, its neighbours, its thread or the batch's order.
"""

from __future__ import annotations

from tensegrity_gym.core.energy import kinetic_energy
from tensegrity_gym.core.forces import lattice_forces
from tensegrity_gym.core.integrators import runge_kutta_step, symplectic_euler_step, velocity_verlet_step
from tensegrity_gym.core.jit import jit
from tensegrity_gym.core.lanes import any_lane, fma, load, load1, select, splat, store1
from tensegrity_gym.core.records import (
    AIRBORNE,
    CONTACT_LOSS,
    DAMPING_LOSS,
    END,
    FLYING,
    HEIGHT,
    KICK,
    KINETIC,
    LANDED,
    LOWEST,
    N_SCALARS,
    NO_FLIGHT,
    RELEASE,
    RESTED,
    STANDING,
    STOPPED,
    TAKEOFF,
    TIME_LIMIT,
    TOUCHDOWN,
    UNSTABLE,
    WAS_AIRBORNE,
    WAS_LOWEST,
    copy_state,
    end_hop,
    frame_energies,
    save_event,
    save_frame,
)


@jit
def load_hop(forces, structure, ground, actuator_length, lanes, lane, start, dt):
    """Put a hop with positions and velocities ``start`` (2, n_masses, 3) into a lane, with the forces that act there."""
    x, v, f = lanes.one[0], lanes.one[1], lanes.one[2]
    lowest = 1e30
    for i in range(start.shape[1]):
        for c in range(3):
            x[i, c] = start[0, i, c]
            v[i, c] = start[1, i, c]
        lowest = min(lowest, start[0, i, 2])
    for row in range(lanes.memory.shape[0]):
        lanes.one_memory[row] = 0.0
        lanes.memory[row, lane] = 0.0
    forces(structure, actuator_length, ground.gravity, x, v, f, lanes.one_memory)
    for i in range(start.shape[1]):
        for c in range(3):
            lanes.x[i, c, lane] = x[i, c]
            lanes.v[i, c, lane] = v[i, c]
            lanes.f[i, c, lane] = f[i, c]
    for row in range(N_SCALARS):
        lanes.scalars[row, lane] = 0.0
    lanes.scalars[KICK, lane] = 0.5 * dt  # leapfrog start: velocities live half a step behind
    lanes.scalars[LOWEST, lane] = lowest
    lanes.scalars[AIRBORNE, lane] = 1.0 if lowest > 0.0 else 0.0
    lanes.scalars[HEIGHT, lane] = -1e30


@jit(forceinline=False)
def vertical_velocity(structure, lanes, lane):
    """Vertical velocity of the centre of mass of one lane [m/s]."""
    momentum, mass = 0.0, 0.0
    for i in range(structure.mass.shape[0]):
        momentum += structure.mass[i] * lanes.v[i, 2, lane]
        mass += structure.mass[i]
    return momentum / mass


@jit(forceinline=False)
def contact_change(structure, settings, lanes, lane, records, hop, phase, time):
    """A lane left the ground or came back to it in the last step; returns its phase from now on.

    Take-off is the last departure before touchdown; touchdown the first contact while the centre of mass descends. A foot
    that still pushes while the body rises is no landing, and a tremble of the standing lattice is no flight. Instants lie
    where the straight path of the lowest mass between two steps meets the ground.
    """
    before, after = lanes.scalars[WAS_LOWEST, lane], lanes.scalars[LOWEST, lane]
    # of the step that has just ended, this much lies behind the instant; the saved state is lag dt before its end
    shift = settings.dt * (before / (before - after) - 1.0 + settings.lag)
    airborne = lanes.scalars[AIRBORNE, lane] > 0.0
    if phase == LANDED:
        if not airborne:
            if records.impact_count[hop] < records.impacts.shape[1]:
                records.impacts[hop, records.impact_count[hop]] = time - settings.lag * settings.dt + shift
            records.impact_count[hop] += 1
        return LANDED
    speed = vertical_velocity(structure, lanes, lane)
    if airborne:
        if speed <= settings.flight_speed:
            return phase
        save_event(settings, lanes, lane, records, hop, TAKEOFF, time)
        records.shift[hop, 0] = shift
        return FLYING
    if phase == STANDING or speed >= 0.0:
        return phase
    save_event(settings, lanes, lane, records, hop, TOUCHDOWN, time)
    records.shift[hop, 1] = shift
    return LANDED


@jit
def watch(structure, lanes):
    """Fill the rows KINETIC and HEIGHT [J, m] of all lanes."""
    store1(lanes.scalars, KINETIC, kinetic_energy(structure, lanes.v))
    moment = load(lanes.x, 0, 2) * 0.0
    mass = 0.0
    for i in range(structure.mass.shape[0]):
        moment = fma(structure.mass[i], load(lanes.x, i, 2), moment)
        mass += structure.mass[i]
    height = moment / mass
    previous = load1(lanes.scalars, HEIGHT)
    store1(lanes.scalars, HEIGHT, select(height > previous, height, previous))


@jit(forceinline=False)
def verdict(settings, lanes, lane, records, hop, step, quiet, phase):
    """HopStatus with which a lane's hop ends now, or -1 while it goes on."""
    kinetic = lanes.scalars[KINETIC, lane]
    if not kinetic < records.runaway_energy[hop]:  # also true of NaN
        return UNSTABLE
    airborne = lanes.scalars[AIRBORNE, lane] > 0.0
    if settings.stop != END and phase == LANDED:
        return STOPPED
    if settings.stop == TAKEOFF and phase == FLYING and airborne and lanes.scalars[LOWEST, lane] > settings.clearance:
        return STOPPED
    if quiet >= settings.rest_steps:
        return RESTED if phase == LANDED else NO_FLIGHT
    if step >= records.max_steps[hop]:
        return TIME_LIMIT if phase == LANDED or (phase == FLYING and airborne) else NO_FLIGHT
    return -1


@jit(forceinline=False)
def next_hop(records, order, queue, last):
    """First place of ``order`` from ``queue`` on whose hop has an equilibrium to start from; the others end where they are."""
    while queue < last and records.status[order[queue]] >= 0:
        for event in (TAKEOFF, TOUCHDOWN, END):
            copy_state(records, order[queue], RELEASE, event)
        queue += 1
    return queue


@jit
def rollout(
    forces, step_function, structure, ground, settings, actuator_length, records, order, lanes, work, first, last, progress
):
    """Run hops ``order[first]`` to ``order[last - 1]`` of ``records`` from their release states in one thread's lanes.

    ``work`` is ``lanes``, or of a single lane the same memory without its axis: the steps then compute one lattice only.
    ``actuator_length`` [m], shape (n_actuators,), are the unlocked natural lengths; ``progress[0]`` counts ended hops.
    """
    count = lanes.x.shape[2]
    dt = settings.dt
    hop, step, quiet, phase = lanes.hop, lanes.step, lanes.quiet, lanes.phase
    queue = first
    running = 0
    for lane in range(count):
        hop[lane] = -1
        step[lane] = 0
        quiet[lane] = 0
        phase[lane] = STANDING
        for k in range(actuator_length.shape[0]):
            lanes.actuator_length[k, lane] = actuator_length[k]
        # idle lanes must hold a sane lattice too
        load_hop(forces, structure, ground, actuator_length, lanes, lane, records.state[order[first], RELEASE], dt)
        queue = next_hop(records, order, queue, last)
        if queue < last:
            hop[lane] = order[queue]
            phase[lane] = records.phase[hop[lane]]
            load_hop(forces, structure, ground, actuator_length, lanes, lane, records.state[hop[lane], RELEASE], dt)
            queue += 1
            running += 1
    while running > 0:
        for k in range(settings.stride):
            kick = load1(work.scalars, KICK)
            power, lost, lowest = step_function(
                forces,
                structure,
                work.actuator_length,
                ground,
                dt,
                kick,
                work.x,
                work.v,
                work.f,
                work.memory,
                work.scratch,
            )
            store1(work.scalars, KICK, splat(dt, kick))
            store1(work.scalars, CONTACT_LOSS, load1(work.scalars, CONTACT_LOSS) + lost)
            store1(work.scalars, DAMPING_LOSS, fma(power, dt, load1(work.scalars, DAMPING_LOSS)))
            was = load1(work.scalars, AIRBORNE)
            now = select(lowest > 0.0, splat(1.0, was), splat(0.0, was))
            changed = (was < now) | (was > now)
            if any_lane(changed):
                store1(work.scalars, AIRBORNE, now)
                store1(work.scalars, WAS_AIRBORNE, was)
                store1(work.scalars, WAS_LOWEST, load1(work.scalars, LOWEST))
                store1(work.scalars, LOWEST, lowest)
                for lane in range(count):
                    if hop[lane] >= 0 and lanes.scalars[WAS_AIRBORNE, lane] != lanes.scalars[AIRBORNE, lane]:
                        time = (step[lane] + k + 1) * dt
                        phase[lane] = contact_change(structure, settings, lanes, lane, records, hop[lane], phase[lane], time)
            store1(work.scalars, LOWEST, lowest)
        watch(structure, work)
        frames_due = False
        for lane in range(count):
            step[lane] += settings.stride
            # no look at contact: a lattice that trembles leaves the ground by micrometres, one in free fall is not slow for long
            still = lanes.scalars[KINETIC, lane] < settings.rest_energy
            quiet[lane] = quiet[lane] + settings.stride if still else 0
            if settings.frame_stride > 0 and hop[lane] >= 0 and step[lane] % settings.frame_stride == 0:
                frames_due = True
        if frames_due:
            frame_energies(structure, settings, ground, work)
        for lane in range(count):
            if hop[lane] < 0:
                continue
            if frames_due and step[lane] % settings.frame_stride == 0:
                save_frame(settings, lanes, lane, records, hop[lane], step[lane] * dt)
            status = verdict(settings, lanes, lane, records, hop[lane], step[lane], quiet[lane], phase[lane])
            if status < 0:
                continue
            end_hop(structure, settings, lanes, lane, records, hop[lane], status, step[lane], phase[lane])
            progress[0] += 1
            hop[lane] = -1
            running -= 1
            queue = next_hop(records, order, queue, last)
            if queue < last:
                hop[lane] = order[queue]
                queue += 1
                running += 1
                step[lane] = 0
                quiet[lane] = 0
                phase[lane] = records.phase[hop[lane]]
                start = records.state[hop[lane], RELEASE]
                load_hop(forces, structure, ground, actuator_length, lanes, lane, start, dt)


@jit(cache=True)
def rollout_symplectic_euler(structure, ground, settings, actuator_length, records, order, lanes, work, first, last, progress):
    """:func:`rollout` of the lattice by symplectic Euler, compiled once and cached."""
    rollout(
        lattice_forces,
        symplectic_euler_step,
        structure,
        ground,
        settings,
        actuator_length,
        records,
        order,
        lanes,
        work,
        first,
        last,
        progress,
    )


@jit(cache=True)
def rollout_velocity_verlet(structure, ground, settings, actuator_length, records, order, lanes, work, first, last, progress):
    """:func:`rollout` of the lattice by velocity Verlet, compiled once and cached."""
    rollout(
        lattice_forces,
        velocity_verlet_step,
        structure,
        ground,
        settings,
        actuator_length,
        records,
        order,
        lanes,
        work,
        first,
        last,
        progress,
    )


@jit(cache=True)
def rollout_runge_kutta(structure, ground, settings, actuator_length, records, order, lanes, work, first, last, progress):
    """:func:`rollout` of the lattice by the classical Runge-Kutta method, compiled once and cached."""
    rollout(
        lattice_forces,
        runge_kutta_step,
        structure,
        ground,
        settings,
        actuator_length,
        records,
        order,
        lanes,
        work,
        first,
        last,
        progress,
    )
