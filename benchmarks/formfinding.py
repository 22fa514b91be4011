"""Form-finding measured: error against CPU time, line search, cells, other equilibria, where it fails.

    python -m benchmarks.formfinding            # everything, 10 to 15 minutes on one core
    python -m benchmarks.formfinding --quick    # two minutes
    python -m benchmarks.formfinding --parts failures

Prints tables; charts go to docs/images/formfinding_*.png. Times are CPU times of one thread, so that a busy machine shows less.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib as mpl
import numpy as np
import tyro

from tensegrity_gym import Design, Equilibria, Lattice, Scene, form_find, simulate
from tensegrity_gym.searches import SearchOptions, start_positions
from tensegrity_gym.stability import check_stability

mpl.use("Agg")
import matplotlib.pyplot as plt

IMAGES = Path(__file__).parents[1] / "docs" / "images"
LATTICE, DESIGN = Lattice(2, 2), Design()
#: Energies closer than this are one equilibrium [J]: found ones agree to 1e-12 J, different ones differ by 1e-5 J or more.
SAME = 1e-7


@dataclass
class Config:
    """What to measure."""

    quick: bool = False
    """Fewer stretches and lattices."""
    parts: tuple[str, ...] = ("accuracy", "line_search", "cells", "throughput", "branches", "failures", "stability")
    """Which measurements."""
    images: Path = field(default=IMAGES)
    """Folder for the charts."""
    seed: int = 0
    """Of the random stretches and starts."""


def timed(call: Callable[[], Equilibria]) -> tuple[Equilibria, float]:
    """The equilibria and the CPU time each took [s]."""
    begin = time.process_time()
    found = call()
    return found, (time.process_time() - begin) / len(found.stretches)


def stretches(n: int, seed: int, cells: int = 4, low: float = 0.2, high: float = 0.8) -> np.ndarray:
    """Random stretches in the paper's range, shape (n, cells)."""
    return np.random.default_rng(seed).uniform(low, high, size=(n, cells))


def save(figure: plt.Figure, config: Config, name: str) -> None:
    """Write a chart."""
    config.images.mkdir(parents=True, exist_ok=True)
    figure.savefig(config.images / f"formfinding_{name}.png", dpi=80, bbox_inches="tight")
    plt.close(figure)


def accuracy(config: Config) -> None:
    """Errors of energy, nodes and landing against CPU time, every method at several tolerances."""
    n = 2 if config.quick else 4
    batch = stretches(64, config.seed)
    reference = form_find(batch, options=SearchOptions(tolerance=5e-10))
    scene = Scene(duration=1.5, landing="touchdown")
    landing = simulate(batch[:n], scene=scene, equilibria=first(reference, n)).touchdown
    runs = [("newton, batch of 64", "newton", 64, {}, (1e-2, 1e-4, 1e-6, 1e-8)), ("newton, one", "newton", 1, {}, (1e-8,))]
    runs += [("CG, fine line search", "cg", n, {"line_tolerance": 1e-3, "line_cap": 20}, (1e-3, 1e-4, 1e-5))]
    runs += [("CG, coarse", "cg", n, {"line_tolerance": 1.0, "line_cap": 1}, (1e-3, 1e-4, 1e-5))]
    runs += [(f"relaxation, {d}", "relaxation", n, {"damping": d}, (1e-3, 1e-4, 1e-5, 2e-6)) for d in ("viscous", "kinetic")]
    print(
        "\nmethod                 tol/Pcr  converged  iterations  CPU/eq [ms]  vs newton  residual [N]"
        "  dE [J]    nodes [m]  touchdown [m]"
    )
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6))
    base = 0.0
    for name, method, count, options, tolerances in runs:
        rows = []
        form_find(batch[:1], method=method, options=SearchOptions(max_iterations=1, **options))  # compile
        for tolerance in tolerances:
            what = SearchOptions(tolerance=tolerance, **options)
            found, cpu = timed(lambda c=count, m=method, o=what: form_find(batch[:c], method=m, options=o, threads=1))
            base = cpu if name.startswith("newton, batch") else base
            k = min(n, count)
            energy = np.abs(found.energy[:k] - reference.energy[:k]).max()
            nodes = np.abs(found.positions[:k, : LATTICE.n_nodes] - reference.positions[:k, : LATTICE.n_nodes]).max()
            forced = replace_converged(first(found, k))
            shift = np.linalg.norm(simulate(batch[:k], scene=scene, equilibria=forced).touchdown - landing[:k], axis=1).max()
            rows.append((cpu, energy, nodes, shift))
            print(
                f"{name:22s} {tolerance:7.0e}  {found.converged.sum():4d}/{count:<4d}  {found.iterations.mean():10.0f}"
                f"  {cpu * 1e3:11.2f}  {cpu / base:9.1f}  {found.residual.max():12.1e}"
                f"  {energy:8.1e}  {nodes:9.1e}  {shift:9.1e}",
                flush=True,
            )
        values = np.array(rows)
        for axis, column in zip(axes, (1, 2, 3), strict=True):
            axis.loglog(values[:, 0], np.maximum(values[:, column], 1e-15), "o-", label=name)
    for axis, title in zip(axes, ("energy error [J]", "node error [m]", "touchdown shift [m]"), strict=True):
        axis.set_xlabel("CPU time per equilibrium [s]")
        axis.set_title(title)
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=7)
    save(figure, config, "accuracy")


