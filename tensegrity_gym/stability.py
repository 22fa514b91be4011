"""Second-order check of equilibria: is it a minimum, how stiff is its softest mode, and how near is the next bifurcation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.linalg import eigh
from scipy.sparse import bsr_matrix, csr_matrix

from tensegrity_gym.clearance import centreline_distance
from tensegrity_gym.core.assembly import assemble_tangent
from tensegrity_gym.design import Design
from tensegrity_gym.elimination import lattice_pattern
from tensegrity_gym.energies import hinge_angles
from tensegrity_gym.formfinding import WIDEST_RANGE, Equilibria, form_find
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene
from tensegrity_gym.types import BlockPattern, Floats, Structure

#: Surface strain at which a pultruded carbon rod is taken to fail in bending [-].
FAILURE_STRAIN = 0.012
#: Negative eigenvalues up to this share of the stiffest entry are rounding.
ROUNDING = 1e-12


@dataclass(frozen=True)
class Stability:
    """Second-order check of a batch of equilibria; arrays are batch first."""

    eigenvalues: Floats  #: lowest of the tangent, rigid and spin modes apart [N/m], shape (n, modes)
    spin_eigenvalues: Floats  #: lowest of the bows' turning about their chords, the rest following [N/m], shape (n, modes)
    stable: np.ndarray  #: no negative eigenvalue on all free coordinates, rigid motions apart, shape (n,)
    slack_cables: np.ndarray  #: count, shape (n,)
    slack_actuators: np.ndarray  #: count, shape (n,)
    load_ratio: Floats  #: largest compression of each bar's segments over the Euler load [-], shape (n, n_bars)
    past_critical: np.ndarray  #: bars above their Euler load, count, shape (n,)
    bending_strain: Floats  #: largest strain at a bar's surface, as if its hinges' angles were spread over it [-], shape (n,)
    safety_margin: Floats  #: failure strain over that, minus one [-], shape (n,)
    bar_clearance: Floats  #: least gap between the surfaces of two bars that share no node [m], shape (n,)
    bars_touch: np.ndarray  #: warning: that gap is negative, the model's bars reach through each other, shape (n,)


@dataclass(frozen=True)
class LoadPath:
    """Equilibria along the straight path of stretches from unloaded (share 0) through the target (share 1)."""

    shares: Floats  #: shape (k,)
    lowest: Floats  #: lowest eigenvalue, rigid and spin modes apart; NaN where no equilibrium was found [N/m], shape (k,)
    energy: Floats  #: [J], shape (k,)
    clearance: Floats  #: least gap between two bars that share no node [m], shape (k,)
    critical: Floats  #: shares at which the path loses stability or jumps, to ``tolerance`` below, ascending, shape (m,)
    distance: float  #: from share 1 to the nearest of them [-]; inf if none in the range looked at


State = TypeVar("State")


def last_share(
    solve: Callable[[float, State], State | None],
    same: Callable[[State, State], bool],
    low: float,
    state: State,
    high: float,
    tolerance: float,
) -> float:
    """Share in (low, high) up to which the path of equilibria through ``state`` at ``low`` goes on, by bisection [-].

    ``solve(share, state)`` is the stable equilibrium that a search from ``state`` finds, None if there is none. The path goes on
    if the way back from it ends where it began: a snap-through does not.
    """
    while high - low > tolerance:
        middle = 0.5 * (low + high)
        new = solve(middle, state)
        back = None if new is None else solve(low, new)
        if new is not None and back is not None and same(back, state):
            low, state = middle, new
        else:
            high = middle
    return 0.5 * (low + high)


def tangent_matrix(structure: Structure, pattern: BlockPattern, actuator_length: Floats, positions: Floats) -> csr_matrix:
    """d2U/dx2 of one lattice at ``positions`` (n_masses, 3) as a sparse matrix, shape (3 n_masses, 3 n_masses) [N/m]."""
    n = len(positions)
    h = np.zeros((pattern.n_slots, 9))
    assemble_tangent(structure, pattern, np.ascontiguousarray(actuator_length), np.ascontiguousarray(positions), h)
    columns = np.repeat(pattern.order, np.diff(pattern.starts))
    blocks = h.reshape(-1, 3, 3)
    rows = np.concatenate([np.arange(n), pattern.rows, columns])
    cols = np.concatenate([np.arange(n), columns, pattern.rows])
    data = np.concatenate([blocks, blocks[n:].transpose(0, 2, 1)])
    order = np.lexsort((cols, rows))
    starts = np.searchsorted(rows[order], np.arange(n + 1))
    return bsr_matrix((data[order], cols[order], starts), shape=(3 * n, 3 * n)).tocsr()


def rigid_motions(positions: Floats) -> Floats:
    """The motions that cost nothing on flat ground without friction: along x, along y and yaw, shape (3 n_masses, 3)."""
    n = len(positions)
    motions = np.zeros((n, 3, 3))
    motions[:, 0, 0] = motions[:, 1, 1] = 1.0
    motions[:, 0, 2], motions[:, 1, 2] = -positions[:, 1], positions[:, 0]
    return motions.reshape(3 * n, 3)


def spin_motions(positions: Floats, bars: np.ndarray) -> Floats:
    """Each bowed bar's inner masses turning about its chord, shape (3 n_masses, n_bowed)."""
    found = []
    for bar in bars:
        chord = positions[bar[-1]] - positions[bar[0]]
        chord = chord / np.linalg.norm(chord)
        arm = positions[bar[1:-1]] - positions[bar[0]]
        turn = np.cross(chord, arm)
        if len(turn) and np.linalg.norm(turn) > 1e-6 * np.linalg.norm(positions[bar[-1]] - positions[bar[0]]):
            motion = np.zeros_like(positions)
            motion[bar[1:-1]] = turn / np.linalg.norm(turn)
            found.append(motion.ravel())
    return np.array(found).T if found else np.zeros((positions.size, 0))


