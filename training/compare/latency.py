"""How long the methods of a comparison take to answer a single question."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from surrogate.model import one_thread
from surrogate.storage import hash_of
from tensegrity_gym.types import Floats
from training.compare.methods import BAYESIAN, SIMULATING
from training.compare.scores import Latencies, rounded
from training.planner import Planner
from training.policies import ActorPolicy
from training.stages import Results

if TYPE_CHECKING:
    from training.compare.run import Comparison

#: Seed of the targets that are asked for.
SEED = 5


def measure(comparison: Comparison) -> None:
    """Time every method of the first seed and the largest budgets."""
    config = comparison.config
    trying = comparison.trying(0)
    makers: dict[str, Callable[[Any], Planner]] = {name: itemgetter(name) for name in comparison.names}
    makers |= {method: make for method, (stage, make) in trying.items() if stage != BAYESIAN}
    largest = max(config.budgets_of_policies, default=0)
    policies = dict.fromkeys(config.policies, largest) if largest else {}
    # threads: of torch; times from before, with all, are measured again
    how = {"threads": 1, "planners": comparison.names, "targets": comparison.places["inside"].tolist()}
    content = {"questions": config.latencies, "tries": config.tries, "refine": config.refine} | comparison.planning
    _time(comparison, "latency", content | how, makers, policies)
    for method, (stage, make) in trying.items():
        if stage == BAYESIAN:  # apart, so that the others' times stay as they were
            content = {"questions": config.latencies} | comparison.trying_settings(method)
            _time(comparison, f"latency_{method}", content | how, {method: make}, {})


def _time(
    comparison: Comparison,
    name: str,
    content: Mapping[str, Any],
    makers: Mapping[str, Callable[[Any], Planner]],
    policies: Mapping[str, int],
) -> None:
    """Time planners, made of what was fitted, and policies of so many calls, unless kept scores have times of the same."""
    budget, targets = max(comparison.config.budgets), comparison.places["inside"]
    trained = {method: f"policy_{method}_0_{calls}" for method, calls in policies.items()}
    needs = [f"net_0_{budget}", *trained.values()]
    settings = hash_of({**content, **comparison.learning, "needs": needs, "methods": sorted(makers)})
    known = comparison.scores.latencies.get(name)
    if known is not None and known.settings == settings:
        return
    comparison.require_planners(0, budget)
    for method, calls in policies.items():
        comparison.require_policy(method, 0, calls)

    def work() -> Results:
        fitted, folder = comparison.fitted(0, budget), comparison.stages.folder
        asked = {method: make(fitted) for method, make in makers.items()}
        asked |= {method: ActorPolicy.load(folder / f"{file}.safetensors") for method, file in trained.items()}
        return {
            method: question_times(planner, method, targets, comparison.config.latencies) for method, planner in asked.items()
        }

    found = comparison.stages.run(name, dict(content), work, needs=needs)
    times = {m: (rounded(float(np.median(t))), rounded(float(np.quantile(t, 0.99)))) for m, t in found.items()}
    comparison.scores.latencies[name] = Latencies(settings, times)


def question_times(planner: Planner, name: str, targets: Floats, questions: int) -> list[float]:
    """Wall times of single questions about random ``targets`` [s], after two to warm up; fewer of methods that simulate."""
    count = max(10, questions // 2) if name.startswith(tuple(SIMULATING)) else questions
    rng = np.random.default_rng(SEED)
    times = []
    with one_thread():  # as planners ask their nets: tandem, CMA-ES and policies are timed alike
        for target in targets[rng.integers(len(targets), size=count + 2)]:
            started = time.perf_counter()
            planner.predict(target)
            times.append(time.perf_counter() - started)
    return times[2:]
