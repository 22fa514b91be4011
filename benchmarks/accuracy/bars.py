"""Bar models against the elastica: post-buckling curve, second buckling load, first bending frequency."""

from __future__ import annotations

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.linalg import eigh
from scipy.optimize import brentq
from scipy.special import ellipe, ellipj, ellipk

from benchmarks.accuracy.part import Data, Options, Part, table
from benchmarks.accuracy.stepping import forces, only_bars
from tensegrity_gym import Design
from tensegrity_gym.types import Floats, Structure

SEGMENTS = (1, 2, 3, 5, 9, 17)
SHORTENINGS = (0.01, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)


def elastica(shortening: float) -> tuple[float, float]:
    """(P / P_Euler, deflection / length) of the pinned inextensible elastica at end-shortening / length."""
    m = brentq(lambda k2: 2.0 - 2.0 * ellipe(k2) / ellipk(k2) - shortening, 1e-12, 0.9)
    return float((2.0 * ellipk(m) / np.pi) ** 2), float(np.sqrt(m) / ellipk(m))


def one_bar(design: Design) -> tuple[Structure, Floats]:
    """One pinned bar along x and the positions of its masses, segments at their natural length."""
    n, bar = int(design.bar_segments), design.bar_mass
    end, inner = design.bar_mass_shares()
    mass = bar * np.array([end, *[inner] * (n - 1), end])
    length = design.bar_length / n
    structure = only_bars(
        mass,
        np.arange(n + 1)[None],
        stiffness=design.bar_rigidity / length,
        length=length,
        hinge_stiffness=design.hinge_stiffness,
    )
    return structure, np.linspace(0, design.bar_length, n + 1)[:, None] * [1.0, 0, 0]


def elastica_links(shortening: float, n: int) -> Floats:
    """Slopes [rad] of the elastica in the middles of n equal pieces, end to end."""
    m = brentq(lambda k2: 2.0 - 2.0 * ellipe(k2) / ellipk(k2) - shortening, 1e-12, 0.9)
    where = (2 * (np.arange(n) + 0.5) / n) * ellipk(m)  # sin(slope / 2) = k cd(u), u from 0 to 2K
    _, cn, dn, _ = ellipj(where, m)
    return 2 * np.arcsin(np.sqrt(m) * cn / dn)


def buckled(design: Design, shortening: float) -> tuple[float, float]:
    """(P / P_Euler, deflection / length) of the model bar whose chord is shorter than the sum of its segments by ``shortening``.

    Segments are as stiff as the design's; the shortening counts bending alone, as the elastica is inextensible. Newton on the
    simulator's forces, from the elastica's own shape.
    """
    structure, x = one_bar(design)
    n, k = len(x), int(design.bar_segments)
    slope = elastica_links(shortening, k)
    steps = design.bar_length / k * np.stack([np.cos(slope), 0 * slope, np.sin(slope)], axis=1)
    x[1:] = np.cumsum(steps, axis=0)
    x[-1, 2] = 0.0
    unknowns = [(i, c) for i in range(1, n - 1) for c in (0, 2)] + [(n - 1, 0)]
    rows, columns = np.array(unknowns).T
    scale = design.critical_load

    def residual(at: Floats) -> Floats:
        f = forces(structure, at)[rows, columns] / scale
        bent = 1 - at[-1, 0] / np.linalg.norm(np.diff(at, axis=0), axis=1).sum()
        f[-1] = 1e4 * (bent - shortening)
        return f

    h = 1e-8 * design.bar_length
    for _ in range(50):
        here = residual(x)
        if np.abs(here).max() < 1e-7:  # rounding of x, 1e-16 of its length, is worth 1e-8 of the Euler load
            pushed = forces(structure, x)[-1, 0]  # the bar pushes its end outwards with the load it carries
            return float(pushed / scale), float(np.abs(x[:, 2]).max() / design.bar_length)
        jacobian = np.zeros((len(rows), len(rows)))
        for j in range(len(rows)):
            ahead, behind = x.copy(), x.copy()
            ahead[rows[j], columns[j]] += h
            behind[rows[j], columns[j]] -= h
            jacobian[:, j] = (residual(ahead) - residual(behind)) / (2 * h)
        move = np.linalg.solve(jacobian, -here)
        move *= min(1.0, 0.02 * design.bar_length / np.abs(move).max())
        x[rows, columns] += move
    raise RuntimeError(
        f"buckled: expected an equilibrium of {k} segments at {shortening}, got a residual of {np.abs(here).max()}"
    )


def bending_matrices(design: Design) -> tuple[Floats, Floats, Floats]:
    """Bending stiffness K [N/m], geometric stiffness G per newton of compression [1/m] and masses of the inner masses.

    Central differences of the forces on the straight bar: what the simulator's force law is, not what it should be.
    """
    structure, x = one_bar(design)
    n, h = len(x), 1e-6 * design.bar_length

    def lateral(at: Floats) -> Floats:
        matrix = np.zeros((n - 2, n - 2))
        for k in range(1, n - 1):
            sides = []
            for sign in (1, -1):
                moved = at.copy()
                moved[k, 2] += sign * h
                sides.append(forces(structure, moved)[1:-1, 2])
            matrix[:, k - 1] = -(sides[0] - sides[1]) / (2 * h)
        return (matrix + matrix.T) / 2

    bending = lateral(x)
    load = design.critical_load
    squeezed = x * [1 - load / (structure.segment_stiffness[0] * structure.segment_length[0]), 1, 1]
    return bending, (bending - lateral(squeezed)) / load, structure.mass[1:-1]


