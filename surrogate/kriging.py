"""What the surrogate misses, from the stored hops around each point: any number of hops, a few neighbours at a time.

A net is smooth, the landing is not, on a scale below the distance between thousands of hops. So near a stored hop its answer
can be mended by what it missed there, and nothing else is known elsewhere: each point has a Gaussian process of its own over
the residuals of the nearest hops and their images (Rasmussen and Williams 2006, eqs. 2.23-2.24 and section 8.3), with the
Matérn kernel whose samples have one derivative (eq. 4.17), as the doubt about a landing grows in proportion to the way from a
stored hop. A planner that minimises the expected squared error then neither strays from the hops where the landing is rough,
nor clings to them where it is smooth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from surrogate.dataset import HopData
from surrogate.model import HopNet, one_thread
from tensegrity_gym.types import Floats

LENGTHS = (0.03, 0.05, 0.08, 0.12, 0.2, 0.4)  #: candidates of the length scale, in stretches
NEIGHBOURS = 24
#: Groups of points that are worked on together: all at once, a planner's pool of 100 000 would take 3 GB.
BLOCK = 2048
#: Least share of the variance that counts as noise, so that kernel matrices have inverses.
LEAST_NOISE = 1e-6
#: Least standard deviation far from all hops [m], where a net misses nothing.
LEAST_SIGMA = 1e-9
#: How often the noise of a length scale is found anew from the variance that it leads to.
PASSES = 3
#: Hops that the scale is chosen on, at most.
MOST_HELD = 1000


@dataclass(frozen=True)
class Scale:
    """Hyper-parameters of the processes."""

    length: float  #: in stretches
    noise: float  #: share of the variance that no stored hop explains
    sigma: float  #: standard deviation far from all hops, in each direction [m]
    log_loss: float  #: mean negative log-likelihood (up to a constant) of the hops that it was chosen on


class Kriging:
    """Stretches (n, n_actuators) to a shift of the landing (n, 2) [m] and its variance in each direction (n,) [m^2].

    Residuals (m, 2) [m] at stretches (m, n_actuators) are stored with their images under the symmetries, permutations
    (g, n_actuators) and signs (g, 2).
    """

    def __init__(self, stretches: Floats, residuals: Floats, permutations: np.ndarray, signs: np.ndarray, scale: Scale) -> None:
        self.permutations, self.signs, self.scale = permutations, signs, scale
        self.stretches = stretches[:, permutations].reshape(-1, stretches.shape[1])
        self.residuals = (residuals[:, None] * signs).reshape(-1, 2)
        self.tree = KDTree(self.stretches)

    def __call__(self, stretches: Tensor) -> tuple[Tensor, Tensor]:
        shift, share = self.shift(stretches.numpy().astype(np.float64))
        variance = self.scale.sigma**2 * (share + self.scale.noise)
        return torch.from_numpy(shift.astype(np.float32)), torch.from_numpy(variance.astype(np.float32))

    def shift(self, at: Floats) -> tuple[Floats, Floats]:
        """Expected residual (n, 2) [m] and the share of the variance that stays in doubt (n,), at stretches (n, n_actuators).

        Groups of close stretches (n, k, n_actuators) ask the neighbours of the first one, with shapes (n, k, 2) and (n, k).
        """
        groups = at.reshape(len(at), -1, at.shape[-1])
        blocks = [self._shift(groups[first : first + BLOCK]) for first in range(0, len(groups), BLOCK)]
        shift, share = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
        return shift.reshape(*at.shape[:-1], 2), share.reshape(at.shape[:-1])

    def _shift(self, groups: Floats) -> tuple[Floats, Floats]:
        """:meth:`shift` of groups (n, k, n_actuators)."""
        count = min(NEIGHBOURS, len(self.stretches))
        near = self.tree.query(groups[:, 0], count)[1].reshape(len(groups), count)
        points = self.stretches[near]  # (n, count, n_actuators)
        kernel = self._kernel(_distances(points, points))
        seen = self._kernel(_distances(points, groups))  # (n, count, k)
        weights = np.linalg.solve(kernel + self.scale.noise * np.eye(count), seen)
        return weights.swapaxes(1, 2) @ self.residuals[near], np.clip(1 - (weights * seen).sum(axis=1), 0, 1)

    def _kernel(self, distance: Floats) -> Floats:
        scaled = np.sqrt(3) * distance / self.scale.length
        return (1 + scaled) * np.exp(-scaled)


def _distances(points: Floats, others: Floats) -> Floats:
    """Between points (n, p, d) and others (n, q, d), shape (n, p, q)."""
    square = np.zeros((len(points), points.shape[1], others.shape[1]))
    for k in range(points.shape[2]):  # a few dimensions: a loop moves far less memory than their difference tensor
        square += (points[:, :, None, k] - others[:, None, :, k]) ** 2
    return np.sqrt(square)


def without_images(net: HopNet, data: HopData) -> HopData:
    """``data`` without stored images of hops, where ``net`` knows the symmetries, by which each hop gets its images back.

    Kept, they would be there once for each symmetry: neighbours of a point would be a quarter as many, and say so of none.
    """
    return data.rows(data["image"] == 0) if len(net.permutations) > 1 else data


@one_thread()
@torch.no_grad()
def fit_kriging(net: HopNet, data: HopData, validation: float, test: float, floor: float = 0.0) -> Kriging | None:
    """Choose the scale on the hops that training stopped on, then store all that training saw; None if there are too few.

    ``validation`` and ``test`` are the shares that the net was trained with, ``floor`` how far a landing moves, in each
    direction, when nothing but the unknowable changes [m].
    """
    data = without_images(net, data)
    stretches = data["stretches"]
    residuals = data["landing"] - net.landing(torch.from_numpy(stretches.astype(np.float32))).mean(dim=0).numpy()
    return fit_process(stretches, residuals, net.landing_images, data.split(validation, test), floor)


def fit_process(
    points: Floats, residuals: Floats, images: tuple[np.ndarray, np.ndarray], split: dict[str, np.ndarray], floor: float
) -> Kriging | None:
    """As :func:`fit_kriging`, of residuals (n, 2) [m] at any points (n, d), whose images are permutations and signs."""
    known, held = split["train"], split["validation"][:MOST_HELD]
    if len(known) < 2 or len(held) < 2:
        return None
    found, process = [], Kriging(points[known], residuals[known], *images, Scale(LENGTHS[0], LEAST_NOISE, 1.0, 0.0))
    for length in LENGTHS:
        sigma = max(float(np.sqrt(np.mean(residuals[held] ** 2))), LEAST_SIGMA)
        for _ in range(PASSES if floor else 1):  # what the floor is a share of is known only once it is taken into account
            noise = max(LEAST_NOISE, (floor / sigma) ** 2)
            process.scale = Scale(length, noise, 1.0, 0.0)
            shift, share = process.shift(points[held])
            share = share[:, None] + noise
            sigma = max(float(np.sqrt(((residuals[held] - shift) ** 2 / share).mean())), LEAST_SIGMA)  # the likeliest
        found.append(Scale(length, noise, sigma, float(np.log(sigma**2 * share).mean())))
    rows = np.sort(np.concatenate([known, split["validation"]]))
    return Kriging(points[rows], residuals[rows], *images, min(found, key=lambda scale: scale.log_loss))
