"""The policies of a comparison: training one is a stage, its score another. Imports stable-baselines3, which takes seconds."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from surrogate.storage import CARD, POLICY_STATE, beside
from training.algorithms import LEAST_UPDATES, hyperparameters, is_cap_passed
from training.compare.methods import algorithm_of
from training.policies import ActorPolicy
from training.sb3_vec_env import ENV_SEEDS
from training.stages import Results
from training.train_policy import PolicyConfig, check_calls, train_policy

if TYPE_CHECKING:
    from training.compare.run import Comparison


def check(comparison: Comparison) -> None:
    """InvalidParameterError for what no policy can learn from: now, not after all planners."""
    for method in comparison.config.policies:
        for budget in comparison.config.budgets_of_policies:
            check_calls(config_of(comparison, method, 0, budget))


def config_of(comparison: Comparison, method: str, seed: int, budget: int) -> PolicyConfig:
    """How a policy is trained."""
    config, (algorithm, symmetric) = comparison.config, algorithm_of(method)
    return PolicyConfig(
        algorithm,
        calls=budget,
        seed=seed,
        symmetric=symmetric,
        fidelity=config.fidelity,
        hyperparameters=config.hyperparameters and config.hyperparameters / f"{algorithm}.toml",
        **comparison.policy_settings,
    )


def content_of(comparison: Comparison, method: str, seed: int, budget: int) -> dict[str, Any]:
    """All that a policy depends on."""
    config = config_of(comparison, method, seed, budget)
    values = hyperparameters(config.algorithm, config.hyperparameters)
    told = asdict(config) | {"hyperparameters": None}  # what stands in the file counts, not where it lies
    content: dict[str, Any] = comparison.base | {"config": told, "values": values, "env_seeds": ENV_SEEDS}
    if is_cap_passed(values, budget):
        content["least_updates"] = LEAST_UPDATES  # trained before there was a least, a policy of so many hops is another
    return content


def settings_of(comparison: Comparison, method: str) -> dict[str, Any]:
    """All that policies of a method depend on besides budget and seed."""
    content = content_of(comparison, method, 0, 1)
    told = {name: value for name, value in content["config"].items() if name not in ("calls", "seed")}
    return content | {"config": told, "least_updates": LEAST_UPDATES}


def train(comparison: Comparison, method: str, seed: int, budget: int) -> str:
    """Train a policy; returns its stage."""
    stages, config = comparison.stages, comparison.config
    name = f"policy_{method}_{seed}_{budget}"
    path = stages.folder / f"{name}.safetensors"

    def work() -> Results:
        state, settings = beside(path, POLICY_STATE), config_of(comparison, method, seed, budget)
        actors, card = train_policy(comparison.scenes, settings, progress=config.progress, state=state, threads=config.threads)
        actors[budget].save(path, card)
        state.unlink(missing_ok=True)
        simulating, values = card["simulating_seconds"], card["train"]["hyperparameters"]
        return {"seconds": card["seconds"], "simulating": simulating, "values": values}

    if name not in stages.results:
        files = [path.name, beside(path, CARD).name]
        stages.run(name, content_of(comparison, method, seed, budget), work, files=files)
    return name


def run(comparison: Comparison, method: str, seed: int, budget: int) -> None:
    """Train a policy, and score it."""
    name = train(comparison, method, seed, budget)
    path, found = comparison.stages.folder / f"{name}.safetensors", comparison.stages.results[name]

    def answers() -> Results:
        return {"stretches": ActorPolicy.load(path).predict(comparison.targets)[0]}

    comparison.score(method, seed, budget, name, answers, seconds=found["seconds"] - found["simulating"])