def measure(_: Options) -> Data:
    """All bar models at all shortenings."""
    load, bow = np.full((len(SEGMENTS), len(SHORTENINGS)), np.nan), np.full((len(SEGMENTS), len(SHORTENINGS)), np.nan)
    loads, frequency = np.full((len(SEGMENTS), 2), np.nan), np.full(len(SEGMENTS), np.nan)
    for i, n in enumerate(SEGMENTS[1:], start=1):
        design = replace(Design(), bar_segments=n)
        for j, shortening in enumerate(SHORTENINGS):
            load[i, j], bow[i, j] = buckled(design, shortening)
        stiffness, geometric, mass = bending_matrices(design)
        found = np.sort(1 / eigh(geometric, stiffness, eigvals_only=True))
        loads[i, : min(2, len(found))] = found[:2] / design.critical_load
        frequency[i] = np.sqrt(eigh(stiffness, np.diag(mass), eigvals_only=True)[0])
    exact = np.array([elastica(s) for s in SHORTENINGS])
    design = Design()
    beam = (np.pi / design.bar_length) ** 2 * np.sqrt(design.bending_rigidity * design.bar_length / design.bar_mass)
    return {
        "segments": np.array(SEGMENTS),
        "shortenings": np.array(SHORTENINGS),
        "load": load,
        "bow": bow,
        "elastica": exact,
        "buckling": loads,
        "frequency": frequency,
        "beam": np.array(beam),
    }


def report(d: Data) -> list[str]:
    """Errors of each model, and of each over the closed form of its chain."""
    rows = []
    for i, n in enumerate(d["segments"]):
        if n == 1:
            continue
        errors = d["load"][i] / d["elastica"][:, 0] - 1
        bow = d["bow"][i] / d["elastica"][:, 1] - 1
        second = d["buckling"][i, 1]
        rows.append(
            [
                str(n),
                *[f"{100 * e:+.2f}" for e in errors],
                f"{100 * bow[2]:+.1f}",
                f"{d['buckling'][i, 0]:.4f}",
                f"{second:.3f}",
                f"{4 * np.cos(np.pi / (2 * n)) ** 2:.3f}" if n > 2 else "-",
                f"{100 * (d['frequency'][i] / d['beam'] - 1):+.1f}",
            ]
        )
    head = "segments  " + "  ".join(f"P at {s:g} [%]" for s in d["shortenings"])
    head += "  bow at 0.1 [%]  first load  second load  chain's  first frequency [%]"
    lines = ["load against the elastica at end-shortening / length; buckling loads over Euler's (a bar: 1, 4)"]
    chain = d["load"][2] / [closed_form_thirds(s) for s in d["shortenings"]] - 1
    return (
        lines
        + table(head, rows)
        + [
            f"thirds against theta / sin theta: {np.abs(chain).max():.1e} at most",
            f"first pinned bending mode of the bar: {d['beam'] / (2 * np.pi):.1f} Hz",
            "a one-segment bar cannot buckle: it carries the whole shortening as axial strain",
        ]
    )


def closed_form_thirds(shortening: float) -> float:
    """P / P_Euler = theta / sin theta of a three-segment bar, shortening = (2/3)(1 - cos theta)."""
    theta = np.arccos(1 - 1.5 * shortening)
    return float(theta / np.sin(theta))


def plot(d: Data) -> Figure:
    """Post-buckling curves, and how fast the models' errors fall with the number of segments."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    fine = np.linspace(0.001, 0.5, 100)
    left.plot(fine, [elastica(s)[0] for s in fine], "k", lw=2, label="elastica")
    for i, n in enumerate(d["segments"]):
        if n > 1:
            left.plot(d["shortenings"], d["load"][i], "o--", ms=4, lw=0.8, label=f"{n} segments")
    left.set(xlabel="end-shortening / length", ylabel="load / Euler load")
    left.legend(fontsize=8)
    n = d["segments"][1:]
    for label, error in (
        ("load at shortening 0.5", np.abs(d["load"][1:, -1] / d["elastica"][-1, 0] - 1)),
        ("load at shortening 0.1", np.abs(d["load"][1:, 2] / d["elastica"][2, 0] - 1)),
        ("bow at shortening 0.1", np.abs(d["bow"][1:, 2] / d["elastica"][2, 1] - 1)),
        ("second buckling load", np.abs(d["buckling"][1:, 1] / 4 - 1)),
        ("first bending frequency", np.abs(d["frequency"][1:] / d["beam"] - 1)),
    ):
        right.loglog(n, error, "o-", ms=4, label=label)
    right.loglog(n, 0.5 / n**2.0, "k:", label="1/n²")
    right.set(xlabel="segments of a bar", ylabel="relative error", xticks=n, xticklabels=[str(k) for k in n])
    right.minorticks_off()
    right.legend(fontsize=8)
    return figure


PART = Part("bars", measure, report, plot)
