"""A small ensemble of MLPs from stretches to the hop, with the lattice's symmetry built in, and its checkpoint."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor, nn

from surrogate.dataset import HopData
from surrogate.storage import atomic_path, ensure_folder, read_json, write_json
from tensegrity_gym import MODEL_VERSION, STRETCH_RANGE, Lattice, Scene
from tensegrity_gym.errors import DataFileError, InvalidStretchesError

FORMAT = "tensegrity_gym.surrogate/1"


class Output(NamedTuple):
    """One predicted number: its column and place there, unit, and the axis whose reflection flips its sign (or None)."""

    name: str
    column: str
    component: int | None
    unit: str
    axis: int | None


OUTPUTS: tuple[Output, ...] = (
    Output("landing_x", "landing", 0, "m", 0),
    Output("landing_y", "landing", 1, "m", 1),
    Output("touchdown_x", "touchdown", 0, "m", 0),
    Output("touchdown_y", "touchdown", 1, "m", 1),
    Output("apex", "apex", None, "m", None),
    Output("takeoff_velocity_x", "takeoff_velocity", 0, "m/s", 0),
    Output("takeoff_velocity_y", "takeoff_velocity", 1, "m/s", 1),
    Output("takeoff_velocity_z", "takeoff_velocity", 2, "m/s", None),
    Output("flight_time", "flight_time", None, "s", None),
)


@dataclass(frozen=True)
class NetConfig:
    """Size of the net."""

    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers."""
    members: int = 5
    """Nets in the ensemble; their mean is the prediction, their spread a sign of doubt."""
    symmetric: bool = True
    """Average over the symmetries of lattice and scene, which makes the net exactly equivariant."""


def target_columns(data: HopData) -> np.ndarray:
    """The outputs of stored hops, not-a-number where a hop has none, shape (n, len(OUTPUTS)) [each its unit]."""
    columns = [data[o.column] if o.component is None else data[o.column][:, o.component] for o in OUTPUTS]
    return np.column_stack(columns).astype(np.float32)


