"""A trained actor kept as safetensors and a card: the policy without the pickle that stable-baselines3's zip is."""

from __future__ import annotations

from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from surrogate.weights import weights_at, write_weights
from tensegrity_gym import MODEL_VERSION, STRETCH_RANGE
from tensegrity_gym.errors import InvalidParameterError
from training.planner import Prediction
from training.similarity import Scaling
from training.symmetry import Symmetry

FORMAT = "tensegrity_gym.actor/4"
#: As the one before it, whose actors know no symmetry.
FORMATS = ("tensegrity_gym.actor/3", FORMAT)

#: How an actor's outputs are brought into [-1, 1].
SQUASHES = {"tanh": torch.tanh, "clip": lambda x: torch.clamp(x, -1, 1)}


class ActorPolicy:
    """Deterministic actor: scaled observation through a ReLU MLP, into [-1, 1], then onto the range of stretches.

    With a ``symmetry`` the target is folded first, and the stretches are unfolded (see ``Symmetry``).
    """

    def __init__(self, layers: nn.Sequential, scaling: Scaling, squash: str = "tanh", symmetry: Symmetry | None = None) -> None:
        self.layers = layers.eval()
        self.scaling, self.squash, self.symmetry = scaling, squash, symmetry

    @classmethod
    def from_model(cls, model: Any, scaling: Scaling, symmetry: Symmetry | None = None) -> ActorPolicy:
        """Copy the actor of a stable-baselines3 SAC, TD3 or PPO with ReLU.

        It was trained on observations of that ``scaling``, of targets folded by that ``symmetry``.

        Raises InvalidParameterError for a model whose actor is another function.
        """
        policy = model.policy
        if getattr(model, "use_sde", False):  # its actors end in other layers
            raise InvalidParameterError("model: expected one with use_sde=False, got use_sde=True; train it without")
        if hasattr(policy, "mlp_extractor"):  # PPO's mean action is cut off, not squashed
            modules, squash = [*policy.mlp_extractor.policy_net, policy.action_net], "clip"
        elif hasattr(policy.actor, "latent_pi"):  # SAC
            modules, squash = [*policy.actor.latent_pi, policy.actor.mu], "tanh"
        else:  # TD3
            *modules, last = policy.actor.mu
            modules, squash = modules if isinstance(last, nn.Tanh) else [*modules, last], "tanh"
        _check_actor(model, modules, squash)
        found = [layer for layer in modules if isinstance(layer, nn.Linear)]
        with torch.random.fork_rng(devices=[]):  # a copy made during training must draw none of its random numbers
            copy = _mlp([found[0].in_features, *(layer.out_features for layer in found)])
        for mine, theirs in zip(list(copy)[::2], found, strict=True):
            mine.load_state_dict(theirs.state_dict())
        return cls(copy, scaling, squash, symmetry)

    @torch.no_grad()
    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Observations (d,) or (n, d) to stretches (4,) or (n, 4)."""
        batch = np.atleast_2d(np.asarray(observation, dtype=np.float32))
        width = self.layers[0].in_features
        if batch.ndim != 2 or batch.shape[1] != width or not np.isfinite(batch).all():
            raise InvalidParameterError(f"observation: expected finite numbers ({width},) or (n, {width}), got {observation!r}")
        if self.symmetry is None:
            stretches = self._stretches(batch)
        else:
            folded, which = self.symmetry.fold(batch)
            stretches = self.symmetry.unfold(self._stretches(folded), which)
        return (stretches[0] if np.ndim(observation) == 1 else stretches), state

    def _stretches(self, seen: np.ndarray) -> np.ndarray:
        low, high = STRETCH_RANGE
        action = SQUASHES[self.squash](self.layers(torch.from_numpy(self.scaling(seen))))
        share = (action.numpy().astype(np.float64) + 1) / 2
        return np.clip(low + (high - low) * share, low, high)

    def save(self, path: Path | str, card: dict[str, Any]) -> Path:
        """Write weights (safetensors) and, beside them, the card with their checksum (.json)."""
        fixed = {
            "format": FORMAT,
            "model_version": MODEL_VERSION,
            "scaling": asdict(self.scaling),
            "squash": self.squash,
            "symmetry": None if self.symmetry is None else asdict(self.symmetry),
        }
        return write_weights(path, self.layers.state_dict(), card | fixed)

    @classmethod
    def load(cls, path: Path | str) -> ActorPolicy:
        """Read a saved actor; DataFileError for a missing, damaged or foreign one."""
        with weights_at(path, "an actor", {"format": FORMATS, "model_version": (MODEL_VERSION,)}) as (state, card):
            weights = [state[name] for name in sorted(state, key=lambda n: int(n.split(".")[0])) if name.endswith("weight")]
            layers = _mlp([weights[0].shape[1], *(w.shape[0] for w in weights)])
            layers.load_state_dict(state)
            if card["squash"] not in SQUASHES:
                raise ValueError(f"its card says squash {card['squash']!r}")
            kept, group = card["scaling"], card.get("symmetry")
            symmetry = group and Symmetry(tuple(map(tuple, group["permutations"])), tuple(map(tuple, group["signs"])))
            return cls(layers, Scaling(tuple(kept["scale"]), tuple(kept["offset"]), kept["gravity"]), card["squash"], symmetry)


def _check_actor(model: Any, modules: list[nn.Module], squash: str) -> None:
    """InvalidParameterError unless the observation, layers with ReLU and the squashed stretches are all there is."""
    from stable_baselines3.common.torch_layers import FlattenExtractor  # whoever has such a model has loaded it already

    hidden = {type(layer).__name__ for layer in modules if not isinstance(layer, nn.Linear)}
    if not hidden <= {"ReLU"}:  # PPO's default is Tanh
        raise InvalidParameterError(
            f"model: expected hidden layers with ReLU alone, got {sorted(hidden)}; train it with "
            "policy_kwargs={'activation_fn': torch.nn.ReLU}"
        )
    extractor = model.policy.pi_features_extractor if squash == "clip" else model.policy.actor.features_extractor
    if type(extractor) is not FlattenExtractor:
        raise InvalidParameterError(
            f"model: expected observations that go straight into the layers, got a {type(extractor).__name__}; train it without"
        )
    space, width = model.action_space, getattr(modules[-1], "out_features", None)
    ranges = [(-1.0, 1.0)] if squash == "clip" else [(-1.0, 1.0), STRETCH_RANGE]  # SAC and TD3 rescale their actions themselves
    if space.shape != (width,) or not any(np.allclose(space.low, low) and np.allclose(space.high, high) for low, high in ranges):
        raise InvalidParameterError(
            f"model: expected as many outputs as actions, each in {' or '.join(map(str, ranges))}, got {width} outputs for "
            f"{space}; train it on training.sb3_vec_env.make_env, which rescales them"
        )


def _mlp(widths: list[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for fan_in, fan_out in pairwise(widths):
        layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])
