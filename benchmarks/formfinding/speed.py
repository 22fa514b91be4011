"""CPU time against the number of cells, and equilibria per second in bulk."""

from __future__ import annotations

import time

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.formfinding.common import Config, save, stretches, timed
from tensegrity_gym import Lattice, form_find
from tensegrity_gym.elimination import lattice_pattern
from tensegrity_gym.searches import SearchOptions


def cells(config: Config) -> None:
    """Newton's CPU time against the number of cells."""
    grids = ((1, 1), (2, 1), (2, 2), (3, 2)) if config.quick else ((1, 1), (2, 1), (2, 2), (3, 2), (3, 3), (4, 3), (5, 4))
    counts, times = [], []
    print("\ncells  masses  converged  iterations  block updates/cell  CPU/eq [ms]  CPU/eq/cell [ms]  CPU/iteration/cell [us]")
    for grid in grids:
        lattice = Lattice(*grid)
        batch = stretches(16 if config.quick else 32, config.seed, lattice.n_cells)
        form_find(batch[:1], lattice=lattice, options=SearchOptions(max_iterations=1))
        found, cpu = timed(lambda b=batch, k=lattice: form_find(b, lattice=k, threads=1))
        counts.append(lattice.n_cells)
        times.append(cpu * 1e3)
        print(
            f"{grid[0]}x{grid[1]:<4d} {lattice.n_masses:6d}  {found.converged.sum():5d}/{len(batch):<4d}"
            f" {found.iterations.mean():9.0f}  {len(lattice_pattern(lattice, 3).targets) / lattice.n_cells:12.0f}"
            f"  {cpu * 1e3:15.2f}  {cpu * 1e3 / lattice.n_cells:10.2f}"
            f"  {cpu * 1e6 / lattice.n_cells / found.iterations.mean():16.2f}",
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
