"""From materials and sizes to point masses, stiffnesses and natural lengths.

Sources: sizes and cable material from the first author's published cell (google-deepmind/mujoco issue 520); the reduced-order
bar is Rimoli 2018 with coefficients derived in ``docs/physics.md``; the self-equilibrium of the cell is the force-density
method (Schek 1974) on one representative node.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from tensegrity_gym.core.forces import MAX_SEGMENTS
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.lattice import Lattice, cell_nodes
from tensegrity_gym.types import Floats, Structure


class CellEquilibrium(NamedTuple):
    """Self-equilibrium of the free cell, in force densities over that of the cables between squares (q_e = 1)."""

    square_density: float  #: q_s / q_e [-]
    bar_density: float  #: q_b / q_e < 0 [-]
    node: Floats  #: representative node (x, y, 1) of nominal (0, 1, 2), over its height z, shape (3,)

    @property
    def twist(self) -> float:
        """Twist of a square face, atan(-x/y) [rad]."""
        return float(np.arctan2(-self.node[0], self.node[1]))


def cell_equilibrium(square_density: float) -> CellEquilibrium:
    """Force-density equilibrium M p = 0 of the cell for a ratio q_s/q_e > 0 (structure of M: docs/physics.md, eq. 3)."""
    s, e = square_density, 1.0
    # det M = A (B D - e^2) - B b^2 with A = 2s + 2e + b, B = 2s + e + 2b, D = e + b, expanded as a polynomial in b
    a_, b_, d_ = np.poly1d([1, 2 * s + 2 * e]), np.poly1d([2, 2 * s + e]), np.poly1d([1, e])
    det = a_ * (b_ * d_ - np.poly1d([e * e])) - b_ * np.poly1d([1, 0, 0])
    roots = det.roots
    real = np.sort(roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real < -1e-9)])
    b = float(real[-1])  # the smaller |q_b|
    matrix = np.array([[2 * s + 2 * e + b, 0, -b], [0, 2 * s + e + 2 * b, -e], [-b, -e, e + b]])
    node = np.linalg.svd(matrix)[2][-1]
    return CellEquilibrium(square_density, b, node / node[2])


def _edge_lengths(node: Floats) -> tuple[float, float, float]:
    """Lengths (square edge, edge between squares, bar) of the cell whose representative node is ``node`` [its unit]."""
    x, y, z = node
    square = np.hypot(x - y, x + y)  # (x, y, z) to its quarter turn (y, -x, z)
    between = np.sqrt(2 * (z - y) ** 2 + (2 * x) ** 2)  # (x, y, z) to (-x, z, y), half-turn image
    bar = np.linalg.norm(np.array((x, y, z)) - np.array((z, -y, x)))
    return float(square), float(between), float(bar)


@lru_cache(maxsize=1)
def equal_cable_equilibrium() -> CellEquilibrium:
    """The self-equilibrium whose 36 cables have equal lengths: q_s/q_e = 0.91982, twist 14.146 degrees."""
    from scipy.optimize import brentq  # takes longer to import than the rest of this package

    def length_difference(square_density: float) -> float:
        square, between, _ = _edge_lengths(cell_equilibrium(square_density).node)
        return square - between

    return cell_equilibrium(float(brentq(length_difference, 0.5, 1.5, xtol=1e-15)))


def cell_node_positions(node: Floats) -> Floats:
    """All 24 nodes of a chi = +1 cell from the representative one by the rotation group, shape (24, 3) [its unit]."""
    group = _rotation_group()
    representative = np.array((0, 1, 2))
    images = {tuple(int(c) for c in g @ representative): g @ node for g in group}
    return np.array([images[n] for n in cell_nodes()])


def _rotation_group() -> list[np.ndarray]:
    axes = np.eye(3, dtype=int)
    group = []
    for i in range(3):
        for j in range(3):
            for si in (1, -1):
                for sj in (1, -1):
                    if i != j:
                        first, second = si * axes[i], sj * axes[j]
                        group.append(np.array([first, second, np.cross(first, second)]).T)
    return group


@dataclass(frozen=True)
class Design:
    """Materials, sizes, prestrain and damping of a lattice. SI units; see docs/physics.md for why each default.

    Cables are cut so that the unloaded lattice is the closed-form equal-cable cell repeated: a cable on a face that two
    cells share carries, and is prestrained for, the self-stress of both.
    """

    bar_length: float = 0.580142
    """Length of a bar under its prestress load [m]."""
    bar_diameter: float = 4e-3
    """Diameter of the solid round bar [m]."""
    bar_modulus: float = 130e9
    """Young's modulus of the bar [Pa]."""
    bar_density: float = 1600.0
    """Density of the bar [kg/m^3]."""
    bar_segments: int = 3
    """Equal segments a bar is divided into (3 is the paper's model; 1 cannot buckle)."""
    bar_softening: float = 1.0
    """Axial stiffness of the bars is divided by it, their buckling load is not [-]: buys larger steps with larger strains."""
    cable_diameter: float = 1e-3
    """Diameter of the cables [m]."""
    cable_modulus: float = 80e9
    """Effective Young's modulus of the cables [Pa]."""
    fitting_mass: float = 5e-3
    """Mass at each node and at each actuator end, cables' share included [kg]."""
    prestrain: float = 5e-4
    """Strain of the cables between squares in the unloaded lattice [-]."""
    bar_damping: float = 1e-6
    """Axial damping of bars, c = bar_damping * k [s]."""
    cable_damping: float = 1e-4
    """Axial damping of taut cables, c = cable_damping * k [s]."""
    hinge_damping: float = 4e-4
    """Bending damping of bars, c = hinge_damping * kappa [s]."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            may_be_zero = field.name in ("prestrain", "bar_damping", "cable_damping", "hinge_damping")
            if (
                isinstance(value, bool)
                or not isinstance(value, (int, float, np.number))
                or not np.isfinite(value)
                or not (value > 0 or (may_be_zero and value == 0))
            ):
                bound = ">= 0" if may_be_zero else "> 0"
                raise InvalidParameterError(f"Design.{field.name}: expected a finite number {bound}, got {value!r}")
        if int(self.bar_segments) != self.bar_segments or self.bar_segments > MAX_SEGMENTS:
            raise InvalidParameterError(
                f"Design.bar_segments: expected an integer from 1 to {MAX_SEGMENTS}, got {self.bar_segments!r}"
            )
        if not self.prestress_load < self.bar_rigidity:
            raise InvalidParameterError(
                "Design: expected an axial rigidity EA of the bars above their prestress load, got "
                f"{self.bar_rigidity:.4g} N and {self.prestress_load:.4g} N, which would press a bar of any length to nothing; "
                "take a larger bar_modulus or bar_diameter, or less bar_softening or prestrain"
            )

    def undamped(self) -> Design:
        """The design without dampings: what its equilibria depend on."""
        return replace(self, bar_damping=0.0, cable_damping=0.0, hinge_damping=0.0)

    @property
    def cell_height(self) -> float:
        """l [m]: distance between opposed square faces of the unloaded cell, the unit of the stretches."""
        return 2 * self._scale

    @property
    def _scale(self) -> float:
        return self.bar_length / _edge_lengths(equal_cable_equilibrium().node)[2]

    @property
    def bar_mass(self) -> float:
        """Mass of one bar [kg]."""
        return self.bar_density * np.pi / 4 * self.bar_diameter**2 * self.bar_length

    @property
    def bar_rigidity(self) -> float:
        """Axial rigidity EA of a bar, softened [N]."""
        return self.bar_modulus * np.pi / 4 * self.bar_diameter**2 / self.bar_softening

    @property
    def bending_rigidity(self) -> float:
        """Bending rigidity EI of a bar [N m^2]."""
        return self.bar_modulus * np.pi / 64 * self.bar_diameter**4

    @property
    def critical_load(self) -> float:
        """Euler load of a pinned bar, pi^2 EI / L^2 [N]."""
        return np.pi**2 * self.bending_rigidity / self.bar_length**2

    @property
    def hinge_stiffness(self) -> float:
        """kappa [N m/rad] with which a chain of equal rigid segments has exactly the Euler load (pi^2 EI / 3L for thirds)."""
        segment = self.bar_length / self.bar_segments
        return self.critical_load * segment / (4 * np.sin(np.pi / (2 * self.bar_segments)) ** 2)

    @property
    def cable_rigidity(self) -> float:
        """Axial rigidity EA of a cable [N]."""
        return self.cable_modulus * np.pi / 4 * self.cable_diameter**2

    @property
    def prestress_load(self) -> float:
        """Compression of a bar in the unloaded lattice [N]."""
        cell = equal_cable_equilibrium()
        _, between, bar = _edge_lengths(cell.node)
        return -cell.bar_density * bar / between * self.cable_rigidity * self.prestrain

    def bar_mass_shares(self) -> tuple[float, float]:
        """Shares (end, inner) of a bar's mass with its exact mass and, for two or more segments, m L^2/12."""
        n = int(self.bar_segments)
        if n == 1:
            return 0.5, 0.0
        spread = sum((k / n - 0.5) ** 2 for k in range(1, n))
        # 2a + (n-1) b = 1 and a/2 + spread*b = 1/12
        end, inner = np.linalg.solve([[2.0, n - 1.0], [0.5, spread]], [1.0, 1.0 / 12.0])
        return float(end), float(inner)

    def unloaded_nodes(self, lattice: Lattice) -> Floats:
        """Closed-form node positions of the unloaded lattice, mid-height at z = 0, shape (n_nodes, 3) [m]."""
        cell = cell_node_positions(self._scale * equal_cable_equilibrium().node)
        return lattice.positions(cell, self.cell_height)

    def unloaded_positions(self, lattice: Lattice) -> Floats:
        """Closed-form positions of all point masses of the unloaded lattice, shape (n_masses, 3) [m]."""
        nodes = self.unloaded_nodes(lattice)
        ties = lattice.ties.reshape(-1, 4, 2)[:, :, 1]
        actuator_masses = nodes[ties].mean(axis=1)
        share = np.arange(1, self.bar_segments) / self.bar_segments
        start, end = nodes[lattice.bars[:, 0], None], nodes[lattice.bars[:, 1], None]
        inner = start + share[None, :, None] * (end - start)
        return np.concatenate([nodes, actuator_masses, inner.reshape(-1, 3)])

    def structure(self, lattice: Lattice) -> Structure:
        """Point masses, stiffnesses and natural lengths of ``lattice`` built to this design."""
        n_bars, segments = len(lattice.bars), int(self.bar_segments)
        x = self.unloaded_positions(lattice)
        bars = self._bar_masses(lattice)
        mass = np.full(len(x), self.fitting_mass)
        end_share, inner_share = self.bar_mass_shares()
        mass[lattice.n_nodes + 2 * lattice.n_cells :] = inner_share * self.bar_mass
        np.add.at(mass, lattice.bars.ravel(), end_share * self.bar_mass)

        length = np.linalg.norm(x[lattice.cables[:, 0]] - x[lattice.cables[:, 1]], axis=1)
        cable_length = length / (1 + self._cable_strains(lattice))
        cable_stiffness = self.cable_rigidity / cable_length
        segment_length = self.bar_length / segments / (1 - self.prestress_load / self.bar_rigidity)
        segment_stiffness = np.full(n_bars, self.bar_rigidity / segment_length)
        hinge = np.full(n_bars, self.hinge_stiffness)
        return Structure(
            mass=mass,
            inverse_mass=1.0 / mass,
            cables=lattice.cables,
            cable_stiffness=cable_stiffness,
            cable_length=cable_length,
            cable_damping=self.cable_damping * cable_stiffness,
            actuators=lattice.actuators,
            actuator_rigidity=np.full(lattice.n_cells, self.cable_rigidity),
            actuator_length=np.full(lattice.n_cells, self.cell_height),
            actuator_damping=np.full(lattice.n_cells, self.cable_damping),
            bars=bars,
            segment_stiffness=segment_stiffness,
            segment_length=np.full(n_bars, segment_length),
            segment_damping=self.bar_damping * segment_stiffness,
            hinge_stiffness=hinge,
            hinge_damping=self.hinge_damping * hinge,
        )

    def _cable_strains(self, lattice: Lattice) -> Floats:
        """Strain of each unactuated cable in the unloaded lattice: equal lengths, so strains go as force densities."""
        sharing = lattice.edge_cells_sharing
        on_squares = equal_cable_equilibrium().square_density * sharing
        edges = self.prestrain * np.where(sharing == 0, 1.0, on_squares)
        return np.concatenate([edges, np.zeros(len(lattice.ties))])

    def _bar_masses(self, lattice: Lattice) -> np.ndarray:
        """Mass indices along each bar, shape (n_bars, bar_segments + 1)."""
        first = lattice.n_nodes + 2 * lattice.n_cells
        inner = first + np.arange((self.bar_segments - 1) * len(lattice.bars), dtype=np.int64)
        return np.column_stack([lattice.bars[:, 0], inner.reshape(len(lattice.bars), -1), lattice.bars[:, 1]])
