"""Closed forms of the design: self-equilibrium of the cell, the unloaded lattice, bars that buckle at Euler's load."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import kernels
import naive
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from tensegrity_gym import Design, Fidelity, InvalidParameterError, Lattice
from tensegrity_gym.design import cell_equilibrium, cell_node_positions, equal_cable_equilibrium
from tensegrity_gym.types import Ground, Structure

EPS = naive.EPS
#: q_s/q_e, q_b/q_e, (x, y)/z, twist [deg], bar length over cell height; docs: self-equilibrium of the cell.
TABLE = {
    "lengths": (0.91982, -0.43596, (-0.12808, 0.50820), 14.146, 0.94581),
    "densities": (1.0, -0.45969, (-0.12984, 0.48062), 15.118, 0.93235),
    "tensions": (0.60216, -0.32255, (-0.11193, 0.64135), 9.900, 1.01465),
}


class Cell:
    """A free cell in space by brute force: lengths of its members and its equilibrium matrix."""

    def __init__(self, nodes: np.ndarray) -> None:
        self.lattice, self.nodes = Lattice(1, 1), nodes
        self.members = np.concatenate([self.lattice.edges, self.lattice.bars])
        self.square = np.append(self.lattice.edge_is_square, np.zeros(12, dtype=bool))
        self.vectors = nodes[self.members[:, 1]] - nodes[self.members[:, 0]]
        self.length = np.linalg.norm(self.vectors, axis=1)
        self.is_bar = np.arange(48) >= 36

    def equilibrium_matrix(self) -> np.ndarray:
        """A with A q = force on the nodes of force densities q, shape (72, 48)."""
        matrix = np.zeros((24, 3, 48))
        for k, (i, j) in enumerate(self.members):
            matrix[i, :, k] += self.vectors[k]
            matrix[j, :, k] -= self.vectors[k]
        return matrix.reshape(72, 48)

    def twist(self) -> float:
        """Angle of the top square about its axis, nominal at 0 [deg]: which way round depends on chirality."""
        top = self.nodes[(self.lattice.nodes[:, 2] == 2)]
        nominal = self.lattice.nodes[self.lattice.nodes[:, 2] == 2]
        cross = (nominal[:, 0] * top[:, 1] - nominal[:, 1] * top[:, 0]).sum()
        return float(np.degrees(np.arctan2(cross, (nominal[:, :2] * top[:, :2]).sum())))


def self_stress(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Singular values of the equilibrium matrix and its last right singular vector, over its value in a hexagon cable."""
    cell = Cell(nodes)
    _, values, rows = np.linalg.svd(cell.equilibrium_matrix())
    stress = rows[-1] / rows[-1][~cell.square & ~cell.is_bar].mean()
    return values, stress


@pytest.mark.parametrize("name", TABLE)
def test_the_force_density_table(name: str) -> None:
    square, bar, (x, y), twist, height = TABLE[name]
    cell = cell_equilibrium(square)
    assert cell.bar_density == pytest.approx(bar, rel=1e-4)
    np.testing.assert_allclose(cell.node[:2], (x, y), rtol=1e-4)
    assert np.degrees(cell.twist) == pytest.approx(twist, rel=1e-4)
    shape = Cell(cell_node_positions(cell.node))
    assert shape.length[shape.is_bar].mean() / 2 == pytest.approx(height, rel=1e-4)
    carried = {
        "lengths": shape.length,
        "densities": np.where(shape.square, square, 1.0),
        "tensions": shape.length * np.where(shape.square, square, 1.0),
    }
    cables = carried[name][~shape.is_bar]  # what the case says is equal
    np.testing.assert_allclose(cables, cables[0], rtol=3e-5)


