"""Second-order checks of random equilibria: stiffness, strain, bars that touch, ends of load paths, symmetry."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.formfinding.common import DESIGN, LATTICE, Config, save, stretches
from tensegrity_gym import form_find
from tensegrity_gym.clearance import centreline_distance
from tensegrity_gym.stability import check_stability, follow_load_path


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
    ends = [follow_load_path(row) for row in batch[: 2 if config.quick else 6]]
    print(
        f"load paths to {min(p.shares[-1] for p in ends):.2f} to {max(p.shares[-1] for p in ends):.2f} times the load:"
        f" {sum(len(p.critical) for p in ends)} lost stabilities in {len(ends)} paths,"
        f" lowest eigenvalue on the way {min(np.nanmin(p.lowest) for p in ends):.2f} N/m"
    )
    touching_bars(config)
    for permutation in LATTICE.symmetries[1:]:
        image = form_find(batch[:, permutation])
        print(
            f"stretches permuted by {permutation.tolist()}: energies differ by {np.abs(image.energy - found.energy).max():.1e} J"
        )


def touching_bars(config: Config) -> None:
    """The least gap between bars that share no node, of random stretches and of equal ones."""
    bars, diameter = DESIGN.structure(LATTICE).bars, DESIGN.bar_diameter
    batch = stretches(100 if config.quick else 1000, config.seed)
    gaps = centreline_distance(form_find(batch).positions, bars) - diameter
    levels = np.linspace(0.2, 0.8, 25)
    equal = centreline_distance(form_find(np.repeat(levels[:, None], LATTICE.n_cells, axis=1)).positions, bars) - diameter
    print(
        f"bars touch in {(gaps < 0).mean():.0%} of {len(batch)} random sets of stretches; with equal stretches up to"
        f" {levels[equal < 0].max(initial=0.0):.3f}; of random ones whose least is above 0.5, in"
        f" {(gaps[batch.min(axis=1) > 0.5] < 0).mean():.0%}"
    )
    figure, axis = plt.subplots(figsize=(4.8, 3.2))
    axis.plot(batch.min(axis=1), gaps * 1e3, ".", markersize=3, label="random")
    axis.plot(levels, equal * 1e3, "-", label="equal stretches")
    axis.axhline(0.0, color="black", linewidth=0.8)
    axis.set_xlabel("least stretch [-]")
    axis.set_ylabel("least gap between bars [mm]")
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3)
    save(figure, config, "clearance")
