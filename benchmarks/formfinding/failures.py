"""Where form-finding fails: maps over stretch, prestrain and bars, the weight that bars carry, absurd materials."""

from __future__ import annotations

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.formfinding.common import DESIGN, LATTICE, SAME, Config, save, stretches
from tensegrity_gym import Design, Scene, form_find
from tensegrity_gym.searches import SearchOptions


def failures(config: Config) -> None:
    """Maps of found, another found, none found on the 2x2 lattice: over stretch and prestrain, over stretch and bar."""
    weight(config)
    extremes()
    levels = np.array((0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.45, 0.6, 0.8, 0.9, 1.0, 1.1, 1.3))
    fewer = levels[[0, 2, 4, 6, 8, 10, 12]]
    strained = [(f"{p:g}", Design(prestrain=p)) for p in (0.0, 1e-4, 5e-4, 2e-3, 5e-3)]
    thin = [(f"{d * 1e3:g}", Design(bar_diameter=d)) for d in (0.25e-3, 0.5e-3, 1e-3, 1.5e-3, 2e-3, 4e-3, 16e-3)]
    panels = [("newton", levels, "prestrain [-]", strained)]
    panels += [(m, fewer, "prestrain [-]", strained[::2]) for m in ("relaxation", "cg") if not config.quick]
    panels.append(("newton", levels, "bar diameter [mm]", thin))
    figure, axes = plt.subplots(1, len(panels), figsize=(4.4 * len(panels), 3.2), squeeze=False, layout="constrained")
    for axis, (method, columns, what, designs) in zip(axes[0], panels, strict=True):
        image = np.array([outcome(method, design, columns) for _, design in designs])
        axis.imshow(image, cmap=mpl.colors.ListedColormap(["#c0392b", "#f1c40f", "#27ae60"]), vmin=0, vmax=2, aspect="auto")
        axis.set_xticks(range(len(columns)), [f"{v:g}" for v in columns], rotation=90)
        axis.set_yticks(range(len(designs)), [name for name, _ in designs])
        axis.set_xlabel("stretch of every other actuator, rest 0.5 [-]")
        axis.set_ylabel(what)
        axis.set_title(method, fontsize=9)
        print(f"\n{method}, columns stretch {columns.tolist()}; 2 found, 1 another, 0 none")
        for (name, _), row in zip(designs, image, strict=True):
            print(f"{what} {name:>7s}  {' '.join(str(int(v)) for v in row)}", flush=True)
    save(figure, config, "failures")


def weight(config: Config) -> None:
    """Equilibria found, and how high the lattice stands, against its weight over the Euler load of a bar."""
    batch = stretches(16, 1)
    cases = [(g, Design(bar_diameter=d * 1e-3)) for g in ("earth", "moon") for d in (0.5, 1, 1.5, 1.75, 2, 2.25, 2.5, 3, 4)]
    cases += [(g, Design(bar_modulus=1e10)) for g in ("earth", "moon")]
    print(
        "\nscene  bar                 weight/Euler load  found  factorisations: median, most  height/cell: least of those found"
    )
    rows = []
    for name, design in cases:
        scene = Scene.preset(name)
        load = design.structure(LATTICE).mass.sum() * scene.gravity / design.critical_load
        found = form_find(batch, design=design, scene=scene)
        height = (found.positions[:, :, 2].max(axis=1) / design.cell_height)[found.converged].min(initial=np.inf)
        rows.append((load, found.converged.mean(), height, name))
        print(
            f"{name:6s} {design.bar_diameter * 1e3:4.2f} mm, {design.bar_modulus:.1e} Pa  {load:10.2f}"
            f"  {found.converged.sum():7d}/16  {np.median(found.evaluations):8.0f} {found.evaluations.max():6d}  {height:10.2f}",
            flush=True,
        )
    figure, axis = plt.subplots(figsize=(4.8, 3.2))
    for name, marker in (("earth", "o"), ("moon", "s")):
        chosen = np.array([r[:2] for r in rows if r[3] == name])
        axis.semilogx(chosen[:, 0], chosen[:, 1], marker, label=name)
    axis.set_xlabel("weight of the lattice over the Euler load of a bar [-]")
    axis.set_ylabel("equilibria found, of 16 [-]")
    axis.legend(fontsize=8)
    axis.grid(alpha=0.3)
    save(figure, config, "weight")


def outcome(method: str, design: Design, levels: np.ndarray) -> np.ndarray:
    """2 where the load path's is found, 1 where another is or a finer load path finds none to compare with, 0 where none."""
    batch = np.repeat(levels[:, None], LATTICE.n_cells, axis=1)
    batch[:, 1::2] = 0.5
    reference = form_find(batch, design=design, outside=True, options=SearchOptions(load_step=0.03))
    options = SearchOptions(max_iterations=300_000 if method == "relaxation" else None)
    found = form_find(batch, design=design, outside=True, method=method, options=options)
    same = np.abs(found.energy - reference.energy) < (SAME if method == "newton" else 1e-5)
    return np.where(found.converged, np.where(same & reference.converged, 2, 1), 0)


def extremes() -> None:
    """Absurd materials and one actuator alone."""
    alone = [[0.2, 1.0, 1.0, 1.0], [0.5, 1.0, 1.0, 1.0], [0.8, 1.0, 1.0, 1.0]]
    cases: list[tuple[str, Design, list[list[float]]]] = [("one actuator alone", DESIGN, alone)]
    sample = stretches(8, 1).tolist()
    cases += [(f"bar diameter {d * 1e3:g} mm", Design(bar_diameter=d), sample) for d in (0.5e-3, 1e-3, 2e-3, 8e-3, 16e-3)]
    cases += [(f"bar modulus {e:.0e} Pa", Design(bar_modulus=e), sample) for e in (5e6, 1e7, 1e10, 1e13)]
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