def check_stability(
    equilibria: Equilibria,
    *,
    design: Design | None = None,
    lattice: Lattice | None = None,
    modes: int = 6,
    failure_strain: float = FAILURE_STRAIN,
) -> Stability:
    """Second-order check of ``equilibria`` of ``design`` and ``lattice``: dense eigenvalues, about 0.1 s per 2x2 equilibrium.

    Masses that the ground presses are held vertically and slide freely.
    """
    design, lattice = design or Design(), lattice or Lattice()
    structure = design.structure(lattice)
    pattern = lattice_pattern(lattice, int(design.bar_segments))
    spectra = [
        _spectra(structure, pattern, s * structure.actuator_length, x, c > 0.0, modes)
        for s, x, c in zip(equilibria.stretches, equilibria.positions, equilibria.contact_force, strict=True)
    ]
    angles = hinge_angles(equilibria.positions, structure.bars).max(axis=(1, 2), initial=0.0)
    clearance = centreline_distance(equilibria.positions, structure.bars) - design.bar_diameter
    strain = angles / (design.bar_length / design.bar_segments) * design.bar_diameter / 2
    segments = np.linalg.norm(np.diff(equilibria.positions[:, structure.bars], axis=2), axis=-1)
    squeeze = structure.segment_stiffness[:, None] * (structure.segment_length[:, None] - segments)
    ratio = squeeze.max(axis=2) / design.critical_load
    return Stability(
        eigenvalues=np.array([s[0] for s in spectra]),
        spin_eigenvalues=np.array([s[1] for s in spectra]),
        stable=np.array([s[2] for s in spectra]) & equilibria.converged,
        slack_cables=(equilibria.cable_tension <= 0.0).sum(axis=1),
        slack_actuators=(equilibria.actuator_tension <= 0.0).sum(axis=1),
        load_ratio=ratio,
        past_critical=(ratio > 1.0).sum(axis=1),
        bending_strain=strain,
        safety_margin=failure_strain / np.maximum(strain, 1e-300) - 1.0,
        bar_clearance=clearance,
        bars_touch=clearance < 0.0,
    )


