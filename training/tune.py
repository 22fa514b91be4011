"""Search a policy's hyper-parameters, and count the hops that it takes."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from surrogate.storage import atomic_path
from tensegrity_gym import MODEL_VERSION
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.task import check_fidelity, reach, sample_targets
from training.algorithms import FOLDER, check_rollout, hyperparameters
from training.compare.statistics import interquartile_mean
from training.compare.targets import SCENES, VARIED, scenes_of
from training.hops import Hops
from training.score import distances
from training.stages import Results, Stages
from training.train_policy import PolicyConfig, train_policy

#: Seed of the targets that settings are judged on, which are none of the registered ones.
TARGET_SEED = 20261124


@dataclass(frozen=True)
class TuneConfig:
    """Search a policy's hyper-parameters at random, and keep the best as a TOML file; a rerun goes on."""

    out: Path = Path("runs/tune")
    """Folder of all trials; the best settings go there as ALGORITHM.toml."""
    algorithm: str = "sac"
    """sac, td3 or ppo; what is chosen from is in training/hyperparameters/choices."""
    scene: str = "earth"
    """Scene preset."""
    landing: str = "touchdown"
    """Where a landing is read: rest or touchdown."""
    fidelity: str = "flown"
    """Model of the hop, for learning and for scoring alike."""
    calls: int = 1000
    """Hops of each training."""
    settings: int = 16
    """Settings tried, of which the committed ones are the first."""
    seeds: int = 2
    """Trainings of each."""
    finalists: int = 3
    """Best settings that are trained anew with other seeds, beside the committed ones."""
    final_seeds: int = 4
    """Those seeds: of many settings the best by few trainings was lucky too."""
    targets: int = 32
    """Targets inside the reachable region that settings are judged on."""
    seed: int = 0
    """Seed of the choices."""
    progress: bool = True
    """Show progress bars."""

    def __post_init__(self) -> None:
        for name in ("settings", "seeds", "finalists", "final_seeds", "targets"):
            if getattr(self, name) < 1:
                raise InvalidParameterError(f"{name}: expected an integer >= 1, got {getattr(self, name)}")
        if self.scene in VARIED:
            raise InvalidParameterError(f"scene: expected one of {SCENES}, got {self.scene!r}, whose scenes vary; choose another")


@dataclass(frozen=True)
class Trial:
    """Settings and what was found of them."""

    number: int  #: 0: the committed ones
    values: dict[str, Any]
    errors: list[float]  #: interquartile mean over targets, by training [m]

    @property
    def mean(self) -> float:
        """Over trainings [m]."""
        return float(np.mean(self.errors))


class Search:
    """A search of one algorithm's settings."""

    def __init__(self, config: TuneConfig) -> None:
        self.config = config
        self.scenes = scenes_of(config.scene, config.landing)
        self.hops = Hops(self.scenes.base, check_fidelity(config.fidelity))
        self.stages = Stages(Path(config.out), say=print if config.progress else lambda _: None)
        self.targets = sample_targets(np.random.default_rng(TARGET_SEED), config.targets, self.scenes.base, "inside")

    @cached_property
    def values(self) -> list[dict[str, Any]]:
        """All settings, the committed ones first."""
        committed = hyperparameters(self.config.algorithm)
        return [committed, *draw(committed, choices(self.config.algorithm), self.config.settings - 1, self.config.seed)]

    def run(self) -> tuple[list[Trial], list[Trial]]:
        """All trials, and those of the final, each from the best to the worst."""
        config = self.config
        if config.algorithm == "ppo":  # one that cannot take so many calls would stop the search hours later
            for rollout in {values["rollout"] for values in self.values}:
                check_rollout(config.calls, rollout, lambda calls: PolicyConfig("ppo", calls=calls).together)
        tried = [self._trial(k, range(config.seeds)) for k in range(len(self.values))]
        tried.sort(key=lambda trial: trial.mean)
        numbers = {0, *(trial.number for trial in tried[: config.finalists])}
        fresh = range(config.seeds, config.seeds + config.final_seeds)
        final = sorted((self._trial(k, fresh) for k in sorted(numbers)), key=lambda trial: trial.mean)
        return tried, final

    @property
    def calls(self) -> int:
        """Hops that trainings and scores took."""
        return sum(self.config.calls + self.config.targets for name in self.stages.results if name.startswith("trial_"))

    def _trial(self, number: int, seeds: range) -> Trial:
        return Trial(number, self.values[number], [self._error(number, seed) for seed in seeds])

    def _error(self, number: int, seed: int) -> float:
        config, values, name = self.config, self.values[number], f"trial_{self.config.algorithm}_{number}_{seed}"
        path = self.stages.folder / f"{config.algorithm}_{number}.toml"

        def work() -> Results:
            write_toml(path, values, f"Trial {number} of `python -m training tune`.")
            settings = PolicyConfig(
                config.algorithm, calls=config.calls, seed=seed, fidelity=config.fidelity, hyperparameters=path
            )
            actors, card = train_policy(self.scenes, settings, progress=config.progress)
            landings = self.hops.land(actors[config.calls].predict(self.targets)[0])
            errors = distances(landings[:, None], self.targets, reach(self.scenes.base))[:, 0]
            return {"errors": errors.tolist(), "seconds": card["seconds"]}

        content = {
            "algorithm": config.algorithm,
            "calls": config.calls,
            "seed": seed,
            "values": values,
            "scene": asdict(self.scenes.base),
            "fidelity": config.fidelity,
            "targets": self.targets.tolist(),
        }
        return float(interquartile_mean(np.array(self.stages.run(name, content, work)["errors"])))