def first(found: Equilibria, n: int) -> Equilibria:
    """The first ``n`` equilibria."""
    return select(found, np.arange(n))


def select(found: Equilibria, rows: np.ndarray) -> Equilibria:
    """Some of the equilibria."""
    columns = {k: v[rows] if isinstance(v, np.ndarray) else v for k, v in vars(found).items()}
    columns["energies"] = {k: v[rows] for k, v in found.energies.items()}
    return Equilibria(**columns)


def replace_converged(found: Equilibria) -> Equilibria:
    """The same, every one of them declared found: to see where a hop from a bad equilibrium lands."""
    return Equilibria(**{**vars(found), "converged": np.ones(len(found.stretches), dtype=bool)})


def line_search(config: Config) -> None:
    """Fine against coarse line searches, on one cell."""
    cell = Lattice(1, 1)
    batch = stretches(2 if config.quick else 6, config.seed, 1)
    tolerances = (1.0, 0.3, 0.1, 0.01, 1e-3)
    caps = (1, 3, 20)
    print("\nline search on one cell: tolerance, cap of parabolas -> directions, energies per direction, CPU/eq [ms], converged")
    figure, axis = plt.subplots(figsize=(5, 3.4))
    form_find(batch[:1], lattice=cell, method="cg", options=SearchOptions(max_iterations=1))
    for cap in caps:
        times = []
        for tolerance in tolerances:
            options = SearchOptions(line_tolerance=tolerance, line_cap=cap)
            found, cpu = timed(lambda o=options: form_find(batch, lattice=cell, method="cg", options=o, threads=1))
            times.append(cpu * 1e3)
            print(
                f"{tolerance:8.0e} {cap:4d}  {found.iterations.mean():9.0f}  {(found.evaluations / found.iterations).mean():6.2f}"
                f"  {cpu * 1e3:8.1f}  {found.converged.sum()}/{len(batch)}",
                flush=True,
            )
        axis.semilogx(tolerances, times, "o-", label=f"at most {cap} parabola{'s' * (cap > 1)}")
    axis.set_xlabel("tolerance of the step [-]")
    axis.set_ylabel("CPU per equilibrium [ms]")
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3)
    save(figure, config, "line_search")


