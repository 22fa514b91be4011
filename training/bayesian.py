"""Composite Bayesian optimisation of an answer by BoTorch: a few simulator calls, each where improvement is most expected.

Where a hop lands is two numbers, of which the landing error is a known function; so a Gaussian process models the numbers and the
expected improvement is taken of the error (Astudillo and Frazier 2019, arXiv:1906.01537), in BoTorch's logarithmic form (Ament
et al. 2023, arXiv:2310.20708). The process is local, of what the surrogate misses at the stored hops about the plan and at the
hops simulated for the answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from surrogate.model import one_thread
from tensegrity_gym import STRETCH_RANGE
from tensegrity_gym.errors import InvalidParameterError, MissingExtraError
from tensegrity_gym.types import Floats
from training.inverse import InversePlanner
from training.planner import Land, Prediction, targets_of


@dataclass(frozen=True)
class BayesianConfig:
    """The process about a plan, and the search for the next hop."""

    neighbours: int = 150
    """Stored hops that the process is of."""
    length: float = 0.1
    """Length scale of the process, in stretches. Not fitted: a thousand stored hops lie too far apart to tell it, and the
    likeliest lengths about a plan come out anywhere from 0.01 to 40; from ten thousand, near 0.06, which lands no nearer."""
    noise: float = 2e-4
    """Standard deviation of a landing about the process, in each direction [m]."""
    radius: float = 0.1
    """Hops are looked for in a box this far about the best so far, in stretches."""
    candidates: int = 64
    """Stretches that the acquisition chooses from."""
    pulls: int = 3
    """Newton steps that pull a candidate to where the process expects the target."""
    samples: int = 128
    """Draws of the process that the expected improvement is a mean over."""
    seed: int = 0
    """Seed of candidates and draws."""

    def __post_init__(self) -> None:
        for name in ("neighbours", "candidates", "samples"):
            if getattr(self, name) < 1:
                raise InvalidParameterError(f"{name}: expected an integer >= 1, got {getattr(self, name)}")
        for name in ("length", "noise", "radius"):
            if not getattr(self, name) > 0:
                raise InvalidParameterError(f"{name}: expected a number > 0, got {getattr(self, name)}")


def require_botorch() -> None:
    """MissingExtraError where BoTorch is not installed."""
    if find_spec("botorch") is None:
        raise MissingExtraError(
            "Bayesian optimisation: expected botorch to be installed, it is not; pip install 'tensegrity-gym[botorch]'"
        )


class BayesianPlanner:
    """Answer with the best of ``tries`` hops: the plan, then each where the error is most expected to improve.

    Args:
        stretches: of the stored hops, shape (m, n_actuators).
        landings: of the stored hops, none of which failed, shape (m, 2) [m].
    """

    def __init__(
        self,
        inverse: InversePlanner,
        land: Land,
        stretches: Floats,
        landings: Floats,
        tries: int = 8,
        config: BayesianConfig | None = None,
    ) -> None:
        require_botorch()
        if tries < 1:
            raise InvalidParameterError(f"tries: expected an integer >= 1, got {tries}")
        if len(stretches) == 0 or len(stretches) != len(landings):
            raise InvalidParameterError(
                f"expected as many stretches as landings, at least one, got {len(stretches)} and {len(landings)}"
            )
        self.inverse, self.land, self.tries, self.config = inverse, land, tries, config or BayesianConfig()
        self.stretches, self.landings = np.asarray(stretches, dtype=np.float64), np.asarray(landings, dtype=np.float64)
        self.tree = KDTree(self.stretches)
        #: Hops simulated for answers so far.
        self.simulator_calls = 0

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Prediction:
        """Targets (2,) or (n, 2) [m] to stretches (4,) or (n, 4); each costs ``tries`` simulator calls."""
        targets = targets_of(observation)
        plans = self.inverse.plan(targets).stretches
        asked, came = plans[:, None], np.empty((len(targets), 0, 2))
        while True:  # hops of all targets side by side, so that they form batches
            came = np.concatenate([came, np.asarray(self.land(asked[:, -1]), dtype=np.float64)[:, None]], axis=1)
            self.simulator_calls += len(targets)
            if came.shape[1] == self.tries:
                break
            following = np.array([self._next(*each) for each in zip(targets, asked, came, strict=True)])
            asked = np.concatenate([asked, following[:, None]], axis=1)
        error = np.linalg.norm(came - targets[:, None], axis=2)
        best = np.where(np.isfinite(error), error, np.inf).argmin(axis=1)
        answers = asked[np.arange(len(targets)), best]
        return (answers[0] if np.ndim(observation) == 1 else answers), state

    @one_thread()
    def _next(self, target: Floats, asked: Floats, came: Floats) -> Floats:
        """The hop to simulate (n_actuators,) after those ``asked`` (k, n_actuators) came down at (k, 2) [m], the plan first."""
        from botorch.optim import optimize_acqf_discrete

        config, flew = self.config, np.isfinite(came).all(axis=1)
        near = np.atleast_1d(self.tree.query(asked[0], min(config.neighbours, len(self.stretches)))[1])
        if not flew.any():  # half the way to the stored hop nearest to the plan, which did fly
            return 0.5 * (asked[-1] + self.stretches[near[0]])
        known = torch.from_numpy(np.concatenate([self.stretches[near], asked[flew]]))
        landings = torch.from_numpy(np.concatenate([self.landings[near], came[flew]]))
        goal, failed = torch.from_numpy(target), torch.from_numpy(asked[~flew])
        error = torch.linalg.norm(landings[len(near) :] - goal, dim=1)
        process = _Process(self.inverse, known, landings, len(near), config)
        choices = self._candidates(process, known[len(near) + error.argmin()], goal, len(asked))
        if len(failed):  # hops nearer to a failed one than to any that flew are taken to fail
            margin = torch.cdist(choices, failed).min(dim=1).values - torch.cdist(choices, known).min(dim=1).values
            choices = choices[margin > 0] if (margin > 0).any() else choices[margin.argmax()][None]
        acquisition = process.improvement(goal, float(error.min()))
        return optimize_acqf_discrete(acquisition, q=1, choices=choices)[0][0].numpy()

    def _candidates(self, process: _Process, best: Tensor, goal: Tensor, number: int) -> Tensor:
        """Stretches (candidates, n_actuators) from all over the box to close by the best, pulled towards the goal.

        Improvement is to be expected only in a thin sheet of the box, which a search by the acquisition's own slope, flat
        elsewhere, mostly fails to meet.
        """
        count, radius = self.config.candidates, self.config.radius
        low, high = (best - radius).clamp(*STRETCH_RANGE), (best + radius).clamp(*STRETCH_RANGE)
        engine = torch.quasirandom.SobolEngine(len(best), scramble=True, seed=self.config.seed + number)
        spread = low + (high - low) * engine.draw(count, dtype=torch.float64)
        at = best + torch.logspace(0, -2, count, dtype=torch.float64)[:, None] * (spread - best)
        for _ in range(self.config.pulls):
            landings, slope = process.expected(at)
            free = torch.ones_like(at, dtype=torch.bool)
            for _ in range(at.shape[1]):  # stretches at the side of the box that would leave it are held
                step = (torch.linalg.pinv(slope * free[:, None], rtol=1e-3) @ (goal - landings)[..., None])[..., 0]
                leaving = free & (((at <= low) & (step < 0)) | ((at >= high) & (step > 0)))
                if not leaving.any():
                    break
                free &= ~leaving
            at = (at + step).clamp(low, high)
        return at


class _Process:
    """Gaussian process of what the surrogate misses, two independent directions with one kernel, in units of its spread.

    Args:
        known: stretches of hops (m, n_actuators), of which the first ``stored`` tell the spread.
        landings: where they came down (m, 2) [m].
    """

    def __init__(self, inverse: InversePlanner, known: Tensor, landings: Tensor, stored: int, config: BayesianConfig) -> None:
        from botorch.models import SingleTaskGP
        from gpytorch.kernels import MaternKernel
        from gpytorch.means import ZeroMean

        self.inverse, self.config = inverse, config
        with torch.no_grad():
            missed = landings - self._surrogate(known)
        # a surrogate that misses nothing would leave no unit
        self.unit = max(float((missed[:stored] ** 2).mean().sqrt()), config.noise)
        directions = torch.Size([2])
        kernel = MaternKernel(nu=1.5, batch_shape=directions)
        kernel.lengthscale = config.length
        noise = torch.full_like(missed, (config.noise / self.unit) ** 2)
        self.model = SingleTaskGP(
            known, missed / self.unit, noise, covar_module=kernel, mean_module=ZeroMean(directions), outcome_transform=None
        ).eval()

    def _surrogate(self, stretches: Tensor) -> Tensor:
        """The ensemble's mean landing (..., 2) [m] at stretches (..., n_actuators)."""
        seen = self.inverse.landing(stretches.reshape(-1, stretches.shape[-1]).float()).mean(dim=0)
        return seen.double().reshape(*stretches.shape[:-1], 2)

    def expected(self, at: Tensor) -> tuple[Tensor, Tensor]:
        """Landings (n, 2) [m] and how they change with the stretches (n, 2, n_actuators) [m], at stretches (n, n_actuators)."""
        at = at.detach().requires_grad_()
        landings = self.unit * self.model.posterior(at[:, None]).mean[:, 0] + self._surrogate(at)
        slope = [torch.autograd.grad(landings[:, k].sum(), at, retain_graph=k == 0)[0] for k in range(2)]
        return landings.detach(), torch.stack(slope, dim=1)

    def improvement(self, goal: Tensor, least: float) -> Any:
        """Logarithm (n,) of the improvement expected on the error ``least`` [m], a function of stretches (n, 1, n_actuators)."""
        from botorch.acquisition import qLogExpectedImprovement
        from botorch.acquisition.objective import GenericMCObjective
        from botorch.sampling import SobolQMCNormalSampler

        def nearness(samples: Tensor, X: Tensor | None = None) -> Tensor:  # BoTorch passes X by this name
            assert X is not None
            return -torch.linalg.norm(samples + (self._surrogate(X) - goal) / self.unit, dim=-1)

        sampler = SobolQMCNormalSampler(torch.Size([self.config.samples]), seed=self.config.seed)
        return qLogExpectedImprovement(self.model, -least / self.unit, sampler, GenericMCObjective(nearness))