def _spectra(
    structure: Structure, pattern: BlockPattern, lengths: Floats, x: Floats, held: np.ndarray, modes: int
) -> tuple[Floats, Floats, bool]:
    """Lowest eigenvalues without spins, of the spins with the rest condensed out, and whether there is none below zero."""
    tangent = tangent_matrix(structure, pattern, lengths, x).toarray()
    free = np.ones(x.size, dtype=bool)
    free[2::3] = ~held
    tangent = tangent[np.ix_(free, free)]
    rigid, spins = rigid_motions(x)[free], spin_motions(x, structure.bars)[free]
    scale = float(np.abs(tangent).max())
    rest = _complement(rigid)
    whole = eigh(rest.T @ tangent @ rest, eigvals_only=True, subset_by_index=(0, 0))[0]
    others = _complement(np.hstack([rigid, spins]))
    stiff = others.T @ tangent @ others
    values = eigh(stiff, eigvals_only=True, subset_by_index=(0, min(modes, len(stiff)) - 1))
    turning = np.zeros(0)
    if spins.shape[1]:
        alone = rest @ (rest.T @ spins)
        coupling = others.T @ tangent @ alone
        soft = alone.T @ tangent @ alone - coupling.T @ np.linalg.solve(stiff, coupling)
        turning = np.linalg.eigvalsh(0.5 * (soft + soft.T))[:modes]
    padded = np.full(modes, np.nan)
    padded[: len(turning)] = turning
    return np.pad(values, (0, modes - len(values)), constant_values=np.nan), padded, bool(whole > -ROUNDING * scale)


def _complement(vectors: Floats) -> Floats:
    """Orthonormal basis of what is orthogonal to the columns of ``vectors``."""
    q, _ = np.linalg.qr(vectors, mode="complete")
    return q[:, np.linalg.matrix_rank(vectors) :]


#: Nodes that come back this near to where they were did not snap [m]; a found equilibrium is 1e-8 m off at most.
SAME_PLACE = 1e-5


def follow_load_path(
    stretches: Floats,
    *,
    design: Design | None = None,
    scene: Scene | None = None,
    lattice: Lattice | None = None,
    reach: float = 1.4,
    points: int = 29,
    tolerance: float = 1e-3,
) -> LoadPath:
    """Stability along the load path of one set of stretches, from unloaded past the target to ``reach`` times the load.

    Between two neighbours that are not joined by a reversible path of stable equilibria the share where it ends is closed in to
    ``tolerance``. The distance counts backwards, too: near share 0.1 the bars buckle, where gravity and the imperfection round
    the corner.
    """
    design, scene, lattice = design or Design(), scene or Scene(), lattice or Lattice()
    target = np.asarray(stretches, dtype=np.float64).ravel()
    shares = np.linspace(0.05, reach, points)
    inside = (_on_path(target, shares) >= WIDEST_RANGE[0]).all(axis=1)
    shares = shares[inside]

    def find(where: Floats, start: Floats | None = None) -> Equilibria:
        path = _on_path(target, where)
        return form_find(path, design=design, scene=scene, lattice=lattice, outside=True, start=start)

    def solve(share: float, positions: Floats) -> Floats | None:
        e = find(np.array([share]), positions[None])
        good = check_stability(e, design=design, lattice=lattice, modes=1).stable[0]
        return e.positions[0] if good else None

    def same(a: Floats, b: Floats) -> bool:
        return bool(np.abs(a[: lattice.n_nodes] - b[: lattice.n_nodes]).max() < SAME_PLACE)

    found = find(shares)
    check = check_stability(found, design=design, lattice=lattice, modes=1)
    back = find(shares[:-1], found.positions[1:])
    critical = []
    for k in range(len(shares) - 1):
        both = check.stable[k] and check.stable[k + 1]
        if both and back.converged[k] and same(back.positions[k], found.positions[k]):
            continue
        if check.stable[k]:
            critical.append(last_share(solve, same, shares[k], found.positions[k], shares[k + 1], tolerance))
        elif check.stable[k + 1]:
            critical.append(-last_share(_mirrored(solve), same, -shares[k + 1], found.positions[k + 1], -shares[k], tolerance))
    distance = float(np.abs(np.array(critical) - 1.0).min()) if critical else float("inf")
    return LoadPath(
        shares,
        np.where(found.converged, check.eigenvalues[:, 0], np.nan),
        found.energy,
        check.bar_clearance,
        np.array(critical),
        distance,
    )


def _on_path(target: Floats, shares: Floats) -> Floats:
    """Stretches at shares of the load path, shape (k, n_actuators)."""
    return 1.0 + shares[:, None] * (target - 1.0)


def _mirrored(solve: Callable[[float, State], State | None]) -> Callable[[float, State], State | None]:
    """The path walked backwards: the same search at minus the share."""
    return lambda share, state: solve(-share, state)
