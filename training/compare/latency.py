"""How long the methods of a comparison take to answer a single question."""

from __future__ import annotations

import time
from collections.abc import Callable
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from surrogate.model import one_thread
from surrogate.storage import hash_of
from tensegrity_gym.types import Floats
from training.compare.methods import SIMULATING
from training.compare.scores import Latency, rounded
from training.planner import Planner
from training.policies import ActorPolicy
from training.stages import Results

if TYPE_CHECKING:
    from training.compare.run import Comparison

#: Seed of the targets that are asked for.
SEED = 5


def measure(comparison: Comparison) -> None:
    """Time every method of the first seed and the largest budgets, unless that is kept, or times of a larger budget are."""
    config, budget = comparison.config, max(comparison.config.budgets)
    makers: dict[str, Callable[[Any], Planner]] = {name: itemgetter(name) for name in comparison.names}
    makers |= {method: make for method, (_, make) in comparison.trying(0).items()}
    for method, make in makers.items():
        _time(comparison, method, budget, lambda make=make: make(comparison.fitted(0, budget)))  # type: ignore[misc]
    largest = max(config.budgets_of_policies, default=0)
    for method in config.policies if largest else ():
        path = comparison.stages.folder / f"policy_{method}_0_{largest}.safetensors"
        _time(comparison, method, largest, lambda path=path: ActorPolicy.load(path))  # type: ignore[misc]


def settings_of(comparison: Comparison, method: str) -> str:
    """Hash of all that a method's latency depends on besides its budget and how many questions are asked."""
    return hash_of({"method": comparison.settings_of(method), "targets": comparison.places["inside"].tolist()})


def _time(comparison: Comparison, method: str, budget: int, planner: Callable[[], Planner]) -> None:
    questions, known = comparison.config.latencies, comparison.scores.latencies.get(method)
    if known is not None and known.budget >= budget and known.questions >= questions:
        return
    settings = settings_of(comparison, method)
    needs = comparison.require(method, 0, budget)

    def work() -> Results:
        times = question_times(planner(), method, comparison.places["inside"], questions)
        return {"median": float(np.median(times)), "p99": float(np.quantile(times, 0.99))}

    name = f"latency_{method}_{budget}"
    found = comparison.stages.run(name, {"settings": settings, "questions": questions}, work, needs=[needs])
    median, p99, day = rounded(found["median"]), rounded(found["p99"]), comparison.stages.dates[name][:10]
    comparison.scores.latencies[method] = Latency(settings, budget, questions, median, p99, day)


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
