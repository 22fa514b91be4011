"""stable-baselines3's algorithms, set up for one-step episodes from the committed files of hyper-parameters."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv

from tensegrity_gym.errors import DataFileError, InvalidParameterError

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"sac": SAC, "td3": TD3, "ppo": PPO}
#: Hops of a rollout that stable-baselines3's PPO takes, at least: it normalises advantages.
LEAST_ROLLOUT = 2
#: Gradient steps per hop that no cap on all of them goes below: with a fifth of one, ten times the hops bring SAC nothing.
LEAST_UPDATES = 1
FOLDER = Path(__file__).parent / "hyperparameters"


def hyperparameters(algorithm: str, path: Path | None = None) -> dict[str, Any]:
    """The committed hyper-parameters of an algorithm, or those in the TOML file ``path``."""
    if algorithm not in ALGORITHMS:
        raise InvalidParameterError(f"algorithm: expected one of {sorted(ALGORITHMS)}, got {algorithm!r}")
    source = path or FOLDER / f"{algorithm}.toml"
    committed = tomllib.loads((FOLDER / f"{algorithm}.toml").read_text(encoding="utf-8"))
    try:
        found = tomllib.loads(source.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise DataFileError(f"expected a TOML file of hyper-parameters at {source}: {error}") from error
    if set(found) != set(committed):
        raise InvalidParameterError(f"{source}: expected the keys {sorted(committed)} of {algorithm}, got {sorted(found)}")
    return found


def env_count(calls: int, envs: int) -> int:
    """The greatest number of envs, out of ``envs`` halved again and again, that divides ``calls``: no hop is over budget."""
    while calls % envs:
        envs = (envs + 1) // 2
    return envs


def build(algorithm: str, values: Mapping[str, Any], venv: VecEnv, calls: int, seed: int, tensorboard: Path | None) -> Any:
    """The algorithm on ``venv`` for ``calls`` hops, which its envs must divide."""
    envs = venv.num_envs
    options = dict(values["model"]) | {"seed": seed, "device": "cpu", "tensorboard_log": tensorboard and str(tensorboard)}
    policy: dict[str, Any] = {"net_arch": list(values["hidden"]), "activation_fn": torch.nn.ReLU}
    policy["optimizer_kwargs"] = {"fused": True}  # a gradient step of such small nets is mostly waiting for Python
    if algorithm == "ppo":
        rollout, parts = rollout_of(calls, envs, values["rollout"]), values["minibatches"]
        policy["log_std_init"] = values["log_std_init"]
        options |= {"n_steps": rollout // envs, "batch_size": max(2, rollout // parts if rollout % parts == 0 else rollout)}
    else:
        options |= {
            "gradient_steps": max(1, round(updates_per_hop(values, calls) * envs)),
            "learning_starts": max(min(int(values["warmup"] * calls), values["most_warmup"]), envs),
            "buffer_size": calls,
        }
    if "action_noise" in values:
        size = venv.action_space.shape or ()
        options["action_noise"] = NormalActionNoise(np.zeros(size), np.full(size, values["action_noise"]))
    return ALGORITHMS[algorithm]("MlpPolicy", venv, policy_kwargs=policy, **options)


def updates_per_hop(values: Mapping[str, Any], calls: int) -> float:
    """Gradient steps per hop of sac and td3: as many as asked, at most ``max_updates`` in all, but one for each hop at least."""
    return min(values["updates"], max(LEAST_UPDATES, values["max_updates"] / calls))


def is_cap_passed(values: Mapping[str, Any], calls: int) -> bool:
    """Whether one gradient step for each hop makes more of them than ``max_updates``; never so for ppo, which has no such cap."""
    return "updates" in values and min(values["updates"], LEAST_UPDATES) * calls > values["max_updates"]


def rollout_of(calls: int, envs: int, asked: int) -> int:
    """Hops of PPO's rollouts: whole steps of all envs, at most ``asked`` hops where a step has no more, that divide ``calls``."""
    return envs * _divisor(calls // envs, max(1, asked // envs))


def check_rollout(calls: int, asked: int, envs_for: Callable[[int], int]) -> None:
    """InvalidParameterError where rollouts of ``calls`` hops would be far shorter than ``asked``: PPO would learn from noise.

    ``envs_for``: how many envs any number of calls gets.
    """

    def found(number: int) -> int:
        return rollout_of(number, envs_for(number), asked)

    def fine(number: int) -> bool:
        return found(number) >= max(LEAST_ROLLOUT, min(asked, number) / 8)

    if fine(calls):
        return
    others = (number for away in range(1, calls + 2) for number in (calls - away, calls + away) if number > 0)
    near = next((number for number in others if fine(number)), None)
    raise InvalidParameterError(
        f"calls: expected a number that rollouts of about {asked} hops divide, got {calls}, which only those of {found(calls)} "
        f"do; {'raise rollout in the hyper-parameters' if near is None else f'the nearest that is fine is {near}'}"
    )


def _divisor(number: int, most: int) -> int:
    """The greatest divisor of ``number`` that is at most ``most``."""
    return next(k for k in range(min(most, number), 0, -1) if number % k == 0)
