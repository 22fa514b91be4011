"""Train a policy with stable-baselines3 on the registered env."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from tqdm import tqdm

import tensegrity_gym  # noqa: F401  registers the env
from surrogate.model import one_thread
from surrogate.storage import POLICY_STATE, beside, hash_of
from tensegrity_gym import Scene
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.scene_ranges import SceneRanges
from tensegrity_gym.task import check_fidelity
from training import checkpoint
from training.algorithms import build, check_rollout, env_count, hyperparameters, rollout_of, updates_per_hop
from training.policies import ActorPolicy
from training.sb3_vec_env import ENV_SEEDS, BatchedHopVecEnv
from training.similarity import Scaling
from training.symmetry import Symmetry

#: Added to the seed of the envs that a policy is evaluated in while it trains.
EVALUATION_SEED = 2_000_003
#: Largest seed of a policy: numpy's takes 32 bits, and evaluation adds EVALUATION_SEED to it.
MOST_SEED = 2**31


@dataclass(frozen=True)
class PolicyConfig:
    """A policy on one-step episodes."""

    algorithm: str = "sac"
    """sac, td3 or ppo; its hyper-parameters are in training/hyperparameters."""
    calls: int = 256
    """Hops that training may simulate."""
    seed: int = 0
    """Seed of weights, exploration and targets."""
    updates: int | None = None
    """Gradient steps per hop of sac and td3; None: as the hyper-parameters say."""
    hyperparameters: Path | None = None
    """TOML file in place of the committed one."""
    envs: int | None = None
    """Envs whose hops are simulated together, halved until they divide ``calls``, so that no hop is over budget; None: 16, or
    80 from 4000 hops on, whose batches keep the simulator's lanes busier."""
    symmetric: bool = False
    """Turn every target into one part of the plane by the symmetries of lattice and ground, and the answer back, so that the
    policy learns a quadrant in place of the plane."""
    fidelity: str = "paper"
    """Model of the hop, one that the envs know by name: paper, single, flown, ..."""
    checkpoint_every: int = 512
    """Hops between two checkpoints, where there is a file to keep them in."""
    evaluate_every: int = 0
    """Hops between two evaluations on 32 episodes of their own, which count as no training hops; 0: none. Rounded down to whole
    steps of all envs, one at least. Their mean rewards (minus the error over the reach) go to the progress bar, TensorBoard and
    the card (there since training was last resumed)."""

    def __post_init__(self) -> None:
        if not 0 <= self.seed <= MOST_SEED:
            raise InvalidParameterError(f"seed: expected an integer from 0 to 2^31, got {self.seed}; any such will do")
        least = {"calls": 1, "updates": 1, "envs": 1, "checkpoint_every": 1, "evaluate_every": 0}
        for name, bound in least.items():
            value = getattr(self, name)
            if value is not None and value < bound:
                raise InvalidParameterError(f"{name}: expected an integer >= {bound}, got {value}")

    @property
    def together(self) -> int:
        """Envs whose hops are simulated together."""
        return env_count(self.calls, self.envs or (80 if self.calls >= 4000 else 16))


@dataclass(frozen=True)
class PolicyCommand(PolicyConfig):
    """Train a policy on the env and keep its actor; run again after a kill, it goes on where it was."""

    out: Path = Path("runs/policy.safetensors")
    """Checkpoint to write; its card goes beside it as .json, and the state of an unfinished training as .training."""
    scene: str = "earth"
    """Scene preset."""
    landing: str = "rest"
    """Where a landing is read: rest or touchdown."""
    tensorboard: Path | None = None
    """Folder for TensorBoard."""


class _Evaluated(BaseCallback):
    """Hands on what an evaluation found."""

    def __init__(self, found: list[dict[str, float]]) -> None:
        super().__init__()
        self.found = found

    def _on_step(self) -> bool:
        assert isinstance(self.parent, EvalCallback)
        self.found.append({"calls": self.num_timesteps, "reward": float(self.parent.last_mean_reward)})
        return True


class _Clock:
    """Seconds that a training has taken, over all its runs."""

    def __init__(self, hops: BatchedHopVecEnv) -> None:
        self.hops, self.started = hops, time.perf_counter()
        #: What earlier runs took, and of that what the simulator did [s].
        self.before = (0.0, 0.0)

    def seconds(self) -> tuple[float, float]:
        """Wall time so far, and that in the simulator [s]."""
        return self.before[0] + time.perf_counter() - self.started, self.before[1] + self.hops.seconds