def cells(config: Config) -> None:
    """Newton's CPU time against the number of cells."""
    grids = ((1, 1), (2, 1), (2, 2), (3, 2)) if config.quick else ((1, 1), (2, 1), (2, 2), (3, 2), (3, 3), (4, 3), (5, 4))
    counts, times = [], []
    print("\ncells  masses  converged  iterations  CPU/eq [ms]  CPU/eq/cell [ms]")
    for grid in grids:
        lattice = Lattice(*grid)
        batch = stretches(16 if config.quick else 32, config.seed, lattice.n_cells)
        form_find(batch[:1], lattice=lattice, options=SearchOptions(max_iterations=1))
        found, cpu = timed(lambda b=batch, k=lattice: form_find(b, lattice=k, threads=1))
        counts.append(lattice.n_cells)
        times.append(cpu * 1e3)
        print(
            f"{grid[0]}x{grid[1]:<4d} {lattice.n_masses:6d}  {found.converged.sum():5d}/{len(batch):<4d}"
            f" {found.iterations.mean():9.0f}  {cpu * 1e3:10.2f}  {cpu * 1e3 / lattice.n_cells:10.2f}",
            flush=True,
        )
    figure, axis = plt.subplots(figsize=(4.6, 3.4))
    axis.loglog(counts, times, "o-", label="measured")
    axis.loglog(counts, times[0] * np.array(counts), "--", color="grey", label="linear in cells")
    axis.set_xlabel("cells")
    axis.set_ylabel("CPU per equilibrium [ms]")
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3, which="both")
    save(figure, config, "cells")


def throughput(config: Config) -> None:
    """Equilibria per second of all threads, and what 40 000 take."""
    n = 512 if config.quick else 4000
    batch = stretches(n, config.seed)
    form_find(batch[:8])
    begin, busy = time.perf_counter(), time.process_time()
    found = form_find(batch, threads=2)
    wall, cpu = time.perf_counter() - begin, time.process_time() - busy
    spread = np.percentile(found.iterations, (50, 90, 99, 100)).astype(int)
    print(
        f"\nthroughput: {n} equilibria, {found.converged.sum()} converged, {wall:.1f} s on 2 threads,"
        f" {cpu / n * 1e3:.2f} ms CPU each;"
        f" 40 000 take {cpu / n * 40000 / 2:.0f} s of 2 idle cores; iterations 50/90/99/100 %: {spread}"
    )
    worst = (found.residual / np.maximum(found.cable_tension.max(axis=1), found.actuator_tension.max(axis=1))).max()
    print(f"largest residual over the largest member force: {worst:.1e}")
    for row in np.flatnonzero(~found.converged)[:5]:
        print(f"not converged: {batch[row].tolist()} {found.hints[row]}")


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


def failures(config: Config) -> None:
    """Maps of found, another found, none found: over stretch and prestrain on one cell, over stretch and bar on the 2x2."""
    levels = np.array((0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.45, 0.6, 0.8, 0.9, 1.0, 1.1, 1.3))
    strained = [(f"{p:g}", Design(prestrain=p)) for p in (0.0, 1e-4, 5e-4, 2e-3, 5e-3)]
    thin = [(f"{d * 1e3:g}", Design(bar_diameter=d)) for d in (0.25e-3, 0.5e-3, 1e-3, 1.5e-3, 2e-3, 4e-3, 16e-3)]
    methods = ("newton",) if config.quick else ("newton", "relaxation", "cg")
    panels = [(m, Lattice(1, 1), "prestrain [-]", strained) for m in methods]
    panels.append(("newton", LATTICE, "bar diameter [mm]", thin))
    figure, axes = plt.subplots(1, len(panels), figsize=(4.4 * len(panels), 3.2), squeeze=False, layout="constrained")
    for axis, (method, lattice, what, designs) in zip(axes[0], panels, strict=True):
        image = np.array([outcome(method, lattice, design, levels) for _, design in designs])
        axis.imshow(image, cmap=mpl.colors.ListedColormap(["#c0392b", "#f1c40f", "#27ae60"]), vmin=0, vmax=2, aspect="auto")
        axis.set_xticks(range(len(levels)), [f"{v:g}" for v in levels], rotation=90)
        axis.set_yticks(range(len(designs)), [name for name, _ in designs])
        axis.set_xlabel("stretch of every other actuator, rest 0.5 [-]" if lattice.n_cells > 1 else "stretch [-]")
        axis.set_ylabel(what)
        axis.set_title(f"{method}, {lattice.nx}x{lattice.ny}", fontsize=9)
        print(f"\n{method}, {lattice.nx}x{lattice.ny}, columns stretch {levels.tolist()}; 2 found, 1 another, 0 none")
        for (name, _), row in zip(designs, image, strict=True):
            print(f"{what} {name:>7s}  {' '.join(str(int(v)) for v in row)}")
    save(figure, config, "failures")
    extremes()


