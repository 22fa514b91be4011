"""Multi-stability: equilibria that random starts and other load paths reach, and how their hops land."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.formfinding.common import DESIGN, LATTICE, SAME, Config, save, select, stretches
from tensegrity_gym import Equilibria, Scene, form_find, simulate
from tensegrity_gym.searches import SearchOptions, start_positions


def random_starts(rng: np.random.Generator, path: Equilibria, rows: np.ndarray, kind: str, size: float) -> np.ndarray:
    """Starts for the given rows of ``path``: bows in random directions, or nodes moved by ``size`` [m] at random."""
    n = len(rows)
    x = path.positions[rows].copy() if kind != "bows, unloaded" else np.repeat(start_positions(DESIGN, LATTICE)[None], n, axis=0)
    inner = np.arange(LATTICE.n_nodes + 2 * LATTICE.n_cells, LATTICE.n_masses).reshape(-1, 2)
    if kind == "nodes":
        return x + rng.normal(scale=size, size=x.shape)
    near, far = x[:, LATTICE.bars[:, 0]], x[:, LATTICE.bars[:, 1]]
    bow = rng.normal(size=near.shape)
    axis = (far - near) / np.linalg.norm(far - near, axis=-1, keepdims=True)
    bow -= (bow * axis).sum(axis=-1, keepdims=True) * axis
    bow *= size / np.linalg.norm(bow, axis=-1, keepdims=True)
    x[:, inner[:, 0]], x[:, inner[:, 1]] = near + (far - near) / 3 + bow, near + 2 * (far - near) / 3 + bow
    return x


def branches(config: Config) -> None:
    """Multi-stability: equilibria that random starts and other load paths reach, and how their hops land."""
    n, starts = (12, 8) if config.quick else (48, 12)
    rng = np.random.default_rng(config.seed)
    batch = stretches(n, config.seed)
    path = form_find(batch)
    rows = np.repeat(np.arange(n), starts)
    kinds = [("bows, unloaded", 0.05), ("bows", 0.05), ("nodes", 0.003), ("nodes", 0.01), ("nodes", 0.03), ("nodes", 0.1)]
    print("\nstart                     converged  other energy  lower energy  largest gap [J]  stretches with another")
    energies: list[list[float]] = [[] for _ in range(n)]
    kept: list[tuple[float, Equilibria]] = []
    for kind, size in kinds:
        found = form_find(batch[rows], start=random_starts(rng, path, rows, kind, size))
        gap = found.energy - path.energy[rows]
        other = found.converged & (np.abs(gap) > SAME)
        kept += [(float(gap[k]), select(found, np.array([k]))) for k in np.flatnonzero(other)]
        for k in np.flatnonzero(found.converged):
            energies[rows[k]].append(float(gap[k]))
        print(
            f"{kind:16s} {size:6.3f} m  {found.converged.sum():5d}/{len(rows):<5d} {other.sum():9d}"
            f"  {(other & (gap < 0)).sum():12d}"
            f"  {np.abs(gap[other]).max(initial=0.0):15.2e}  {len(np.unique(rows[other])):10d}/{n}",
            flush=True,
        )
    few = np.repeat(np.arange(n // 4), 4)
    rough = SearchOptions(tolerance=1e-5, max_iterations=300_000)
    rest = form_find(
        batch[few],
        method="relaxation",
        options=rough,
        start=random_starts(rng, path, few, "bows", 0.05),
    )
    found = form_find(batch[few], start=rest.positions)
    gap = found.energy - path.energy[few]
    for k in np.flatnonzero(found.converged):
        energies[few[k]].append(float(gap[k]))
    other = found.converged & (np.abs(gap) > SAME)
    print(f"bows 0.05 m, relaxed first {found.converged.sum():3d}/{len(few):<5d} {other.sum():9d}")
    for step in (0.02, 0.3):
        found = form_find(batch, options=SearchOptions(load_step=step))
        other = found.converged & (np.abs(found.energy - path.energy) > SAME)
        print(f"load step {step:4.2f}           {found.converged.sum():5d}/{n:<5d} {other.sum():9d}")
    one_by_one = sequential_path(batch)
    other = one_by_one.converged & (np.abs(one_by_one.energy - path.energy) > SAME)
    print(f"one actuator at a time   {one_by_one.converged.sum():5d}/{n:<5d} {other.sum():9d}")
    counts = [len(np.unique(np.round(np.array(e + [0.0]) / SAME))) for e in energies]
    print(f"distinct energies per set of stretches: median {int(np.median(counts))}, most {max(counts)}")
    compare_landings(path, batch, kept)
    mirrored_bows(config, path)


def mirrored_bows(config: Config, path: Equilibria) -> None:
    """The twins of one energy: bows that lie on the ground mirrored to their other side, and where their hops land."""
    inner = np.arange(LATTICE.n_nodes + 2 * LATTICE.n_cells, LATTICE.n_masses).reshape(-1, 2)
    x = path.positions
    near, chord = x[:, LATTICE.bars[:, 0]], x[:, LATTICE.bars[:, 1]] - x[:, LATTICE.bars[:, 0]]
    normal = np.stack([-chord[:, :, 1], chord[:, :, 0], np.zeros(chord.shape[:2])], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    offset = np.einsum("nbc,nbkc->nbk", normal, x[:, inner] - near[:, :, None])
    sideways = np.abs(offset.mean(axis=2)) > 1e-6
    print(
        f"bows on the ground: in {sideways.any(axis=1).sum()} of {len(x)} sets of stretches, at most {sideways.sum(axis=1).max()}"
    )
    rows = np.flatnonzero(sideways.any(axis=1))
    if not len(rows):
        return
    twins = x[rows].copy()
    for k, row in enumerate(rows):
        bar = np.flatnonzero(sideways[row])[0]
        twins[k][inner[bar]] -= 2 * offset[row, bar][:, None] * normal[row, bar]
    own = select(path, rows)
    other = Equilibria(**{**vars(own), "positions": twins})
    scene = Scene(duration=1.5, landing="touchdown")
    apart = np.linalg.norm(
        simulate(own.stretches, scene=scene, equilibria=other).touchdown
        - simulate(own.stretches, scene=scene, equilibria=own).touchdown,
        axis=1,
    )
    print(f"one bow mirrored: touchdown moves by {np.median(apart) * 1e3:.2f} mm (median), {apart.max() * 1e3:.2f} mm (most)")
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    left.hist(sideways.sum(axis=1), bins=np.arange(-0.5, sideways.sum(axis=1).max() + 1.5), rwidth=0.8)
    left.set_xlabel("bows on the ground")
    left.set_ylabel("sets of stretches")
    right.semilogy(own.stretches.mean(axis=1), apart * 1e3, "o")
    right.set_xlabel("mean stretch [-]")
    right.set_ylabel("touchdown moved by\none mirrored bow [mm]")
    right.grid(alpha=0.3)
    save(figure, config, "branches")


def sequential_path(batch: np.ndarray) -> Equilibria:
    """Equilibria reached by shortening one actuator after another in small steps."""
    current = np.full_like(batch, 0.9)
    found = form_find(current, outside=True)
    for k in range(batch.shape[1]):
        for share in np.linspace(0.1, 1.0, 10):
            step = current.copy()
            step[:, k] += share * (batch[:, k] - current[:, k])
            found = form_find(step, outside=True, start=found.positions)
        current[:, k] = batch[:, k]
    return found


def compare_landings(path: Equilibria, batch: np.ndarray, kept: list[tuple[float, Equilibria]]) -> None:
    """Touchdowns from some of the other equilibria beside those of the load path's."""
    scene = Scene(duration=1.5, landing="touchdown")
    chosen = sorted(kept, key=lambda pair: abs(pair[0]))
    chosen = [chosen[k] for k in np.unique(np.linspace(0, len(chosen) - 1, 6).astype(int))] if chosen else []
    if not chosen:
        return
    print("energy gap [J]  touchdown of the path's [m]  distance of the other's [m]")
    for gap, other in chosen:
        row = int(np.argmin(np.abs(batch - other.stretches).sum(axis=1)))
        hops = [simulate(e.stretches, scene=scene, equilibria=e).touchdown[0] for e in (select(path, np.array([row])), other)]
        print(f"{gap:14.2e}  {hops[0].round(4)!s:27s}  {np.linalg.norm(hops[1] - hops[0]):.4f}")
