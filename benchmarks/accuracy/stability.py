"""Where each integrator stops being stable: over step, damping ratio and stiffness contrast, predicted and measured.

Three masses on two springs in a line have the spectrum omega^2 = ((k + K) +- sqrt(k^2 + K^2 - k K)) / m in closed form.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import brentq

from benchmarks.accuracy.part import Data, Options, Part, table
from benchmarks.accuracy.stepping import METHODS, SPACE, Motion, only_bars
from tensegrity_gym.types import Floats, Structure

RATIOS = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)
CONTRASTS = (1.0, 1e2, 1e4)
MASS, STIFFNESS, LENGTH = 0.01, 1e5, 0.2  #: [kg], [N/m] of the soft spring, [m]


def chain(contrast: float, ratio: float) -> tuple[Structure, Floats, float]:
    """Three masses in a line, springs k and contrast k, damped in proportion to stiffness; positions; highest omega [rad/s].

    ``ratio`` is the damping ratio of the highest mode.
    """
    soft, hard = STIFFNESS, contrast * STIFFNESS
    omega = np.sqrt((soft + hard + np.sqrt(soft**2 + hard**2 - soft * hard)) / MASS)
    stiffness = np.array([soft, hard])
    damping = 2 * ratio / omega * stiffness
    structure = only_bars(np.full(3, MASS), np.array([[0, 1], [1, 2]]), stiffness=stiffness, length=LENGTH, damping=damping)
    return structure, np.arange(3)[:, None] * [LENGTH, 0, 0] + [0, 0, 5.0], float(omega)


def runge_kutta_limit(ratio: float) -> float:
    """Largest omega dt with |R(lambda dt)| <= 1 for R(z) = 1 + z + z^2/2 + z^3/6 + z^4/24 and lambda of the damped mode."""
    root = np.emath.sqrt(ratio**2 - 1.0)
    eigenvalues = np.array([-ratio + root, -ratio - root])

    def excess(h: float) -> float:
        z = eigenvalues * h
        return float(np.abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24).max()) - 1.0 - 1e-12

    grid = np.linspace(0.01, 4.0, 2000)
    last = grid[np.argmax([excess(h) > 0 for h in grid]) - 1]
    return float(brentq(excess, last, last + 0.01)) if excess(last + 0.01) > 0 else float(last)


def predicted(method: str, ratio: float) -> float:
    """Largest stable dt omega / 2, 1 being the undamped leapfrog's."""
    if method == "runge_kutta":
        return runge_kutta_limit(ratio) / 2
    return float(np.sqrt(1 + ratio**2) - ratio)


def grows(method: str, contrast: float, ratio: float, step: float, steps: int = 4000) -> bool:
    """Whether a small disturbance has grown a thousandfold after ``steps`` of dt = ``step`` 2/omega."""
    structure, x, omega = chain(contrast, ratio)
    v = np.zeros_like(x)
    v[:, 0] = 1e-6 * np.array([0.5, -1.0, 0.7])
    v[:, 0] -= v[:, 0].mean()
    motion = Motion(structure, SPACE, 2 * step / omega, x, v, method)
    motion.run(steps)
    return not np.abs(motion.v).max() < 1e3 * np.abs(v).max()


def measure(options: Options) -> Data:
    """The measured limit of each integrator, by bisection to half a per cent, and the prediction."""
    shape = (len(METHODS), len(CONTRASTS), len(RATIOS))
    found, expected = np.zeros(shape), np.zeros(shape)
    for i, method in enumerate(METHODS):
        for j, contrast in enumerate(CONTRASTS):
            for k, ratio in enumerate(RATIOS):
                low, high = 0.01, 3.0
                while high / low > 1.005:
                    middle = np.sqrt(low * high)
                    low, high = (low, middle) if grows(method, contrast, ratio, middle) else (middle, high)
                found[i, j, k], expected[i, j, k] = np.sqrt(low * high), predicted(method, ratio)
    return {"found": found, "expected": expected}


def report(d: Data) -> list[str]:
    """Limits, and how far the measured ones are from the predicted."""
    rows = []
    for i, method in enumerate(METHODS):
        for k, ratio in enumerate(RATIOS):
            cells = [f"{v:.3f}" for v in d["found"][i, :, k]]
            rows.append([method, f"{ratio:g}", f"{d['expected'][i, 0, k]:.3f}", *cells])
    head = "integrator  damping ratio  predicted  " + "  ".join(f"contrast {c:g}" for c in CONTRASTS)
    worst = np.abs(d["found"] / d["expected"] - 1).max()
    fine = np.geomspace(1e-3, 30, 200)
    rule = min(predicted("runge_kutta", z) / (np.sqrt(2) * predicted("symplectic_euler", z)) for z in fine)
    return [
        "largest stable step over 2/omega of the highest mode",
        *table(head, rows),
        f"measured from predicted: {100 * worst:.1f} % at most",
        f"Runge-Kutta's limit is at least {rule:.3f} of sqrt 2 times leapfrog's, the rule of simulate, at damping ratios to 30",
    ]


def plot(d: Data) -> Figure:
    """Predicted limits as lines, measured ones as marks, over the damping ratio."""
    figure, axis = plt.subplots(figsize=(5.5, 3.8), layout="constrained")
    fine = np.concatenate([[0.0], np.geomspace(0.01, 5, 100)])
    for i, (method, colour) in enumerate(zip(METHODS, ("C0", "C2", "C1"), strict=True)):
        axis.plot(fine, [predicted(method, z) for z in fine], color=colour, lw=1, ls="--" if i == 1 else "-")
        for j, mark in enumerate("o^s"):
            label = f"{method.replace('_', ' ')}, contrast {CONTRASTS[j]:g}"
            axis.plot(RATIOS, d["found"][i, j], mark, color=colour, ms=7 - 2 * i + j % 2, mfc="none", label=label)
    axis.set(xscale="symlog", yscale="log", xlabel="damping ratio of the highest mode", ylabel="largest stable step over 2/ω")
    axis.set_xscale("symlog", linthresh=0.03)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=6, loc="lower left")
    return figure


PART = Part("stability", measure, report, plot)
