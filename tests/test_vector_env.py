"""All hops of a step in one batch: the same bits as single envs and as training's VecEnv, and what vector envs promise.

The ideas are gymnasium's (tests/vector) and stable-baselines3's (tests/test_vec_envs.py) own.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import tensegrity_gym  # noqa: F401 (registers the env)
from tensegrity_gym import HopStatus, Scene, task
from tensegrity_gym.errors import InvalidParameterError, InvalidStretchesError, ResetNeededError
from tensegrity_gym.vector_env import TensegrityHopVectorEnv

SHORT = Scene(duration=0.15)
RANGES = {"gravity": (6.0, 9.8), "friction": (0.4, 0.6), "duration": 0.15}


def actions_of(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.25, 0.75, (n, 4)).astype(np.float32)


def assert_same(one: Any, other: Any) -> None:
    """Same structure, dtypes and bits."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, np.ndarray) and one.dtype == object:
        assert one.shape == other.shape
        for a, b in zip(one.ravel(), other.ravel(), strict=True):
            assert_same(a, b)
    else:
        assert np.asarray(one).dtype == np.asarray(other).dtype
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("scene", [SHORT, RANGES], ids=["one scene", "ranges"])
def test_it_gives_what_single_envs_give_bit_by_bit(scene: Any) -> None:
    """Spaces, seeded draws, observations, rewards, infos and autoreset, against gymnasium's SyncVectorEnv."""
    options = {"scene": scene, "success_bonus": 1.0, "energy_cost": 0.01}
    makers = [lambda: gym.make("TensegrityHop-v0", disable_env_checker=True, **options)] * 3
    single = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)
    vector = gym.make_vec("TensegrityHop-v0", num_envs=3, **options)
    assert isinstance(vector.unwrapped, TensegrityHopVectorEnv)
    assert vector.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    for name in ("observation_space", "action_space", "single_observation_space", "single_action_space", "num_envs"):
        assert getattr(single, name) == getattr(vector, name)
    seen, found = single.reset(seed=3), vector.reset(seed=3)
    assert_same(dict(enumerate(seen)), dict(enumerate(found)))
    for k in range(2):
        seen_step, found_step = single.step(actions_of(3, k)), vector.step(actions_of(3, k))
        assert_same(dict(enumerate(seen_step)), dict(enumerate(found_step)))
        assert vector.observation_space.contains(found_step[0])
        infos = found_step[4]
        assert infos["_final_obs"].all()
        assert infos["_final_info"].all()
        assert set(infos["final_info"]) >= {"landing", "touchdown", "error", "success", "apex", "energies", "status"}
        assert infos["final_info"]["simulator_calls"].tolist() == [1, 1, 1]
        assert (found_step[0] != np.stack(infos["final_obs"])).any()  # the next episodes' targets
    seen, found = single.reset(seed=[7, 8, 9]), vector.reset(seed=[7, 8, 9])
    assert_same(dict(enumerate(seen)), dict(enumerate(found)))


def test_single_vector_and_training_env_score_injected_targets_alike() -> None:
    """On a whole hop, bit for bit."""
    sb3_vec_env = pytest.importorskip("training.sb3_vec_env")
    scene, n = Scene(duration=1.4, landing="touchdown"), 3
    targets = task.sample_targets(np.random.default_rng(0), n, scene).astype(np.float32).astype(float)
    scaled = np.random.default_rng(1).uniform(-1, 1, (n, 4)).astype(np.float32)
    sb3 = sb3_vec_env.BatchedHopVecEnv(scene, 1.0, n)
    sb3.set_options([{"target": target} for target in targets])
    sb3.reset()
    actions = np.stack([env.action(a) for env, a in zip(sb3.envs, scaled, strict=True)])
    _, sb3_rewards, sb3_dones, sb3_infos = sb3.step(scaled)
    vector = gym.make_vec("TensegrityHop-v0", num_envs=n, scene=scene)
    vector.reset(options={"target": targets})
    _, rewards, dones, _, infos = vector.step(actions)
    np.testing.assert_array_equal(rewards.astype(np.float32), sb3_rewards)
    np.testing.assert_array_equal(dones, sb3_dones)
    env = gym.make("TensegrityHop-v0", scene=scene)
    for k in range(n):
        env.reset(options={"target": targets[k]})
        _, reward, *_, info = env.step(actions[k])
        assert reward == rewards[k]
        for key in ("landing", "error", "status"):
            np.testing.assert_array_equal(info[key], infos["final_info"][key][k])
            np.testing.assert_array_equal(info[key], sb3_infos[k][key])
        assert info["status"] in (HopStatus.TIME_LIMIT, HopStatus.RESTED)


