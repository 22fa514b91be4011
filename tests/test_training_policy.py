"""Policies through the registered env: they spend exactly their hops, are copied faithfully, and go on after a kill."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from surrogate.storage import read_sealed, write_sealed
from tensegrity_gym import Scene, simulate
from tensegrity_gym.errors import DataFileError, InvalidParameterError, OutputFolderError
from tensegrity_gym.scene_ranges import scene_ranges
from tensegrity_gym.task import reach
from training import checkpoint
from training import train_policy as module
from training.algorithms import build, check_rollout, hyperparameters, is_cap_passed, rollout_of, updates_per_hop
from training.compare.config import CompareConfig
from training.compare.run import Comparison
from training.inverse import InverseConfig, InversePlanner
from training.planner import NearestHopPlanner, Planner
from training.policies import ActorPolicy, _mlp
from training.refine import RefiningPlanner
from training.sb3_vec_env import BatchedHopVecEnv, make_env
from training.similarity import Scaling
from training.tandem import TandemConfig, TandemPlanner
from training.train_policy import PolicyCommand, PolicyConfig, train_policy

QUICK = Scene(duration=0.05)
VARIED = scene_ranges({"gravity": (1.6, 9.81), "friction": (0.3, 0.8), "duration": 0.05})
SMALL = PolicyConfig(calls=24, updates=1, envs=3, checkpoint_every=6)


@pytest.mark.parametrize("algorithm", ["sac", "td3", "ppo"])
def test_spends_its_budget_exactly_and_keeps_snapshots(algorithm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, _ = train_policy(QUICK, PolicyConfig(algorithm, calls=8, updates=1, envs=4), progress=False)
    seen = {}
    build = module.build
    monkeypatch.setattr(module, "build", lambda *a: seen.setdefault("model", build(*a)))
    budgets = [8] if algorithm == "ppo" else [4]  # its one rollout of 8 hops is not yet over at 4
    actors, card = train_policy(QUICK, PolicyConfig(algorithm, calls=8, updates=1, envs=4), budgets=budgets, progress=False)
    assert card["simulator_calls"] == 8
    assert sorted(actors) == sorted({*budgets, 8})
    # the copy answers as stable-baselines3 does, rescaled from [-1, 1] to stretches
    targets = np.random.default_rng(0).uniform(-0.4, 0.4, (6, 2)).astype(np.float32)
    theirs, _ = seen["model"].predict(actors[8].scaling(targets), deterministic=True)
    np.testing.assert_allclose(actors[8].predict(targets)[0], 0.5 + 0.3 * theirs, atol=1e-6)
    np.testing.assert_array_equal(whole[8].predict(targets)[0], actors[8].predict(targets)[0])  # copies change no training
    if 4 in budgets:
        assert not np.allclose(actors[4].predict(targets)[0], actors[8].predict(targets)[0])


@pytest.mark.parametrize(
    ("algorithm", "scene"), [("sac", QUICK), ("td3", QUICK), ("ppo", QUICK), ("sac", VARIED)], ids=["sac", "td3", "ppo", "varied"]
)
def test_killed_training_goes_on_with_the_same_bits(
    algorithm: str, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = PolicyConfig(**{**vars(SMALL), "algorithm": algorithm, "calls": 96 if algorithm == "ppo" else 24})
    whole, _ = train_policy(scene, config, progress=False)
    state = tmp_path / "policy.training"
    step = module._Watch._on_step

    def killed(self) -> bool:
        if self.model.num_timesteps >= config.calls * 2 // 3:
            raise KeyboardInterrupt
        return step(self)

    with monkeypatch.context() as patch:
        patch.setattr(module._Watch, "_on_step", killed)
        with pytest.raises(KeyboardInterrupt):
            train_policy(scene, config, progress=False, state=state)
    assert state.exists()
    torch.manual_seed(99)
    with pytest.raises(DataFileError, match="settings"):
        train_policy(scene, PolicyConfig(**{**vars(config), "seed": 5}), progress=False, state=state)
    content = torch.load(io.BytesIO(read_sealed(state)), weights_only=True)
    assert 0 < content["past"]["simulating"] < content["past"]["seconds"]
    content["past"] |= {"seconds": 1000.0, "simulating": 500.0}
    save_content(state, content)
    resumed, card = train_policy(scene, config, progress=False, state=state)
    assert card["simulator_calls"] == config.calls
    assert 1000 < card["seconds"] < 1100  # what was spent before the kill counts
    assert 500 < card["simulating_seconds"] < 600
    for name, values in whole[config.calls].layers.state_dict().items():
        assert torch.equal(values, resumed[config.calls].layers.state_dict()[name])
    assert state.exists()  # for the caller to remove, when the actors are written


def test_a_policy_that_cannot_be_written_goes_on_from_its_last_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Scene, "preset", lambda *_, **__: QUICK)
    out, state = tmp_path / "policy.safetensors", tmp_path / "policy.training"
    command = PolicyCommand(**{**vars(SMALL), "out": out})
    whole, _ = train_policy(QUICK, SMALL, progress=False)
    with monkeypatch.context() as patch:
        patch.setattr(ActorPolicy, "save", full_disk)
        with pytest.raises(OutputFolderError):
            module.main(command)
    assert state.exists()
    taken, restore = [], checkpoint.restore
    monkeypatch.setattr(checkpoint, "restore", lambda path, model, *a: (restore(path, model, *a), taken.append(model))[0])
    module.main(command)
    assert len(taken) == 1
    assert not state.exists()
    for name, values in whole[SMALL.calls].layers.state_dict().items():
        assert torch.equal(values, ActorPolicy.load(out).layers.state_dict()[name])


def full_disk(*_: object) -> None:
    raise OutputFolderError("no room")


def test_policies_with_dots_in_their_names_have_cards_of_their_own(tmp_path: Path) -> None:
    for reach_of in (0.1, 0.2):
        ActorPolicy(_mlp([2, 8, 4]), Scaling((reach_of,))).save(tmp_path / f"policy{reach_of}", {})
    assert [ActorPolicy.load(tmp_path / f"policy{r}").scaling.scale for r in (0.1, 0.2)] == [(0.1,), (0.2,)]
    for name in ("policy.json", "policy.training"):
        with pytest.raises(InvalidParameterError, match="choose another name"):
            module.main(PolicyCommand(out=tmp_path / name))
        with pytest.raises(InvalidParameterError, match="choose another name"):
            PLANNERS["actor"]().save(tmp_path / name, {})  # type: ignore[attr-defined]


def test_a_comparison_keeps_a_training_until_its_policy_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    actor = ActorPolicy(_mlp([2, 8, 4]), Scaling((0.155,)))
    card = {"seconds": 1.0, "simulating_seconds": 0.5, "train": {"hyperparameters": {}}}

    def trained(*_: object, state: Path, **__: object) -> Any:
        state.write_bytes(b"state")
        return {16: actor}, card

    monkeypatch.setattr("training.compare.policies.train_policy", trained)
    comparison = Comparison(CompareConfig(out=tmp_path, quick=True, progress=False))
    monkeypatch.setattr(comparison, "score", lambda *_, **__: None)
    state = tmp_path / "policy_sac_0_16.training"
    with monkeypatch.context() as patch:
        patch.setattr(ActorPolicy, "save", full_disk)
        with pytest.raises(OutputFolderError):
            comparison.policy("sac", 0, 16)
    assert state.exists()
    comparison.policy("sac", 0, 16)
    assert not state.exists()


def test_a_damaged_or_foreign_training_state_is_named(tmp_path: Path) -> None:
    state = tmp_path / "policy.training"

    def refused(match: str) -> None:
        with pytest.raises(DataFileError, match=match):
            train_policy(QUICK, SMALL, progress=False, state=state)

    state.write_bytes(b"no checkpoint")
    refused("begins with")
    torch.save({"format": "tensegrity_gym.policy_training/1"}, state)  # as versions before wrote it
    refused("an older version wrote it")
    assert state.exists()
    write_sealed(state, b"no checkpoint")
    refused("whole checkpoint")
    save_content(state, {"format": "another", "code": print})  # a pickle that names code is not run
    refused("whole checkpoint")
    save_content(state, {"format": "another"})
    refused("format")


def save_content(path: Path, content: Any) -> None:
    """Write a checkpoint of any content, as the training writes its own."""
    file = io.BytesIO()
    torch.save(content, file)
    write_sealed(path, file.getvalue())


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The checkpoint of a training that was killed."""
    state = tmp_path_factory.mktemp("unfinished") / "policy.training"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module._Watch, "keep", lambda self: _stop(state))
        with pytest.raises(KeyboardInterrupt):
            train_policy(QUICK, SMALL, progress=False, state=state)
    return state.read_bytes()


