"""What it brings a planner to weigh its doubt: the same nets and hops, inverted with and without, and with other doubts.

And what it costs to prefer, of answers that it expects to err alike, the one that stores least energy.

``python -m benchmarks.doubt --out runs/doubt --fidelity flown --data runs/flown/earth.h5 --budgets 1000 10000 --seeds 3``, with
options as of ``python -m training compare``, whose kept nets it uses where ``--out`` is a comparison's folder.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
import tyro
from torch import Tensor

from surrogate.model import HopNet
from surrogate.outputs import LANDING
from tensegrity_gym.task import reach
from training.compare.config import CompareConfig
from training.compare.run import Comparison
from training.compare.statistics import interquartile_mean
from training.inverse import START_SEED, InversePlanner
from training.score import distances

#: The planner that prefers no answer for the energy that it stores.
LEAST_ERROR = "the planner, whatever the energy"
Correction = Callable[[Tensor], tuple[Tensor, Tensor]]


def predicted_scatter(net: HopNet) -> Callable[[Tensor], Tensor]:
    """Stretches (..., n_actuators) to the variance that the net predicts of a hop, in each direction (...) [m^2]."""

    def variance(stretches: Tensor) -> Tensor:
        with torch.no_grad():
            found = net.moments(stretches.reshape(-1, stretches.shape[-1]))[1]
        return found.mean(dim=0)[:, LANDING].mean(dim=1).reshape(stretches.shape[:-1])

    return variance


def corrections(net: HopNet, kriging: Correction, stretches: np.ndarray) -> dict[str, Correction | None]:
    """What planners may add to the ensemble's landing, and take for its variance, by name."""
    scatter = predicted_scatter(net)
    typical = scatter(torch.from_numpy(stretches.astype(np.float32))).mean()

    def scaled(at: Tensor) -> tuple[Tensor, Tensor]:
        shift, doubt = kriging(at)
        return shift, doubt * scatter(at) / typical

    def sure(at: Tensor) -> tuple[Tensor, Tensor]:
        shift, doubt = kriging(at)
        return shift, torch.zeros_like(doubt)

    def blind(at: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros(*at.shape[:-1], 2), torch.zeros(at.shape[:-1])

    return {
        "stored hops mend, their doubt (the planner)": kriging,
        "stored hops mend, their doubt times the net's scatter": scaled,
        "stored hops mend, no doubt": sure,
        "the net alone, its members' spread for doubt": None,
        "the net alone, its predicted scatter for doubt": lambda at: (blind(at)[0], scatter(at)),
        "the net alone, no doubt": blind,
    }


def main(config: CompareConfig) -> None:
    """Print interquartile mean errors over targets inside and seeds, and the scatter of the answers' landings."""
    comparison = Comparison(replace(config, tries=(), refine=(), algorithms=(), oracle=0, latencies=0))
    comparison.run()
    inside = comparison.places["inside"]
    found: dict[tuple[str, int], list[np.ndarray]] = {}
    energies: dict[tuple[str, int], list[np.ndarray]] = {}
    for seed, budget in config.planner_runs:
        fitted = comparison.fitted(seed, budget)
        usual = fitted.inverse
        if usual.correction is None:
            continue  # too few hops to tell a scale
        stored = fitted.data["stretches"]
        choices = corrections(fitted.net, usual.correction, stored)
        for name, correction in (choices | {LEAST_ERROR: usual.correction}).items():
            planner = InversePlanner(
                fitted.landing,
                config.inverse,
                correction=correction,
                energy=None if name == LEAST_ERROR else usual.energy,
                stored=stored,
                images=fitted.net.landing_images,
                seed=seed + START_SEED,
            )
            stretches = planner.predict(inside)[0]
            landings = comparison.hops.perturbed(stretches, config.perturbations)[:, 1:]
            errors = distances(landings, inside, reach(comparison.scene)).mean(axis=1)
            apart = np.linalg.norm(landings - landings.mean(axis=1, keepdims=True), axis=2).mean(axis=1)
            assert usual.energy is not None
            found.setdefault((name, budget), []).append(np.stack([errors, apart]))
            energies.setdefault((name, budget), []).append(usual.energy(stretches))
    print(f"{'':<56}{'error and scatter [mm], mean energy [J] after':>50}")
    print(f"{'':<56}" + "".join(f"{b:>25,}" for b in config.budgets))
    for name in dict.fromkeys(name for name, _ in found):
        cells = []
        for budget in config.budgets:
            errors, apart = (1e3 * interquartile_mean(part) for part in np.stack(found[name, budget], axis=1))
            cells.append(f"{errors:>9.3g} {apart:>8.2g} {np.mean(energies[name, budget]):>6.1f}")
        print(f"{name:<56}" + "".join(cells))


if __name__ == "__main__":
    main(tyro.cli(CompareConfig, description=__doc__))