def test_observations_are_fresh_arrays() -> None:
    env = TensegrityHopVectorEnv(2, scene=SHORT)
    first, _ = env.reset(seed=0)
    kept = first.copy()
    first[:] = 99
    infos = env.step(actions_of(2))[4]
    np.testing.assert_array_equal(np.stack(infos["final_obs"]), kept)


def test_seeds_fix_everything_and_unseeded_resets_go_on() -> None:
    env = TensegrityHopVectorEnv(3, scene=RANGES)
    first = env.reset(seed=5)[0]
    second = env.reset()[0]
    np.testing.assert_array_equal(first, env.reset(seed=5)[0])
    np.testing.assert_array_equal(second, env.reset()[0])
    assert len(np.unique(np.concatenate([first, second]), axis=0)) == 6
    alone = env.reset(seed=[None, 6, None])[0]
    np.testing.assert_array_equal(alone[1], first[1])  # env 1 of seed 5 has seed 6
    assert (alone[[0, 2]] != first[[0, 2]]).any()


def test_numpys_integers_are_seeds_too() -> None:
    env = TensegrityHopVectorEnv(3)
    for seed, same in ((np.int64(3), 3), (np.arange(3), [0, 1, 2])):
        np.testing.assert_array_equal(env.reset(seed=seed)[0], env.reset(seed=same)[0])  # type: ignore[arg-type]


def test_options_go_to_all_envs_or_to_each() -> None:
    env = TensegrityHopVectorEnv(2, scene=SHORT, target="boundary")
    both = env.reset(options={"target": (0.1, 0.2)})[0]
    np.testing.assert_array_equal(both, np.float32([[0.1, 0.2]] * 2))
    each = env.reset(options={"target": [(0.1, 0.2), (0.3, 0.4)]})[0]
    np.testing.assert_array_equal(each, np.float32([[0.1, 0.2], [0.3, 0.4]]))
    assert not env.reset(options={"target": "beyond"})[1]["reachable"].any()
    env.reset(options={"scene": Scene(gravity=15.0, duration=0.15)})
    assert {episode.scene.gravity for episode in env._episodes} == {15.0}


def test_a_shared_scene_makes_one_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    batches: list[int] = []
    real = task.simulate

    def counted(stretches: np.ndarray, **arguments: Any) -> Any:
        batches.append(len(stretches))
        return real(stretches, **arguments)

    monkeypatch.setattr(task, "simulate", counted)
    shared = TensegrityHopVectorEnv(4, scene=RANGES, shared_scene=True)
    observation = shared.reset(seed=0)[0]
    assert len(np.unique(observation[:, 2:], axis=0)) == 1
    assert len(np.unique(observation[:, :2], axis=0)) == 4
    following = shared.step(actions_of(4))[0]
    assert batches == [4]
    assert (following[0, 2:] != observation[0, 2:]).all()
    batches.clear()
    fixed = TensegrityHopVectorEnv(4, scene=SHORT)
    fixed.reset(seed=0)
    fixed.step(actions_of(4))
    assert batches == [4]


