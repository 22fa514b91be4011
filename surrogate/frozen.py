"""A trained surrogate reduced to what a planner asks of it: the landing alone, with all that is fixed worked out once."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from surrogate.model import HopNet
from tensegrity_gym.errors import InvalidParameterError


class FrozenLanding:
    """As ``net.landing`` to rounding: stretches (n, n_actuators) to landings as each member sees them, (members, n, 2) [m].

    A net of scenes that vary also takes their values, shape (n, k) [SI], or is bound to one scene's by :meth:`at`; ``names``
    are those values in the order in which they come (default: the net's own).

    The net's layers commute with the symmetries because each is made, at every pass, of a few blocks repeated and permuted.
    Here they are plain matrices, and the last one gives the two numbers that are asked for.
    """

    @torch.no_grad()
    def __init__(self, net: HopNet, names: Sequence[str] | None = None) -> None:
        self.names = tuple(net.scene_names if names is None else names)
        if set(self.names) != set(net.scene_names) or {"slope", "slope_direction"} & set(self.names):
            raise InvalidParameterError(
                f"net: expected one that is told {list(self.names)} and no slope, got one that is told {list(net.scene_names)}"
            )
        self.permutations, self.input_mean, self.input_scale = net.permutations, net.input_mean, net.input_scale
        order, inputs = [net.scene_names.index(name) for name in self.names], net.permutations.shape[1]
        low, high = net.scene_low[order], net.scene_high[order]
        self.middle, self.half = (low + high) / 2, (high - low) / 2
        whole = net.weights[0].detach()
        self.first, self.first_bias = whole[:, :inputs], net.biases[0].detach()
        self.of_scene = whole[:, inputs:][:, order]  # symmetries leave these values alone: they only shift the first layer
        group, members = len(net.permutations), net.config.members
        self.layers = []
        for weight, bias in zip(list(net.weights)[1:-1], list(net.biases)[1:-1], strict=True):
            if weight.ndim == 4:
                wide = weight[:, net.products].permute(0, 1, 3, 2, 4).reshape(members, group * weight.shape[2], -1)
            else:  # each image on its own
                wide = torch.stack([torch.block_diag(*[w] * group) for w in weight])
            self.layers.append((wide.contiguous(), bias.repeat(1, 1, group)))
        signs, scale = net.signs[:, :2], net.output_scale[:2]
        last, last_bias = net.weights[-1][..., :2], net.biases[-1][..., :2]
        self.last = (last[:, None] * signs[:, None] * scale / group).reshape(members, -1, 2)
        self.last_bias = net.output_mean[:2] + scale * last_bias * signs.mean(dim=0)

    def at(self, values: np.ndarray) -> FrozenLanding:
        """In the scene of ``values``, shape (k,) [SI]: as fast as a net of a single scene."""
        bound = copy.copy(self)
        bound.first_bias = self.first_bias + self._shift(torch.as_tensor(values, dtype=torch.float32)[None])
        bound.names = ()
        return bound

    def _shift(self, scene: Tensor) -> Tensor:
        """What scenes (n, k) add to the first layer, (members, n, channels)."""
        scaled = (scene - self.middle) / self.half
        return scaled.expand(len(self.of_scene), -1, -1) @ self.of_scene

    def __call__(self, stretches: Tensor, scene: Tensor | None = None) -> Tensor:
        if (scene is None) != (not self.names):
            raise InvalidParameterError(f"scene: expected the values of {list(self.names)}, got {scene}")
        n, members = len(stretches), len(self.first)
        images = ((stretches - self.input_mean) / self.input_scale)[:, self.permutations]
        hidden = torch.baddbmm(self.first_bias, images.reshape(1, -1, images.shape[2]).expand(members, -1, -1), self.first)
        if scene is not None:
            hidden = hidden + self._shift(scene).repeat_interleave(len(self.permutations), dim=1)
        hidden = torch.nn.functional.silu(hidden).reshape(members, n, -1)
        for weight, bias in self.layers:
            hidden = torch.nn.functional.silu(torch.baddbmm(bias, hidden, weight))
        return torch.baddbmm(self.last_bias, hidden, self.last)