def _stop(state: Path) -> None:
    if state.exists():
        raise KeyboardInterrupt


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.999])
def test_one_flipped_bit_of_a_training_state_is_noticed(share: float, tmp_path: Path, unfinished: bytes) -> None:
    state, content = tmp_path / "policy.training", bytearray(unfinished)
    content[int(share * len(content))] ^= 4
    state.write_bytes(content)
    with pytest.raises(DataFileError, match="damaged"):
        train_policy(QUICK, SMALL, progress=False, state=state)


def test_a_training_state_that_lacks_a_part_is_named(tmp_path: Path, unfinished: bytes) -> None:
    state = tmp_path / "policy.training"
    state.write_bytes(unfinished)
    content = torch.load(io.BytesIO(read_sealed(state)), weights_only=True)
    for wrong in ({"parameters": None}, {"buffer": {"pos": 0}}, {"past": {}}, {"numpy_rng": 3}):
        save_content(state, content | wrong)
        with pytest.raises(DataFileError, match="all that a SAC needs"):
            train_policy(QUICK, SMALL, progress=False, state=state)
    del content["variables"]
    save_content(state, content)
    with pytest.raises(DataFileError, match=r"KeyError.*variables"):
        train_policy(QUICK, SMALL, progress=False, state=state)


@pytest.mark.parametrize(("calls", "steps"), [(100, 4), (10_000, 4), (20_000, 2), (40_000, 1), (100_000, 1)])
def test_gradient_steps_are_capped_but_every_hop_has_one(calls: int, steps: int) -> None:
    values = hyperparameters("sac")
    assert updates_per_hop(values, calls) == steps
    venv = BatchedHopVecEnv(QUICK, 0.5, 20)
    assert build("sac", values, venv, calls, 0, None).gradient_steps == 20 * steps


