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

from surrogate.storage import atomic_path, ensure_folder
from tensegrity_gym.errors import DataFileError
from tensegrity_gym.types import Floats
from training.compare.statistics import interquartile_mean
from training.score import distances

FORMAT = 1
#: Digits of errors that are kept: a hundredth of what seeds scatter by.
DIGITS = 4

Key = tuple[str, int, int]


@dataclass(frozen=True)
class Score:
    """How near one training's answers come. Errors are in metres, or in reaches of the targets' scenes where these vary."""

    method: str
    budget: int  #: simulator calls learnt from
    seed: int  #: of the training
    errors: tuple[float, ...]  #: mean distance to the target from moved starts, of each registered target, in their order
    scatter: float  #: of an answer's landings about their own mean, interquartile mean over targets inside
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
class Latencies:
    """Wall times of single questions, on one idle core."""

    settings: str  #: hash of all that they depend on
    times: dict[str, tuple[float, float]]  #: median and 99th percentile [s], by method


class Scores:
    """Scores of one scene and landing, by method, budget and seed.

    ``task`` is what all of them have in common: physics, model, targets, moved starts.
    """

    def __init__(self, task: Mapping[str, Any]) -> None:
        self.task = json.loads(json.dumps(task))
        #: How far moved starts carry random hops, in the unit of errors; None as long as it was not measured.
        self.floor: float | None = None
        self.latencies: dict[str, Latencies] = {}
        self.rows: dict[Key, Score] = {}

    def add(self, score: Score) -> None:
        """Take a score in; those of its method and budget with other settings are of another method, and go."""
        same = [k for k, row in self.rows.items() if k[:2] == score.key[:2] and row.settings != score.settings]
        for key in same:
            del self.rows[key]
        self.rows[score.key] = score

    def holds(self, method: str, budget: int, seed: int, settings: str) -> bool:
        """Whether this score is known, with these settings."""
        row = self.rows.get((method, budget, seed))
        return row is not None and row.settings == settings

    def of(self, method: str, budget: int) -> list[Score]:
        """Scores of all seeds of a method and budget, by seed."""
        return sorted((r for r in self.rows.values() if r.key[:2] == (method, budget)), key=lambda r: r.seed)

    def write(self, path: Path) -> None:
        """Write all, atomically; the same scores give the same text."""
        head = {"format": FORMAT, "task": self.task, "floor": self.floor}
        head |= {"latencies": {name: asdict(found) for name, found in sorted(self.latencies.items())}}
        rows = [{k: v for k, v in asdict(self.rows[key]).items() if v is not None} for key in sorted(self.rows)]
        ensure_folder(path.parent)
        with atomic_path(path) as temporary:
            temporary.write_text("".join(json.dumps(line) + "\n" for line in [head, *rows]), encoding="utf-8")

    @classmethod
    def read(cls, path: Path, task: Mapping[str, Any]) -> Scores:
        """The scores in ``path``, none if there is no such file.

        DataFileError for a damaged file, and for scores of another task.
        """
        scores = cls(task)
        if not path.exists():
            return scores
        try:
            head, *rows = (json.loads(line) for line in path.read_text(encoding="utf-8").splitlines())
            version, came = head["format"], head["task"]
            if version == FORMAT:
                scores.floor = head["floor"]
                scores.latencies = {name: _latencies(found) for name, found in head["latencies"].items()}
                for row in rows:
                    scores.add(Score(**row | {"errors": tuple(row["errors"])}))
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise DataFileError(f"{path}: expected lines of scores ({error!r}); restore it, or take --anew") from error
        for what, expected, got in [("format", FORMAT, version), *_differences(scores.task, came)]:
            if got != expected:
                raise DataFileError(
                    f"{path}: expected scores with {what} {expected!r}, got {got!r}; choose options that fit, or take --anew"
                )
        return scores


def _latencies(found: Mapping[str, Any]) -> Latencies:
    return Latencies(found["settings"], {m: (float(a), float(b)) for m, (a, b) in found["times"].items()})


def _differences(wanted: Mapping[str, Any], came: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """What tasks differ in: name, wanted, came."""
    return [(name, wanted.get(name), came.get(name)) for name in sorted({*wanted, *came}) if wanted.get(name) != came.get(name)]


def measure(landings: Floats, targets: Floats, reaches: Floats, units: Floats, inside: Floats) -> tuple[tuple[float, ...], float]:
    """Errors and scatter, as in :class:`Score`, of landings from moved starts, shape (targets, starts, 2) [m].

    Args:
        landings: not-a-number where a hop failed, which counts as one that landed as far away as any target may be.
        targets: shape (targets, 2) [m].
        reaches: of the targets' scenes, shape (targets,) [m].
        units: what lengths are divided by, shape (targets,) [m].
        inside: whether a target lies in the reachable region, shape (targets,).
    """
    errors = distances(landings, targets, reaches[:, None]).mean(axis=1) / units
    return tuple(rounded(error) for error in errors), rounded(_scatter(landings[inside], units[inside]))


def _scatter(landings: Floats, units: Floats) -> float:
    whole = np.isfinite(landings).all(axis=(1, 2))
    landings, units, count = landings[whole], units[whole], landings.shape[1]
    if count < 2 or not len(landings):
        return float("nan")
    apart = np.linalg.norm(landings - landings.mean(axis=1, keepdims=True), axis=2)
    # about a mean of few, distances are too small by this root
    return float(interquartile_mean(np.sqrt(count / (count - 1)) * apart.mean(axis=1) / units))


def rounded(value: float) -> float:
    """To as many digits as are kept, so that tables made from a run and from its lines are the same."""
    return float(f"{value:.{DIGITS}g}")
