"""Work arrays of hops and of the searches for equilibria: lanes of lattices, or a single one."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from tensegrity_gym.core import conjugate_gradient, newton, relaxation
from tensegrity_gym.core.conjugate_gradient import DescentLanes
from tensegrity_gym.core.descent import DescentCases, GroundLanes
from tensegrity_gym.core.lanes import lane_count, lanes_empty
from tensegrity_gym.core.newton import NewtonLanes
from tensegrity_gym.core.records import N_SCALARS, LaneState
from tensegrity_gym.core.relaxation import RelaxationLanes
from tensegrity_gym.types import Floats, Structure

#: Up to so many equilibria are found one after another, without lanes: eight at once cost as much as some alone.
ALONE = 2


def lanes_for(n: int) -> int:
    """How many of ``n`` equilibria each thread looks for at a time."""
    return 1 if n <= ALONE else lane_count(np.float64)


def lane_array(count: int, *shape: int, dtype: Any = np.float64) -> np.ndarray:
    """Zeros of ``shape + (count,)``; ``count`` is that of a vector's lanes, or one."""
    return lanes_empty(shape, dtype) if count == lane_count(dtype) else np.zeros((*shape, count), dtype)


Lanes = TypeVar("Lanes", LaneState, NewtonLanes, DescentLanes, RelaxationLanes, GroundLanes)


def without_lanes(lanes: Lanes) -> Lanes:
    """The work arrays of a single lane, seen without their lane axis; lists of the lanes, and what has no lanes, stay."""
    arrays = {name: array for name, array in lanes._asdict().items() if array.ndim > 1 and array.shape[-1] == 1}
    return lanes._replace(**{name: array.reshape(array.shape[:-1]) for name, array in arrays.items()})


def hop_lanes(structure: Structure, count: int) -> LaneState:
    """Work arrays of one thread for ``count`` hops at a time."""
    dtype, n = structure.mass.dtype, len(structure.mass)

    def array(*shape: int) -> np.ndarray:
        return lane_array(count, *shape, dtype=dtype)

    return LaneState(
        x=array(n, 3),
        v=array(n, 3),
        f=array(n, 3),
        memory=array(structure.n_axial_members),
        mid=array(n, 3),
        scratch=array(4 * n, 3),
        one=np.zeros((3, n, 3), dtype),
        one_memory=np.zeros(structure.n_axial_members, dtype),
        actuator_length=array(len(structure.actuators)),
        scalars=array(N_SCALARS),
        hop=np.zeros(count, dtype=np.int64),
        step=np.zeros(count, dtype=np.int64),
        quiet=np.zeros(count, dtype=np.int64),
        phase=np.zeros(count, dtype=np.int64),
    )


def newton_lanes(n_masses: int, members: int, unloaded_length: Floats, n_slots: int, count: int) -> NewtonLanes:
    """Work arrays of one thread for ``count`` lattices at a time: as many as a vector has lanes, or one."""
    actuators = len(unloaded_length)
    return NewtonLanes(
        x=lane_array(count, n_masses, 3),
        anchor=lane_array(count, n_masses, 3),
        still=lane_array(count, n_masses, 3),
        f=lane_array(count, n_masses, 3),
        memory=lane_array(count, members),
        d=lane_array(count, n_masses, 3),
        h=lane_array(count, n_slots, 9),
        actuator_length=lane_array(count, actuators),
        unloaded_length=unloaded_length,
        scalars=lane_array(count, newton.N_SCALARS),
        case=np.zeros(count, dtype=np.int64),
        iterations=np.zeros(count, dtype=np.int64),
        share=np.zeros(count),
        rounds=np.zeros(count, dtype=np.int64),
        tension=lane_array(count, members),
        anchor_tension=lane_array(count, members),
        strayed=np.zeros(count, dtype=np.int64),
        held=lane_array(count, n_masses),
    )


def ground_lanes(structure: Structure, cases: DescentCases, count: int, first: int, last: int) -> GroundLanes:
    """Work arrays of one thread for the cases ``first`` to ``last``, ``count`` at a time."""
    n = len(structure.mass)
    return GroundLanes(
        x=lane_array(count, n, 3),
        f=lane_array(count, n, 3),
        still=lane_array(count, n, 3),
        memory=lane_array(count, structure.n_axial_members),
        held=lane_array(count, n),
        actuator_length=lane_array(count, len(structure.actuators)),
        mass=lane_array(count, cases.mass.shape[1]),
        case=np.full(count, -1),
        rounds=np.zeros(count, dtype=np.int64),
        queue=np.array((first, last)),
    )


def descent_lanes(x: np.ndarray) -> DescentLanes:
    """Work arrays of conjugate gradients from positions ``x``, shape (n, k, lanes)."""
    count = x.shape[-1]
    f, old, d, trial = (lane_array(count, *x.shape[:-1]) for _ in range(4))
    return DescentLanes(
        x=x,
        f=f,
        old=old,
        d=d,
        trial=trial,
        scalars=lane_array(count, conjugate_gradient.N_SCALARS),
        stage=np.zeros(count, dtype=np.int64),
        steepest=np.zeros(count, dtype=np.bool_),
        tries=np.zeros(count, dtype=np.int64),
        parabolas=np.zeros(count, dtype=np.int64),
        iterations=np.zeros(count, dtype=np.int64),
        evaluations=np.zeros(count, dtype=np.int64),
    )


def relaxation_lanes(x: np.ndarray, mass: np.ndarray) -> RelaxationLanes:
    """Work arrays of relaxation from positions ``x``, shape (n, k, lanes), with ``mass`` [N step^2/m], shape (n, lanes)."""
    count = x.shape[-1]
    f, old, v = (lane_array(count, *x.shape[:-1]) for _ in range(3))
    return RelaxationLanes(
        x=x,
        f=f,
        old=old,
        v=v,
        mass=mass,
        scalars=lane_array(count, relaxation.N_SCALARS),
        steps=np.zeros(count, dtype=np.int64),
        busy=np.zeros(count, dtype=np.bool_),
    )
