"""A trained surrogate reduced to what a planner asks of it: the landing alone, with all that is fixed worked out once."""

from __future__ import annotations

import torch
from torch import Tensor

from surrogate.model import HopNet
from tensegrity_gym.errors import InvalidParameterError


class FrozenLanding:
    """As ``net.landing`` to rounding: stretches (n, n_actuators) to landings as each member sees them, (members, n, 2) [m].

    The net's layers commute with the symmetries because each is made, at every pass, of a few blocks repeated and permuted.
    Here they are plain matrices, and the last one gives the two numbers that are asked for.
    """

    @torch.no_grad()
    def __init__(self, net: HopNet) -> None:
        if net.scene_names:
            raise InvalidParameterError(f"net: expected one of a single scene, got one that is told {list(net.scene_names)}")
        self.permutations, self.input_mean, self.input_scale = net.permutations, net.input_mean, net.input_scale
        self.first, self.first_bias = net.weights[0].detach(), net.biases[0].detach()
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

    def __call__(self, stretches: Tensor) -> Tensor:
        n, members = len(stretches), len(self.first)
        images = ((stretches - self.input_mean) / self.input_scale)[:, self.permutations]
        hidden = torch.baddbmm(self.first_bias, images.reshape(1, -1, images.shape[2]).expand(members, -1, -1), self.first)
        hidden = torch.nn.functional.silu(hidden).reshape(members, n, -1)
        for weight, bias in self.layers:
            hidden = torch.nn.functional.silu(torch.baddbmm(bias, hidden, weight))
        return torch.baddbmm(self.last_bias, hidden, self.last)