def test_the_cap_is_passed_by_more_hops_than_it_has_steps_and_by_no_rounding() -> None:
    values = hyperparameters("sac")
    assert {calls for calls in range(1, 40_100) if is_cap_passed(values, calls)} == set(range(40_001, 40_100))
    assert not is_cap_passed(values | {"updates": 0.2}, 100_000)
    assert not is_cap_passed(hyperparameters("ppo"), 100_000)


def test_without_a_future_no_target_net_is_heard() -> None:
    """So that SAC need not keep one up to date: its hyper-parameters leave it as it was for most gradient steps."""

    def trained(interval: int) -> Any:
        values = hyperparameters("sac") | {"hidden": [8]}
        values["model"] = values["model"] | {"target_update_interval": interval}
        return build("sac", values, BatchedHopVecEnv(QUICK, 0.5, 4), 24, 0, None).learn(24)

    often, seldom = trained(1), trained(hyperparameters("sac")["model"]["target_update_interval"])
    targets = zip(often.critic_target.parameters(), seldom.critic_target.parameters(), strict=True)
    assert not all(torch.equal(a, b) for a, b in targets)
    assert all(torch.equal(a, b) for a, b in zip(often.actor.parameters(), seldom.actor.parameters(), strict=True))


def test_hyperparameters_are_committed_files_and_strangers_are_named(tmp_path: Path) -> None:
    assert hyperparameters("sac")["model"]["gamma"] == 0.0
    with pytest.raises(InvalidParameterError, match="algorithm"):
        hyperparameters("dqn")
    path = tmp_path / "mine.toml"
    path.write_text("hidden = [8]")
    with pytest.raises(InvalidParameterError, match="keys"):
        hyperparameters("td3", path)
    path.write_text("hidden = [")
    with pytest.raises(DataFileError, match="TOML"):
        hyperparameters("td3", path)


def test_evaluation_and_tensorboard_do_not_change_training(tmp_path: Path) -> None:
    config = PolicyConfig(calls=8, updates=1, envs=4)
    plain, _ = train_policy(QUICK, config, progress=False)
    watched, card = train_policy(
        QUICK, PolicyConfig(**{**vars(config), "evaluate_every": 4}), progress=False, tensorboard=tmp_path
    )
    assert card["simulator_calls"] == 8
    assert list(tmp_path.glob("*/events*"))
    # they are told without TensorBoard too
    assert [found["calls"] for found in card["evaluations"]] == [4, 8]
    assert all(-5 <= found["reward"] <= 0 for found in card["evaluations"])
    for name, values in plain[8].layers.state_dict().items():
        assert torch.equal(values, watched[8].layers.state_dict()[name])


