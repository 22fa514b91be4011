"""What the net misses, learnt from the stored hops themselves: exact where a hop is stored, doubtful far from all of them.

A net trained on a few hundred hops is smooth, the landing is not. The residuals of the stored hops, as a Gaussian process
over the stretches (Rasmussen and Williams 2006, eqs. 2.23-2.24), say near which of them its answer can be mended, and how
uncertain it is anywhere: a planner that minimises the expected squared error then neither strays from the hops where the
landing is rough, nor clings to them where it is smooth.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from torch import Tensor

from surrogate.dataset import HopData
from surrogate.model import HopNet, one_thread

LENGTHS = (0.02, 0.04, 0.08, 0.15, 0.3)  #: candidates of the length scale, in stretches
NOISES = (1e-3, 1e-2, 1e-1)  #: candidates of the noise's share of the variance
MOST_HOPS = 512  #: more hops would make the process slower than the net is worth


@dataclass(frozen=True)
class Scale:
    """Hyper-parameters of the process."""

    length: float  #: in stretches
    noise: float  #: share of the variance that no stored hop explains
    sigma: float  #: standard deviation far from all hops [m]
    log_loss: float  #: mean negative log-likelihood (up to a constant) of the hops that it was chosen on


class LocalCorrection:
    """Gaussian process over residual landings: stretches (n, n_actuators) to shift (n, 2) [m] and variance (n,) [m^2].

    Residuals and their images under the net's symmetries are all stored, so the corrected net is as equivariant as it.
    """

    def __init__(self, net: HopNet, stretches: Tensor, residuals: Tensor, length: float, noise: float, sigma: float) -> None:
        images = stretches[:, net.permutations]  # (n, g, n_actuators)
        self.stretches = images.reshape(-1, images.shape[-1])
        shifts = (residuals[:, None] * net.signs[:, :2]).reshape(-1, 2).double()
        self.length, self.sigma = length, sigma
        # in double precision: the kernel matrix of near neighbours is nearly singular
        kernel = self._kernel(self.stretches.double(), self.stretches.double())
        inverse = torch.linalg.inv(kernel + noise * torch.eye(len(kernel), dtype=torch.float64))
        self.weights, self.inverse = (inverse @ shifts).float(), inverse.float()

    def _kernel(self, first: Tensor, second: Tensor) -> Tensor:
        distance = (first**2).sum(dim=1)[:, None] + (second**2).sum(dim=1) - 2 * first @ second.T
        return torch.exp(-0.5 * distance.clamp(min=0) / self.length**2)

    def __call__(self, stretches: Tensor) -> tuple[Tensor, Tensor]:
        near = self._kernel(stretches, self.stretches)
        variance = self.sigma**2 * (1 - ((near @ self.inverse) * near).sum(dim=1)).clamp(min=0)
        return near @ self.weights, variance


@one_thread()
@torch.no_grad()
def fit_correction(net: HopNet, data: HopData, validation: float, test: float) -> tuple[LocalCorrection, Scale] | None:
    """Choose the scale on the hops that training stopped on, then store all that training saw; None if there are too few.

    ``validation`` and ``test`` are the shares that the net was trained with. Hops beyond ``MOST_HOPS`` are left out.
    """
    split = data.split(validation, test)
    train_rows, validation_rows = split["train"][:MOST_HOPS], split["validation"][:MOST_HOPS]
    if len(train_rows) < 2 or len(validation_rows) < 2:
        return None
    stretches = torch.from_numpy(data["stretches"].astype(np.float32))
    residuals = torch.from_numpy(data["landing"].astype(np.float32)) - net.landing(stretches).mean(dim=0)
    found = []
    for length, noise in product(LENGTHS, NOISES):
        process = LocalCorrection(net, stretches[train_rows], residuals[train_rows], length, noise, 1.0)
        shift, variance = process(stretches[validation_rows])
        share = variance[:, None] + noise
        sigma = torch.sqrt(((residuals[validation_rows] - shift) ** 2 / share).mean())  # the likeliest, in closed form
        found.append(Scale(length, noise, float(sigma), float(torch.log(sigma**2 * share).mean())))
    best = min(found, key=lambda scale: scale.log_loss)
    rows = np.sort(np.concatenate([train_rows, validation_rows]))[:MOST_HOPS]
    return LocalCorrection(net, stretches[rows], residuals[rows], best.length, best.noise, best.sigma), best