def scene_symmetries(lattice: Lattice, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The lattice's symmetries that leave gravity unmoved: permutations (g, n_actuators) and signs (g, 2)."""
    horizontal = scene.gravity_vector[:2]
    keep = np.abs(lattice.symmetry_signs * horizontal - horizontal).max(axis=1) < 1e-12 * scene.gravity
    return lattice.symmetries[keep], lattice.symmetry_signs[keep]


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep torch on one thread: nets this small lose more by waiting for each other's threads than they gain."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class HopNet(nn.Module):
    """Ensemble of MLPs: stretches [-], shape (..., n, n_actuators), to outputs in SI units, shape (members, ..., n, 9).

    With ``symmetric``, f(s) = mean over g of sign_g * mlp(s[perm_g]): f is equivariant whatever the weights are.
    """

    permutations: Tensor
    signs: Tensor
    output_mean: Tensor
    output_scale: Tensor
    input_mean: Tensor
    input_scale: Tensor

    def __init__(self, config: NetConfig, permutations: np.ndarray, signs: np.ndarray) -> None:
        super().__init__()
        self.config = config
        if not config.symmetric:
            permutations, signs = permutations[:1], signs[:1]  # row 0 is the identity
        output_signs = [[1 if o.axis is None else int(row[o.axis]) for o in OUTPUTS] for row in signs]
        self.register_buffer("permutations", torch.as_tensor(np.asarray(permutations), dtype=torch.int64))
        self.register_buffer("signs", torch.as_tensor(output_signs, dtype=torch.float32))
        self.register_buffer("output_mean", torch.zeros(len(OUTPUTS)))
        self.register_buffer("output_scale", torch.ones(len(OUTPUTS)))
        low, high = STRETCH_RANGE
        self.register_buffer("input_mean", torch.tensor((low + high) / 2))
        self.register_buffer("input_scale", torch.tensor((high - low) / 2))
        widths: tuple[int, ...] = (self.permutations.shape[1], *config.hidden, len(OUTPUTS))
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for fan_in, fan_out in pairwise(widths):
            bound = float(fan_in**-0.5)
            self.weights.append(nn.Parameter(torch.empty(config.members, fan_in, fan_out).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.empty(config.members, 1, fan_out).uniform_(-bound, bound)))

    def fit_normalisers(self, targets: Tensor) -> None:
        """Set the output buffers from training targets, shape (n, 9): group-averaged means, so odd outputs get zero."""
        mean = torch.nan_to_num(torch.nanmean(targets, dim=0))
        self.output_mean.copy_((self.signs * mean).mean(dim=0))
        spread = torch.sqrt(torch.nanmean((targets - self.output_mean) ** 2, dim=0))
        self.output_scale.copy_(torch.where(spread > 1e-6, spread, torch.ones_like(spread)))

    def normalised(self, stretches: Tensor) -> Tensor:
        """Outputs before the normalisers are undone, shape (members, ..., n, 9)."""
        batch = stretches.shape[:-1]
        images = (stretches.reshape(-1, stretches.shape[-1]) - self.input_mean) / self.input_scale
        images = images[:, self.permutations]  # (n, g, n_actuators)
        n, group = images.shape[:2]
        hidden = images.reshape(1, n * group, -1).expand(self.config.members, -1, -1)
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = torch.baddbmm(bias, hidden, weight)
            if k + 1 < len(self.weights):
                hidden = nn.functional.silu(hidden)
        averaged = (hidden.reshape(-1, n, group, len(OUTPUTS)) * self.signs).mean(dim=2)
        return averaged.reshape(self.config.members, *batch, len(OUTPUTS))

    def forward(self, stretches: Tensor) -> Tensor:
        return self.output_mean + self.output_scale * self.normalised(stretches)

    def landing(self, stretches: Tensor) -> Tensor:
        """Landing as each member sees it [m], shape (members, ..., n, 2)."""
        return self(stretches)[..., :2]

    @torch.no_grad()
    def predict(self, stretches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation over the members, each (n, 9) [units of OUTPUTS]; refuses what no data covers."""
        stretches = np.atleast_2d(np.asarray(stretches, dtype=np.float32))
        low, high = STRETCH_RANGE
        n_actuators = self.permutations.shape[1]
        inside = (np.abs(stretches - (low + high) / 2) <= (high - low) / 2 + 1e-6).all()  # not-a-number is not inside
        if stretches.ndim != 2 or stretches.shape[1] != n_actuators or not inside:
            raise InvalidStretchesError(
                f"expected stretches (n, {n_actuators}) in [{low}, {high}], where the surrogate was trained, got {stretches!r}"
            )
        seen = self(torch.from_numpy(stretches))
        return seen.mean(dim=0).numpy(), seen.std(dim=0, unbiased=False).numpy()


def save(net: HopNet, path: Path | str, card: dict[str, Any]) -> Path:
    """Write weights and normalisers to ``path`` (safetensors) and the card, with their checksum, to ``path`` .json."""
    path = Path(path)
    ensure_folder(path.parent)
    content = save_tensors({name: value.contiguous() for name, value in net.state_dict().items()})
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    fixed = {
        "format": FORMAT,
        "model_version": MODEL_VERSION,
        "net": asdict(net.config),
        "outputs": [o.name for o in OUTPUTS],
        "sha256": hashlib.sha256(content).hexdigest(),
    }
    write_json(path.with_suffix(".json"), card | fixed)
    return path


def load(path: Path | str) -> tuple[HopNet, dict[str, Any]]:
    """Read a checkpoint and its card; nothing is unpickled.

    Raises DataFileError for a missing, damaged or foreign one (another format, or another version of the physics).
    """
    path = Path(path)
    card = read_json(path.with_suffix(".json"))
    expected = {"format": FORMAT, "model_version": MODEL_VERSION, "outputs": [o.name for o in OUTPUTS]}
    for name, value in expected.items():
        came = card.get(name) if isinstance(card, dict) else None
        if came != value:
            raise DataFileError(f"{path}: expected a surrogate with {name} {value!r}, got {came!r}; train it again")
    try:
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != card["sha256"]:
            raise ValueError(f"its checksum is not {card['sha256']}, as the card says")
        state = load_tensors(content)
        size = NetConfig(**(card["net"] | {"hidden": tuple(card["net"]["hidden"])}))
        group, n_actuators = state["permutations"].shape
        net = HopNet(size, np.zeros((group, n_actuators)), np.ones((group, 2)))
        net.load_state_dict(state)
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, SafetensorError, json.JSONDecodeError) as error:
        raise DataFileError(f"{path}: expected a whole surrogate checkpoint ({error}); train it again") from error
    return net.eval(), card