def test_equal_cables_are_the_designs_choice() -> None:
    shape = Cell(cell_node_positions(equal_cable_equilibrium().node))
    np.testing.assert_allclose(shape.length[:36], shape.length[0], rtol=1e-13)
    assert equal_cable_equilibrium().square_density == pytest.approx(TABLE["lengths"][0], rel=1e-5)
    # taut only when the bar is longer than 2.5521662 cables
    assert shape.length[36] / shape.length[0] == pytest.approx(2.5521662, abs=5e-8)


def test_the_cell_has_one_self_stress_and_19_mechanisms() -> None:
    """From the SVD of the equilibrium matrix (Pellegrino 1993), which knows nothing of the force-density formula."""
    design = Design()
    nodes = design.unloaded_nodes(Lattice(1, 1))
    values, stress = self_stress(nodes)
    assert (values < 1e-9 * values[0]).sum() == 1
    assert 72 - (48 - 1) - 6 == 19
    cell = Cell(nodes)
    assert stress[cell.square].mean() == pytest.approx(TABLE["lengths"][0], rel=1e-3)
    assert stress[cell.is_bar].mean() == pytest.approx(TABLE["lengths"][1], rel=1e-3)
    for group in (cell.square, cell.is_bar, ~cell.square & ~cell.is_bar):
        np.testing.assert_allclose(stress[group], stress[group][0], rtol=1e-9)
    assert abs(cell.twist()) == pytest.approx(14.146, rel=1e-3)


def test_a_shaken_free_cell_relaxes_to_the_tables_twist_and_self_stress() -> None:
    """Form-finding of the free cell by damped motion from 2 mm off, in space, without gravity: not by construction."""
    design, lattice = Design(prestrain=5e-4), Lattice(1, 1)
    s = design.structure(lattice)
    x = design.unloaded_positions(lattice)
    x += np.random.default_rng(4).normal(size=x.shape) * 2e-3 + np.array([0, 0, 5.0])
    v, f, memory, losses = np.zeros_like(x), np.zeros_like(x), np.zeros(s.n_axial_members), np.zeros(3)
    slack_actuators = 2 * s.actuator_length
    space = Ground(np.zeros(3), 0.0, 0.0)  # no gravity, and the ground 5 m below
    for _ in range(3000):  # kinetic damping: let it move, stop it where its kinetic energy peaks
        last, kinetic = -1.0, 0.0
        first = 0.5e-5
        while kinetic >= last:
            last = kinetic
            kernels.advance(s, slack_actuators, space, 1e-5, first, 20, x, v, f, memory, losses)
            first, kinetic = 1e-5, 0.5 * float((s.mass[:, None] * v**2).sum())
        v[:] = 0.0
        memory[:] = 0.0
        if last < 1e-17:
            break
    residual = naive.forces(s, slack_actuators, np.zeros(3), x, np.zeros_like(x)).f
    tension = s.cable_stiffness[0] * design.prestrain * s.cable_length[0]
    assert np.abs(residual).max() < 1e-4 * tension
    cell = Cell(aligned(x[: lattice.n_nodes], design.unloaded_nodes(lattice)))
    assert abs(cell.twist()) == pytest.approx(14.146, rel=1e-3)
    density = s.cable_stiffness[:36] * (cell.length[:36] - s.cable_length[:36]) / cell.length[:36]
    segments = np.linalg.norm(np.diff(x[s.bars], axis=1), axis=2)
    load = (s.segment_stiffness[:, None] * (s.segment_length[:, None] - segments)).mean(axis=1)
    between = density[~cell.square[:36]].mean()
    assert density[cell.square[:36]].mean() / between == pytest.approx(TABLE["lengths"][0], rel=1e-3)
    assert -(load / cell.length[36:]).mean() / between == pytest.approx(TABLE["lengths"][1], rel=1e-3)