def linear(stretches: torch.Tensor) -> torch.Tensor:
    """A map from stretches to landings, as an ensemble of one, (1, n, 2) [m]."""
    return (stretches[None, :, :2] - 0.5) / 3


PLANNERS: dict[str, Callable[[], Planner]] = {
    "nearest": lambda: NearestHopPlanner(np.full((2, 4), 0.5), np.eye(2)),
    "inverse": lambda: InversePlanner(linear, InverseConfig(pool=64)),
    "refining": lambda: RefiningPlanner(
        InversePlanner(linear, InverseConfig(pool=64)), lambda s: linear(torch.from_numpy(s))[0].numpy() + 0.01, 3
    ),
    "tandem": lambda: TandemPlanner(
        lambda s: (linear(s)[0], torch.zeros(len(s))), np.random.default_rng(0).normal(size=(20, 2)), TandemConfig(steps=5)
    ),
    "actor": lambda: ActorPolicy(_mlp([2, 8, 4]), Scaling((0.155,))),
}


@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize("envs", [1, 3])
def test_planners_are_scored_by_stable_baselines3_as_policies_are(name: str, envs: int) -> None:
    from tensegrity_gym.env import TensegrityHopEnv

    planner, asked = PLANNERS[name](), []
    predict = planner.predict

    def watched(observation: np.ndarray, **how: Any) -> Any:
        asked.append(observation.shape)
        answers = predict(observation, **how)
        assert answers[0].shape == (envs, 4)
        return answers

    planner.predict = watched  # type: ignore[method-assign, assignment]
    env = VecMonitor(DummyVecEnv([lambda: TensegrityHopEnv(scene=QUICK)] * envs))
    env.seed(3)
    rewards, lengths = evaluate_policy(planner, env, n_eval_episodes=3, return_episode_rewards=True)  # type: ignore[arg-type]
    assert lengths == [1, 1, 1]
    assert all(-5 <= reward <= 0 for reward in rewards)
    assert set(asked) == {(envs, 2)}
    alone = gym.make("TensegrityHop-v0", scene=QUICK)
    answer, state = PLANNERS[name]().predict(alone.reset(seed=3)[0])  # one observation, one answer, as gymnasium's loop has it
    assert alone.action_space.contains(answer.astype(np.float32))
    assert state is None


def test_batched_envs_give_what_the_registered_env_gives_one_after_the_other() -> None:
    plain = DummyVecEnv([lambda: make_env(QUICK, 0.5)] * 3)
    batched = BatchedHopVecEnv(QUICK, 0.5, 3)
    steps = []
    seeds = batched.seed(5)
    plain._seeds = list(seeds)
    for venv in (plain, batched):
        first = venv.reset()
        for action in (np.linspace(-1, 1, 12), np.linspace(0.5, -1, 12)):
            after, rewards, dones, infos = venv.step(action.reshape(3, 4).astype(np.float32))
            shown = [[info[k] for info in infos] for k in ("landing", "error", "status", "terminal_observation")]
            steps.append((first, after, rewards, dones, *shown))
        venv.close()
    for theirs, ours in zip(steps[:2], steps[2:], strict=True):
        for one, other in zip(theirs, ours, strict=True):
            assert np.array_equal(one, other)
    assert batched.simulator_calls == 6


def test_neighbouring_seeds_share_no_target_and_a_seed_repeats_its_own() -> None:
    venv = BatchedHopVecEnv(QUICK, 0.5, 8)

    def targets(seed: int) -> np.ndarray:
        venv.seed(seed)
        return np.asarray(venv.reset())

    first, second, again = targets(0), targets(1), targets(0)
    assert len(np.unique(np.concatenate([first, second]), axis=0)) == 16  # seed + k, as usual, would leave 9
    np.testing.assert_array_equal(first, again)
    venv.seed()  # one of its own choice
    assert not np.isin(np.asarray(venv.reset()), first).any()
    venv.close()


class Doubled(FlattenExtractor):
    """Observations that are changed on their way into the layers."""

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return 2 * super().forward(observations)


