"""Planners where scenes vary: known inverses of a throw under any gravity, and data of many scenes made alike."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from surrogate.dataset import HopData
from surrogate.frozen import FrozenLanding
from surrogate.generate import sample_stretches
from surrogate.model import HopNet, NetConfig, scene_symmetries
from tensegrity_gym import Lattice, Scene
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.scene_ranges import scene_ranges
from training.evolution import EvolutionConfig
from training.inverse import InversePlanner
from training.similarity import EARTH, alike
from training.tandem import TandemConfig, TandemPlanner
from training.varied import (
    NearestVariedHops,
    ScaledScenes,
    VariedEvolution,
    VariedPlanner,
    fit_varied_kriging,
    scene_values,
    unit_values,
)

VARIED = scene_ranges({"gravity": (1.6, 9.81), "friction": (0.3, 0.8)}, "touchdown")


def throw(stretches: Tensor, values: Tensor) -> Tensor:
    """Throw with speed, elevation and azimuth from the stretches; friction takes off speed; gravity (n,) [m/s^2]: (n, 2) [m]."""
    gravity, friction = values.unbind(dim=-1)
    speed = (1.0 + 2.0 * stretches[:, 0]) * (1 - 0.2 * friction)
    elevation = 0.4 + stretches[:, 1]
    azimuth = 6.0 * (stretches[:, 2] - stretches[:, 3])
    distance = speed**2 * torch.sin(2 * elevation) / gravity
    return torch.stack([distance * torch.cos(azimuth), distance * torch.sin(azimuth)], dim=-1)


def alike_throw(stretches: Tensor, values: Tensor) -> Tensor:
    """The same as it would be on Earth."""
    return throw(stretches, values) * values[..., :1] / EARTH


def questions(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Observations that can be answered, and their scene values."""
    rng = np.random.default_rng(0)
    values = rng.uniform(*VARIED.bounds(), (count, 2))
    hidden = torch.from_numpy(sample_stretches(count, 11).astype(np.float32))
    targets = throw(hidden, torch.from_numpy(values.astype(np.float32))).numpy()
    return np.column_stack([targets, values]), values


def missed(observations: np.ndarray, stretches: np.ndarray) -> np.ndarray:
    """Errors in lengths as on Earth [m]."""
    at, values = torch.from_numpy(stretches), torch.from_numpy(observations[:, 2:])
    return np.linalg.norm(alike_throw(at, values).numpy() - alike(observations, VARIED)[0], axis=1)


def planner_of(values: np.ndarray) -> InversePlanner:
    def landing(stretches: Tensor) -> Tensor:
        return alike_throw(stretches, torch.as_tensor(values, dtype=torch.float32).expand(len(stretches), 2))[None]

    return InversePlanner(landing)


def test_recovers_the_inverse_of_a_throw_in_each_scene() -> None:
    observations, values = questions(24)
    observations[12:, 2:] = values[:12]  # two questions a scene, the second one perhaps beyond reach
    planner = VariedPlanner(planner_of, VARIED, made_alike=True)
    stretches, state = planner.predict(observations)
    assert state is None
    assert missed(observations, stretches)[:12].max() < 1e-3
    np.testing.assert_allclose(planner.predict(observations[3])[0], stretches[3], atol=1e-4)
    # an answer for one scene is none for another
    moon, earth = (np.array([(0.6, 0.2, gravity, 0.5)]) for gravity in (1.625, EARTH))
    assert missed(earth, planner.predict(moon)[0])[0] > 0.2
    proposed = planner.propose(observations[:6], 4)
    assert proposed.shape == (6, 4, 4)
    for k in range(4):
        assert missed(observations[:6], proposed[:, k]).max() < 1e-2


def test_tandem_net_learns_the_inverse_in_all_scenes_at_once() -> None:
    def see(stretches: Tensor, scene: Tensor) -> tuple[Tensor, Tensor]:
        low, high = (torch.from_numpy(bound.astype(np.float32)) for bound in VARIED.bounds())
        return alike_throw(stretches, (low + high) / 2 + scene * (high - low) / 2), torch.zeros(len(stretches))

    observations, _ = questions(2000)
    landings = alike(observations, VARIED)[0]
    planner = ScaledScenes(TandemPlanner(see, landings, TandemConfig(steps=600), scene_values=2), VARIED)
    stretches, _ = planner.predict(observations[:200])
    assert np.median(missed(observations[:200], stretches)) < 0.03 * np.linalg.norm(landings, axis=1).max()
    np.testing.assert_allclose(planner.predict(observations[0])[0], stretches[0], atol=1e-6)


