"""Train a policy with stable-baselines3 through ``gym.make("TensegrityHop-v0")``."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from tqdm import tqdm

import tensegrity_gym  # noqa: F401  registers the env
from surrogate.model import one_thread
from tensegrity_gym import Scene
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.task import reach
from training.policies import ActorPolicy
from training.sb3_vec_env import BatchedHopVecEnv


@dataclass(frozen=True)
class PolicyConfig:
    """SAC on one-step episodes: nothing follows a hop, so gamma is 0 and the critic learns the reward itself.

    Automatic entropy would drown a reward of this size in exploration; a small constant does not.
    """

    calls: int = 256
    """Hops that training may simulate."""
    seed: int = 0
    """Seed of weights, exploration and targets."""
    learning_rate: float = 1e-3
    """Adam's learning rate of actor and critics."""
    ent_coef: float = 0.001
    """Weight of the entropy in the objective."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of actor and critics."""
    batch_size: int = 64
    """Hops per gradient step."""
    gradient_steps: int = 8
    """Gradient steps per hop."""
    warmup: float = 0.125
    """Share of the hops with random stretches before learning starts."""
    envs: int = 16
    """Envs whose hops are simulated together; halved until it divides ``calls``, so that no hop is over budget."""


@dataclass(frozen=True)
class PolicyCommand(PolicyConfig):
    """Train a SAC policy on the env and keep its actor."""

    out: Path = Path("runs/policy.safetensors")
    """Checkpoint to write; its card goes beside it as .json."""
    scene: str = "earth"
    """Scene preset."""
    landing: str = "rest"
    """Where a landing is read: rest or touchdown."""


class _Watch(BaseCallback):
    """Moves the progress bar and copies the actor whenever a budget of simulator calls is spent."""

    def __init__(self, budgets: Sequence[int], scale: float, bar: tqdm) -> None:
        super().__init__()
        self.budgets, self.scale, self.bar = sorted(budgets), scale, bar
        self.snapshots: dict[int, ActorPolicy] = {}

    def _on_step(self) -> bool:
        self.bar.update(self.num_timesteps - self.bar.n)
        error = np.mean([info["error"] for info in self.locals["infos"]])
        self.bar.set_postfix(error=f"{error:.3f} m", refresh=False)
        return True

    def _on_rollout_start(self) -> None:
        self.keep()  # training on the last hops is over when the next are collected

    def keep(self) -> None:
        """Copy the actor if a budget is spent that has no copy yet."""
        for budget in self.budgets:
            if self.num_timesteps >= budget and budget not in self.snapshots:
                self.snapshots[budget] = ActorPolicy.from_sac(self.model, self.scale)


@one_thread()
def train_policy(
    scene: Scene, config: PolicyConfig, *, budgets: Sequence[int] = (), progress: bool = True
) -> tuple[dict[int, ActorPolicy], dict[str, Any]]:
    """Train SAC for ``config.calls`` hops; returns actors as they were after each of ``budgets`` hops, and a card.

    The last actor, after all the hops, is always among them.
    """
    if config.calls < 1 or any(not 0 < b <= config.calls for b in budgets):
        raise InvalidParameterError(
            f"calls and budgets: expected 1 <= budgets <= calls, got calls {config.calls}, budgets {list(budgets)}"
        )
    started = time.perf_counter()
    scale = reach(scene)
    envs = config.envs
    while config.calls % envs:
        envs = (envs + 1) // 2
    with contextlib.closing(BatchedHopVecEnv(scene, scale, envs)) as venv:
        model = SAC(
            "MlpPolicy",
            venv,
            gamma=0.0,
            learning_rate=config.learning_rate,
            ent_coef=config.ent_coef,
            batch_size=config.batch_size,
            gradient_steps=config.gradient_steps * envs,
            learning_starts=max(int(config.warmup * config.calls), envs),
            buffer_size=max(config.calls, envs),
            policy_kwargs={"net_arch": list(config.hidden), "activation_fn": torch.nn.ReLU},
            seed=config.seed,
            device="cpu",
        )
        with tqdm(total=config.calls, unit="hop", desc="policy (SAC)", disable=not progress, mininterval=0.5) as bar:
            watch = _Watch([*budgets, config.calls], scale, bar)
            model.learn(config.calls, callback=watch)
            watch.keep()
        calls = venv.simulator_calls
    card = {"algorithm": "SAC", "train": asdict(config), "scene": asdict(scene), "simulator_calls": calls}
    return watch.snapshots, card | {"seconds": time.perf_counter() - started}


def main(config: PolicyCommand) -> None:
    """Entry of ``python -m training policy``."""
    actors, card = train_policy(Scene.preset(config.scene, landing=config.landing), config)
    card["train"] = {k: str(v) if isinstance(v, Path) else v for k, v in card["train"].items()}
    actors[config.calls].save(config.out, card)
    print(f"{config.out}: SAC, {card['simulator_calls']} simulator calls in {card['seconds']:.1f} s")
