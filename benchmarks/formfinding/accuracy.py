"""Errors of energy, nodes and landing against CPU time, all methods; fine against coarse line searches."""

from __future__ import annotations

import time

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.formfinding.common import DESIGN, LATTICE, Config, first, save, stretches, timed
from benchmarks.formfinding.reference import refined
from tensegrity_gym import Equilibria, Lattice, Scene, form_find, simulate
from tensegrity_gym.energies import elastic_energies
from tensegrity_gym.searches import Problem, SearchOptions, built, relaxation_search
from tensegrity_gym.timestep import default_time_step

#: Cap of relaxation with real masses.
PHYSICAL_STEPS = 1_000_000


def accuracy(config: Config) -> None:
    """Errors of energy, nodes and landing against CPU time, every method at several tolerances."""
    n = 2 if config.quick else 4
    batch = stretches(64, config.seed)
    scene = Scene(duration=1.5, landing="touchdown")
    reference = beyond_float64(batch[:n])
    landing = simulate(batch[:n], scene=scene, equilibria=reference).touchdown
    fine, coarse = {"line_tolerance": 1e-3, "line_cap": 20}, {"line_tolerance": 1.0, "line_cap": 1}
    many = 8 if config.quick else 24
    runs = [
        ("newton, batch of 64", "newton", 64, {}, (1e-2, 1e-4, 1e-6, 1e-8)),
        ("newton, one by one", "newton", -16, {}, (1e-8,)),
    ]
    for name, options in (("CG, fine line search", fine), ("CG, coarse", coarse)):
        runs += [(name, "cg", many, options, (1e-3, 1e-4, 1e-5)), (f"{name}, one by one", "cg", -n, options, (1e-5,))]
    for damping, last in (("viscous", 2e-6), ("kinetic", 1e-5)):
        name, options = f"relaxation, {damping}", {"damping": damping}
        tolerances = (1e-3, 1e-4, 1e-5, 2e-6)
        runs += [(name, "relaxation", many, options, tolerances), (f"{name}, one by one", "relaxation", -n, options, (last,))]
    print(
        "\nmethod                           tol/Pcr  converged  iterations  CPU/eq [ms]  vs newton  residual [N]"
        "  dE [J]    nodes [m]  touchdown [m]"
    )
    base, errors = 0.0, {}
    for name, method, count, options, tolerances in runs:
        rows = []
        for few in (1, 8):  # compile, without lanes and with
            form_find(batch[:few], method=method, options=SearchOptions(max_iterations=1, **options))
        for tolerance in tolerances:
            what = SearchOptions(tolerance=tolerance, **options)
            if count < 0:
                found, cpu = one_by_one(batch[:-count], method, what)
            else:
                found, cpu = timed(lambda c=count, m=method, o=what: form_find(batch[:c], method=m, options=o, threads=1))
            base = cpu if name.startswith("newton, batch") else base
            k = min(n, abs(count))
            energy = np.abs(found.energy[:k] - reference.energy[:k]).max()
            nodes = np.abs(found.positions[:k, : LATTICE.n_nodes] - reference.positions[:k, : LATTICE.n_nodes]).max()
            forced = replace_converged(first(found, k))
            shift = np.linalg.norm(simulate(batch[:k], scene=scene, equilibria=forced).touchdown - landing[:k], axis=1).max()
            rows.append((cpu, energy, nodes, shift))
            print(
                f"{name:32s} {tolerance:7.0e}  {found.converged.sum():4d}/{len(found.converged):<4d}"
                f"  {found.iterations.mean():10.0f}  {cpu * 1e3:11.2f}  {cpu / base:9.1f}  {found.residual.max():12.1e}"
                f"  {energy:8.1e}  {nodes:9.1e}  {shift:9.1e}",
                flush=True,
            )
        errors[name] = np.array(rows)
    draw_accuracy(config, errors)
    physical_relaxation(batch[:many], base)


