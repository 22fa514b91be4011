"""SAC through the registered env: it spends exactly its hops, and its actor is copied faithfully."""

from __future__ import annotations

import numpy as np
import pytest

from tensegrity_gym import Scene
from tensegrity_gym.errors import InvalidParameterError
from training import train_policy as module
from training.train_policy import PolicyConfig, ThreadedVecEnv, make_env, train_policy

QUICK = Scene(duration=0.05)


def test_spends_its_budget_exactly_and_keeps_snapshots(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = {}
    monkeypatch.setattr(module, "SAC", lambda *a, **k: seen.setdefault("model", _sac(*a, **k)))
    actors, card = train_policy(QUICK, PolicyConfig(calls=8, gradient_steps=1, warmup=0.25), budgets=[4], progress=False)
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


def test_threads_give_what_one_after_the_other_gives() -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv

    steps = []
    for kind in (DummyVecEnv, ThreadedVecEnv):
        venv = kind([lambda: make_env(QUICK, 0.5)] * 2)
        venv.seed(5)
        first = venv.reset()
        after, rewards, dones, infos = venv.step(np.array([(-0.5, 0.0, 0.5, 1.0), (0.1, -1.0, 0.2, 0.3)], dtype=np.float32))
        steps.append((first, after, rewards, dones, [i["landing"] for i in infos], [i["terminal_observation"] for i in infos]))
        venv.close()
    for plain, threaded in zip(*steps, strict=True):
        assert np.array_equal(plain, threaded)


def test_budgets_beyond_the_calls_are_refused() -> None:
    with pytest.raises(InvalidParameterError, match="budgets"):
        train_policy(QUICK, PolicyConfig(calls=8), budgets=[9], progress=False)
