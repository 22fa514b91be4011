"""Plain containers that kernels and public functions share.

Every field says ``[unit], shape``. Containers that kernels take are NamedTuples, because numba compiles those;
everything in them is a C-contiguous array of one floating dtype or of ``int64`` indices.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]


class Structure(NamedTuple):
    """Point masses and the members between them: all that statics and dynamics need to know of a lattice.

    Masses are ordered: nodes, then actuator masses (lower, upper per actuator), then the bars' inner masses bar by bar.
    """

    mass: Floats  #: [kg], shape (n_masses,)
    inverse_mass: Floats  #: [1/kg], shape (n_masses,)
    cables: Ints  #: mass indices, shape (n_cables, 2)
    cable_stiffness: Floats  #: EA / natural length [N/m], shape (n_cables,)
    cable_length: Floats  #: natural length [m], shape (n_cables,)
    cable_damping: Floats  #: Kelvin-Voigt c = beta * k [N s/m], shape (n_cables,)
    actuators: Ints  #: mass indices (lower, upper), shape (n_actuators, 2)
    actuator_rigidity: Floats  #: EA of the actuated cable [N], shape (n_actuators,)
    actuator_length: Floats  #: natural length when unlocked, l [m], shape (n_actuators,)
    actuator_damping: Floats  #: stiffness-proportional beta [s], shape (n_actuators,)
    bars: Ints  #: mass indices along each bar, shape (n_bars, bar_segments + 1)
    segment_stiffness: Floats  #: axial, of each of a bar's equal segments [N/m], shape (n_bars,)
    segment_length: Floats  #: natural length of a segment [m], shape (n_bars,)
    segment_damping: Floats  #: Kelvin-Voigt, axial [N s/m], shape (n_bars,)
    hinge_stiffness: Floats  #: kappa of each hinge between two segments [N m/rad], shape (n_bars,)
    hinge_damping: Floats  #: c = beta_h * kappa [N m s/rad], shape (n_bars,)

    def astype(self, dtype: np.dtype) -> Structure:
        """The same structure with its floating-point fields in ``dtype``; itself where they are already."""
        if self.mass.dtype == dtype:
            return self
        return self._replace(**{name: a.astype(dtype) for name, a in zip(self._fields, self, strict=True) if a.dtype.kind == "f"})

    @property
    def n_axial_members(self) -> int:
        """Bar segments, cables and actuated cables."""
        return self.bars.shape[0] * (self.bars.shape[1] - 1) + len(self.cables) + len(self.actuators)

    def member_name(self, member: int) -> str:
        """What the axial member of that number is, in words."""
        segments = self.bars.shape[1] - 1
        if member < len(self.bars) * segments:
            return f"segment {member % segments} of bar {member // segments}"
        cable = member - len(self.bars) * segments
        return f"cable {cable}" if cable < len(self.cables) else f"actuated cable {cable - len(self.cables)}"


class Ground(NamedTuple):
    """The half-space z >= 0 and the gravity over it, in the frame of the ground (a slope is tilted gravity)."""

    gravity: Floats  #: acceleration vector [m/s^2], shape (3,)
    friction: float  #: Coulomb coefficient mu [-]
    restitution: float  #: Newton coefficient e [-]
    masses: int = 2**31 - 1  #: only the first so many masses meet the ground


class BlockPattern(NamedTuple):
    """Where the 3x3 blocks of a tangent stiffness and its Cholesky factor live, and in which order they are eliminated.

    Slots 0 to n_masses - 1 are the diagonal blocks; a slot beyond holds the block (row, column) whose column goes first.
    """

    order: Ints  #: masses in elimination order, shape (n_masses,)
    starts: Ints  #: first slot below the diagonal of the k-th column eliminated, shape (n_masses + 1,)
    rows: Ints  #: row mass of each slot past the diagonal ones, shape (n_slots - n_masses,)
    targets: Ints  #: slot that each pair of a column's blocks updates, in the order of the factorisation
    cable_slots: Ints  #: slot that couples each cable's ends (symmetric blocks), shape (n_cables,)
    actuator_slots: Ints  #: likewise for actuated cables, shape (n_actuators,)
    near_slots: Ints  #: (slot, transposed) of masses j, j+1 of each bar, shape (n_bars, segments, 2)
    far_slots: Ints  #: (slot, transposed) of masses j, j+2 of each bar, shape (n_bars, segments - 1, 2)

    @property
    def n_slots(self) -> int:
        """Blocks of the lower triangle, fill included."""
        return int(self.starts[-1])


class HopStatus(IntEnum):
    """How one hop ended. RESTED, TIME_LIMIT, STOPPED and IN_FLIGHT are flights; the rest still have finite landings."""

    RESTED = 0  #: flew, came down and came to rest
    TIME_LIMIT = 1  #: flew and came down, but was still moving when ``scene.duration`` was over
    NO_FLIGHT = 2  #: never left the ground with every mass
    UNSTABLE = 3  #: the integration blew up; its landing reads zero, which is no answer
    NOT_CONVERGED = 4  #: no equilibrium was found to start from; not simulated
    STOPPED = 5  #: flew and came down; by the fidelity's choice not followed to rest, which is not a number
    IN_FLIGHT = 6  #: had not come down when ``scene.duration`` was over; touchdown and landing are where it was then


#: Elastic energy is kept apart by member class; dissipated energies are cumulative. Order of ``energies`` columns.
ENERGY_NAMES = (
    "bars",
    "cables",
    "actuators",
    "kinetic",
    "gravitational",
    "dissipated_contact",
    "dissipated_damping",
)
