"""Errors gathered from the stages of a comparison, and the numbers made of them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tensegrity_gym.task import SUCCESS_RADIUS, TARGET_PLACES
from tensegrity_gym.types import Floats
from training.compare.run import SIMULATING, Comparison
from training.compare.statistics import interquartile_mean, interval, probability_of_improvement
from training.score import distances

LABELS = {
    "nearest": "nearest stored hop",
    "single": "planner, one net",
    "ensemble": "planner, ensemble and its doubt",
    "tandem": "tandem net",
    "cma": "CMA-ES on the surrogate",
    "sac": "SAC",
    "sac_symmetric": "SAC, knowing the symmetry",
    "td3": "TD3",
    "td3_symmetric": "TD3, knowing the symmetry",
    "ppo": "PPO",
    "ppo_symmetric": "PPO, knowing the symmetry",
}


def label(method: str) -> str:
    """A method's name in tables and figures."""
    if method.startswith("best"):
        return f"the same, best of {answer_calls(method)} simulated"
    if method.startswith("repeat"):
        return f"nearest stored hop, {answer_calls(method)} simulated in turn"
    if method.startswith("refine"):
        return f"the same, {answer_calls(method)} simulated in turn"
    if method.startswith("bayes"):
        return f"the same, {answer_calls(method)} simulated in turn by BoTorch"
    return LABELS.get(method, method)


def answer_calls(method: str) -> int:
    """Hops that a method simulates for each answer."""
    return int(re.sub("^[a-z]+", "", method) or 0) if method.startswith(tuple(SIMULATING)) else 0


def _place(method: str) -> tuple[int, int]:
    """Order of methods in tables: best-of-T follows the planner that proposes."""
    known = list(LABELS)
    for k, (prefix, start) in enumerate(SIMULATING.items()):
        if method.startswith(prefix):
            return known.index(start), 1000 * (k + 1) + answer_calls(method)
    return (known.index(method) if method in known else len(known)), 0


@dataclass(frozen=True)
class Summary:
    """Errors of one method at one budget, on the targets of one place, in metres or, where scenes vary, in reaches."""

    mean: float  #: interquartile mean
    low: float  #: its 95 % interval, see ``statistics.interval``
    high: float  #: likewise
    p95: float  #: of single landings
    missed: float  #: share of single landings farther than ``SUCCESS_RADIUS`` reaches from the target [-]
    seeds: int