class _Watch(BaseCallback):
    """Moves the progress bar and copies the actor whenever a budget of simulator calls is spent.

    ``copy`` makes an actor of the model that is in training.
    """

    def __init__(self, budgets: Sequence[int], copy: Callable[[Any], ActorPolicy], bar: tqdm) -> None:
        super().__init__()
        self.budgets, self.copy, self.bar = sorted(budgets), copy, bar
        self.snapshots: dict[int, ActorPolicy] = {}
        #: Hops so far and mean reward of each evaluation.
        self.evaluations: list[dict[str, float]] = []

    def _on_step(self) -> bool:
        self.bar.update(self.num_timesteps - self.bar.n)
        errors = [info["error"] for info in self.locals["infos"]]
        self.logger.record_mean("rollout/landing_error", float(np.mean(errors)))
        evaluated = {"evaluated": f"{self.evaluations[-1]['reward']:.3f}"} if self.evaluations else {}
        self.bar.set_postfix(error=f"{np.mean(errors):.3f} m", refresh=False, **evaluated)
        return True

    def _on_rollout_start(self) -> None:
        self.keep()  # training on the last hops is over when the next are collected

    def keep(self) -> None:
        """Copy the actor if a budget is spent that has no copy yet."""
        for budget in self.budgets:
            if self.model.num_timesteps >= budget and budget not in self.snapshots:
                self.snapshots[budget] = self.copy(self.model)


class _Checkpoints(BaseCallback):
    """Writes the training's state to ``path`` every so many hops, with the actors copied by ``watch``, which is called first."""

    def __init__(self, path: Path, every: int, settings: str, watch: _Watch, clock: _Clock) -> None:
        super().__init__()
        self.path, self.every, self.settings, self.watch, self.clock = path, every, settings, watch, clock
        self.written = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        done = self.model.num_timesteps
        if done - self.written >= self.every:
            actors = {budget: actor.layers.state_dict() for budget, actor in self.watch.snapshots.items()}
            checkpoint.save(self.path, self.model, self.settings, checkpoint.Past(actors, *self.clock.seconds()))
            self.written = done

    def resume(self, model: Any, venv: VecEnv) -> None:
        """Go on from the file, if there is one."""
        if not self.path.exists():
            return
        past = checkpoint.restore(self.path, model, venv, self.settings)
        self.written, self.clock.before = model.num_timesteps, (past.seconds, past.simulating)
        for budget, weights in past.actors.items():
            self.watch.snapshots[budget] = self.watch.copy(model)
            self.watch.snapshots[budget].layers.load_state_dict(weights)
        self.watch.bar.update(model.num_timesteps)


