"""The whole state of a policy's training in one file, from which it goes on bit by bit.

stable-baselines3's own zips are pickles: loading one runs whatever code is in it. This file holds tensors and plain numbers
alone, and is read with ``weights_only``, which refuses anything else. torch looks at no checksum of tensors: the file is sealed.
"""

from __future__ import annotations

import io
import json
import pickle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.vec_env import VecEnv

from surrogate.storage import ensure_folder, read_sealed, write_sealed
from tensegrity_gym import MODEL_VERSION
from tensegrity_gym.errors import DataFileError

FORMAT = "tensegrity_gym.policy_training/2"
BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class Past(NamedTuple):
    """What a training has behind it, besides the state of its model."""

    actors: dict[int, dict[str, torch.Tensor]]
    """Weights of the actors kept so far, by the hops that they had seen."""
    seconds: float
    """Wall time that it took [s]."""
    simulating: float
    """Of that, in the simulator [s]."""


def save(path: Path, model: Any, settings: str, past: Past) -> None:
    """Write the state of ``model`` between two rollouts; ``settings`` is a hash of all that decides its training."""
    kind, keys, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002 (stable-baselines3 draws from it)
    assert kind == "MT19937"
    variables = model._get_torch_save_params()[1]
    content = {
        "format": FORMAT,
        "model_version": MODEL_VERSION,
        "settings": settings,
        "num_timesteps": model.num_timesteps,
        "n_updates": model._n_updates,
        "parameters": model.get_parameters(),
        "variables": {name: recursive_getattr(model, name).detach() for name in variables},
        "torch_rng": torch.get_rng_state(),
        "numpy_rng": [torch.from_numpy(np.asarray(keys).astype(np.int64)), position, has_gauss, gauss],
        "action_rng": json.dumps(model.action_space.np_random.bit_generator.state),
        "past": past._asdict(),
        "buffer": _buffer(model),
    }
    ensure_folder(path.parent)
    file = io.BytesIO()
    torch.save(content, file)
    write_sealed(path, file.getvalue())


def _buffer(model: Any) -> dict[str, Any] | None:
    buffer = getattr(model, "replay_buffer", None)
    if buffer is None:
        return None
    rows = buffer.buffer_size if buffer.full else buffer.pos
    columns = {name: torch.from_numpy(getattr(buffer, name)[:rows].copy()) for name in BUFFER}
    return {"pos": buffer.pos, "full": buffer.full, "columns": columns}


def restore(path: Path, model: Any, venv: VecEnv, settings: str) -> Past:
    """Put the state in ``path`` into a newly built ``model`` on a new ``venv``; returns what lies behind it.

    DataFileError for a damaged file, or one of another training.
    """
    file = io.BytesIO(read_sealed(path))
    try:
        content = torch.load(file, weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, ValueError, KeyError, TypeError) as error:
        raise DataFileError(f"{path}: expected a whole checkpoint of a policy's training ({error!r}); delete it") from error
    expected = {"format": FORMAT, "model_version": MODEL_VERSION, "settings": settings}
    for name, value in expected.items():
        came = content.get(name) if isinstance(content, dict) else None
        if came != value:
            raise DataFileError(
                f"{path}: expected a checkpoint with {name} {value!r}, got {came!r}; delete it, or choose another --out"
            )
    try:
        return _take(content, model, venv)
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise DataFileError(
            f"{path}: expected a checkpoint with all that a {type(model).__name__} needs, got one that lacks or misshapes it "
            f"({error!r}); delete it"
        ) from error


def _take(content: dict[str, Any], model: Any, venv: VecEnv) -> Past:
    past = Past(**content["past"])
    model.set_parameters(content["parameters"], exact_match=True, device="cpu")
    for name, values in content["variables"].items():
        recursive_getattr(model, name).data.copy_(values)
    model.num_timesteps, model._n_updates = content["num_timesteps"], content["n_updates"]
    if content["buffer"] is not None:
        buffer = model.replay_buffer
        buffer.pos, buffer.full = content["buffer"]["pos"], content["buffer"]["full"]
        for name, values in content["buffer"]["columns"].items():
            getattr(buffer, name)[: len(values)] = values.numpy()
    # episodes are one step long, and each reset draws the next one: so many resets lead to the same targets
    for _ in range(1 + content["num_timesteps"] // venv.num_envs):
        model._last_obs = venv.reset()
    model._last_episode_starts = np.ones(venv.num_envs, dtype=bool)
    model.action_space.np_random.bit_generator.state = json.loads(content["action_rng"])
    keys, position, has_gauss, gauss = content["numpy_rng"]
    np.random.set_state(("MT19937", keys.numpy().astype(np.uint32), position, has_gauss, gauss))  # noqa: NPY002
    torch.set_rng_state(content["torch_rng"])
    return past