#: Always copied: stable-baselines3 writes into the mapping it is given.
RELU = {"net_arch": [8, 8], "activation_fn": torch.nn.ReLU}


def test_threads_of_the_simulator_are_those_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def spied(*stretches: Any, threads: int | None, **options: Any) -> Any:
        asked.append(threads)
        return simulate(*stretches, threads=threads, **options)

    monkeypatch.setattr("training.sb3_vec_env.simulate", spied)
    train_policy(QUICK, PolicyConfig(calls=8, updates=1, envs=4), progress=False, threads=1)
    assert asked == [1, 1]


@pytest.mark.parametrize(
    "values", [{"updates": 0}, {"envs": -3}, {"calls": 0}, {"checkpoint_every": 0}, {"evaluate_every": -1}, {"seed": -1}]
)
def test_numbers_that_mean_nothing_are_refused(values: dict[str, int]) -> None:
    (name,) = values
    with pytest.raises(InvalidParameterError, match=rf"^{name}: expected an integer .*, got {values[name]}"):
        PolicyConfig(**values)


@pytest.mark.parametrize(
    ("model", "options", "said"),
    [
        (PPO, {"policy_kwargs": {"net_arch": [8]}}, r"ReLU alone, got \['Tanh'\]"),  # its default
        (SAC, {"policy_kwargs": RELU | {"activation_fn": torch.nn.ELU}}, r"ReLU alone, got \['ELU'\]"),
        (TD3, {"policy_kwargs": RELU | {"activation_fn": torch.nn.Tanh}}, r"ReLU alone, got \['Tanh'\]"),
        (SAC, {"policy_kwargs": {**RELU}, "use_sde": True}, "use_sde=False, got use_sde=True"),
        (PPO, {"policy_kwargs": {**RELU}, "use_sde": True}, "use_sde=False, got use_sde=True"),
        (SAC, {"policy_kwargs": RELU | {"features_extractor_class": Doubled}}, "got a Doubled"),
        (PPO, {"policy_kwargs": RELU | {"features_extractor_class": Doubled}}, "got a Doubled"),
    ],
)
def test_models_that_are_another_function_than_the_copy_are_refused(model: Any, options: dict[str, Any], said: str) -> None:
    options = {"n_steps": 8, "batch_size": 8, **options} if model is PPO else options
    with pytest.raises(InvalidParameterError, match=said):
        ActorPolicy.from_model(model("MlpPolicy", make_env(QUICK, 0.5), device="cpu", **options), Scaling((0.5,)))


def test_only_models_that_rescale_their_actions_themselves_may_ask_for_stretches() -> None:
    raw = gym.make("TensegrityHop-v0", scene=QUICK)
    with pytest.raises(InvalidParameterError, match=r"each in \(-1.0, 1.0\), got 4 outputs for Box\(0.2, 0.8"):
        ActorPolicy.from_model(
            PPO("MlpPolicy", raw, n_steps=8, batch_size=8, policy_kwargs={**RELU}, device="cpu"), Scaling((1.0,))
        )
    model = SAC("MlpPolicy", raw, policy_kwargs={**RELU}, device="cpu")
    targets = np.random.default_rng(0).uniform(-0.4, 0.4, (6, 2)).astype(np.float32)
    copied = ActorPolicy.from_model(model, Scaling((1.0,))).predict(targets)[0]
    np.testing.assert_allclose(copied, model.predict(targets, deterministic=True)[0], atol=1e-6)
    model.action_space = gym.spaces.Box(0.2, 0.8, (3,))
    with pytest.raises(InvalidParameterError, match="got 4 outputs"):
        ActorPolicy.from_model(model, Scaling((1.0,)))


@pytest.mark.parametrize(
    ("calls", "rollout", "near"), [(1, 1, 2), (101, 1, 100), (254, 2, 253), (1004, 4, 1003), (1006, 2, 1005), (10006, 2, 10005)]
)
def test_calls_that_no_long_rollout_divides_are_refused_for_ppo(calls: int, rollout: int, near: int) -> None:
    said = f"got {calls}, which only those of {rollout} do; the nearest that is fine is {near}$"
    with pytest.raises(InvalidParameterError, match=said):
        train_policy(QUICK, PolicyConfig("ppo", calls=calls), progress=False)


