"""Inversion of a learned map from many starts: which stretches does the surrogate expect to land on the target?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from surrogate.generate import sample_stretches
from surrogate.model import one_thread
from tensegrity_gym import STRETCH_RANGE
from tensegrity_gym.errors import InvalidParameterError
from training.planner import Images, Prediction, targets_of

#: Longest first step in one stretch, from hops towards the target: what is farther away tells little of it [-].
LONGEST_AIM = 0.05
#: Added to the variance under the root, so that its derivative exists where it is zero [m^2].
LEAST_VARIANCE = 1e-10
#: Step of the differences that derivatives are taken by [-].
DIFFERENCE = 1e-3
#: Expected errors closer than this are the same: a tenth of the floor of a touchdown on Earth [m].
LEAST_EQUAL = 3e-5
#: To add to the seed of the starts where hops may have been drawn with that seed: they are points of the same sequence, and
#: starts already.
START_SEED = 2_000_003
#: Proposals differ in some stretch by at least this [-].
DISTINCT = 0.01
#: Targets whose starts are chosen together: what is compared, targets times points of the pool, must fit into memory, and is
#: 100 MB where 100 000 hops and their images are points.
BLOCK = 64


@dataclass(frozen=True)
class InverseConfig:
    """Levenberg-Marquardt through the surrogate from many starts."""

    pool: int = 4096
    """Spread-out stretches that the starts are chosen from."""
    aims: int = 64
    """Points of the pool that a first step is taken from, straight to the target: the best ends of these are the starts."""
    starts: int = 12
    """Descents per target."""
    steps: int = 12
    """Steps per descent."""
    damping: float = 1e-4
    """Damping at the first step, as a share of the squared reach of the pool; it falls with every step that helps."""
    equal: float = 0.05
    """Answers whose expected error is above the least by no more than this share of it, or by ``LEAST_EQUAL``, count as equals,
    among which the least energy wins [-]."""
    miss: float = 0.01
    """A target is called unreachable if the landing expected nearest to it is farther away than this [m], and than its doubt."""

    def __post_init__(self) -> None:
        for name in ("pool", "aims", "starts", "steps"):
            if getattr(self, name) < 1:
                raise InvalidParameterError(f"{name}: expected an integer >= 1, got {getattr(self, name)}")


class Plans(NamedTuple):
    """Answers to n targets."""

    stretches: np.ndarray  #: shape (n, n_actuators) [-]
    landings: np.ndarray  #: expected, mean over the members, shape (n, 2) [m]
    errors: np.ndarray  #: expected, root mean square over members and scatter, shape (n,) [m]
    reachable: np.ndarray  #: False where ``landings`` is only the nearest landing known, see ``InverseConfig.miss``, shape (n,)


class InversePlanner:
    """Find the stretches whose expected squared landing error is least.

    The expected square is that of the mean landing's distance to the target plus the variance: the members' spread or, with
    a ``correction``, the doubt that distance from the stored hops brings. So among the many stretches that reach a
    target, a surface in the box, it takes those that it is surest of. Both are residuals of one least-squares problem,
    solved by Levenberg-Marquardt steps; stretches at the end of their range that would leave it are held there for the
    step, so that answers on the box's boundary are reached.

    A stored hop is where doubt is least, the tip of a cone, which no descent leaves for a target beside it. So first a step is
    taken from each of many hops and points of the pool that heeds the landing alone; descents begin where that ended best.

    Args:
        landing: stretches, shape (n, n_actuators), to landings as each member sees them, shape (members, n, 2) [m].
        correction: stretches to a shift of the landing, shape (n, 2) [m], and a variance, shape (n,) [m^2] a direction; or
            groups of close stretches (n, k, n_actuators) to (n, k, 2) and (n, k).
        energy: stretches to the energy that they store, shape (n,) [J]: chooses among equals.
        stored: stretches to start from besides the spread-out ones, shape (m, n_actuators).
        images: symmetries that ``landing`` and ``correction`` have: it starts from the images of all these as well.
    """

    def __init__(
        self,
        landing: Callable[[Tensor], Tensor],
        config: InverseConfig | None = None,
        *,
        correction: Callable[[Tensor], tuple[Tensor, Tensor]] | None = None,
        energy: Callable[[np.ndarray], np.ndarray] | None = None,
        stored: np.ndarray | None = None,
        images: Images | None = None,
        n_actuators: int = 4,
        seed: int = 0,
    ) -> None:
        self.landing, self.correction, self.energy = landing, correction, energy
        self.config = config or InverseConfig()
        pool = sample_stretches(self.config.pool, seed, n_actuators)
        self.pool = torch.from_numpy((pool if stored is None else np.concatenate([pool, stored])).astype(np.float32))
        with torch.no_grad():
            self.pool_seen = self.see(self.pool)
        if images is not None:  # what is seen of an image is the image of what is seen
            permutations, signs = (torch.from_numpy(np.asarray(a)) for a in images)
            mean, variance = self.pool_seen
            self.pool = self.pool[:, permutations].reshape(-1, n_actuators)
            self.pool_seen = (mean[:, None] * signs.to(mean)).reshape(-1, 2), variance.repeat_interleave(len(permutations))
        self.scale = float((self.pool_seen[0] ** 2).sum(dim=1).quantile(0.95)) or 1.0  # squared reach [m^2]

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Targets (2,) or (n, 2) [m] to stretches (4,) or (n, 4); unreachable ones get the nearest landing it knows."""
        stretches = self.plan(targets_of(observation)).stretches
        return (stretches[0] if np.ndim(observation) == 1 else stretches), state

    @one_thread()
    @torch.no_grad()
    def plan(self, targets: np.ndarray) -> Plans:
        """Answers to targets (n, 2) [m], with what is expected of them."""
        goal = torch.from_numpy(targets_of(targets).astype(np.float32))
        found, cost = self._search(goal, self.config.starts)
        best = cost.argmin(dim=1) if self.energy is None else self._least_energy(found, cost)
        rows = torch.arange(len(best))
        landings, variance = self.see(found[rows, best])
        nearest = torch.linalg.norm(landings - goal, dim=1)
        errors = torch.sqrt(cost[rows, best])
        # in great doubt it stays a little away from the target, where it is surer: that tells nothing of what can be reached
        reachable = nearest <= torch.sqrt(variance).clamp(min=self.config.miss)
        return Plans(_in_range(found[rows, best]), landings.numpy(), errors.numpy(), reachable.numpy())

    def propose(self, targets: np.ndarray, count: int) -> np.ndarray:
        """``count`` different answers to each target (n, 2) [m], best first, shape (n, count, n_actuators).

        Where descents end in fewer different places, the last ones repeat the best.
        """
        goal = torch.from_numpy(targets_of(targets).astype(np.float32))
        found, cost = self._search(goal, max(self.config.starts, 2 * count))
        order = cost.argsort(dim=1)
        found = torch.gather(found, 1, order[..., None].expand_as(found))
        return np.stack([_distinct(row, count) for row in _in_range(found)])

    @one_thread()
    @torch.no_grad()
    def slope(self, stretches: np.ndarray) -> np.ndarray:
        """How the expected landing changes with the stretches (n, n_actuators), shape (n, 2, n_actuators) [m]."""
        return self._seen(torch.from_numpy(np.asarray(stretches, dtype=np.float32)))[1][:, :2].numpy().astype(np.float64)

    def see(self, stretches: Tensor) -> tuple[Tensor, Tensor]:
        """Mean landing (n, 2) [m] and its variance, both directions added (n,) [m^2], at stretches (n, n_actuators).

        Stretches may come in groups of close ones, (n, k, n_actuators); shapes are then (n, k, 2) and (n, k).
        """
        landings = self.landing(stretches.reshape(-1, stretches.shape[-1]))
        landings = landings.reshape(len(landings), *stretches.shape[:-1], 2)
        mean = landings.mean(dim=0)
        if self.correction is None:
            return mean, ((landings - mean) ** 2).sum(dim=-1).mean(dim=0)
        shift, doubt = self.correction(stretches)
        return mean + shift, 2 * doubt

    def _search(self, goal: Tensor, starts: int) -> tuple[Tensor, Tensor]:
        """Ends of the descents (n, starts, n_actuators) and their expected squares (n, starts) [m^2]."""
        parts = [self._search_block(block, starts) for block in goal.split(BLOCK)]
        found, cost = (torch.cat(part) for part in zip(*parts, strict=True))
        return found, cost

    @one_thread()
    @torch.no_grad()
    def _search_block(self, goal: Tensor, starts: int) -> tuple[Tensor, Tensor]:
        mean, variance = self.pool_seen
        aims = min(max(self.config.aims, starts), len(self.pool))
        first = (torch.cdist(goal, mean) ** 2 + variance).topk(aims, largest=False).indices
        found, cost = self._aim(self.pool[first].reshape(len(goal) * aims, -1), goal.repeat_interleave(aims, dim=0))
        found = found.reshape(len(goal), aims, -1)
        best = cost.reshape(len(goal), aims).topk(min(starts, aims), largest=False).indices
        found = torch.gather(found, 1, best[..., None].expand(-1, -1, found.shape[2]))
        n, starts, _ = found.shape
        stretches, cost = self._descend(found.reshape(n * starts, -1), goal.repeat_interleave(starts, dim=0))
        return stretches.reshape(n, starts, -1), cost.reshape(n, starts)

    def _aim(self, start: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """One step straight to the goal, whatever the doubt there, or none where that is worse; and the expected square."""
        residual, slope = self._residual(start, goal)
        damping = torch.full((len(start),), self.config.damping * self.scale)
        step = _step(start, residual[:, :2], slope[:, :2], damping)
        longest = step.abs().amax(dim=1, keepdim=True).clamp(min=LONGEST_AIM)
        aimed = (start + step * (LONGEST_AIM / longest)).clamp(*STRETCH_RANGE)
        cost, aimed_cost = (residual**2).sum(dim=1), self._cost(aimed, goal)
        better = aimed_cost < cost
        return torch.where(better[:, None], aimed, start), torch.where(better, aimed_cost, cost)

    def _descend(self, best: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        residual, slope = self._residual(best, goal)
        cost = (residual**2).sum(dim=1)
        damping = torch.full_like(cost, self.config.damping * self.scale)
        for _ in range(self.config.steps):
            tried = (best + _step(best, residual, slope, damping)).clamp(*STRETCH_RANGE)
            tried_residual, tried_slope = self._residual(tried, goal)
            tried_cost = (tried_residual**2).sum(dim=1)
            better = tried_cost < cost
            best, cost = torch.where(better[:, None], tried, best), torch.where(better, tried_cost, cost)
            residual = torch.where(better[:, None], tried_residual, residual)
            slope = torch.where(better[:, None, None], tried_slope, slope)
            damping = torch.where(better, damping / 8, damping * 4)
        return best, cost

    def _cost(self, stretches: Tensor, goal: Tensor) -> Tensor:
        """Expected square of the landing error (n,) [m^2]."""
        mean, variance = self.see(stretches)
        return ((mean - goal) ** 2).sum(dim=1) + variance

    def _residual(self, stretches: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Landing minus goal and the root of the variance, (n, 3) [m], and their derivatives, (n, 3, n_actuators) [m]."""
        seen, slope = self._seen(stretches)
        return seen - nn.functional.pad(goal, (0, 1)), slope

    def _seen(self, stretches: Tensor) -> tuple[Tensor, Tensor]:
        """Landing and the root of the variance, (n, 3) [m], and their derivatives, (n, 3, n_actuators) [m].

        Differences along each stretch, towards the middle of its range, all in one pass of the net: for nets this small a
        pass costs more for being one than for what is in it, and derivatives need not be exact to lead to an exact end.
        """
        step = torch.where(stretches < sum(STRETCH_RANGE) / 2, DIFFERENCE, -DIFFERENCE)  # (n, n_actuators)
        points = torch.cat([stretches[:, None], stretches[:, None] + torch.diag_embed(step)], dim=1)
        mean, variance = self.see(points)
        seen = torch.cat([mean, torch.sqrt(variance + LEAST_VARIANCE)[..., None]], dim=2)
        slope = (seen[:, 1:] - seen[:, :1]) / step[..., None]
        return seen[:, 0], slope.mT

    def _least_energy(self, found: Tensor, cost: Tensor) -> Tensor:
        assert self.energy is not None
        energies = torch.from_numpy(self.energy(_in_range(found).reshape(-1, found.shape[2]))).reshape(cost.shape)
        error = torch.sqrt(cost)
        least = error.min(dim=1, keepdim=True).values
        equals = error <= torch.maximum((1 + self.config.equal) * least, least + LEAST_EQUAL)
        return torch.where(equals, energies, torch.inf).argmin(dim=1)


def _step(at: Tensor, residual: Tensor, slope: Tensor, damping: Tensor) -> Tensor:
    """Damped Gauss-Newton steps (n, n_actuators) of k residuals (n, k) with slopes (n, k, n_actuators)."""
    low, high = STRETCH_RANGE
    downhill = -(slope * residual[..., None]).sum(dim=1)  # (n, n_actuators)
    held = ((at <= low) & (downhill < 0)) | ((at >= high) & (downhill > 0))
    free = slope.masked_fill(held[:, None], 0.0)
    # (J'J + d I)^-1 J' = J' (J J' + d I)^-1, and the latter is but k by k
    system = free @ free.mT + damping[:, None, None] * torch.eye(residual.shape[1])
    solved, singular = torch.linalg.solve_ex(system, residual[..., None])
    # both directions may run alike, and the damping have fallen below rounding: stay, and damp more
    solved = solved.masked_fill(singular[:, None, None] != 0, 0.0)
    return -(free.mT @ solved)[..., 0]


def _in_range(stretches: Tensor) -> np.ndarray:
    # float32 cannot hold 0.2 and 0.8: cut the overshoot off
    return np.clip(stretches.numpy().astype(np.float64), *STRETCH_RANGE)


def _distinct(found: np.ndarray, count: int) -> np.ndarray:
    """The first ``count`` rows that differ from those before them; filled up with the first."""
    chosen = [found[0]]
    for row in found[1:]:
        if len(chosen) < count and min(np.abs(row - c).max() for c in chosen) >= DISTINCT:
            chosen.append(row)
    return np.stack(chosen + [found[0]] * (count - len(chosen)))


def fit_energy(stretches: np.ndarray, energies: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Stored energy as a quadratic of the stretches, fitted by least squares: (m, n_actuators) and (m,) [J] to a function."""

    def features(at: np.ndarray) -> np.ndarray:
        upper = np.triu_indices(at.shape[1])
        return np.concatenate([np.ones((len(at), 1)), at, (at[:, :, None] * at[:, None])[:, upper[0], upper[1]]], axis=1)

    weights = np.linalg.lstsq(features(np.asarray(stretches)), np.asarray(energies), rcond=None)[0]
    return lambda at: features(at) @ weights