def outcome(method: str, lattice: Lattice, design: Design, levels: np.ndarray) -> np.ndarray:
    """2 where the load path's is found, 1 where another is or a finer load path finds none to compare with, 0 where none."""
    batch = np.repeat(levels[:, None], lattice.n_cells, axis=1)
    batch[:, 1::2] = 0.5
    reference = form_find(batch, design=design, lattice=lattice, outside=True, options=SearchOptions(load_step=0.03))
    options = SearchOptions(max_iterations={"cg": 40_000, "relaxation": 300_000}.get(method))
    found = form_find(batch, design=design, lattice=lattice, outside=True, method=method, options=options)
    same = np.abs(found.energy - reference.energy) < (SAME if method == "newton" else 1e-5)
    return np.where(found.converged, np.where(same & reference.converged, 2, 1), 0)


def extremes() -> None:
    """Absurd materials and one actuator alone."""
    alone = [[0.2, 1.0, 1.0, 1.0], [0.5, 1.0, 1.0, 1.0], [0.8, 1.0, 1.0, 1.0]]
    cases: list[tuple[str, Design, list[list[float]]]] = [("one actuator alone", DESIGN, alone)]
    sample = stretches(8, 1).tolist()
    cases += [(f"bar diameter {d * 1e3:g} mm", Design(bar_diameter=d), sample) for d in (0.5e-3, 1e-3, 2e-3, 8e-3, 16e-3)]
    cases += [(f"bar modulus {e:.0e} Pa", Design(bar_modulus=e), sample) for e in (1e6, 1e8, 1e10, 1e13)]
    cases += [(f"cable modulus {e:.0e} Pa", Design(cable_modulus=e), sample) for e in (1e6, 1e8, 1e10, 1e13)]
    print("\ncase                      converged  iterations  largest bar load / Euler  a hint")
    for name, design, batch in cases:
        found = form_find(batch, design=design, outside=True)
        hint = next((h for h in found.hints if h), "")
        ratio = found.bar_load.max() / design.critical_load
        print(
            f"{name:25s} {found.converged.sum():4d}/{len(batch):<4d} {found.iterations.mean():9.0f}  {ratio:12.2f}  {hint[:90]}",
            flush=True,
        )


def stability(config: Config) -> None:
    """Second-order check of random equilibria, and how well the lattice's symmetries hold."""
    batch = stretches(8 if config.quick else 24, config.seed)
    found = form_find(batch)
    check = check_stability(found)
    print(
        f"\nstable {check.stable.sum()}/{len(batch)}, lowest eigenvalue {check.eigenvalues.min():.2f} N/m, softest spin"
        f" {check.spin_eigenvalues.min():.2f} N/m, bars past their Euler load {check.past_critical.min()} to"
        f" {check.past_critical.max()} (by {check.load_ratio.max() - 1:.1%} at most),"
        f" surface strain {check.bending_strain.max():.2%}"
    )
    for permutation in LATTICE.symmetries[1:]:
        image = form_find(batch[:, permutation])
        print(
            f"stretches permuted by {permutation.tolist()}: energies differ by {np.abs(image.energy - found.energy).max():.1e} J"
        )


PARTS: dict[str, Callable[[Config], None]] = {
    "accuracy": accuracy,
    "line_search": line_search,
    "cells": cells,
    "throughput": throughput,
    "branches": branches,
    "failures": failures,
    "stability": stability,
}


def main(config: Config) -> None:
    """Run the parts asked for."""
    for part in config.parts:
        PARTS[part](config)


if __name__ == "__main__":
    main(tyro.cli(Config))