def choices(algorithm: str) -> dict[str, Any]:
    """What the search of an algorithm's hyper-parameters chooses from: lists, by the names of the hyper-parameters."""
    return tomllib.loads((FOLDER / "choices" / f"{algorithm}.toml").read_text(encoding="utf-8"))


def draw(committed: Mapping[str, Any], among: Mapping[str, Any], count: int, seed: int) -> list[dict[str, Any]]:
    """``count`` settings: the committed ones, with each value that there is a choice of drawn evenly."""
    rng = np.random.default_rng(seed)

    def one(values: Mapping[str, Any], lists: Mapping[str, Any]) -> dict[str, Any]:
        found = dict(values)
        for name, options in lists.items():
            found[name] = one(values[name], options) if isinstance(options, Mapping) else options[rng.integers(len(options))]
        return found

    return [one(committed, among) for _ in range(count)]


def write_toml(path: Path, values: Mapping[str, Any], comment: str) -> Path:
    """Write hyper-parameters as a TOML file; numbers, texts and lists of them are written as in JSON."""
    plain = {name: value for name, value in values.items() if not isinstance(value, Mapping)}
    tables = {name: value for name, value in values.items() if isinstance(value, Mapping)}
    lines = [f"# {line}" for line in comment.splitlines()] + [f"{name} = {json.dumps(v)}" for name, v in plain.items()]
    for name, table in tables.items():
        lines += ["", f"[{name}]", *(f"{key} = {json.dumps(v)}" for key, v in table.items())]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def changes(values: Mapping[str, Any], committed: Mapping[str, Any]) -> str:
    """Where settings differ from the committed ones."""
    found = []
    for name, value in values.items():
        if isinstance(value, Mapping):
            found.append(changes(value, committed[name]))
        elif value != committed[name]:
            found.append(f"{name} {value}")
    return ", ".join(part for part in found if part)


def main(config: TuneConfig) -> None:
    """Entry of ``python -m training tune``."""
    search = Search(config)
    tried, final = search.run()
    committed = search.values[0]
    for title, trials in (("all settings", tried), ("the final, with other seeds", final)):
        print(f"{title}: error after {config.calls} hops, interquartile mean over {config.targets} targets [mm]")
        for trial in trials:
            each = " ".join(f"{1e3 * error:.1f}" for error in trial.errors)
            print(f"  {1e3 * trial.mean:6.1f}  ({each})  {trial.number:2}: {changes(trial.values, committed) or 'as committed'}")
    best = final[0]
    comment = (
        f"{config.algorithm.upper()}, the best of {config.settings} settings by `python -m training tune --algorithm "
        f"{config.algorithm}`:\n{search.calls} hops of {config.scene} at {config.landing}, {config.calls} in each training; "
        f"model version {MODEL_VERSION}."
    )
    print(write_toml(Path(config.out) / f"{config.algorithm}.toml", best.values, comment))