@one_thread()
def train_policy(
    scene: Scene | SceneRanges,
    config: PolicyConfig,
    *,
    budgets: Sequence[int] = (),
    progress: bool = True,
    state: Path | None = None,
    tensorboard: Path | None = None,
    threads: int | None = None,
) -> tuple[dict[int, ActorPolicy], dict[str, Any]]:
    """Train for ``config.calls`` hops; returns actors as they were after each of ``budgets`` hops, and a card.

    Training goes by rollouts (of one step of all envs, or PPO's): budgets are whole numbers of them. The last
    actor, after all the hops, is always among the actors. ``state`` is a file from which a killed training goes on, with the
    same bits; it stays there for the caller to remove when the actors are safely written. ``threads`` of the simulator, None for
    all cores that this process may use, change no bit.
    """
    scenes = scene if isinstance(scene, SceneRanges) else SceneRanges(scene)
    scaling, envs = Scaling.of(scenes), config.together
    symmetry = Symmetry.of(scenes) if config.symmetric else None
    values = check_calls(config)
    _check_budgets(budgets, config, values)
    if config.updates is not None and "updates" in values:
        values |= {"updates": config.updates}
    plain, told = asdict(config) | {"hyperparameters": values}, asdict(scenes if scenes.ranges else scenes.base)
    decisive: dict[str, Any] = {"config": plain, "scene": told, "budgets": sorted(budgets), "env_seeds": ENV_SEEDS}
    if "updates" in values:
        decisive["updates_per_hop"] = updates_per_hop(values, config.calls)
    settings = hash_of(decisive)
    with contextlib.ExitStack() as stack:
        hops = BatchedHopVecEnv(scenes, scaling, envs, check_fidelity(config.fidelity) | {"threads": threads}, symmetry)
        clock = _Clock(hops)
        venv = stack.enter_context(contextlib.closing(VecMonitor(hops)))
        bar = stack.enter_context(
            tqdm(total=config.calls, unit="hop", desc=f"policy ({config.algorithm})", disable=not progress, mininterval=0.5)
        )
        model = build(config.algorithm, values, venv, config.calls, config.seed, tensorboard)
        if tensorboard is None:
            model.set_logger(Logger(None, []))  # its own would leave an empty folder in the system's for temporary files
        watch = _Watch([*budgets, config.calls], lambda trained: ActorPolicy.from_model(trained, scaling, symmetry), bar)
        callbacks: list[BaseCallback] = [watch]
        if state is not None:
            checkpoints = _Checkpoints(state, config.checkpoint_every, settings, watch, clock)
            checkpoints.resume(model, venv)
            callbacks.append(checkpoints)
        before = model.num_timesteps
        if config.evaluate_every:
            callbacks.append(_evaluation(stack, scenes, scaling, symmetry, config, watch.evaluations))
        model.learn(config.calls - before, callback=CallbackList(callbacks), reset_num_timesteps=before == 0)
        watch.keep()
        calls = before + hops.simulator_calls
    card = {"algorithm": config.algorithm.upper(), "train": plain, "scene": told, "simulator_calls": calls}
    card |= {"evaluations": watch.evaluations} if config.evaluate_every else {}
    seconds, simulating = clock.seconds()
    return watch.snapshots, card | {"seconds": seconds, "simulating_seconds": simulating}


def check_calls(config: PolicyConfig) -> dict[str, Any]:
    """The hyper-parameters that ``config`` means; InvalidParameterError for a number of calls that PPO cannot learn from."""
    values = hyperparameters(config.algorithm, config.hyperparameters)
    if config.algorithm == "ppo":
        check_rollout(config.calls, values["rollout"], lambda calls: replace(config, calls=calls).together)
    return values


def _check_budgets(budgets: Sequence[int], config: PolicyConfig, values: dict[str, Any]) -> None:
    if any(not 0 < b <= config.calls for b in budgets):
        raise InvalidParameterError(f"budgets: expected 1 <= budgets <= calls, got calls {config.calls}, budgets {list(budgets)}")
    envs = config.together
    rollout = rollout_of(config.calls, envs, values["rollout"]) if config.algorithm == "ppo" else envs
    for budget in budgets:
        if budget % rollout:  # the actor after the rollout has seen more hops than asked for, that before it fewer
            raise InvalidParameterError(
                f"budgets: expected multiples of {rollout}, the hops between two trainings of {config.algorithm} with {envs} "
                f"envs, got {budget}; the nearest is {max(rollout, round(budget / rollout) * rollout)}"
            )


def _evaluation(
    stack: contextlib.ExitStack,
    scenes: SceneRanges,
    scaling: Scaling,
    symmetry: Symmetry | None,
    config: PolicyConfig,
    found: list[dict[str, float]],
) -> EvalCallback:
    venv = BatchedHopVecEnv(scenes, scaling, 16, check_fidelity(config.fidelity), symmetry)
    venv.seed(config.seed + EVALUATION_SEED)
    monitored = stack.enter_context(contextlib.closing(VecMonitor(venv)))
    every = max(1, config.evaluate_every // config.together)
    told = _Evaluated(found)
    return EvalCallback(monitored, callback_after_eval=told, n_eval_episodes=32, eval_freq=every, verbose=0, warn=False)


def main(config: PolicyCommand) -> None:
    """Entry of ``python -m training policy``."""
    plain = PolicyConfig(**{name: getattr(config, name) for name in PolicyConfig.__dataclass_fields__})
    scene = Scene.preset(config.scene, landing=config.landing)
    state = beside(config.out, POLICY_STATE)
    actors, card = train_policy(scene, plain, state=state, tensorboard=config.tensorboard)
    actors[config.calls].save(config.out, card)
    state.unlink(missing_ok=True)
    print(f"{config.out}: {card['algorithm']}, {card['simulator_calls']} simulator calls in {card['seconds']:.1f} s")
    for found in card.get("evaluations", []):
        print(f"  after {found['calls']} hops: mean reward {found['reward']:.3f} on 32 episodes")