def draw_accuracy(config: Config, errors: dict[str, np.ndarray]) -> None:
    """``errors``: rows of CPU time [s], energy error [J], node error [m], touchdown shift [m] by the method's name."""
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6))
    colours: dict[str, str] = {}
    for name, values in errors.items():
        alone = name.endswith("one by one")
        method = name.removesuffix(", one by one").removesuffix(", batch of 64")
        for axis, column in zip(axes, (1, 2, 3), strict=True):
            shown = {"color": colours[method]} if method in colours else {"label": method}
            (line,) = axis.loglog(values[:, 0], np.maximum(values[:, column], 1e-15), "s" if alone else "o-", **shown)
            line.set_markerfacecolor("white" if alone else line.get_color())
        colours[method] = line.get_color()
    for axis, title in zip(axes, ("energy error [J]", "node error [m]", "touchdown shift [m]"), strict=True):
        axis.set_xlabel("CPU time per equilibrium [s]")
        axis.set_title(title)
        axis.grid(alpha=0.3)
    axes[0].plot([], [], "s", color="grey", markerfacecolor="white", label="one by one")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=6, fontsize=8)
    save(figure, config, "accuracy")


def beyond_float64(batch: np.ndarray) -> Equilibria:
    """The equilibria as float64 rounds those of extended precision; prints what is left of their residuals and of Newton's."""
    found, close = form_find(batch), form_find(batch, options=SearchOptions(tolerance=2e-11))
    positions, residuals = refined(found, LATTICE, DESIGN, Scene())
    away = [float(np.abs(positions - e.positions).max()) for e in (found, close)]
    print(
        f"reference: residual {residuals.max() / DESIGN.critical_load:.1e} Euler loads in extended precision; Newton's masses are"
        f" {away[0]:.1e} m from it, asked for 2e-11 Euler loads {away[1]:.1e} m ({close.converged.sum()}/{len(batch)} converge)"
    )
    rounded, structure = positions.astype(np.float64), DESIGN.structure(LATTICE)
    parts = elastic_energies(structure, rounded, batch * structure.actuator_length)
    weight = -np.einsum("m,nmc,c->n", structure.mass, rounded, Scene().gravity_vector)
    return Equilibria(**{**vars(found), "positions": rounded, "energy": np.sum(list(parts.values()), axis=0) + weight})


def one_by_one(batch: np.ndarray, method: str, options: SearchOptions) -> tuple[Equilibria, float]:
    """Each equilibrium by a call of its own: the equilibria and the CPU time each took [s]."""
    begin = time.process_time()
    for row in batch:
        form_find(row, method=method, options=options, threads=1)
    cpu = (time.process_time() - begin) / len(batch)
    return form_find(batch, method=method, options=options), cpu


def physical_relaxation(batch: np.ndarray, newton: float) -> None:
    """Relaxation with the lattice's own masses and the simulator's time step, as a simulation that is damped to rest."""
    lattice, structure, _, _ = built(DESIGN, LATTICE)
    problem = Problem(batch, None, DESIGN, Scene(), lattice, structure)
    mass = np.repeat(structure.mass[None] / default_time_step(DESIGN, LATTICE) ** 2, len(batch), axis=0)
    for damping in ("viscous", "kinetic"):
        begin = time.process_time()
        found = relaxation_search(problem, SearchOptions(damping=damping, max_iterations=PHYSICAL_STEPS), 1, None, mass)
        cpu = (time.process_time() - begin) / len(batch)
        print(
            f"relaxation, {damping}, real masses and the simulator's step: {found.converged.sum()}/{len(batch)} to"
            f" {found.residual.max() / DESIGN.critical_load:.0e} Euler loads, {found.iterations.mean():.0f} steps, {cpu:.2f} s,"
            f" {cpu / newton:.0f} times Newton's",
            flush=True,
        )


def replace_converged(found: Equilibria) -> Equilibria:
    """The same, every one of them declared found: to see where a hop from a bad equilibrium lands."""
    return Equilibria(**{**vars(found), "converged": np.ones(len(found.stretches), dtype=bool)})


def line_search(config: Config) -> None:
    """Fine against coarse line searches, on one cell."""
    cell = Lattice(1, 1)
    batch = stretches(8 if config.quick else 24, config.seed, 1)
    tolerances = (1.0, 0.3, 0.1, 0.01, 1e-3)
    caps = (1, 3, 20)
    print("\nline search on one cell: tolerance, cap of parabolas -> directions, energies per direction, CPU/eq [ms], converged")
    figure, axis = plt.subplots(figsize=(5, 3.4))
    form_find(batch, lattice=cell, method="cg", options=SearchOptions(max_iterations=1))
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
