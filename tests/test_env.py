"""``TensegrityHop-v0`` and its task: what gymnasium and SB3 expect, scoring, seeding, and every refusal."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import tensegrity_gym  # noqa: F401 (registers the env)
from tensegrity_gym import ENERGY_NAMES, HopStatus, Scene, simulate, task
from tensegrity_gym import env as env_module
from tensegrity_gym.env import TensegrityHopEnv, check_action, register_envs
from tensegrity_gym.errors import InvalidParameterError, InvalidStretchesError, ResetNeededError, UnknownPresetError

MIDDLE = np.full(4, 0.5, dtype=np.float32)
#: Hops that are over soon, for tests in which the physics plays no part.
SHORT = Scene(duration=0.3)
RANGES = {"gravity": (6.0, 9.8), "friction": (0.4, 0.6), "slope": (0.0, 0.1), "duration": 0.3}


@pytest.mark.parametrize("scene", [SHORT, RANGES], ids=["one scene", "ranges"])
def test_gymnasium_check_env(scene: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # the one warning we cannot avoid: actions are stretches, not in [-1, 1], see docs
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        # check_env wants an env that gym.make has made, without wrappers
        check_env(gym.make("TensegrityHop-v0", scene=scene, render_mode="rgb_array").unwrapped)


def test_sb3_check_env() -> None:
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        sb3.check_env(TensegrityHopEnv(scene=SHORT))


def test_make_imports_by_module_and_registering_twice_is_harmless() -> None:
    register_envs()
    env = gym.make("tensegrity_gym:TensegrityHop-v0")
    assert isinstance(env.unwrapped, TensegrityHopEnv)
    assert env.spec is not None
    assert env.spec.max_episode_steps is None


def test_one_hop_ends_the_episode_and_tells_all() -> None:
    env = TensegrityHopEnv()
    observation, info = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    assert info["reach"] == task.reach(Scene())
    after, reward, terminated, truncated, info = env.step(np.array((0.3, 0.4, 0.3, 0.4), dtype=np.float32))
    assert (terminated, truncated) == (True, False)
    assert env.observation_space.contains(after)
    hop = simulate(np.array((0.3, 0.4, 0.3, 0.4), dtype=np.float32).astype(float))
    np.testing.assert_array_equal(info["landing"], hop.landing[0])
    np.testing.assert_array_equal(info["touchdown"], hop.touchdown[0])
    assert info["energies"].shape == (4, len(ENERGY_NAMES))
    assert info["status"] is HopStatus(int(hop.status[0]))
    assert info["apex"] == hop.apex[0]
    assert info["error"] == pytest.approx(np.linalg.norm(hop.landing[0] - observation.astype(float)), rel=1e-12)
    assert reward == pytest.approx(-info["error"] / task.reach(Scene()), rel=1e-12)
    assert info["success"] == (info["error"] <= task.SUCCESS_RADIUS * task.reach(Scene()))
    assert (info["simulator_calls"], env.simulator_calls) == (1, 1)


def test_landing_on_the_target_is_the_best_reward_and_a_success() -> None:
    landing = simulate(MIDDLE.astype(float)).landing[0]
    env = TensegrityHopEnv()
    env.reset(options={"target": landing})
    _, reward, _, _, info = env.step(MIDDLE)
    assert info["error"] < 1e-6  # the target is observed as float32
    assert -1e-5 < reward <= 0
    assert info["success"] is True


def test_where_the_landing_is_read_is_an_option() -> None:
    hop = simulate(MIDDLE.astype(float))
    for landing, expected in (("rest", hop.rest), ("touchdown", hop.touchdown)):
        env = TensegrityHopEnv(landing=landing)
        _, info = env.reset(seed=0)
        assert info["reach"] == task.REACHES["earth"][landing].radius
        np.testing.assert_allclose(env.step(MIDDLE)[4]["landing"], expected[0], atol=1e-12)


def test_seeds_fix_targets_and_scenes_exactly() -> None:
    for scene in ("earth", {"gravity": (1.6, 9.8)}):
        one, other = TensegrityHopEnv(scene=scene), TensegrityHopEnv(scene=scene)
        first = [one.reset(seed=7 if k == 0 else None)[0] for k in range(5)]
        second = [other.reset(seed=7 if k == 0 else None)[0] for k in range(5)]
        np.testing.assert_array_equal(first, second)
        assert len({tuple(f) for f in first}) == 5
        assert not np.array_equal(one.reset(seed=8)[0], first[0])


def test_the_same_action_has_the_same_bits() -> None:
    env = TensegrityHopEnv(scene=SHORT)
    found = []
    for _ in range(2):
        env.reset(seed=3)
        found.append(env.step(MIDDLE))
    assert found[0][1] == found[1][1]
    np.testing.assert_array_equal(found[0][4]["energies"], found[1][4]["energies"])


def test_observations_are_fresh_arrays() -> None:
    env = TensegrityHopEnv(scene=SHORT)
    observation, _ = env.reset(seed=0)
    kept = observation.copy()
    observation[:] = 99
    np.testing.assert_array_equal(env.step(MIDDLE)[0], kept)


def test_a_randomised_scene_is_observed_and_simulated() -> None:
    env = TensegrityHopEnv(scene=RANGES)
    assert env.observation_space.shape == (5,)
    observation, _ = env.reset(seed=0)
    for value, name in zip(observation[2:], task.SCENE_VALUES, strict=True):
        low, high = RANGES[name]  # type: ignore[misc]
        assert low <= value <= high
    scene = env.scene
    assert scene is not None
    np.testing.assert_allclose([scene.gravity, scene.friction, scene.slope], observation[2:], rtol=1e-6)
    info = env.step(MIDDLE)[4]
    np.testing.assert_array_equal(info["landing"], simulate(MIDDLE.astype(float), scene=scene).landing[0])
    unseen = TensegrityHopEnv(scene={"preset": "moon", "gravity": (1.0, 2.0)})
    assert unseen.scenes.base.duration == Scene.preset("moon").duration


def test_a_failed_hop_gets_the_worst_reward(monkeypatch: pytest.MonkeyPatch) -> None:
    real = simulate(MIDDLE.astype(float), scene=SHORT)
    broken = replace(real, status=np.array([int(HopStatus.UNSTABLE)]))
    monkeypatch.setattr(env_module, "simulate", lambda *_, **__: broken)
    env = TensegrityHopEnv(scene=SHORT)
    env.reset(seed=0, options={"target": real.landing[0]})
    _, reward, terminated, _, info = env.step(MIDDLE)
    assert (reward, terminated, info["status"], info["success"]) == (task.WORST_REWARD, True, HopStatus.UNSTABLE, False)


def test_rewards_are_finite_and_never_below_the_worst() -> None:
    landing = np.array([(0, 0), (0.3, 0.4), (1e6, 0), (np.nan, 0), (0, 0)])
    status = np.array([0, 1, 0, 0, int(HopStatus.NOT_CONVERGED)])
    found = task.reward(landing, np.zeros((5, 2)), status, 0.5)
    np.testing.assert_allclose(found, [0, -1, task.WORST_REWARD, task.WORST_REWARD, task.WORST_REWARD], rtol=1e-15)


def test_targets_fill_the_reachable_disc_evenly() -> None:
    scene = Scene.preset("slope", slope_direction=0.5)
    targets = task.sample_targets(np.random.default_rng(0), 4000, scene) - task.reachable_middle(scene)
    radius = np.linalg.norm(targets, axis=1) / task.reach(scene)
    assert radius.max() <= 1
    # uniform in area: P(r < x) = x^2; the Kolmogorov-Smirnov statistic is below 1.95/sqrt(n) but once in a thousand
    distance = np.abs(np.sort(radius) ** 2 - (np.arange(4000) + 0.5) / 4000).max()
    assert distance < 1.95 / np.sqrt(4000)
    assert np.linalg.norm(targets.mean(axis=0)) < 4 * task.reach(scene) / 2 / np.sqrt(4000)


@pytest.mark.parametrize("scene", ["earth", "slope", {"gravity": (1.3, 9.8)}, {"slope": (0.0, 0.2)}], ids=str)
def test_targets_lie_within_the_observation_space(scene: Any) -> None:
    env = TensegrityHopEnv(scene=scene)
    assert all(env.observation_space.contains(env.reset(seed=seed)[0]) for seed in range(200))


def test_pictures_before_and_after_the_hop() -> None:
    env = TensegrityHopEnv(scene=SHORT, render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    env.step(MIDDLE)
    after = env.render()
    assert before is not None
    assert after is not None
    assert before.shape == after.shape
    assert before.dtype == after.dtype == np.uint8
    assert (before != after).any()


@pytest.mark.parametrize(
    "action",
    [
        [0.5, 0.5, 0.5, np.nan],
        [0.5, 0.5, 0.5, np.inf],
        [0.5, 0.5, 0.5, 0.81],
        [0.5, 0.5, 0.5, 0.199],
        [0.5, 0.5, 0.5],
        [[0.5] * 4],
        "jump",
        None,
    ],
)
def test_actions_that_are_no_stretches_are_refused(action: Any) -> None:
    env = TensegrityHopEnv(scene=SHORT)
    env.reset(seed=0)
    with pytest.raises(InvalidStretchesError, match=r"action: expected .*, got "):
        env.step(action)
    assert env.simulator_calls == 0
    env.step(MIDDLE)  # the episode still runs


def test_the_bounds_themselves_are_actions_in_either_precision() -> None:
    for dtype in (np.float32, np.float64):
        for bound in (0.2, 0.8):
            checked = check_action(np.full(4, bound, dtype=dtype), (4,))
            assert checked.dtype == np.float64
            np.testing.assert_allclose(checked, bound, rtol=2e-8)  # half a unit in the last place of float32
            simulate(checked, scene=Scene(duration=0.01))  # and the simulator takes them


def test_step_needs_a_running_episode() -> None:
    env = TensegrityHopEnv(scene=SHORT)
    with pytest.raises(ResetNeededError, match="call reset"):
        env.step(MIDDLE)
    env.reset(seed=0)
    env.step(MIDDLE)
    with pytest.raises(ResetNeededError, match="one hop ends an episode"):
        env.step(MIDDLE)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"goal": (0, 0)}, r"reset options: expected keys out of \['target'\], got \['goal'\]"),
        ({"target": (0.1,)}, "target: expected two finite numbers"),
        ({"target": (0.1, np.nan)}, "target: expected two finite numbers"),
        ({"target": "here"}, "target: expected two finite numbers"),
        ({"target": (100.0, 0.0)}, r"target: expected within .* reaches.*got"),
    ],
)
def test_options_that_mean_nothing_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(InvalidParameterError, match=said):
        TensegrityHopEnv().reset(options=options)


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        ({"scene": "pluto"}, UnknownPresetError, "expected one of"),
        ({"scene": 9.8}, InvalidParameterError, "scene: expected a preset's name"),
        ({"scene": {"air": 1.0}}, InvalidParameterError, "scene: expected keys out of"),
        ({"scene": {"duration": (1.0, 2.0)}}, InvalidParameterError, "scene ranges: expected keys out of"),
        ({"scene": {"gravity": (9.8, 1.6)}}, InvalidParameterError, "expected low < high"),
        ({"scene": {"gravity": (1.6, np.nan)}}, InvalidParameterError, "two finite numbers"),
        ({"scene": {"gravity": (1.6, 3.7, 9.8)}}, InvalidParameterError, "two finite numbers"),
        ({"scene": {"friction": (-1.0, 0.5)}}, InvalidParameterError, r"Scene\.friction: expected"),
        ({"landing": "orbit"}, InvalidParameterError, r"Scene\.landing: expected one of"),
        ({"success_radius": -1.0}, InvalidParameterError, "success_radius: expected"),
        ({"render_mode": "hologram"}, InvalidParameterError, "render_mode: expected"),
    ],
)
def test_arguments_that_mean_nothing_are_refused(arguments: dict[str, Any], error: type[Exception], said: str) -> None:
    with pytest.raises(error, match=said):
        TensegrityHopEnv(**arguments)
