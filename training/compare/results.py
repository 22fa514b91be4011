"""The numbers that tables and figures show, made of a comparison's scores."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tensegrity_gym.task import SUCCESS_RADIUS
from tensegrity_gym.types import Floats
from training.compare.methods import ORACLE, place
from training.compare.run import Comparison
from training.compare.scores import Line
from training.compare.statistics import interquartile_mean, interval, probability_of_improvement


@dataclass(frozen=True)
class Summary:
    """Errors of one method at one budget, on the targets of one place, in metres or, where scenes vary, in reaches."""

    mean: float  #: interquartile mean
    low: float  #: its 95 % interval, see ``statistics.interval``
    high: float  #: likewise
    p95: float  #: 95th percentile over answers
    missed: float  #: share of answers that err by more than ``SUCCESS_RADIUS`` reaches [-]
    seeds: int


class Outcome:
    """What a comparison found.

    Errors are in metres; where scenes vary, and reaches with them, each is divided by the reach of its target's scene.
    """

    def __init__(self, comparison: Comparison) -> None:
        self.comparison = comparison
        self.all = comparison.scores
        self.varied = bool(comparison.scenes.ranges)
        #: Reach of each target's scene [m], and what errors are divided by, shapes (targets,).
        self.reaches, self.unit = comparison.reaches, comparison.units
        #: Name of the unit that errors are shown in, and how many of it one is.
        self.shown, self.factor = ("% of reach", 100.0) if self.varied else ("mm", 1000.0)
        self.rows = comparison.rows

    @cached_property
    def scores(self) -> dict[tuple[str, int], list[Line]]:
        """Scores of all seeds, by method and budget, methods in the order of tables."""
        cells = sorted({key[:2] for key in self.all.lines}, key=lambda cell: (place(cell[0]), cell[1]))
        return {cell: self.all.of(*cell) for cell in cells}

    @property
    def methods(self) -> list[str]:
        """Methods that were run, without the oracle."""
        return [m for m in dict.fromkeys(m for m, _ in self.scores) if m != ORACLE]

    @property
    def common_budget(self) -> int:
        """The largest budget that every method was run at; the largest of all where there is none."""
        every = [set(self.budgets(m)) for m in self.methods]
        return max(set.intersection(*every) or set.union(*every))

    def budgets(self, method: str) -> list[int]:
        """Budgets at which a method was run."""
        return [b for m, b in self.scores if m == method]

    def errors(self, method: str, budget: int, where: str = "inside") -> Floats:
        """Mean over the moved starts of every answer, shape (seeds, targets)."""
        return np.array([score.errors for score in self.scores[method, budget]])[:, self.rows[where]]

    def summary(self, method: str, budget: int, where: str = "inside") -> Summary:
        """The numbers of a table's cell."""
        errors = self.errors(method, budget, where)
        limit = (SUCCESS_RADIUS * self.reaches / self.unit)[self.rows[where]]
        return Summary(
            float(interquartile_mean(errors)),
            *interval(errors),
            p95=float(np.quantile(errors, 0.95)),
            missed=float((errors > limit).mean()),
            seeds=len(errors),
        )

    @property
    def floor(self) -> float:
        """How far moved starts land from where the unmoved one does, interquartile mean over random hops."""
        return float("nan") if self.all.floor is None else self.all.floor

    @property
    def scatter(self) -> float | None:
        """How far landings of the best answers lie from their own mean when the start is moved: no aim does better.

        Mean over the seeds of the method that errs least of those that were run; None where one start was simulated alone.
        """
        best = min(self.scores, key=lambda cell: float(interquartile_mean(self.errors(*cell))))
        known = [line.scatter for line in self.scores[best] if line.scatter is not None]
        return float(np.mean(known)) if known else None

    @property
    def dates(self) -> tuple[str, str]:
        """Days of the first and of the last score."""
        days = sorted(row.date for row in self.all.lines.values())
        return days[0], days[-1]

    @property
    def versions(self) -> list[str]:
        """Versions of packages that scores were made with."""
        return sorted({row.versions for row in self.all.lines.values()})

    @property
    def oracle(self) -> Line | None:
        """The score of CMA-ES on the simulator, None where it was not run."""
        return next((lines[0] for (method, _), lines in self.scores.items() if method == ORACLE), None)

    @property
    def oracle_error(self) -> float | None:
        """Interquartile mean error of CMA-ES on the simulator."""
        return None if self.oracle is None else self.summary(ORACLE, self.oracle.budget).mean

    def improvement(self, method: str, other: str, budget: int) -> float:
        """Chance that ``method`` errs less than ``other`` on a target inside."""
        return probability_of_improvement(self.errors(method, budget), self.errors(other, budget))

    def learning_seconds(self, method: str, budget: int) -> float:
        """Mean wall time that a method learnt for, simulating left out [s]."""
        return float(np.mean([score.seconds for score in self.scores[method, budget]]))

    def latency(self, method: str) -> tuple[float, float] | None:
        """Median and 99th percentile of a single question's wall time [s]."""
        found = self.all.latencies.get(method)
        return None if found is None else (found.median, found.p99)
