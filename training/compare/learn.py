"""What each method learns from its hops, and the planners that come of it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from surrogate import dataset, model
from surrogate.dataset import Configuration, HopData
from surrogate.model import HopNet
from surrogate.train import train
from tensegrity_gym import Scene
from tensegrity_gym.errors import DataFileError
from training.compare.config import CompareConfig
from training.compare.hops import Hops
from training.evolution import EvolutionConfig, EvolutionPlanner
from training.frozen import FrozenLanding
from training.inverse import InversePlanner, fit_energy
from training.kriging import fit_kriging
from training.planner import NearestHopPlanner, Planner
from training.tandem import TandemPlanner

#: Planners that simulate nothing, by name; in this order in tables.
PLANNERS = ("nearest", "single", "ensemble", "tandem", "cma")

#: Parts of a file at whose beginnings seeds begin.
PARTS = 10


def simulated(hops: Hops, stretches: np.ndarray, seed: int) -> HopData:
    """Hops of ``stretches`` as data; its wall time is what they took."""
    started = time.perf_counter()
    result = hops.simulate(stretches)
    configuration = Configuration(scene=hops.scene, seed=seed)
    return dataset.from_result(result, configuration, time.perf_counter() - started)


def from_file(path: Path, scene: Scene, seed: int, most: int) -> HopData:
    """``most`` hops of a file, from its ``seed``-th tenth on, with their landing read where ``scene`` says."""
    data = dataset.read(path)
    kept = Scene(**data.configuration["scene"])
    if replace(kept, landing=scene.landing, duration=scene.duration) != scene or data.configuration["scene_ranges"]:
        raise DataFileError(f"{path}: expected hops in {scene}, got hops in {kept}; use another file, or none")
    if len(data) < most:
        raise DataFileError(f"{path}: expected at least {most} hops, got {len(data)}; generate more, or choose smaller budgets")
    rows = data.rows((np.arange(most) + seed * (len(data) // PARTS)) % len(data))
    configuration = rows.configuration | {"scene": rows.configuration["scene"] | {"landing": scene.landing}}
    columns = rows.columns | {"landing": rows[scene.landing].copy()}
    seconds = float(columns["cpu_seconds"].sum()) if "cpu_seconds" in columns else data.seconds * most / len(data)
    return HopData(columns, configuration, seconds)


def fit_net(data: HopData, config: CompareConfig, seed: int) -> tuple[HopNet, float]:
    """The surrogate trained on ``data``, and how long that took [s]."""
    settings = replace(config.surrogate, seed=seed, steps=min(config.surrogate.steps, config.updates))
    net, card = train(data, settings, progress=config.progress, desc=f"surrogate of {len(data)} hops")
    return net, float(card["seconds"])


@dataclass(frozen=True)
class Fitted:
    """Planners made from the same hops, and what making each took beyond simulating and the surrogate [s]."""

    planners: dict[str, Planner]
    seconds: dict[str, float]

    @property
    def inverse(self) -> InversePlanner:
        """The robust planner, which others build on."""
        found = self.planners["ensemble"]
        assert isinstance(found, InversePlanner)
        return found


def fit_planners(net: HopNet, data: HopData, config: CompareConfig, seed: int, floor: float) -> Fitted:
    """All planners from the hops in ``data`` and the surrogate trained on them; ``floor`` [m] as in ``fit_kriging``."""
    data = data.rows(data.usable)
    seconds = {}
    landing = FrozenLanding(net)

    def timed(name: str, make):  # type: ignore[no-untyped-def]
        started = time.perf_counter()
        made = make()
        seconds[name] = time.perf_counter() - started
        return made

    def ensemble() -> InversePlanner:
        correction = fit_kriging(net, data, config.surrogate.validation, config.surrogate.test, floor)
        return InversePlanner(
            landing,
            config.inverse,
            correction=correction,
            energy=fit_energy(data["stretches"], data["stored_energy"]),
            stored=data["stretches"],
            seed=seed,
        )

    def by_net(stretches: Tensor) -> tuple[Tensor, Tensor]:
        landings = landing(stretches)
        mean = landings.mean(dim=0)
        return mean, ((landings - mean) ** 2).sum(dim=-1).mean(dim=0)

    def tandem() -> TandemPlanner:
        return TandemPlanner(
            by_net,
            data["landing"],
            replace(config.tandem, seed=seed),
            permutations=net.permutations.numpy(),
            signs=net.signs[:, :2].numpy(),
        )

    nearest = timed("nearest", lambda: NearestHopPlanner(data["stretches"], data["landing"]))
    single = timed("single", lambda: InversePlanner(lambda s: landing(s)[:1], config.inverse, stored=data["stretches"]))
    robust = timed("ensemble", ensemble)
    planners: dict[str, Planner] = {"nearest": nearest, "single": single, "ensemble": robust, "tandem": timed("tandem", tandem)}
    search = EvolutionConfig(evaluations=config.search, seed=seed)
    planners["cma"] = EvolutionPlanner(lambda s: mean_landing(landing, s), nearest, search)
    seconds["cma"] = seconds["nearest"]
    return Fitted(planners, seconds)


@torch.no_grad()
def mean_landing(landing: FrozenLanding, stretches: np.ndarray) -> np.ndarray:
    """The ensemble's landing of stretches (n, n_actuators), shape (n, 2) [m]."""
    return landing(torch.from_numpy(stretches.astype(np.float32))).mean(dim=0).numpy().astype(np.float64)


def save_net(net: HopNet, path: Path, data: HopData, seconds: float) -> None:
    """Checkpoint of the surrogate and its card."""
    model.save(net, path, {"hops": len(data), "configuration": data.configuration, "seconds": seconds})
