"""What the default damping means: the damping ratio of every mode of the unloaded lattice, and where it comes from."""

from __future__ import annotations

from itertools import pairwise

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.linalg import eigh

from benchmarks.accuracy.bars import bending_matrices
from benchmarks.accuracy.part import Data, Options, Part, table
from tensegrity_gym import Design, Lattice
from tensegrity_gym.elimination import lattice_pattern
from tensegrity_gym.stability import tangent_matrix
from tensegrity_gym.timestep import spring_matrix

SOURCES = ("bars, axial", "cables", "bars, bending")


def modes(lattice: Lattice) -> tuple[np.ndarray, np.ndarray]:
    """omega [rad/s] of the free unloaded lattice's elastic modes and their damping ratios by source, shape (n, 3).

    Actuated cables and their ties, just slack there, are left out; bars are straight (hinges damp as a small bow would).
    """
    design = Design()
    s, x = design.structure(lattice), design.unloaded_positions(lattice)
    taut = np.linalg.norm(x[s.cables[:, 1]] - x[s.cables[:, 0]], axis=1) > s.cable_length * (1 + 1e-9)
    changed = {name: np.where(taut, getattr(s, name), 0.0) for name in ("cable_stiffness", "cable_damping")}
    s = s._replace(actuator_rigidity=0.0 * s.actuator_rigidity, **changed)
    pattern = lattice_pattern(lattice, int(design.bar_segments))
    root = np.repeat(1 / np.sqrt(s.mass), 3)

    def scaled(structure: object) -> np.ndarray:
        return root[:, None] * tangent_matrix(structure, pattern, s.actuator_length, x).toarray() * root  # type: ignore[arg-type]

    stiffness = scaled(s)
    bending = stiffness - scaled(s._replace(hinge_stiffness=0.0 * s.hinge_stiffness))
    none = 0.0 * s.actuator_damping
    axial = spring_matrix(s, x, (0.0 * s.cable_damping, none, s.segment_damping)).toarray()
    cables = spring_matrix(s, x, (s.cable_damping, none, 0.0 * s.segment_damping)).toarray()
    squares, shapes = eigh(stiffness)
    elastic = squares > 1.0  # [1/s^2]; rigid motions are zero
    omega, shapes = np.sqrt(squares[elastic]), shapes[:, elastic]
    ratios = [np.einsum("im,ij,jm->m", shapes, c, shapes) / (2 * omega) for c in (axial, cables, design.hinge_damping * bending)]
    return omega, np.stack(ratios, axis=1)


def measure(options: Options) -> Data:
    """Modes of the lattice and of one bar."""
    omega, ratios = modes(Lattice(1, 1) if options.quick else Lattice())
    design = Design()
    stiffness, geometric, mass = bending_matrices(design)
    data = {"omega": omega, "ratios": ratios}
    for share in (0.0, design.prestress_load / design.critical_load):
        squares, shapes = eigh(stiffness - share * design.critical_load * geometric, np.diag(mass))
        damping = np.einsum("im,ij,jm->m", shapes, design.hinge_damping * stiffness, shapes)
        data[f"bar/{share:.2f}/omega"], data[f"bar/{share:.2f}/ratio"] = np.sqrt(squares), damping / (2 * np.sqrt(squares))
    return data


def report(d: Data) -> list[str]:
    """Bands of frequencies of the lattice, and one bar's modes."""
    hertz, ratios = d["omega"] / (2 * np.pi), d["ratios"]
    rows = []
    edges = (0.0, 15.0, 30.0, 60.0, 150.0, 400.0, 1500.0, 5e3, np.inf)
    for low, high in pairwise(edges):
        band = (hertz >= low) & (hertz < high)
        if band.any():
            cells = [f"{low:g} to {high:g}", str(band.sum()), f"{100 * np.median(ratios[band].sum(axis=1)):.2g}"]
            rows.append([*cells, *[f"{100 * np.median(ratios[band, k]):.2g}" for k in range(3)]])
    head = "band [Hz]  modes  damping ratio [%]  " + "  ".join(f"of {s} [%]" for s in SOURCES)
    lines = [f"{len(hertz)} elastic modes of the unloaded lattice, {hertz.min():.1f} to {hertz.max():.0f} Hz", *table(head, rows)]
    for key in sorted(k for k in d if k.startswith("bar/") and k.endswith("omega")):
        share = key.split("/")[1]
        pairs = zip(d[key] / (2 * np.pi), 100 * d[f"bar/{share}/ratio"], strict=True)
        lines.append(f"one pinned bar at {share} of its Euler load: " + ", ".join(f"{f:.1f} Hz {r:.1f} %" for f, r in pairs))
    return lines


def plot(d: Data) -> Figure:
    """Damping ratio of every mode, and each source's share."""
    figure, axis = plt.subplots(figsize=(6, 3.6), layout="constrained")
    hertz = d["omega"] / (2 * np.pi)
    for k, (source, mark) in enumerate(zip(SOURCES, ".x+", strict=True)):
        axis.loglog(hertz, np.maximum(d["ratios"][:, k], 1e-7), mark, ms=4, alpha=0.6, label=source)
    axis.loglog(hertz, d["ratios"].sum(axis=1), "k-", lw=0.6, label="all")
    axis.axhspan(5e-4, 5e-3, color="0.9", zorder=0)
    axis.text(150.0, 2.2e-3, "carbon rods alone", fontsize=8, color="0.4", zorder=0)
    axis.set(xlabel="frequency [Hz]", ylabel="damping ratio [-]", ylim=(1e-5, 2))
    axis.grid(alpha=0.3)
    axis.legend(fontsize=7, loc="upper left")
    return figure


PART = Part("damping", measure, report, plot)
