"""Whether neighbouring seeds of policies spread less than seeds that share nothing.

stable-baselines3 seeds the k-th env of a training with seed + k, so that trainings of seeds 0, 1, 2 ... meet mostly the same
targets, in other orders. Here as many are trained with seeds ``APART``, which share none, and compared.

``python -m benchmarks.policy_seeds --out runs/earth --fidelity flown --policy-budgets 100 1000 --policy-seeds 10``, with options
as of ``python -m training compare``, whose kept policies it uses where ``--out`` is a comparison's folder; its own go below it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import tyro

from tensegrity_gym.types import Floats
from training.compare.config import CompareConfig
from training.compare.results import Outcome
from training.compare.run import Comparison
from training.compare.statistics import interquartile_mean

#: Between two seeds that share no target, for policies of fewer envs than that.
APART = 1000


def trained(config: CompareConfig, runs: Iterable[tuple[int, int]]) -> Outcome:
    """Policies of these seeds and budgets, and their errors."""
    comparison = Comparison(config)
    for seed, budget in runs:
        for method in config.policies:
            comparison.policy(method, seed, budget)
    return Outcome(comparison)


def by_seed(outcome: Outcome, method: str, budget: int) -> Floats:
    """Interquartile mean over targets inside, shape (seeds,) [mm]."""
    return 1e3 * interquartile_mean(outcome.errors(method, budget), axis=1)


def main(config: CompareConfig) -> None:
    """Print means and standard deviations between seeds, and how many standard errors the means differ by."""
    near = trained(config, config.policy_runs)
    far = trained(replace(config, out=config.out / "apart"), ((APART * seed, budget) for seed, budget in config.policy_runs))
    head = ("seeds 0, 1, ... [mm]", f"0, {APART}, ... [mm]", "ratio of deviations")
    print(f"{'':<28}{'calls':>8}" + "".join(f"{name:>24}" for name in head) + f"{'z of means':>12}")
    ratios, scores = [], []
    for method, budget in near.scores:
        a, b = by_seed(near, method, budget), by_seed(far, method, budget)
        ratios.append(b.std(ddof=1) / a.std(ddof=1))
        scores.append((b.mean() - a.mean()) / np.sqrt(a.var(ddof=1) / len(a) + b.var(ddof=1) / len(b)))
        said = "".join(f"{f'{part.mean():.3g} ± {part.std(ddof=1):.2g}':>24}" for part in (a, b))
        print(f"{method:<28}{budget:>8,}{said}{ratios[-1]:>24.2f}{scores[-1]:>12.1f}")
    typical = np.exp(np.mean(np.log(ratios)))
    print(f"geometric mean of the ratios {typical:.2f}; sum of z squared {np.sum(np.square(scores)):.1f} of {len(scores)}")


if __name__ == "__main__":
    main(tyro.cli(CompareConfig, description=__doc__))
