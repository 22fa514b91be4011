"""The comparison where scenes vary: each target has a scene of its own, which planners and policies see."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from surrogate import dataset
from surrogate.dataset import Configuration, HopData
from surrogate.frozen import FrozenLanding
from surrogate.generate import fill, sample_stretches
from surrogate.model import HopNet, one_thread
from tensegrity_gym.task import check_fidelity, reach
from tensegrity_gym.types import Floats
from training.compare.config import CompareConfig
from training.compare.question import BLOCK, FLOOR_HOPS
from training.compare.run import Comparison
from training.evolution import EvolutionConfig
from training.hops import VariedHops
from training.inverse import START_SEED, InversePlanner, fit_energy
from training.planner import BestOfPlanner, Planner
from training.refine import RefiningPlanner
from training.similarity import alike_data, likeness
from training.stages import Results
from training.tandem import TandemPlanner
from training.varied import (
    NearestVariedHops,
    ScaledScenes,
    VariedEvolution,
    VariedKriging,
    VariedPlanner,
    fit_varied_kriging,
    inverse_planners,
    scene_values,
)


class VariedComparison(Comparison):
    """As the comparison of one scene; what is learnt is lengths as they would be on Earth."""

    #: All envs of a step share a scene, as every 16 hops of a data set do; more envs would see fewer scenes.
    policy_settings: ClassVar[dict[str, Any]] = {"envs": 16}
    starts: ClassVar[tuple[str, ...]] = ("ensemble",)

    def _varying(self) -> dict[str, Any]:
        return {"ranges": {name: list(bounds) for name, bounds in self.scenes.ranges.items()}}

    def _simulator(self) -> VariedHops:
        return VariedHops(self.scenes, check_fidelity(self.config.fidelity), self.config.threads)

    @property
    def reaches(self) -> np.ndarray:
        """Reach of the scene of each target, shape (n,) [m]."""
        return self._reaches(self.targets)

    @property
    def units(self) -> np.ndarray:
        """What lengths are divided by in scores: the reach of each target's scene, shape (n,) [m]."""
        return self.reaches

    def _reaches(self, observations: Floats) -> Floats:
        return np.array([reach(self.hops.at(values)) for values in observations[:, 2:]])

    def learnt(self, seed: int, budget: int) -> HopData:
        """The hops that planners learn from, with lengths as they would be on Earth."""
        return alike_data(super().learnt(seed, budget), self.scenes)

    def _block(self, seed: int, first: int, most: int) -> HopData:
        last = min(first + BLOCK, most)
        path = self.stages.folder / f"hops_{seed}_{first}_{last}.h5"
        configuration = Configuration(
            scene=self.scene, seed=seed, fidelity=self.config.fidelity, scene_ranges=dict(self.scenes.ranges)
        )

        def work() -> Results:
            fill(path, last - first, configuration, first=first, threads=self.config.threads, progress=False)
            return {"seconds": dataset.read(path).seconds}

        self.stages.run(path.stem, self.base | {"seed": seed, "first": first, "last": last}, work, files=[path.name])
        return dataset.read(path)

    def _moved_hops(self) -> Results:
        rng = np.random.default_rng(99)
        drawn = [self.scenes.sample(rng) for _ in range(FLOOR_HOPS)]
        values = np.array([[getattr(scene, name) for name in self.scenes.observed] for scene in drawn])
        asked = np.column_stack([np.zeros((FLOOR_HOPS, 2)), values])
        landings = self.hops.perturbed(sample_stretches(FLOOR_HOPS, 99), self.config.perturbations, asked)
        distances = np.linalg.norm(landings[:, 1:] - landings[:, :1], axis=2)
        factor = likeness(values, self.scenes.observed)
        return {"distances": distances.tolist(), "reaches": self._reaches(asked).tolist(), "likeness": factor.tolist()}

    @property
    def floor(self) -> float:
        """As in one scene, of lengths as they would be on Earth [m]."""
        found = self.stages.results["floor"]
        alike = np.array(found["distances"]) * np.array(found["likeness"])[:, None]
        return float(np.sqrt(np.mean(np.square(alike)) / 2))

    def _fit(self, load: Callable[[], HopNet], data: HopData, seed: int) -> VariedFitted:
        return VariedFitted(load, data, self.config, seed, self)

    def land(self, stretches: Floats, values: Floats) -> Floats:
        """Landings as they would be on Earth (n, 2) [m], of stretches (n, n_actuators) in scenes of ``values`` (n, k) [SI]."""
        asked = np.column_stack([np.zeros((len(values), 2)), values])
        return likeness(values, self.scenes.observed)[:, None] * self.hops.land(stretches, asked)

    def _land_at(self, values: Floats) -> Callable[[Floats], Floats]:
        return lambda stretches: self.land(stretches, np.repeat(values[None], len(stretches), axis=0))

    def of_scenes(self, make: Callable[[Floats], Any]) -> VariedPlanner:
        """Planners made for each scene by ``make``, of lengths as they would be on Earth."""
        return VariedPlanner(make, self.scenes, made_alike=True)

    def _best(self, fitted: VariedFitted, tries: int) -> Planner:
        return self.of_scenes(lambda values: BestOfPlanner(fitted.planner(values), self._land_at(values), tries))

    def _refining(self, fitted: VariedFitted, start: str, tries: int) -> Planner:
        assert start == "ensemble"
        return self.of_scenes(lambda values: RefiningPlanner(fitted.planner(values), self._land_at(values), tries))

    def _search_from(self, start: Planner) -> Planner:
        return VariedEvolution(self.land, start, self._search, self.scenes)


