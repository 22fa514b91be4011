"""What each method learns from its hops, and the planners that come of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from surrogate import dataset
from surrogate.dataset import Configuration, HopData
from surrogate.frozen import FrozenLanding
from surrogate.hops import PHYSICS, check_parts
from surrogate.kriging import fit_kriging
from surrogate.model import HopNet
from surrogate.train import train
from tensegrity_gym import Design, Lattice, Scene
from tensegrity_gym.auto import choose_fidelity
from tensegrity_gym.errors import DataFileError, InvalidParameterError
from tensegrity_gym.fidelity import FIDELITIES, Fidelity, named_fidelity
from tensegrity_gym.scene_ranges import SceneRanges
from training.compare.config import CompareConfig
from training.evolution import EvolutionConfig, EvolutionPlanner
from training.hops import Hops
from training.inverse import START_SEED, InversePlanner, fit_energy
from training.planner import Images, NearestHopPlanner, Planner
from training.tandem import TandemPlanner

#: Parts of a file at whose beginnings seeds begin.
PARTS = 10


def simulated(hops: Hops, stretches: np.ndarray, seed: int) -> HopData:
    """Hops of ``stretches`` as data; its wall time is what they took."""
    started = time.perf_counter()
    result = hops.simulate(stretches)
    configuration = Configuration(scene=hops.scene, seed=seed, fidelity=result.fidelity)
    return dataset.from_result(result, configuration, time.perf_counter() - started)


def from_file(path: Path, scenes: SceneRanges, fidelity: str, seed: int, most: int) -> HopData:
    """``most`` hops of a file, from its ``seed``-th tenth on, with their landing read where the scenes say.

    They must be hops of the model that ``fidelity`` names: answers are scored with it.
    """
    if seed >= PARTS:
        raise InvalidParameterError(
            f"seeds: expected at most {PARTS} with a file of hops, of which each begins at another tenth, got seed {seed}; "
            "ask for fewer, or leave --data out"
        )
    data, scene = dataset.read(path), scenes.base
    data = data.rows(data["image"] == 0)  # images of simulated hops are no simulator calls
    _check_physics(data.configuration, scene, fidelity, path)
    kept, ranges = Scene(**data.configuration["scene"]), data.configuration["scene_ranges"]
    same = replace(kept, landing=scene.landing, duration=scene.duration, **{n: getattr(scene, n) for n in scenes.observed})
    wanted = {name: list(bounds) for name, bounds in scenes.ranges.items()}
    # a file of shorter hops has some that were cut off in flight
    if same != scene or ranges != wanted or kept.duration < scene.duration:
        raise DataFileError(
            f"{path}: expected hops in {scene}{_and(wanted)}, got hops in {kept}{_and(ranges)}; use another file, or none"
        )
    if len(data) < most:
        raise DataFileError(f"{path}: expected at least {most} hops, got {len(data)}; generate more, or choose smaller budgets")
    rows = data.rows((np.arange(most) + seed * (len(data) // PARTS)) % len(data))
    configuration = rows.configuration | {"scene": rows.configuration["scene"] | {"landing": scene.landing}}
    columns = rows.columns | {"landing": rows[scene.landing].copy()}
    seconds = float(columns["cpu_seconds"].sum()) if "cpu_seconds" in columns else data.seconds * most / len(data)
    return HopData(columns, configuration, seconds)


def model_of(fidelity: str, scene: Scene) -> Fidelity:
    """The model of the hop that the name means in ``scene``."""
    return choose_fidelity(Design(), scene, Lattice()) if fidelity == "auto" else named_fidelity(fidelity)


def _check_physics(came: Mapping[str, Any], scene: Scene, fidelity: str, path: Path) -> None:
    model = model_of(fidelity, scene)
    fitting = [name for name, known in FIDELITIES.items() if known.levers() == came.get("fidelity")]
    fix = f"compare with --fidelity {fitting[0]}, or use" if fitting and named_fidelity(fitting[0]) != model else "use"
    expected, why = Configuration(scene=scene, fidelity=model).as_dict(), f"as answers are scored with --fidelity {fidelity}"
    check_parts(came, expected, PHYSICS, str(path), why, f"{fix} another file, or none")


def _and(ranges: Mapping[str, Sequence[float]]) -> str:
    return "".join(f", {name} from {low:g} to {high:g}" for name, (low, high) in ranges.items())


def fit_net(data: HopData, config: CompareConfig, seed: int) -> tuple[HopNet, dict[str, Any]]:
    """The surrogate trained on ``data``, and its card."""
    settings = replace(config.surrogate, seed=seed, steps=min(config.surrogate.steps, config.updates))
    return train(data, settings, progress=config.progress, desc=f"surrogate of {len(data)} hops")


class Fitted:
    """Planners made, when they are asked for, from the hops in ``data`` and the surrogate trained on them.

    ``load`` reads the surrogate, once a planner needs it; ``floor`` [m] as in ``fit_kriging``.
    """

    def __init__(
        self, load: Callable[[], HopNet], data: HopData, config: CompareConfig, seed: int, images: Images, floor: float
    ) -> None:
        self._load, self.data, self.config, self.seed, self.images = load, data.rows(data.usable), config, seed, images
        self.floor = floor
        #: What making each planner took beyond simulating and the surrogate [s].
        self.seconds: dict[str, float] = {}
        self._made: dict[str, Planner] = {}

    @cached_property
    def net(self) -> HopNet:
        """The surrogate."""
        return self._load()

    @cached_property
    def landing(self) -> FrozenLanding:
        """Its members' landings."""
        return FrozenLanding(self.net)

    def __getitem__(self, name: str) -> Planner:
        if name not in self._made:
            started = time.perf_counter()
            make: dict[str, Callable[[], Planner]] = {
                "nearest": lambda: NearestHopPlanner(self.data["stretches"], self.data["landing"], images=self.images),
                "single": lambda: InversePlanner(
                    FrozenLanding(self.net.member(0)),
                    self.config.inverse,
                    stored=self.data["stretches"],
                    images=self.net.landing_images,
                    seed=self.seed + START_SEED,
                ),
                "ensemble": lambda: self.inverse,
                "tandem": self._tandem,
                "cma": self._evolution,
            }
            self._made[name] = make[name]()
            self.seconds[name] = time.perf_counter() - started
        return self._made[name]

    @cached_property
    def inverse(self) -> InversePlanner:
        """The robust planner, which others build on."""
        stretches, shares = self.data["stretches"], (self.config.surrogate.validation, self.config.surrogate.test)
        return InversePlanner(
            self.landing,
            self.config.inverse,
            correction=fit_kriging(self.net, self.data, *shares, self.floor),
            energy=fit_energy(stretches, self.data["stored_energy"]),
            stored=stretches,
            images=self.net.landing_images,
            seed=self.seed + START_SEED,
        )

    def _tandem(self) -> TandemPlanner:
        def see(stretches: Tensor) -> tuple[Tensor, Tensor]:
            landings = self.landing(stretches)
            mean = landings.mean(dim=0)
            return mean, ((landings - mean) ** 2).sum(dim=-1).mean(dim=0)

        permutations, signs = self.net.landing_images
        settings = replace(self.config.tandem, seed=self.seed)
        return TandemPlanner(see, self.data["landing"], settings, permutations=permutations, signs=signs)

    def _evolution(self) -> EvolutionPlanner:
        search = EvolutionConfig(evaluations=self.config.search, seed=self.seed)
        return EvolutionPlanner(lambda s: mean_landing(self.landing, s), self["nearest"], search)


@torch.no_grad()
def mean_landing(landing: FrozenLanding, stretches: np.ndarray) -> np.ndarray:
    """The ensemble's landing of stretches (n, n_actuators), shape (n, 2) [m]."""
    return landing(torch.from_numpy(stretches.astype(np.float32))).mean(dim=0).numpy().astype(np.float64)
