"""A small ensemble of MLPs from stretches and scene to the hop and its scatter, with the lattice's symmetry built in."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from surrogate.hops import PHYSICS, check_parts
from surrogate.outputs import LANDING, OUTPUTS, Output, scene_columns, target_columns
from surrogate.schema import SCENE_VALUES
from surrogate.weights import weights_at, write_weights
from tensegrity_gym import MODEL_VERSION, STRETCH_RANGE, Lattice, Scene
from tensegrity_gym.errors import InvalidParameterError, InvalidStretchesError

__all__ = [
    "OUTPUTS",
    "HopNet",
    "NetConfig",
    "Output",
    "Prediction",
    "check_data",
    "load",
    "save",
    "scene_columns",
    "target_columns",
]

FORMAT = "tensegrity_gym.surrogate/2"
#: Factor on the usual initial weights of the first layer: landings vary within a small part of the range of stretches, which a
#: net with the usual ones is slow to learn.
FIRST_GAIN = 3.0
#: Bounds of the natural logarithm of a variance, in units of the output's spread: from 1e-3 of it to three of it.
LOG_VARIANCE = (-14.0, 2.2)


@dataclass(frozen=True)
class NetConfig:
    """Size of the net."""

    hidden: tuple[int, ...] = (128, 128, 128, 128)
    """Widths of the hidden layers: multiples of the number of symmetries (4 on level ground)."""
    members: int = 3
    """Nets in the ensemble; their mean is the prediction, their spread a part of the doubt."""
    symmetric: bool = True
    """Layers that commute with the symmetries of lattice and scene, which makes the net exactly equivariant."""


def scene_symmetries(lattice: Lattice, scene: Scene, varied: Sequence[str] = ()) -> tuple[np.ndarray, np.ndarray]:
    """Permutations (g, n_actuators) and signs (g, 2) under which the net is to be equivariant.

    Those of the lattice that leave gravity unmoved; all of them where the slope is an input, which then moves along.
    """
    turns_along = bool({"slope", "slope_direction"} & set(varied))
    return lattice.symmetries_keeping(np.zeros(2) if turns_along else scene.gravity_vector[:2] / scene.gravity)


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep torch on one thread: nets this small lose more by waiting for each other's threads than they gain."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Prediction(NamedTuple):
    """What the ensemble says of n hops, in the units of OUTPUTS."""

    mean: np.ndarray  #: shape (n, 9)
    deviation: np.ndarray  #: calibrated standard deviation of a hop about ``mean``, shape (n, 9)


class HopNet(nn.Module):
    """Ensemble of MLPs: stretches [-], shape (..., n, n_actuators), to outputs in SI units, shape (members, ..., n, 9).

    Where the data varied the scene, its values follow the stretches: ``scene``, shape (..., n, k), ordered as
    ``scene_names``.

    With ``symmetric`` each hidden layer of width w is a function on the symmetry group with w / g channels, and its weights
    depend on pairs of group elements by their quotient only (group convolution, Cohen and Welling 2016): the net is
    equivariant whatever its weights are, and costs what a plain MLP of its width costs. Its inputs transform with the
    symmetry: stretches are permuted, the two components of a slope change sign.
    """

    permutations: Tensor
    signs: Tensor
    products: Tensor
    output_mean: Tensor
    output_scale: Tensor
    input_mean: Tensor
    input_scale: Tensor
    scene_low: Tensor
    scene_high: Tensor
    variance_factor: Tensor

    def __init__(
        self,
        config: NetConfig,
        permutations: np.ndarray,
        signs: np.ndarray,
        scene: Scene | None = None,
        scene_ranges: Mapping[str, Sequence[float]] | None = None,
    ) -> None:
        super().__init__()
        self.config, self.scene, self.scene_ranges = config, scene or Scene(), dict(sorted((scene_ranges or {}).items()))
        self.scene_names = tuple(self.scene_ranges)
        if not config.symmetric:
            permutations, signs = permutations[:1], signs[:1]  # row 0 is the identity
        permutations, signs = np.asarray(permutations, dtype=np.int64), np.asarray(signs, dtype=np.int64)
        group = len(permutations)
        if not config.hidden or any(w < group or w % group for w in config.hidden) or config.members < 1:
            raise InvalidParameterError(
                f"net: expected at least one member and hidden widths that are multiples of {group}, the number of "
                f"symmetries, got {config.members} and {config.hidden}; change them, or turn symmetric off"
            )
        output_signs = [[1 if o.axis is None else int(row[o.axis]) for o in OUTPUTS] for row in signs]
        self.register_buffer("permutations", torch.as_tensor(permutations))
        self.register_buffer("signs", torch.as_tensor(output_signs, dtype=torch.float32))
        self.register_buffer("products", torch.as_tensor(_products(permutations, signs)))
        self.register_buffer("output_mean", torch.zeros(len(OUTPUTS)))
        self.register_buffer("output_scale", torch.ones(len(OUTPUTS)))
        self.register_buffer("variance_factor", torch.ones(len(OUTPUTS)))
        low, high = STRETCH_RANGE
        self.register_buffer("input_mean", torch.tensor((low + high) / 2))
        self.register_buffer("input_scale", torch.tensor((high - low) / 2))
        bounds = torch.tensor(list(self.scene_ranges.values()), dtype=torch.float32).reshape(-1, 2)
        self.register_buffer("scene_low", bounds[:, 0].contiguous())
        self.register_buffer("scene_high", bounds[:, 1].contiguous())
        self._make_layers(self.images(torch.zeros(1, permutations.shape[1]), bounds[None, :, 0]).shape[-1], group)

    def _make_layers(self, n_inputs: int, group: int) -> None:
        channels = [w // group for w in self.config.hidden]
        members = self.config.members
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()

        def add(shape: tuple[int, ...], fan_in: int) -> None:
            bound = float(fan_in**-0.5)
            self.weights.append(nn.Parameter(torch.empty(members, *shape).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.empty(members, 1, shape[-1]).uniform_(-bound, bound)))

        add((n_inputs, channels[0]), n_inputs)
        with torch.no_grad():
            self.weights[0].mul_(FIRST_GAIN)
        for fan_in, fan_out in pairwise(channels):
            add((group, fan_in, fan_out), group * fan_in)
        add((channels[-1], 2 * len(OUTPUTS)), channels[-1])

    def member(self, number: int) -> HopNet:
        """One member as a net of its own."""
        one = copy.deepcopy(self)
        one.config = replace(self.config, members=1)
        for layers in (one.weights, one.biases):
            for k, layer in enumerate(layers):
                layers[k] = nn.Parameter(layer.detach()[number : number + 1].clone())
        return one

    def fit_normalisers(self, targets: Tensor) -> None:
        """Set the output buffers from training targets, shape (n, 9): group-averaged means, so odd outputs get zero."""
        mean = torch.nan_to_num(torch.nanmean(targets, dim=0))
        self.output_mean.copy_((self.signs * mean).mean(dim=0))
        spread = torch.sqrt(torch.nanmean((targets - self.output_mean) ** 2, dim=0))
        self.output_scale.copy_(torch.where(spread > 1e-6, spread, torch.ones_like(spread)))

    @property
    def landing_images(self) -> tuple[np.ndarray, np.ndarray]:
        """Symmetries under which hops have images: permutations of stretches (g, n_actuators) and signs of landings (g, 2)."""
        return self.permutations.numpy(), self.signs[:, :2].numpy().astype(np.float64)

    def images(self, stretches: Tensor, scene: Tensor) -> Tensor:
        """Inputs of the net, about -1 to 1, under each symmetry: shapes (n, n_actuators) and (n, k) to (n, g, inputs)."""
        scaled = ((stretches - self.input_mean) / self.input_scale)[:, self.permutations]
        if not self.scene_names:
            return scaled
        middle, half = (self.scene_low + self.scene_high) / 2, (self.scene_high - self.scene_low) / 2
        plain = (scene - middle) / torch.where(half > 0, half, torch.ones_like(half))
        invariant = [k for k, name in enumerate(self.scene_names) if name not in ("slope", "slope_direction")]
        parts = [scaled, plain[:, None, invariant].expand(-1, scaled.shape[1], -1)]
        if len(invariant) < len(self.scene_names):
            parts.append(self._downhill(scene)[:, None] * self.signs[:, LANDING])
        return torch.cat(parts, dim=-1)

    def _downhill(self, scene: Tensor) -> Tensor:
        """Horizontal part of gravity over the greatest there is, shape (n, 2): a vector, which symmetries turn."""
        value = {name: scene[:, k] for k, name in enumerate(self.scene_names)}
        still = {name: torch.full_like(scene[:, 0], getattr(self.scene, name)) for name in ("slope", "slope_direction")}
        slope, azimuth = (value.get(name, still[name]) for name in ("slope", "slope_direction"))
        steepest = float(np.sin(max(self.scene_ranges.get("slope", (self.scene.slope,))))) or 1.0
        return (torch.sin(slope) / steepest)[:, None] * torch.stack([torch.cos(azimuth), torch.sin(azimuth)], dim=-1)

    def heads(self, stretches: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Normalised means and logarithms of variances, each (members, ..., n, 9), before calibration."""
        batch, members = stretches.shape[:-1], self.config.members
        hidden = self.images(stretches.reshape(-1, stretches.shape[-1]), self._scene(scene, batch))
        n, group = hidden.shape[:2]
        hidden = hidden.reshape(1, n * group, -1).expand(members, -1, -1)
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            if weight.ndim == 4:
                wide = weight[:, self.products].permute(0, 1, 3, 2, 4).reshape(members, group * weight.shape[2], -1)
                flat = hidden.reshape(members, n, -1)
                hidden = torch.baddbmm(bias.repeat(1, 1, group), flat, wide).reshape(members, n * group, -1)
            else:
                hidden = torch.baddbmm(bias, hidden, weight)
            if k + 1 < len(self.weights):
                hidden = nn.functional.silu(hidden)
        mean, log_variance = hidden.reshape(members, n, group, 2, len(OUTPUTS)).unbind(dim=3)
        shape = (members, *batch, len(OUTPUTS))
        mean = (mean * self.signs).mean(dim=2).reshape(shape)
        return mean, log_variance.mean(dim=2).clamp(*LOG_VARIANCE).reshape(shape)

    def _scene(self, scene: Tensor | None, batch: torch.Size) -> Tensor:
        width = len(self.scene_names)
        if width == 0:
            return self.output_mean.new_empty((batch.numel(), 0))
        if scene is None or scene.shape[-1] != width:
            raise InvalidParameterError(
                f"scene: expected the values of {self.scene_names}, which varied in training, shape (..., {width}), got "
                f"{None if scene is None else tuple(scene.shape)}"
            )
        return scene.expand(*batch, width).reshape(batch.numel(), width)

    def moments(self, stretches: Tensor, scene: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Mean and calibrated variance of a hop as each member sees them, (members, ..., n, 9) [SI units, squared].

        The variance is the scatter that remains where members agree; their disagreement adds to it, see :meth:`doubt`.
        """
        mean, log_variance = self.heads(stretches, scene)
        variance = self.variance_factor * self.output_scale**2 * torch.exp(log_variance)
        return self.output_mean + self.output_scale * mean, variance

    def forward(self, stretches: Tensor, scene: Tensor | None = None) -> Tensor:
        return self.output_mean + self.output_scale * self.heads(stretches, scene)[0]

    def landing(self, stretches: Tensor, scene: Tensor | None = None) -> Tensor:
        """Landing as each member sees it [m], shape (members, ..., n, 2)."""
        return self(stretches, scene)[..., LANDING]

    @torch.no_grad()
    def predict(self, stretches: np.ndarray, scene: Any = None) -> Prediction:
        """Mean and standard deviation of hops, each (n, 9) [units of OUTPUTS]; refuses what no data covers.

        ``scene`` is needed where the training data varied it: a Scene, a mapping from ``scene_names`` to values (one, or n),
        or an array (n, k). A Scene must be the training data's in all else (but its duration). The deviation holds the
        predicted scatter of a hop and the members' disagreement.
        """
        points, values = self._checked(stretches, scene)
        mean, variance = self.moments(points, values)
        total = variance.mean(dim=0) + self.variance_factor * mean.var(dim=0, unbiased=False)
        return Prediction(mean.mean(dim=0).cpu().numpy(), torch.sqrt(total).cpu().numpy())

    def doubt(self, stretches: np.ndarray, scene: Any = None) -> np.ndarray:
        """Landing error to expect at these stretches (rms, scatter and disagreement together), shape (n,) [m]."""
        return np.sqrt((self.predict(stretches, scene).deviation[:, LANDING] ** 2).sum(axis=1))

    def _checked(self, stretches: np.ndarray, scene: Any) -> tuple[Tensor, Tensor | None]:
        stretches = np.atleast_2d(np.asarray(stretches, dtype=np.float32))
        low, high = STRETCH_RANGE
        n_actuators = self.permutations.shape[1]
        inside = (np.abs(stretches - (low + high) / 2) <= (high - low) / 2 + 1e-6).all()  # not-a-number is not inside
        if stretches.ndim != 2 or stretches.shape[1] != n_actuators or not inside:
            raise InvalidStretchesError(
                f"expected stretches (n, {n_actuators}) in [{low}, {high}], where the surrogate was trained, got {stretches!r}"
            )
        points = torch.from_numpy(stretches).to(self.output_mean)
        if isinstance(scene, Scene):
            scene = self._values_of(scene)
        if not self.scene_names:
            if scene is not None and np.size(scene if isinstance(scene, np.ndarray) else list(scene)):
                raise InvalidParameterError(f"scene: expected no values, as the surrogate was trained in one, got {scene!r}")
            return points, None
        return points, self._checked_scene(scene, len(stretches)).to(points)

    def _values_of(self, scene: Scene) -> dict[str, float]:
        """What the net is told of a scene; InvalidParameterError where it differs in anything else from the one trained in."""
        told = {name: getattr(scene, name) for name in self.scene_names}
        still = {f.name for f in fields(Scene)} - {*told, "duration"}  # how long a hop is followed moves no landing
        other = {n: (getattr(self.scene, n), getattr(scene, n)) for n in sorted(still)}
        differ = [f"{n} {own!r}, got {came!r}" for n, (own, came) in other.items() if own != came]
        if differ:
            raise InvalidParameterError(f"scene: expected {'; '.join(differ)}, as the surrogate was trained; train one there")
        return told

    def _checked_scene(self, scene: Any, n: int) -> Tensor:
        if isinstance(scene, Mapping) and set(scene) == set(self.scene_names):
            scene = np.column_stack([np.broadcast_to(np.asarray(scene[name], dtype=np.float64), n) for name in self.scene_names])
        try:
            values = np.asarray(scene, dtype=np.float64)
            values = np.broadcast_to(values, (n, len(self.scene_names)))
        except (TypeError, ValueError):
            values = np.full((n, len(self.scene_names)), np.nan)
        low, high = np.array(list(self.scene_ranges.values())).T
        if not ((values >= low - 1e-6 * np.abs(low)) & (values <= high + 1e-6 * np.abs(high))).all():
            wanted = ", ".join(f"{k} in {list(v)} {SCENE_VALUES[k]}" for k, v in self.scene_ranges.items())
            raise InvalidParameterError(f"scene: expected {wanted}, where the surrogate was trained, got {scene!r}")
        return torch.from_numpy(values.copy())


def _products(permutations: np.ndarray, signs: np.ndarray) -> np.ndarray:
    """Which symmetry is the quotient of two, shape (g, g); each is its own inverse, and they commute."""
    rows = [(*p.tolist(), *s.tolist()) for p, s in zip(permutations, signs, strict=True)]
    number = {row: k for k, row in enumerate(rows)}
    return np.array(
        [
            [number[(*p[q].tolist(), *(s * t).tolist())] for q, t in zip(permutations, signs, strict=True)]
            for p, s in zip(permutations, signs, strict=True)
        ],
        dtype=np.int64,
    )


def save(net: HopNet, path: Path | str, card: dict[str, Any]) -> Path:
    """Write weights and normalisers to ``path`` (safetensors) and the card, with their checksum, to ``path`` .json."""
    fixed = {
        "format": FORMAT,
        "model_version": MODEL_VERSION,
        "net": asdict(net.config),
        "scene": asdict(net.scene),
        "scene_ranges": {name: list(bounds) for name, bounds in net.scene_ranges.items()},
        "outputs": [o.name for o in OUTPUTS],
    }
    return write_weights(path, net.state_dict(), card | fixed)


def load(path: Path | str) -> tuple[HopNet, dict[str, Any]]:
    """Read a checkpoint and its card; nothing is unpickled.

    Raises DataFileError for a missing, damaged or foreign one (another format, or another version of the physics), and
    InvalidParameterError for the name of a file that lies beside one.
    """
    expected = {"format": (FORMAT,), "model_version": (MODEL_VERSION,), "outputs": ([o.name for o in OUTPUTS],)}
    with weights_at(path, "a surrogate", expected) as (state, card):
        size = NetConfig(**(card["net"] | {"hidden": tuple(card["net"]["hidden"])}))
        signs = state["signs"][:, LANDING]
        net = HopNet(size, state["permutations"].numpy(), signs.numpy(), Scene(**card["scene"]), card["scene_ranges"])
        net.load_state_dict(state)
    return net.eval(), card


def check_data(card: Mapping[str, Any], configuration: Mapping[str, Any], where: str) -> None:
    """DataFileError, which names ``where`` and what differs, unless hops are of the configuration that a card's net learnt from.

    Seed, sampler and number of the hops may differ; ``lengths`` is there where they are other than metres in the hop's scene.
    """
    names = (*PHYSICS, "scene", "scene_ranges", "lengths")
    why, fix = "which the surrogate was trained on", "use data of the same configuration"
    check_parts(configuration, card["configuration"], names, where, why, fix)