class VariedFitted:
    """As ``Fitted``: planners of scenes that vary, made, when they are asked for, from hops and the net trained on them."""

    def __init__(
        self, load: Callable[[], HopNet], data: HopData, config: CompareConfig, seed: int, comparison: VariedComparison
    ) -> None:
        self._load, self.data, self.config, self.seed = load, data.rows(data.usable), config, seed
        self.comparison, self.scenes = comparison, comparison.scenes
        #: What making each planner took beyond simulating and the surrogate [s].
        self.seconds: dict[str, float] = {}
        self._made: dict[str, Any] = {}

    @cached_property
    def net(self) -> HopNet:
        """The surrogate."""
        return self._load()

    @cached_property
    def landing(self) -> FrozenLanding:
        """Its members' landings, told the scene."""
        return FrozenLanding(self.net, self.scenes.observed)

    def __getitem__(self, name: str) -> Any:
        if name not in self._made:
            started = time.perf_counter()
            make: dict[str, Callable[[], Planner]] = {
                "nearest": lambda: self.comparison.of_scenes(self._stored().at),
                "single": lambda: self.comparison.of_scenes(self._of_one_net),
                "ensemble": self._robust,
                "tandem": self._tandem,
                "cma": self._evolution,
            }
            self._made[name] = make[name]()
            self.seconds[name] = time.perf_counter() - started
        return self._made[name]

    def _robust(self) -> VariedPlanner:
        """All that its planners of one scene share is fitted here, so that its time counts as making this one."""
        return self.comparison.of_scenes(self.planner)

    @cached_property
    def kriging(self) -> VariedKriging | None:
        """What the ensemble misses near stored hops."""
        split = self.data.split(self.config.surrogate.validation, self.config.surrogate.test)
        return fit_varied_kriging(self.net, self.data, self.scenes, split, self.comparison.floor)

    @cached_property
    def energy(self) -> Callable[[np.ndarray], np.ndarray]:
        """The energy that stretches store."""
        return fit_energy(self.data["stretches"], self.data["stored_energy"])

    def _stored(self) -> NearestVariedHops:
        data, scenes = self.data, self.scenes
        return NearestVariedHops(
            data["stretches"], data["landing"], scene_values(data, scenes), scenes, images=self.comparison.images
        )

    @property
    def inverse(self) -> VariedPlanner:
        """The robust planner, which others build on."""
        return self["ensemble"]

    @cached_property
    def planner(self) -> Callable[[Floats], InversePlanner]:
        """Scene values (k,) [SI] to the robust planner of that scene."""
        images = self.net.landing_images
        return inverse_planners(
            self.landing, self.kriging, self.config.inverse, energy=self.energy, images=images, seed=self.seed + START_SEED
        )

    @one_thread()
    def _of_one_net(self, values: Floats) -> InversePlanner:
        return InversePlanner(
            self._first.at(values), self.config.inverse, images=self.net.landing_images, seed=self.seed + START_SEED
        )

    @cached_property
    def _first(self) -> FrozenLanding:
        """The first member alone."""
        return FrozenLanding(self.net.member(0), self.scenes.observed)

    def _tandem(self) -> Planner:
        low, high = (torch.from_numpy(bound.astype(np.float32)) for bound in self.scenes.bounds())

        def see(stretches: Tensor, scene: Tensor) -> tuple[Tensor, Tensor]:
            landings = self.landing(stretches, (low + high) / 2 + scene * (high - low) / 2)
            mean = landings.mean(dim=0)
            return mean, ((landings - mean) ** 2).sum(dim=-1).mean(dim=0)

        tandem = TandemPlanner(
            see,
            self.data["landing"],
            replace(self.config.tandem, seed=self.seed),
            permutations=self.net.landing_images[0],
            signs=self.net.landing_images[1],
            scene_values=len(self.scenes.observed),
        )
        return ScaledScenes(tandem, self.scenes)

    def _evolution(self) -> Planner:
        search = EvolutionConfig(evaluations=self.config.search, seed=self.seed)
        return VariedEvolution(self._mean_landing, self["nearest"], search, self.scenes)

    @torch.no_grad()
    def _mean_landing(self, stretches: Floats, values: Floats) -> Floats:
        inputs = (torch.from_numpy(a.astype(np.float32)) for a in (stretches, values))
        return self.landing(*inputs).mean(dim=0).numpy().astype(np.float64)