def test_a_failed_hop_leaves_its_neighbours_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    env = TensegrityHopVectorEnv(3, scene=SHORT)
    env.reset(seed=0)
    healthy = env.step(actions_of(3))[1]
    real = task.simulate

    def broken(*arguments: Any, **named: Any) -> Any:
        result = real(*arguments, **named)
        result.status[1], result.landing[1] = int(HopStatus.UNSTABLE), np.nan
        return result

    monkeypatch.setattr(task, "simulate", broken)
    env.reset(seed=0)
    observations, rewards, _, _, infos = env.step(actions_of(3))
    assert rewards.tolist() == [healthy[0], task.WORST_REWARD, healthy[2]]
    assert np.isfinite(observations).all()
    assert infos["final_info"]["status"][1] == HopStatus.UNSTABLE
    assert not infos["final_info"]["success"][1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"num_envs": 0}, "num_envs: expected an integer >= 1"),
        ({"num_envs": 2.0}, "num_envs: expected an integer >= 1"),
        ({"render_mode": "rgb_array"}, "for pictures use gym.make"),
        ({"target": "nowhere"}, "target: expected one of"),
    ],
)
def test_arguments_that_mean_nothing_are_refused(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(InvalidParameterError, match=said):
        TensegrityHopVectorEnv(**{"num_envs": 2, **arguments})


def test_steps_seeds_and_actions_that_mean_nothing_are_refused() -> None:
    env = TensegrityHopVectorEnv(2, scene=SHORT)
    with pytest.raises(ResetNeededError, match=r"call reset\(\) first"):
        env.step(actions_of(2))
    with pytest.raises(InvalidParameterError, match="seed: expected one, or 2"):
        env.reset(seed=[1, 2, 3])
    with pytest.raises(InvalidParameterError, match="reset options: expected keys"):
        env.reset(options={"goal": 1})
    env.reset(seed=0)
    bad = actions_of(2)
    bad[1, 2] = np.nan
    for action in (bad, actions_of(3), actions_of(2)[0], bad + 1):
        with pytest.raises(InvalidStretchesError, match="action: expected"):
            env.step(action)
    assert env.simulator_calls == 0
    env.step(actions_of(2))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "hops", "envs"), [("PPO", 512, 32), ("SAC", 320, 16)])
def test_sb3_learns_a_fixed_target_better_than_random(name: str, hops: int, envs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    sb3_vec_env = pytest.importorskip("training.sb3_vec_env")
    scene, target = Scene(duration=1.2, landing="touchdown"), (0.12, 0.06)

    def make_env(scene: Scene, scale: float, leader: gym.Env | None = None) -> gym.Env:
        env = gym.make("TensegrityHop-v0", scene=scene, target=target)
        return sb3_vec_env.ScaledAction(sb3_vec_env.ScaledObservation(env, scale))

    monkeypatch.setattr(sb3_vec_env, "make_env", make_env)
    env = sb3_vec_env.BatchedHopVecEnv(scene, task.reach(scene), envs)
    if name == "PPO":
        settings = {"n_steps": 1, "batch_size": envs, "n_epochs": 10, "policy_kwargs": {"log_std_init": -0.7, "net_arch": [32]}}
    else:
        settings = {"learning_starts": 64, "gradient_steps": 24, "batch_size": 64, "ent_coef": 0.01}
        settings["policy_kwargs"] = {"net_arch": [32, 32]}
    model = getattr(sb3, name)("MlpPolicy", env, learning_rate=3e-3, gamma=0.0, seed=0, device="cpu", **settings)
    env.reset()
    random = env.step(np.random.default_rng(0).uniform(-1, 1, (envs, 4)).astype(np.float32))[1]
    model.learn(hops)
    action, _ = model.predict(env.reset(), deterministic=True)
    learnt = env.step(action)[1]
    # random rewards scatter by about 0.3; the policy must beat their mean by four standard errors, and most of them
    assert learnt.mean() > random.mean() + 4 * random.std() / np.sqrt(envs)
    assert learnt.mean() > np.quantile(random, 0.75)
    assert env.simulator_calls == hops + 2 * envs


def test_seeds_are_told_as_they_were_given() -> None:
    envs = TensegrityHopVectorEnv(3, scene=Scene(duration=0.05))
    envs.reset(seed=5)
    assert envs.np_random_seed == (5, 6, 7)
    envs.reset(seed=[9, None, np.int64(4)])
    assert envs.np_random_seed == (9, 6, 4)
    with pytest.raises(InvalidParameterError, match=r"seed: expected an integer, a list of 3 or None, got 1\.5"):
        envs.reset(seed=1.5)  # type: ignore[arg-type]
    fresh = TensegrityHopVectorEnv(2, scene=Scene(duration=0.05))
    drawn = fresh.np_random_seed
    first, _ = fresh.reset()
    again, _ = TensegrityHopVectorEnv(2, scene=Scene(duration=0.05)).reset(seed=list(drawn))
    np.testing.assert_array_equal(first, again)
