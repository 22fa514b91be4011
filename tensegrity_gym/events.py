"""What the events of a rollout say: displacements, speeds, times and energies of hops."""

from __future__ import annotations

import numpy as np

from tensegrity_gym.core import records as rec
from tensegrity_gym.energies import centre_of_mass
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.rollouts import Problem
from tensegrity_gym.types import ENERGY_NAMES, Floats, HopStatus


def flew(status: np.ndarray) -> np.ndarray:
    """Which hops took off."""
    return np.isin(status, (HopStatus.RESTED, HopStatus.TIME_LIMIT, HopStatus.STOPPED, HopStatus.IN_FLIGHT))


def measure(records: rec.HopRecords, problem: Problem, lattice: Lattice) -> dict[str, np.ndarray]:
    """Columns of HopResult and, under "frame_...", of Trajectory."""
    centre = centre_of_mass(problem.structure, records.state)  # (n, 4, 2, 3)
    nodes = records.state[:, :, :, : lattice.n_nodes].mean(axis=3)
    start, takeoff, touchdown, end = rec.RELEASE, rec.TAKEOFF, rec.TOUCHDOWN, rec.END
    took_off = flew(records.status)
    followed = records.status != HopStatus.STOPPED

    def at_touchdown(mean: Floats) -> Floats:
        at = mean[:, touchdown, 0, :2] + records.shift[:, 1:] * mean[:, touchdown, 1, :2]
        return at - mean[:, start, 0, :2]

    def at_rest(mean: Floats) -> Floats:
        return np.where(followed[:, None], mean[:, end, 0, :2] - mean[:, start, 0, :2], np.nan)

    takeoff_time, touchdown_time = (records.time[:, (takeoff, touchdown)] + records.shift).T
    gravity = problem.ground.gravity
    # from the saved state back to the instant of take-off: the centre of mass falls freely
    velocity = np.where(took_off[:, None], centre[:, takeoff, 1] + records.shift[:, :1] * gravity, 0.0)
    # a drop may begin on its way down: it has been highest at its start
    rising = np.maximum(centre[:, takeoff, 1, 2], 0.0)
    ballistic = centre[:, takeoff, 0, 2] + rising**2 / (-2 * gravity[2])
    top = np.where(took_off, ballistic, np.maximum(records.height, centre[:, start, 0, 2]))
    return {
        "rest": at_rest(centre),
        "touchdown": at_touchdown(centre),
        "rest_nodes": at_rest(nodes),
        "touchdown_nodes": at_touchdown(nodes),
        "apex": top - centre[:, start, 0, 2],
        "apex_time": np.where(took_off, takeoff_time - np.maximum(velocity[:, 2], 0.0) / gravity[2], np.nan),
        "takeoff_time": takeoff_time,
        "takeoff_velocity": velocity,
        "touchdown_time": touchdown_time,
        "flight_time": np.where(took_off, touchdown_time - takeoff_time, 0.0),
        "impacts": records.impacts,
        "impact_count": records.impact_count,
        "end_time": records.time[:, end],
        "end_nodes": records.state[:, end, 0, : lattice.n_nodes],
        "status": records.status,
        "failed_mass": records.failed_mass,
        "failed_member": records.failed_member,
        "steps": records.steps,
        "energies": event_energies(records, problem),
        "frame_times": records.frame_times,
        "frame_positions": records.frame_positions,
        "frame_energies": records.frame_energies,
        "frame_frames": records.frame_count,
    }


def event_energies(records: rec.HopRecords, problem: Problem) -> Floats:
    """Energies at the four events [J], columns ENERGY_NAMES, shape (n, 4, 7)."""
    energies = np.zeros((len(records.status), 4, len(ENERGY_NAMES)))
    for event in range(4):
        parts = problem.energies(records.state[:, event, 0], records.state[:, event, 1])
        for name, values in parts.items():
            energies[:, event, ENERGY_NAMES.index(name)] = values
    energies[:, :, 5:] = records.dissipated
    return energies
