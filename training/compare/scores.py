"""Scores of a comparison: all that its tables and figures are made of, as lines of text that are kept beside them.

One line of JSON for each method, budget and training seed, after one of what they have in common. Kept in the repository, they
let tables be made anew in seconds, and seeds be added on another machine than the one that ran the first.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surrogate.storage import atomic_path, ensure_folder, hash_of, writer_lock
from tensegrity_gym.errors import DataFileError
from tensegrity_gym.types import Floats
from training.compare.statistics import interquartile_mean
from training.score import distances

FORMAT = 1
#: Digits of errors that are kept: a hundredth of what seeds scatter by.
DIGITS = 4

Key = tuple[str, int, int]


@dataclass(frozen=True)
class Line:
    """How near one training's answers come. Errors are in metres, or in reaches of the targets' scenes where these vary."""

    method: str
    budget: int  #: simulator calls learnt from
    seed: int  #: of the training
    errors: tuple[float, ...]  #: mean distance to the target from moved starts, of each registered target, in their order
    scatter: float | None  #: of answers' landings about their own mean, interquartile mean over targets inside; None: unknown
    seconds: float  #: wall time of learning, simulating left out [s]
    settings: str  #: hash of all that the method depends on besides budget and seed
    date: str  #: day of the run
    versions: str  #: of packages that results may depend on
    calls_per_answer: float | None = None  #: hops for each answer, where they were counted

    @property
    def key(self) -> Key:
        """Which score this is."""
        return self.method, self.budget, self.seed


@dataclass(frozen=True)
class Latency:
    """Wall time of single questions to one method, on one idle core."""

    settings: str  #: hash of all that it depends on besides the two that follow
    budget: int  #: simulator calls learnt from
    questions: int  #: that were asked for
    median: float  #: [s]
    p99: float  #: 99th percentile [s]
    date: str  #: day of the run


class Scores:
    """Scores of one scene and landing, by method, budget and seed.

    ``task`` is what all of them have in common: physics, model, targets, moved starts. All scores of a method have the same
    settings.
    """

    def __init__(self, task: Mapping[str, Any]) -> None:
        self.task = json.loads(json.dumps(task))
        #: How far moved starts carry random hops, in the unit of errors; None as long as it was not measured.
        self.floor: float | None = None
        self.latencies: dict[str, Latency] = {}
        self.lines: dict[Key, Line] = {}
        #: Methods and settings whose scores or latencies were dropped, not to come back from a file.
        self._dropped: set[tuple[str, str]] = set()

    def settings(self, method: str) -> str | None:
        """Hash of the settings that a method's scores were made with, None where there are none."""
        return next((line.settings for line in self.lines.values() if line.method == method), None)

    @property
    def methods(self) -> list[str]:
        """Methods that have scores."""
        return list(dict.fromkeys(line.method for line in self.lines.values()))

    def add(self, line: Line) -> None:
        """Take a score in; those of its method with other settings go."""
        if self.settings(line.method) not in (None, line.settings):
            self.drop(line.method)
        self.lines[line.key] = line

    def drop(self, method: str) -> int:
        """Leave all scores of a method out; returns how many there were."""
        gone = [key for key in self.lines if key[0] == method]
        self._dropped |= {(method, self.lines.pop(key).settings) for key in gone}
        return len(gone)

    def drop_latency(self, method: str) -> None:
        """Leave a method's latency out."""
        self._dropped.add((method, self.latencies.pop(method).settings))

    def of(self, method: str, budget: int) -> list[Line]:
        """Scores of all seeds of a method and budget, by seed."""
        return sorted((line for line in self.lines.values() if line.key[:2] == (method, budget)), key=lambda line: line.seed)

    def text(self) -> str:
        """What is kept; the same scores give the same text."""
        latencies = {method: asdict(found) for method, found in sorted(self.latencies.items())}
        head = {"format": FORMAT, "task": self.task, "floor": self.floor, "latencies": latencies}
        lines = [{k: v for k, v in asdict(self.lines[key]).items() if v is not None} for key in sorted(self.lines)]
        return "".join(json.dumps(line, allow_nan=False) + "\n" for line in [head, *lines])

    @property
    def digest(self) -> str:
        """Hash of all scores."""
        return hash_of(self.text())

    def write(self, path: Path, *, anew: bool = False) -> None:
        """Write all, with what others may have added to ``path`` since it was read, or without it if ``anew``."""
        ensure_folder(path.parent)
        with writer_lock(path):
            if not anew:
                self._take(Scores.read(path, self.task))
            with atomic_path(path) as temporary:
                temporary.write_text(self.text(), encoding="utf-8")

    def _take(self, others: Scores) -> None:
        for key, line in others.lines.items():
            known = key in self.lines or (line.method, line.settings) in self._dropped
            if not known and self.settings(line.method) in (None, line.settings):
                self.lines[key] = line
        for method, latency in others.latencies.items():
            if (method, latency.settings) not in self._dropped:
                self.latencies.setdefault(method, latency)
        self.floor = others.floor if self.floor is None else self.floor

    @classmethod
    def read(cls, path: Path, task: Mapping[str, Any]) -> Scores:
        """The scores in ``path``, none if there is no such file.

        DataFileError for a damaged file, and for scores of another task.
        """
        scores = cls(task)
        if not path.exists():
            return scores
        try:
            head, *lines = (json.loads(text) for text in path.read_text(encoding="utf-8").splitlines())
            version, came = head["format"], head["task"]
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise DataFileError(f"{path}: expected lines of scores ({error!r}); restore it, or take --anew") from error
        for what, expected, got in [("format", FORMAT, version), *_differences(scores.task, came)]:
            if got != expected:
                raise DataFileError(
                    f"{path}: expected scores with {what} {expected!r}, got {got!r}; choose options that fit, or take --anew"
                )
        try:
            scores.floor = None if head["floor"] is None else float(head["floor"])
            scores.latencies = {method: Latency(**found) for method, found in head["latencies"].items()}
            for line in lines:
                scores._insert(_line(line))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise DataFileError(f"{path}: expected lines of scores ({error!r}); restore it, or take --anew") from error
        return scores

    def _insert(self, line: Line) -> None:
        """Take in a line of a file, which must be whole: ValueError for two of one score, and for others of its method."""
        targets = sum(self.task["places"].values())
        if len(line.errors) != targets:
            raise ValueError(f"{line.key}: expected {targets} errors, got {len(line.errors)}")
        if line.key in self.lines:
            raise ValueError(f"{line.key}: expected one line, got two")
        if self.settings(line.method) not in (None, line.settings):
            raise ValueError(f"{line.method}: expected settings {self.settings(line.method)}, got {line.settings}")
        self.lines[line.key] = line


