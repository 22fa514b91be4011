"""The question of a comparison: one scene and landing, the hops that methods learn from, and how their answers are scored."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from surrogate import dataset
from surrogate.dataset import HopData
from surrogate.generate import sample_stretches
from surrogate.storage import hash_of, package_versions
from tensegrity_gym import MODEL_VERSION
from tensegrity_gym.specimen import POSITION
from tensegrity_gym.task import check_fidelity, reach
from training.compare import targets as registered
from training.compare.config import CompareConfig
from training.compare.learn import from_file, model_of, simulated
from training.compare.scores import Line, Scores, errors_and_scatter, rounded
from training.compare.statistics import interquartile_mean
from training.hops import SEED as MOVED_SEED
from training.hops import Hops
from training.planner import Images
from training.stages import Results, Stages
from training.symmetry import Symmetry

#: Hops of a pool that are simulated, and kept, together.
BLOCK = 2048
#: Random hops that the floor is measured on.
FLOOR_HOPS = 64
#: Packages whose versions are noted with scores.
NOTED = ("numpy", "numba", "torch", "stable-baselines3")


class Question(ABC):
    """Targets in one scene; see ``varied`` for scenes that vary."""

    hops: Any

    def __init__(self, config: CompareConfig) -> None:
        self.config = config
        changes = {} if config.duration is None else {"duration": config.duration}
        self.scenes = registered.scenes_of(config.scene, config.landing, **changes)
        self.scene = self.scenes.base
        self.hops = self._simulator()
        self.stages = Stages(Path(config.out), say=print if config.progress else lambda _: None)
        self.places = registered.read(
            config.scene, config.landing, config.targets, registered.SECOND if config.second else registered.PATH
        )
        self.targets = np.concatenate(list(self.places.values()))
        #: Which targets are of a place, shape (targets,).
        self.rows = {p: np.repeat([p == q for q in self.places], [len(t) for t in self.places.values()]) for p in self.places}
        #: What every stage's record depends on.
        self.base = {"scene": asdict(self.scene), "fidelity": config.fidelity} | self._varying()
        #: What the methods are judged by: kept scores, where there are some, and those of this run.
        self.scores = Scores(self.task) if config.kept is None else Scores.read(config.kept, self.task)
        self._pools: dict[int, HopData] = {}

    def _simulator(self) -> Any:
        return Hops(self.scene, check_fidelity(self.config.fidelity), self.config.threads)

    @property
    def reaches(self) -> np.ndarray:
        """Reach of the scene of each target, shape (n,) [m]."""
        return np.full(len(self.targets), reach(self.scene))

    def _varying(self) -> dict[str, Any]:
        """What records depend on where scenes vary."""
        return {}

    @cached_property
    def images(self) -> Images:
        """Symmetries that all scenes share."""
        return Symmetry.of(self.scenes).images

    @property
    def units(self) -> np.ndarray:
        """What lengths are divided by in scores: metres, shape (n,) [m]."""
        return np.ones(len(self.targets))

    @property
    def task(self) -> dict[str, Any]:
        """What all scores have in common."""
        counts = {place: len(targets) for place, targets in self.places.items()}
        given = {"perturbations": self.config.perturbations, "places": counts, "targets": hash_of(self.targets.tolist())}
        moved = {"moved_by": POSITION, "moved_seed": MOVED_SEED, "floor_hops": FLOOR_HOPS}
        return self.base | given | moved | {"model_version": MODEL_VERSION}

    @abstractmethod
    def settings_of(self, method: str) -> dict[str, Any]:
        """All that scores of a method depend on besides budget and seed."""

    def pool(self, seed: int) -> HopData:
        """The hops of a seed: as many as the largest budget; smaller budgets are its first rows."""
        if seed in self._pools:
            return self._pools[seed]
        most = max(self.config.budgets)
        if self.config.data is not None:
            found = from_file(self.config.data, self.scenes, self.config.fidelity, seed, most)
        else:
            found = dataset.concatenate([self._block(seed, k, most) for k in range(0, most, BLOCK)])
        self._pools = {seed: found}  # one at a time in memory
        return found

    def learnt(self, seed: int, budget: int) -> HopData:
        """The hops that planners of a seed and budget learn from, with a record of which they are."""
        pool, name = self.pool(seed), f"hops_{seed}_{budget}"
        found = pool.rows(slice(0, budget))
        if name not in self.stages.hashes:
            seconds = pool.seconds * budget / len(pool)
            self.stages.run(name, self.base | {"digest": found.digest}, lambda: {"seconds": seconds})
        return found

    def _block(self, seed: int, first: int, most: int) -> HopData:
        last = min(first + BLOCK, most)
        path = self.stages.folder / f"hops_{seed}_{first}_{last}.h5"

        def work() -> Results:
            part = simulated(self.hops, sample_stretches(last, seed)[first:last], seed)
            dataset.write(path, part)
            return {"seconds": part.seconds}

        self.stages.run(path.stem, self.base | {"seed": seed, "first": first, "last": last}, work, files=[path.name])
        found, made = dataset.read(path), model_of(self.config.fidelity, self.scene)
        # older files name the paper's model whichever made them; the stage's record knows
        configuration = found.configuration | {"fidelity": made.levers(), "precision": made.precision}
        return HopData(found.columns, configuration, found.seconds)

    def measure_floor(self) -> None:
        """Measure :attr:`floor`, and what of it scores keep, once."""
        if "floor" in self.stages.results:
            return
        found = self.stages.run("floor", self.base | {"perturbations": self.config.perturbations}, self._moved_hops)
        moved = np.array(found["distances"]).mean(axis=1) / np.array(found.get("reaches", 1.0))
        self.scores.floor = rounded(float(interquartile_mean(moved)))

    def _moved_hops(self) -> Results:
        """How far moved starts carry random hops [m]."""
        landings = self.hops.perturbed(sample_stretches(FLOOR_HOPS, 99), self.config.perturbations)
        return {"distances": np.linalg.norm(landings[:, 1:] - landings[:, :1], axis=2).tolist()}

    @property
    def floor(self) -> float:
        """How far moved starts land from where the unmoved one does, root mean square in each direction [m]."""
        return float(np.sqrt(np.mean(np.square(self.stages.results["floor"]["distances"])) / 2))

    def score(
        self,
        method: str,
        seed: int,
        budget: int,
        needs: str,
        answers: Callable[[], Any],
        *,
        seconds: float,
        calls_per_answer: float | None = None,
    ) -> None:
        """Simulate the answers of a method, from their start and from moved ones, and take down how near they come.

        ``needs`` is the stage that the answers come of, ``seconds`` the wall time that the method learnt for, simulating left
        out [s].
        """

        def work() -> Results:
            stretches = np.array(answers()["stretches"])
            landings = self.hops.perturbed(stretches, self.config.perturbations, self.targets)
            return {"stretches": stretches.tolist(), "landings": landings.tolist()}

        content = self.base | {"perturbations": self.config.perturbations, "targets": self.targets.tolist()}
        name = f"score_{method}_{seed}_{budget}"
        found = self.stages.run(name, content, work, needs=[needs])
        landings = np.array(found["landings"], dtype=np.float64)[:, 1:]
        errors, scatter = errors_and_scatter(landings, self.targets[:, :2], self.reaches, self.units, self.rows["inside"])
        versions = self.stages.versions[needs] or package_versions()
        self.scores.add(
            Line(
                method,
                budget,
                seed,
                errors,
                scatter,
                rounded(seconds),
                hash_of(self.settings_of(method)),
                self.stages.dates[name][:10],
                ", ".join(f"{package} {versions[package]}" for package in NOTED if package in versions),
                calls_per_answer,
            )
        )