class Outcome:
    """What a comparison found.

    Errors are in metres; where scenes vary, and reaches with them, each is divided by the reach of its target's scene.
    """

    def __init__(self, comparison: Comparison) -> None:
        self.comparison = comparison
        self.records = comparison.stages.results
        self.seconds = comparison.stages.seconds
        self.varied = bool(comparison.scenes.ranges)
        #: Reach of each target's scene [m], and what errors are divided by, shapes (targets,).
        self.reaches = comparison.reaches
        self.unit = self.reaches if self.varied else np.ones(len(self.reaches))
        #: Name of the unit that errors are shown in, and how many of it one is.
        self.shown, self.factor = ("% of reach", 100.0) if self.varied else ("mm", 1000.0)
        self.rows = {
            place: np.repeat([p == place for p in TARGET_PLACES], [len(comparison.places[p]) for p in TARGET_PLACES])
            for place in TARGET_PLACES
        }

    @cached_property
    def scores(self) -> dict[tuple[str, int], list[int]]:
        """Seeds that were run, by method and budget, methods in the order of tables."""
        found: dict[tuple[str, int], list[int]] = {}
        for name in self.records:
            if name.startswith("score_"):
                method, seed, budget = name.removeprefix("score_").rsplit("_", 2)
                found.setdefault((method, int(budget)), []).append(int(seed))
        return dict(sorted(found.items(), key=lambda item: (_place(item[0][0]), item[0][1])))

    @property
    def methods(self) -> list[str]:
        """Methods that were run, without the oracle."""
        return [m for m in dict.fromkeys(m for m, _ in self.scores) if m != "oracle"]

    @property
    def common_budget(self) -> int:
        """The largest budget that every method was run at; the largest of all where there is none."""
        every = [set(self.budgets(m)) for m in self.methods]
        return max(set.intersection(*every) or set.union(*every))

    def budgets(self, method: str) -> list[int]:
        """Budgets at which a method was run."""
        return [b for m, b in self.scores if m == method]

    def landing_errors(self, method: str, budget: int, place: str) -> Floats:
        """Of every answer from every moved start, shape (seeds, targets, perturbations).

        A failed hop counts as one that landed as far away as any target may be.
        """
        rows = self.rows[place]
        landings, targets = self._landings(method, budget, place), self.comparison.targets[rows, :2]
        return distances(landings, targets, self.reaches[rows, None]) / self.unit[rows, None]

    def _landings(self, method: str, budget: int, place: str) -> Floats:
        """From moved starts, shape (seeds, targets, perturbations, 2) [m]."""
        records = [self.records[f"score_{method}_{seed}_{budget}"] for seed in self.scores[method, budget]]
        return np.stack([np.array(r["landings"], dtype=np.float64)[self.rows[place], 1:] for r in records])

    def errors(self, method: str, budget: int, place: str = "inside") -> Floats:
        """Mean over the moved starts, shape (seeds, targets)."""
        return self.landing_errors(method, budget, place).mean(axis=2)

    def summary(self, method: str, budget: int, place: str = "inside") -> Summary:
        """The numbers of a table's cell."""
        every, errors = self.landing_errors(method, budget, place), self.errors(method, budget, place)
        limit = (SUCCESS_RADIUS * self.reaches / self.unit)[self.rows[place], None]
        return Summary(
            float(interquartile_mean(errors)),
            *interval(errors),
            p95=float(np.quantile(every, 0.95)),
            missed=float((every > limit).mean()),
            seeds=len(errors),
        )

    @property
    def floor(self) -> float:
        """How far moved starts land from where the unmoved one does, interquartile mean over random hops."""
        record = self.records["floor"]
        return float(interquartile_mean(np.array(record["distances"]).mean(axis=1) / np.array(record.get("reaches", 1.0))))

    @property
    def scatter(self) -> float:
        """How far landings of the best answers lie from their own mean when the start is moved: no aim does better.

        Interquartile mean over targets inside and seeds, of the method that errs least of those that were run.
        """
        method, budget = min(self.scores, key=lambda key: float(interquartile_mean(self.errors(*key))))
        landings = self._landings(method, budget, "inside")
        count = landings.shape[2]
        if count < 2:
            return float("nan")
        apart = np.linalg.norm(landings - np.nanmean(landings, axis=2, keepdims=True), axis=3)
        # about a mean of few, distances are too small by this root
        apart *= np.sqrt(count / (count - 1)) / self.unit[self.rows["inside"], None]
        return float(interquartile_mean(np.nanmean(apart, axis=2)))

    @property
    def dates(self) -> tuple[str, str]:
        """Days of the first and of the last score."""
        days = sorted(date[:10] for name, date in self.comparison.stages.dates.items() if name.startswith("score_"))
        return days[0], days[-1]

    @property
    def oracle(self) -> float | None:
        """Interquartile mean error of CMA-ES on the simulator, None where it was not run."""
        found = [b for m, b in self.scores if m == "oracle"]
        return self.summary("oracle", found[0]).mean if found else None

    def improvement(self, method: str, other: str, budget: int) -> float:
        """Chance that ``method`` errs less than ``other`` on a target inside."""
        return probability_of_improvement(self.errors(method, budget), self.errors(other, budget))

    def learning_seconds(self, method: str, budget: int) -> float:
        """Mean wall time that a method learnt for, simulating left out [s]."""
        times = []
        for seed in self.scores[method, budget]:
            tag = f"{seed}_{budget}"
            if f"policy_{method}_{tag}" in self.records:
                record = self.records[f"policy_{method}_{tag}"]
                times.append(record["seconds"] - record["simulating"])
            else:
                plans = self.records[f"plans_{tag}"]
                start = next((s for prefix, s in SIMULATING.items() if method.startswith(prefix)), method)
                own = plans[start]["seconds"]
                times.append(own + (0.0 if start == "nearest" else self.seconds[f"net_{tag}"]))
        return float(np.mean(times))

    def latency(self, method: str) -> tuple[float, float] | None:
        """Median and 99th percentile of a single question's wall time [s]."""
        times = self.records.get("latency", {}).get(method) or self.records.get(f"latency_{method}", {}).get(method)
        return None if times is None else (float(np.median(times)), float(np.quantile(times, 0.99)))
