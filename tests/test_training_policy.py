"""SAC through the registered env: it spends exactly its hops, and its actor is copied faithfully."""

from __future__ import annotations

import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from tensegrity_gym import Scene
from tensegrity_gym.errors import InvalidParameterError
from training import train_policy as module
from training.sb3_vec_env import BatchedHopVecEnv, make_env
from training.train_policy import PolicyConfig, train_policy

QUICK = Scene(duration=0.05)


def test_spends_its_budget_exactly_and_keeps_snapshots(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = {}
    monkeypatch.setattr(module, "SAC", lambda *a, **k: seen.setdefault("model", _sac(*a, **k)))
    actors, card = train_policy(QUICK, PolicyConfig(calls=8, gradient_steps=1, warmup=0.25, envs=3), budgets=[4], progress=False)
    assert card["simulator_calls"] == 8
    assert sorted(actors) == [4, 8]
    # the copy answers as stable-baselines3 does, rescaled from [-1, 1] to stretches
    targets = np.random.default_rng(0).uniform(-0.4, 0.4, (6, 2)).astype(np.float32)
    theirs, _ = seen["model"].predict(targets / actors[8].scale, deterministic=True)
    np.testing.assert_allclose(actors[8].predict(targets)[0], 0.5 + 0.3 * theirs, atol=1e-6)
    assert not np.allclose(actors[4].predict(targets)[0], actors[8].predict(targets)[0])


def _sac(*args, **options):
    from stable_baselines3 import SAC

    return SAC(*args, **options)


def test_batched_envs_give_what_the_registered_env_gives_one_after_the_other() -> None:
    plain = DummyVecEnv([lambda: make_env(QUICK, 0.5)] * 3)
    batched = BatchedHopVecEnv(QUICK, 0.5, 3)
    steps = []
    for venv in (plain, batched):
        venv.seed(5)
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


def test_budgets_beyond_the_calls_are_refused() -> None:
    with pytest.raises(InvalidParameterError, match="budgets"):
        train_policy(QUICK, PolicyConfig(calls=8), budgets=[9], progress=False)
