"""Gradient descent that can be stopped at any moment and goes on with the same bits: one object, one file."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from surrogate.model import HopNet
from surrogate.storage import ensure_folder, read_sealed, write_sealed
from tensegrity_gym.errors import DataFileError

if TYPE_CHECKING:
    from surrogate.train import TrainConfig

SAVE_SECONDS = 10.0  #: between two savings of a training
MOMENTS = ("step", "exp_avg", "exp_avg_sq")  #: what AdamW remembers of each parameter


class Rows(NamedTuple):
    """What the net learns from, hops first."""

    stretches: Tensor  #: (n, n_actuators)
    scene: Tensor  #: varied scene values, (n, k) [SI]
    targets: Tensor  #: (n, 9) [units of OUTPUTS], not-a-number where a hop has none

    def of(self, which: Tensor) -> Rows:
        """Some of the hops."""
        return Rows(*(values[which] for values in self))


class Descent:
    """AdamW along a cosine on the beta-NLL of the members, keeping the weights of the least validation error."""

    def __init__(self, net: HopNet, rows: Rows, train: np.ndarray, validation: np.ndarray, config: TrainConfig) -> None:
        self.net, self.rows, self.config, self.train = net, rows, config, train
        self.held_back = rows.of(torch.from_numpy(validation).to(rows.targets.device))
        self.optimiser = torch.optim.AdamW(net.parameters(), lr=config.lr, weight_decay=config.weight_decay)
        per_epoch = -(-len(train) // config.batch)
        self.epochs = max(1, min(config.epochs, config.steps // per_epoch))
        self.epoch = self.best_epoch = 0
        self.best = self.error = float("inf")
        self.best_state = self._weights()
        self.started = self.saved = time.perf_counter()
        self.before = 0.0  # seconds that earlier runs took

    @property
    def rate(self) -> float:
        """Learning rate of the epoch that comes next."""
        share = self.epoch / self.epochs
        return self.config.lr * (0.01 + 0.99 * 0.5 * (1 + float(np.cos(np.pi * share))))

    def run_epoch(self) -> float:
        """One pass over the training hops, in an order that seed and epoch decide; returns its mean loss."""
        order = np.random.default_rng([self.config.seed, self.epoch]).permutation(self.train)
        for group in self.optimiser.param_groups:
            group["lr"] = self.rate
        total = 0.0
        for first in range(0, len(order), self.config.batch):
            batch = self.rows.of(torch.from_numpy(order[first : first + self.config.batch]).to(self.rows.targets.device))
            self.optimiser.zero_grad()
            loss = beta_nll(self.net, batch, self.config.beta)
            loss.backward()
            self.optimiser.step()
            total += float(loss.detach()) * len(batch.targets)
        self.epoch += 1
        self.error = validation_error(self.net, self.held_back)
        if self.error < self.best:
            self.best, self.best_epoch, self.best_state = self.error, self.epoch, self._weights()
        return total / len(order)

    def finish(self) -> None:
        """Put the best weights into the net."""
        self.net.load_state_dict(self.best_state)
        self.net.eval()

    def _weights(self) -> dict[str, Tensor]:
        return {name: value.detach().clone() for name, value in self.net.state_dict().items()}

    def save_at_times(self, path: Path, fingerprint: str) -> None:
        """As :meth:`save`, where the last time is some seconds ago."""
        if time.perf_counter() - self.saved > SAVE_SECONDS:
            self.save(path, fingerprint)

    def save(self, path: Path, fingerprint: str) -> None:
        """Write all that the next epoch depends on, in one sealed file, by a rename."""
        ensure_folder(path.parent)
        tensors = {f"net/{name}": value for name, value in self.net.state_dict().items()}
        tensors |= {f"best/{name}": value for name, value in self.best_state.items()}
        for k, parameter in enumerate(self.net.parameters()):
            tensors |= {f"{name}/{k}": self.optimiser.state[parameter][name] for name in MOMENTS}
        self.saved = time.perf_counter()
        numbers = {
            "epoch": self.epoch,
            "best_epoch": self.best_epoch,
            "best": self.best.hex(),
            "seconds": self.before + self.saved - self.started,
        }
        metadata = {"fingerprint": fingerprint, **{name: str(value) for name, value in numbers.items()}}
        content = save_tensors({name: value.detach().cpu().contiguous() for name, value in tensors.items()}, metadata)
        write_sealed(path, content)

    def resume(self, path: Path | None, fingerprint: str) -> float:
        """Go on from a saved training of the same data and settings; returns the seconds it had taken, 0 without one.

        A file of another training is left to be overwritten; DataFileError for a damaged one.
        """
        if path is None or not path.exists():
            return 0.0
        content = read_sealed(path)
        try:
            kept = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])["__metadata__"]
            if kept["fingerprint"] != fingerprint:
                return 0.0
            self._take(load_tensors(content))
            self.epoch, self.best_epoch = int(kept["epoch"]), int(kept["best_epoch"])
            self.best, self.before = float.fromhex(kept["best"]), float(kept["seconds"])
        except (KeyError, TypeError, ValueError, RuntimeError, SafetensorError) as error:
            raise DataFileError(f"{path}: expected a saved training ({error!r}); delete it to start anew") from error
        return self.before

    def _take(self, tensors: dict[str, Tensor]) -> None:
        def part(name: str) -> dict[str, Tensor]:
            return {k.split("/", 1)[1]: v for k, v in tensors.items() if k.startswith(name + "/")}

        self.net.load_state_dict(part("net"))
        device = self.rows.targets.device
        self.best_state = {name: value.to(device) for name, value in part("best").items()}
        moments = {name: part(name) for name in MOMENTS}
        count = len(list(self.net.parameters()))
        state = {k: {name: moments[name][str(k)] for name in MOMENTS} for k in range(count)}
        self.optimiser.load_state_dict({"state": state, "param_groups": self.optimiser.state_dict()["param_groups"]})


def beta_nll(net: HopNet, rows: Rows, beta: float) -> Tensor:
    """Mean over members and known outputs of the beta-NLL, v^beta (e^2/v + log v) / 2 with no gradient through v^beta.

    Seitzer et al. 2022, eq. 5; e and v in units of each output's spread.
    """
    mean, log_variance = net.heads(rows.stretches, rows.scene)
    wanted = (rows.targets - net.output_mean) / net.output_scale
    known = torch.isfinite(wanted)
    error = torch.where(known, mean - torch.nan_to_num(wanted), 0.0)
    weight = torch.exp(beta * log_variance.detach())
    loss = torch.where(known, weight * (error**2 * torch.exp(-log_variance) + log_variance), 0.0)
    return loss.sum() / (2 * known.sum().clamp(min=1) * net.config.members)


@torch.no_grad()
def validation_error(net: HopNet, rows: Rows) -> float:
    """Geometric mean over outputs of the ensemble's RMSE in units of their spread.

    Each output counts alike, however little of it can be known; those that no hop has do not count. Infinite where the net says
    of a known target what is no finite number: such weights are never the best.
    """
    square = ((net(rows.stretches, rows.scene).mean(dim=0) - rows.targets) / net.output_scale) ** 2
    known = torch.isfinite(rows.targets)
    if not torch.isfinite(square[known]).all():
        return float("inf")
    mean = torch.nanmean(torch.where(known, square, torch.nan), dim=0)[known.any(dim=0)]
    return float(torch.exp(0.5 * torch.log(mean.clamp(min=1e-12)).mean())) if len(mean) else 0.0