def test_ppo_takes_calls_that_a_rollout_divides_and_few_calls_whole() -> None:
    asked = hyperparameters("ppo")["rollout"]
    rollouts = {8: 8, 24: 24, 32: 32, 96: 48, 100: 20, 128: 64, 256: 64, 1000: 40, 10_000: 80, 100_000: 80}
    for calls, rollout in rollouts.items():
        config = PolicyConfig("ppo", calls=calls)
        check_rollout(calls, asked, lambda number: PolicyConfig("ppo", calls=number).together)
        assert rollout_of(calls, config.together, asked) == rollout
    with pytest.raises(InvalidParameterError, match="raise rollout"):
        check_rollout(8, 1, lambda _: 1)


def test_budgets_beyond_the_calls_are_refused() -> None:
    with pytest.raises(InvalidParameterError, match="budgets"):
        train_policy(QUICK, PolicyConfig(calls=8), budgets=[9], progress=False)


@pytest.mark.parametrize(
    ("algorithm", "calls", "budget", "said"),
    [
        ("sac", 8, 3, "multiples of 4, .* with 4 envs, got 3; the nearest is 4$"),
        ("ppo", 8, 4, "multiples of 8, .* with 4 envs, got 4; the nearest is 8$"),
        ("ppo", 256, 100, "multiples of 64, .* got 100; the nearest is 128$"),
    ],
)
def test_budgets_within_a_rollout_are_refused(algorithm: str, calls: int, budget: int, said: str) -> None:
    """An actor of 100 hops must not be one that learnt from 128."""
    with pytest.raises(InvalidParameterError, match=said):
        train_policy(QUICK, PolicyConfig(algorithm, calls=calls, envs=4), budgets=[budget], progress=False)


def test_policies_see_the_scene_that_all_envs_of_a_step_share() -> None:
    scaling = Scaling.of(VARIED)
    batched = BatchedHopVecEnv(VARIED, scaling, 3)
    registered = gym.make_vec("TensegrityHop-v0", num_envs=3, scene=VARIED, shared_scene=True)
    seeds = [int(seed) for seed in batched.seed(5) if seed is not None]
    seen, (observed, _) = batched.reset(), registered.reset(seed=seeds)
    for action in (np.linspace(-1, 1, 12), np.linspace(0.5, -1, 12)):
        assert len(np.unique(observed[:, 2:], axis=0)) == 1
        np.testing.assert_array_equal(seen, scaling(observed))
        box = batched.observation_space
        assert isinstance(box, gym.spaces.Box)
        assert (seen >= box.low).all()
        assert (seen <= box.high).all()
        actions = action.reshape(3, 4).astype(np.float32)
        seen, rewards, _, infos = batched.step(actions)
        stretches = np.stack([env.action(a) for env, a in zip(batched.envs, actions, strict=True)])  # type: ignore[attr-defined]
        observed, theirs, _, _, told = registered.step(stretches)
        np.testing.assert_allclose(rewards, theirs, rtol=1e-6)
        ends = np.stack([info["landing"] for info in infos])
        np.testing.assert_array_equal(ends, np.stack(told["final_info"]["landing"]))
    batched.close()


def test_scaled_observations_are_of_order_one_and_mean_what_they_say() -> None:
    scaling = Scaling.of(VARIED)
    rng = np.random.default_rng(0)
    episodes = [VARIED.sample(rng) for _ in range(200)]
    at_reach = np.array([(reach(s), 0.0, s.gravity, s.friction) for s in episodes], dtype=np.float32)
    seen = scaling(at_reach)
    np.testing.assert_allclose(seen[:, 2], (at_reach[:, 2] - 5.705) / 4.105, atol=1e-6)
    np.testing.assert_allclose(seen[:, 3], (at_reach[:, 3] - 0.55) / 0.25, atol=1e-6)
    # reaches differ manifold between these scenes; made alike, by a quarter
    assert np.ptp(np.log(at_reach[:, 0])) > np.log(5)
    assert 0.75 < seen[:, 0].min() < seen[:, 0].max() < 1.25
    products = at_reach[:, 0] * at_reach[:, 2]
    np.testing.assert_allclose(seen[:, 0] / seen[0, 0], products / products[0], rtol=1e-5)
    assert Scaling.of(scene_ranges("earth")) == Scaling((reach(Scene()),))
