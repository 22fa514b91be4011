"""Planners where scenes vary: each observation says which scene it is of, and a planner is made for that scene.

Lengths made alike (see ``similarity``) let what is learnt in one gravity serve in another; most plan in them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.optimize import nnls
from scipy.spatial import KDTree
from torch import Tensor

from surrogate.dataset import HopData
from surrogate.frozen import FrozenLanding
from surrogate.kriging import Kriging, fit_process
from surrogate.model import HopNet, one_thread
from tensegrity_gym.scene_ranges import SceneRanges
from tensegrity_gym.types import Floats
from training.evolution import EvolutionConfig, EvolutionPlanner
from training.inverse import InverseConfig, InversePlanner
from training.planner import Images, NearestHopPlanner, Planner, Prediction, targets_of, with_images
from training.similarity import alike

#: Neighbours of each hop that tell how its landing changes with stretches and scene.
NEIGHBOURS = 8


class VariedPlanner:
    """Observations, target [m] and scene values, answered by a planner made anew for each scene that occurs among them.

    ``make``: scene values (k,) [SI] to a planner of targets in that scene [m]; with ``made_alike`` its targets are as they
    would be on Earth (see ``similarity``), which is what nets and hops that were made alike know.
    """

    def __init__(self, make: Callable[[Floats], Any], scenes: SceneRanges, *, made_alike: bool = False) -> None:
        self.make, self.scenes, self.made_alike = make, scenes, made_alike

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Observations (2 + k,) or (n, 2 + k) to stretches (4,) or (n, 4)."""
        found = self._asked(observation, lambda planner, targets: planner.predict(targets)[0])
        return (found[0] if np.ndim(observation) == 1 else found), state

    def propose(self, observations: np.ndarray, count: int) -> np.ndarray:
        """``count`` different answers to each observation (n, 2 + k), best first, shape (n, count, n_actuators)."""
        return self._asked(observations, lambda planner, targets: planner.propose(targets, count))

    def _asked(self, observations: np.ndarray, ask: Callable[[Any, Floats], np.ndarray]) -> np.ndarray:
        targets, values = alike(observations, self.scenes)
        if not self.made_alike:
            targets = targets_of(observations)
        distinct, which = np.unique(values, axis=0, return_inverse=True)
        rows = [np.flatnonzero(which.reshape(-1) == k) for k in range(len(distinct))]
        parts = [ask(self.make(scene), targets[row]) for scene, row in zip(distinct, rows, strict=True)]
        return np.concatenate(parts)[np.argsort(np.concatenate(rows))]


class VariedEvolution:
    """CMA-ES from another planner's answers; the searches of all scenes advance together.

    ``land``: stretches (n, n_actuators) and the scene values of each (n, k) [SI] to landings as they would be on Earth (n, 2)
    [m].
    """

    def __init__(
        self, land: Callable[[Floats, Floats], Floats], start: Planner, config: EvolutionConfig, scenes: SceneRanges
    ) -> None:
        self.land, self.start, self.config, self.scenes = land, start, config, scenes

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Observations (2 + k,) or (n, 2 + k) to stretches (4,) or (n, 4)."""
        targets, values = alike(observation, self.scenes)

        def land(stretches: Floats) -> Floats:
            return self.land(stretches, np.repeat(values, len(stretches) // len(values), axis=0))

        search = EvolutionPlanner(land, _Given(self.start.predict(np.atleast_2d(observation))[0]), self.config)
        found, _ = search.predict(targets)
        return (found[0] if np.ndim(observation) == 1 else found), state


class _Given:
    """Answers that are known already."""

    def __init__(self, stretches: Floats) -> None:
        self.stretches = stretches

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        return self.stretches, state


class ScaledScenes:
    """A planner that is told scenes itself: targets as they would be on Earth [m], then scene values from -1 to 1."""

    def __init__(self, planner: Planner, scenes: SceneRanges) -> None:
        self.planner, self.scenes = planner, scenes

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Observations (2 + k,) or (n, 2 + k) to stretches (4,) or (n, 4)."""
        targets, values = alike(observation, self.scenes)
        found, _ = self.planner.predict(np.column_stack([targets, unit_values(values, self.scenes)]))
        return (found[0] if np.ndim(observation) == 1 else found), state


def scene_values(data: HopData, scenes: SceneRanges) -> Floats:
    """Scene values of stored hops in observed order, shape (n, k) [SI]."""
    return np.column_stack([data[f"scene_{name}"] for name in scenes.observed])


def unit_values(values: Floats, scenes: SceneRanges) -> Floats:
    """Scene values (n, k) [SI] from -1 to 1 over their ranges."""
    low, high = scenes.bounds()
    return (np.asarray(values, dtype=np.float64) - (low + high) / 2) / ((high - low) / 2)