def test_nearest_of_many_scenes_weighs_what_a_scene_changes() -> None:
    """Landings move by 0.3 m over the range of friction, and not with gravity, once they are made alike."""
    rng = np.random.default_rng(1)
    values = rng.uniform(*VARIED.bounds(), (2000, 2))
    stretches = sample_stretches(2000, 2)
    landings = stretches[:, :2] + 0.15 * unit_values(values, VARIED)[:, 1:]
    hops = NearestVariedHops(stretches, landings, values, VARIED)
    gravity, friction = hops.weights
    assert friction == pytest.approx(2 * 0.15**2, rel=0.2)  # both directions move
    assert gravity < 0.02 * friction
    # a hop of the same scene is preferred to one that landed a little nearer in another
    hops.weights = np.array([0.0, 0.045])
    hops.stretches, hops.landings = stretches[:2], np.array([(0.1, 0.0), (0.12, 0.0)])
    hops.values = np.array([(0.0, 1.0), (0.0, 0.0)])
    chosen, _ = hops.at(np.array([3.0, 0.55])).predict(np.array([0.1, 0.0]))
    np.testing.assert_array_equal(chosen, stretches[1])


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros(2),
        np.array((np.nan, 0.0, 3.0, 0.5)),
        np.zeros((2, 5)),
        np.array((0.1, 0.0, 0.5, 3.0)),  # gravity and friction the other way round
        np.array((0.1, 0.0, -4.0, 0.5)),
        np.array([(0.1, 0.0, 3.0, 0.5), (0.1, 0.0, 12.0, 0.5)]),
    ],
)
def test_observations_without_their_scene_are_named(bad: np.ndarray) -> None:
    with pytest.raises(InvalidParameterError, match="gravity"):
        VariedPlanner(planner_of, VARIED, made_alike=True).predict(bad)


def test_evolution_of_all_scenes_together_recovers_the_inverse_in_each() -> None:
    pytest.importorskip("cma")
    observations, _ = questions(5)
    looked = []

    def land(stretches: np.ndarray, values: np.ndarray) -> np.ndarray:
        looked.append(len(stretches))
        return alike_throw(torch.from_numpy(stretches), torch.from_numpy(values)).numpy()

    stored, values = sample_stretches(500, 0), np.random.default_rng(2).uniform(*VARIED.bounds(), (500, 2))
    start = VariedPlanner(NearestVariedHops(stored, land(stored, values), values, VARIED).at, VARIED, made_alike=True)
    looked.clear()
    stretches, _ = VariedEvolution(land, start, EvolutionConfig(evaluations=400), VARIED).predict(observations)
    assert missed(observations, stretches).max() < 1e-3
    assert missed(observations, start.predict(observations)[0]).max() > 1e-2
    assert sum(looked) == 5 * 400


def rough_hops(net: HopNet, count: int, seed: int) -> tuple[HopData, np.ndarray]:
    """Hops that the net misses by waves, rough in the stretches, whose height changes slowly with gravity; and what it misses."""
    rng = np.random.default_rng(seed)
    stretches, values = sample_stretches(count, seed), rng.uniform(*VARIED.bounds(), (count, 2))
    images = stretches[:, net.permutations.numpy()]
    wave = np.stack([np.sin(20 * images[..., 0]), np.cos(15 * images[..., 1])], axis=2)
    height = 0.02 + 0.015 * unit_values(values, VARIED)[:, :1]
    residual = height * (wave * net.signs[:, :2].numpy()).mean(axis=1)
    with torch.no_grad():
        inputs = (torch.from_numpy(a.astype(np.float32)) for a in (stretches, values))
        smooth = FrozenLanding(net, VARIED.observed)(*inputs).mean(dim=0).numpy()
    columns = {
        "stretches": stretches,
        "landing": smooth + residual,
        "scene_gravity": values[:, 0],
        "scene_friction": values[:, 1],
    }
    return HopData(columns | {"index": np.arange(count)}, {}), residual


def test_kriging_of_many_scenes_finds_what_the_net_misses_in_each() -> None:
    torch.manual_seed(0)
    net = HopNet(NetConfig(hidden=(8, 8), members=2), *scene_symmetries(Lattice(2, 2), Scene()), Scene(), dict(VARIED.ranges))
    net.output_scale.copy_(torch.linspace(0.1, 0.9, len(net.output_scale)))
    data, _ = rough_hops(net.eval(), 4000, 0)
    shares = np.random.default_rng(1).random(4000)
    split = {"train": np.flatnonzero(shares > 0.1), "validation": np.flatnonzero(shares <= 0.1)}
    kriging = fit_varied_kriging(net, data, VARIED, split, 0.0)
    assert kriging is not None
    unseen, residual = rough_hops(net, 400, 9)
    points, values = torch.from_numpy(unseen["stretches"].astype(np.float32)), scene_values(unseen, VARIED)
    shifts = [kriging.at(values[k])(points[k : k + 1]) for k in range(400)]
    left = residual - np.concatenate([shift.numpy() for shift, _ in shifts])
    assert np.sqrt((left**2).mean()) < 0.4 * np.sqrt((residual**2).mean())
    variance = np.array([doubt.item() for _, doubt in shifts])
    assert np.sqrt(variance.mean()) == pytest.approx(np.sqrt((left**2).mean()), rel=0.4)
    # groups of close stretches are corrected as each alone is, but for their having the first one's neighbours
    group, doubt = kriging.at(values[0])(points[:1].expand(1, 3, 4))
    np.testing.assert_allclose(group[0, 1].numpy(), shifts[0][0][0].numpy(), atol=1e-6)
    assert doubt.shape == (1, 3)
    few = {"train": np.arange(1), "validation": np.arange(1)}
    assert fit_varied_kriging(net, data.rows(slice(0, 2)), VARIED, few, 0.0) is None