def aligned(points: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """``points`` moved and turned rigidly onto ``reference`` (Kabsch)."""
    centred, target = points - points.mean(axis=0), reference - reference.mean(axis=0)
    u, _, vt = np.linalg.svd(centred.T @ target)
    turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    return centred @ turn


@pytest.mark.parametrize("size", [(1, 1), (2, 1), (2, 2), (3, 2)])
def test_the_unloaded_lattice_is_in_equilibrium(size: tuple[int, int]) -> None:
    """A face that two cells share carries the self-stress of both, so the closed form holds for every lattice."""
    design, lattice = Design(), Lattice(*size)
    s, x = design.structure(lattice), design.unloaded_positions(lattice)
    residual = naive.forces(s, s.actuator_length, np.zeros(3), x, np.zeros_like(x)).f
    tension = design.cable_rigidity * design.prestrain
    assert np.abs(residual).max() < 1e-9 * design.cable_rigidity
    assert np.abs(residual).max() < 1e-6 * tension  # of a tension that is 5e-4 of EA
    ends = x[lattice.actuators]
    np.testing.assert_allclose(ends[:, 1] - ends[:, 0], [[0, 0, design.cell_height]] * lattice.n_cells, atol=1e-14)


def test_no_two_masses_coincide() -> None:
    x = Design().unloaded_positions(Lattice(2, 2))
    assert min(np.linalg.norm(x[i] - x[j]) for i, j in combinations(range(len(x)), 2)) > 1e-3


def column(design: Design) -> Structure:
    """One free bar of the design, straight along x."""
    n = int(design.bar_segments)
    s = design.structure(Lattice(1, 1))
    return naive.make_structure(
        np.ones(n + 1),
        bars=[range(n + 1)],
        segment_stiffness=s.segment_stiffness[0],
        segment_length=s.segment_length[0],
        hinge_stiffness=s.hinge_stiffness[0],
    )


@pytest.mark.parametrize("segments", [2, 3, 5, 9])
def test_a_chain_of_any_number_of_segments_buckles_at_eulers_load(segments: int) -> None:
    """P_cr = pi^2 EI / L^2: lowest P at which bending K_b - P K_g of the pinned chain is singular, K_b = kappa D'D / a^2."""
    design = Design(bar_segments=segments)
    kappa, a = design.hinge_stiffness, design.bar_length / segments
    inner = segments - 1
    second = (np.diag(-2 * np.ones(inner)) + np.diag(np.ones(inner - 1), 1) + np.diag(np.ones(inner - 1), -1)) / a
    bending = kappa * second.T @ second  # hinge angles theta = (w_{j-1} - 2 w_j + w_{j+1}) / a
    geometric = -second  # end shortening sum (w_j - w_{j-1})^2 / 2a
    loads = np.sort(np.linalg.eigvals(np.linalg.solve(geometric, bending)).real)
    assert loads[0] == pytest.approx(design.critical_load, rel=1e-12)
    if segments == 3:  # Euler has 4 here
        assert loads[1] == pytest.approx(3 * design.critical_load, rel=1e-12)
    assert design.critical_load == pytest.approx(np.pi**2 * 130e9 * np.pi / 64 * 4e-3**4 / 0.580142**2, rel=1e-14)


def test_thirds_have_the_hinge_of_rimolis_bar() -> None:
    """kappa = pi^2 EI / (3 L)."""
    design = Design()
    assert design.hinge_stiffness == pytest.approx(np.pi**2 * design.bending_rigidity / (3 * design.bar_length), rel=1e-14)


def buckled(theta: float, segment: float) -> np.ndarray:
    """A bar of thirds buckled symmetrically: outer segments at +-theta to the chord, the middle one parallel to it."""
    c, s = segment * np.cos(theta), segment * np.sin(theta)
    return np.array([[0, 0, 0], [c, s, 0], [c + segment, s, 0], [2 * c + segment, 0, 0]], dtype=float)


def energy(s: Structure, x: np.ndarray) -> float:
    parts = np.zeros(5)
    kernels.energies(s, np.zeros(0), np.zeros(3), x, np.zeros_like(x), parts)
    return float(parts[0])


@pytest.mark.parametrize("theta", [0.05, 0.3, 0.8, 1.2, 2.0])
def test_one_bars_post_buckling_is_theta_over_sin_theta(theta: float) -> None:
    """P/P_cr = theta / sin(theta), delta/L = (2/3)(1 - cos(theta)): P = dU/d(delta) at natural segment lengths."""
    design = Design()
    s = column(design)
    segment, h = float(s.segment_length[0]), 1e-5

    def at(angle: float) -> tuple[float, float]:
        x = buckled(angle, segment)
        return energy(s, x), 3 * segment - x[3, 0]

    (ahead, far), (behind, near) = at(theta + h), at(theta - h)
    load = (ahead - behind) / (far - near)
    euler = design.hinge_stiffness / segment  # of the natural length, 3 segments: pi^2 EI/L^2 there
    # U = kappa theta^2 has no error in a central difference, delta's is h^2/6; the rest is rounding over h
    tolerance = h**2 / 6 + 1e-12 / h * theta
    assert tolerance < 1e-6
    assert load / euler == pytest.approx(theta / np.sin(theta), rel=tolerance)
    assert at(theta)[1] / (3 * segment) == pytest.approx(2 / 3 * (1 - np.cos(theta)), abs=8 * EPS)
    # and so say the forces: the hinge pushes the end across its segment with kappa theta / a
    f, power = np.zeros((4, 3)), np.zeros(1)
    kernels.forces(s, np.zeros(0), np.zeros(3), buckled(theta, segment), np.zeros((4, 3)), f, np.zeros(3), power)
    across = f[0] @ np.array([-np.sin(theta), np.cos(theta), 0])
    assert across == pytest.approx(design.hinge_stiffness * theta / segment, rel=1e-11)


@pytest.mark.parametrize(("shortening", "elastica", "off"), [
    (0.10, 1.05299, 0.02), (0.20, 1.11274, 0.09), (0.30, 1.18070, 0.24), (0.40, 1.25876, 0.49), (0.50, 1.34945, 0.88),
])  # fmt: skip
def test_the_reduced_order_bar_follows_the_elastica(shortening: float, elastica: float, off: float) -> None:
    """Elastica: P/P_cr = (2K/pi)^2, delta/L = 2 - 2E/K; the bar's load is off by less than 1 % to half its length [table]."""
    modulus = brentq(lambda m: 2 - 2 * ellipe(m) / ellipk(m) - shortening, 1e-9, 0.9)
    exact = (2 * ellipk(modulus) / np.pi) ** 2
    assert exact == pytest.approx(elastica, abs=5.1e-6)
    s = column(Design())
    segment, h = float(s.segment_length[0]), 1e-5
    theta = np.arccos(1 - 1.5 * shortening)
    ahead, behind = buckled(theta + h, segment), buckled(theta - h, segment)
    load = (energy(s, ahead) - energy(s, behind)) / (behind[3, 0] - ahead[3, 0]) / (Design().hinge_stiffness / segment)
    assert 100 * abs(load / exact - 1) == pytest.approx(off, abs=0.0051)


@pytest.mark.parametrize("segments", [1, 2, 3, 5, 9])
def test_a_bar_has_its_mass_and_for_two_or_more_segments_its_inertia(segments: int) -> None:
    """sum m = m and sum m x^2 = m L^2 / 12; halves at the ends are all that one segment can do."""
    end, inner = Design(bar_segments=segments).bar_mass_shares()
    x = np.linspace(-0.5, 0.5, segments + 1)
    shares = np.full(segments + 1, inner)
    shares[[0, -1]] = end
    assert (shares >= 0).all()
    assert shares.sum() == pytest.approx(1.0, rel=8 * EPS)
    if segments > 1:
        assert shares @ x**2 == pytest.approx(1 / 12, rel=8 * EPS)
    if segments == 3:
        assert (end, inner) == pytest.approx((1 / 8, 3 / 8))


def test_total_mass_and_member_stiffness_are_those_of_rods_and_ropes() -> None:
    design, lattice = Design(), Lattice(2, 2)
    s = design.structure(lattice)
    fittings = lattice.n_nodes + 2 * lattice.n_cells
    rod = 1600 * np.pi / 4 * 4e-3**2 * 0.580142
    assert s.mass.sum() == pytest.approx(fittings * 5e-3 + 48 * rod, rel=1e-13)
    np.testing.assert_array_equal(s.inverse_mass, 1 / s.mass)
    # segments in series have the rod's EA / L
    series = s.segment_stiffness / 3 * (3 * s.segment_length)
    np.testing.assert_allclose(series, 130e9 * np.pi / 4 * 4e-3**2, rtol=1e-14)
    np.testing.assert_allclose(s.cable_stiffness * s.cable_length, 62831.853, rtol=1e-8)
    np.testing.assert_allclose(s.cable_damping, 1e-4 * s.cable_stiffness, rtol=1e-14)


def test_more_prestrain_is_more_load_and_none_is_none() -> None:
    assert Design(prestrain=0.0).prestress_load == 0.0
    assert Design(prestrain=1e-3).prestress_load == pytest.approx(2 * Design(prestrain=5e-4).prestress_load, rel=1e-14)
    slack = Design(prestrain=0.0)
    s, x = slack.structure(Lattice(1, 1)), slack.unloaded_positions(Lattice(1, 1))
    assert naive.energies(s, s.actuator_length, np.zeros(3), x, np.zeros_like(x)).sum() < 1e-20


POSITIVE = ["bar_length", "bar_diameter", "bar_modulus", "bar_density", "cable_diameter", "cable_modulus", "fitting_mass"]
NOT_NEGATIVE = ["prestrain", "bar_damping", "cable_damping", "hinge_damping"]


@pytest.mark.parametrize("name", POSITIVE + NOT_NEGATIVE)
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf, "thick", None])
def test_a_design_that_cannot_be_is_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(InvalidParameterError, match=rf"Design\.{name}: expected a finite number .* got"):
        replace(Design(), **{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize("name", POSITIVE)
def test_zero_is_refused_where_it_would_divide(name: str) -> None:
    with pytest.raises(InvalidParameterError, match=rf"Design\.{name}: expected a finite number > 0, got 0"):
        replace(Design(), **{name: 0.0})


@pytest.mark.parametrize("name", NOT_NEGATIVE)
def test_zero_is_accepted_where_it_means_none(name: str) -> None:
    assert getattr(replace(Design(), **{name: 0.0}), name) == 0.0


def test_bars_that_their_prestress_would_press_to_nothing_are_refused() -> None:
    """L0 (1 - P/EA) = L has a natural length L0 > 0 only for EA > P; without prestrain any bar will do."""
    said = "expected an axial rigidity EA of the bars above their prestress load"
    for change in ({"bar_modulus": 1e6}, {"bar_softening": 1e6}, {"prestrain": 30.0}):
        with pytest.raises(InvalidParameterError, match=said):
            Design(**change)
    with pytest.raises(InvalidParameterError, match=rf"{said}, got 1\.634 N and 34\.9\d N.*less bar_softening"):
        Fidelity(bar_softening=1e6).design(Design())
    softest = Design().bar_rigidity / Design().prestress_load
    with pytest.raises(InvalidParameterError, match=said):
        Design(bar_softening=1.001 * softest)
    assert (Design(bar_softening=0.999 * softest).structure(Lattice(1, 1)).segment_length > 0).all()
    assert Design(bar_modulus=1e3, prestrain=0.0).prestress_load == 0.0


@pytest.mark.parametrize("value", [0, -3, 2.5, np.nan, "three"])
def test_a_bar_has_a_whole_number_of_segments(value: object) -> None:
    with pytest.raises(InvalidParameterError, match=r"Design\.bar_segments: expected"):
        Design(bar_segments=value)  # type: ignore[arg-type]