def variogram(stretches: Floats, landings: Floats, values: Floats) -> tuple[float, Floats]:
    """Squared distance of two hops' landings per squared difference of their stretches [m^2], and of each scene value.

    Of hops with nearly the same stretches, fitted, with a constant, by non-negative least squares; arrays (n, n_actuators),
    (n, 2) [m] and, from -1 to 1, (n, k).
    """
    count = min(NEIGHBOURS + 1, len(stretches))
    if count < 2:
        return 0.0, np.zeros(values.shape[1])
    near = KDTree(stretches).query(stretches, count)[1][:, 1:]  # the first is the hop itself
    apart = ((stretches[near] - stretches[:, None]) ** 2).sum(axis=2).reshape(-1, 1)
    strange = ((values[near] - values[:, None]) ** 2).reshape(-1, values.shape[1])
    moved = ((landings[near] - landings[:, None]) ** 2).sum(axis=2).reshape(-1)
    _, slope, *weights = nnls(np.column_stack([np.ones(len(apart)), apart, strange]), moved)[0]
    return float(slope), np.array(weights)


class NearestVariedHops:
    """Stored hops of many scenes: for each scene the planner that repeats one of them.

    The squared error to expect of repeating a hop is its landing's squared distance to the target plus what being of another
    scene costs, as the :func:`variogram` of these hops has it.

    Args:
        stretches: shape (n, n_actuators).
        landings: as they would be on Earth, shape (n, 2) [m].
        values: of each hop's scene, shape (n, k) [SI].
        images: symmetries under which hops have images, in all of the scenes.
    """

    def __init__(
        self, stretches: Floats, landings: Floats, values: Floats, scenes: SceneRanges, *, images: Images | None = None
    ) -> None:
        self.scenes = scenes
        values = unit_values(values, scenes)
        self.weights = variogram(stretches, landings, values)[1]
        self.stretches, self.landings = with_images(stretches, landings, images)
        self.values = np.repeat(values, len(self.stretches) // len(stretches), axis=0)

    def at(self, values: Floats) -> NearestHopPlanner:
        """The planner of one scene, of ``values`` (k,) [SI]."""
        away = (self.values - unit_values(values[None], self.scenes)) ** 2
        return NearestHopPlanner(self.stretches, self.landings, strangeness=away @ self.weights)


class VariedKriging:
    """Kriging of what a net misses where scenes vary: a scene's difference counts as that of stretches that moves as much."""

    def __init__(self, process: Kriging, weights: Floats, scenes: SceneRanges) -> None:
        self.process, self.weights, self.scenes = process, weights, scenes

    def at(self, values: Floats) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
        """The correction in the scene of ``values`` (k,) [SI]; see ``Kriging``."""
        scene = torch.from_numpy(((unit_values(values[None], self.scenes) * self.weights)[0]).astype(np.float32))
        return lambda s: self.process(torch.cat([s, scene.expand(*s.shape[:-1], len(scene))], dim=-1))


def inverse_planners(
    landing: FrozenLanding, kriging: VariedKriging | None, config: InverseConfig, **of_all: Any
) -> Callable[[Floats], InversePlanner]:
    """Scene values in observed order (k,) [SI] to the robust planner of that scene; ``of_all``: what all of them are told."""

    @one_thread()
    def make(values: Floats) -> InversePlanner:
        planner = InversePlanner(landing.at(values), config, **of_all)
        if kriging is not None:  # the descents need it; to see the whole pool with it in each scene would take a second
            planner.correction = kriging.at(values)
        return planner

    return make


@one_thread()
@torch.no_grad()
def fit_varied_kriging(
    net: HopNet, data: HopData, scenes: SceneRanges, split: dict[str, np.ndarray], floor: float
) -> VariedKriging | None:
    """As ``fit_kriging``, of hops in scenes that vary, with lengths as they would be on Earth; None if there are too few."""
    stretches, values = data["stretches"], scene_values(data, scenes)
    inputs = (torch.from_numpy(a.astype(np.float32)) for a in (stretches, values))
    residuals = data["landing"] - FrozenLanding(net, scenes.observed)(*inputs).mean(dim=0).numpy()
    unit = unit_values(values, scenes)
    slope, weights = variogram(stretches, data["landing"], unit)
    weights = np.sqrt(weights / slope) if slope > 0 else np.ones(len(weights))
    own, group = net.permutations.shape[1], len(net.permutations)
    still = np.broadcast_to(np.arange(own, own + len(weights)), (group, len(weights)))
    images = np.column_stack([net.permutations.numpy(), still]), net.signs[:, :2].numpy().astype(np.float64)
    process = fit_process(np.column_stack([stretches, unit * weights]), residuals, images, split, floor)
    return None if process is None else VariedKriging(process, weights, scenes)