def _line(found: Mapping[str, Any]) -> Line:
    scatter = found.get("scatter")
    numbers = {"errors": tuple(map(float, found["errors"])), "scatter": None if scatter is None else float(scatter)}
    return Line(**{**found, **numbers, "budget": int(found["budget"]), "seed": int(found["seed"])})


def _differences(wanted: Mapping[str, Any], came: Mapping[str, Any], inside: str = "") -> list[tuple[str, Any, Any]]:
    """What tasks differ in: name, wanted, came; of what has parts, the parts."""
    found: list[tuple[str, Any, Any]] = []
    for name in sorted({*wanted, *came}):
        ours, theirs = wanted.get(name), came.get(name)
        if isinstance(ours, dict) and isinstance(theirs, dict):
            found += _differences(ours, theirs, f"{inside}{name}: ")
        elif ours != theirs:
            found.append((f"{inside}{name}", ours, theirs))
    return found


def errors_and_scatter(
    landings: Floats, targets: Floats, reaches: Floats, units: Floats, inside: Floats
) -> tuple[tuple[float, ...], float | None]:
    """Errors and scatter, as in :class:`Line`, of landings from moved starts, shape (targets, starts, 2) [m].

    Args:
        landings: not-a-number where a hop failed, which counts as one that landed as far away as any target may be.
        targets: shape (targets, 2) [m].
        reaches: of the targets' scenes, shape (targets,) [m].
        units: what lengths are divided by, shape (targets,) [m].
        inside: whether a target lies in the reachable region, shape (targets,).
    """
    errors = distances(landings, targets, reaches[:, None]).mean(axis=1) / units
    return tuple(rounded(error) for error in errors), _scatter(landings[inside], units[inside])


def _scatter(landings: Floats, units: Floats) -> float | None:
    whole = np.isfinite(landings).all(axis=(1, 2))
    landings, units, count = landings[whole], units[whole], landings.shape[1]
    if count < 2 or not len(landings):
        return None
    apart = np.linalg.norm(landings - landings.mean(axis=1, keepdims=True), axis=2)
    # about a mean of few, distances are too small by this root
    return rounded(float(interquartile_mean(np.sqrt(count / (count - 1)) * apart.mean(axis=1) / units)))


def rounded(value: float) -> float:
    """To as many digits as are kept, so that tables made from a run and from its lines are the same."""
    return float(f"{value:.{DIGITS}g}")
