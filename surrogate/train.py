"""Train the surrogate on a file of hops, with early stopping on held-back hops."""

from __future__ import annotations

import copy
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from torch import Tensor
from tqdm import tqdm

from surrogate import dataset, model
from surrogate.dataset import HopData
from surrogate.evaluate import rmse
from surrogate.model import HopNet, NetConfig, one_thread
from tensegrity_gym import Lattice, Scene
from tensegrity_gym.errors import InvalidParameterError


@dataclass(frozen=True)
class TrainConfig:
    """How the surrogate is trained."""

    net: NetConfig = field(default_factory=NetConfig)
    """Size of the net."""
    epochs: int = 1500
    """Most passes over the training hops."""
    patience: int = 300
    """Stop after so many passes without a better validation error."""
    batch: int = 1024
    """Hops per gradient step."""
    lr: float = 3e-3
    """AdamW's learning rate at the start; it falls along a cosine."""
    weight_decay: float = 1e-3
    """AdamW's weight decay."""
    validation: float = 0.1
    """Share of the hops held back to stop on."""
    test: float = 0.1
    """Share of the hops never looked at in training."""
    seed: int = 0
    """Seed of weights and batches."""


@dataclass(frozen=True)
class TrainCommand(TrainConfig):
    """Train the surrogate on a file of hops."""

    data: Annotated[Path, tyro.conf.Positional] = tyro.MISSING
    """HDF5 file made by `python -m surrogate generate`."""
    out: Path = Path("runs/surrogate.safetensors")
    """Checkpoint to write; its card goes beside it as .json."""


@one_thread()
def train(data: HopData, config: TrainConfig, *, progress: bool = True, desc: str = "surrogate") -> tuple[HopNet, dict[str, Any]]:
    """Train on the usable hops of ``data``; returns the net with the least validation error and its card."""
    started = time.perf_counter()
    split = data.split(config.validation, config.test)
    train_rows = split["train"]
    # a handful of hops may leave nothing to stop on: then stop on the training error, and the card says so
    validation_rows = split["validation"] if len(split["validation"]) else train_rows
    if not len(train_rows):
        raise InvalidParameterError(
            f"data: expected at least one usable training hop, got {len(data)} hops of which none is; generate more"
        )
    if data.configuration.get("scene_ranges"):
        raise InvalidParameterError(
            f"data: expected hops of one scene, since the surrogate is told the stretches alone, got scenes that vary in "
            f"{sorted(data.configuration['scene_ranges'])}; train on a file of one scene"
        )
    torch.manual_seed(config.seed)
    scene, lattice = Scene(**data.configuration["scene"]), Lattice(**data.configuration["lattice"])
    net = HopNet(config.net, *model.scene_symmetries(lattice, scene))
    inputs, targets = torch.from_numpy(data["stretches"].astype(np.float32)), torch.from_numpy(model.target_columns(data))
    net.fit_normalisers(targets[train_rows])
    best, epochs = _descend(net, inputs, targets, train_rows, validation_rows, config, progress, desc)
    card = {
        "data_digest": data.digest,
        "configuration": data.configuration,
        "train": asdict(config),
        "hops": {name: len(rows) for name, rows in split.items()},
        "stopped_on": "validation" if len(split["validation"]) else "train",
        "epochs": epochs,
        "validation_error": best,
        "seconds": time.perf_counter() - started,
        "rmse": {name: rmse(net, data.rows(rows)) for name, rows in split.items() if len(rows)},
    }
    return net, card


def _descend(
    net: HopNet,
    inputs: Tensor,
    targets: Tensor,
    train_rows: np.ndarray,
    validation_rows: np.ndarray,
    config: TrainConfig,
    progress: bool,
    desc: str,
) -> tuple[float, int]:
    """Gradient descent with early stopping; leaves the best weights in ``net``. Returns validation error and epochs."""
    optimiser = torch.optim.AdamW(net.parameters(), lr=config.lr, weight_decay=config.weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.epochs, eta_min=config.lr / 100)
    shuffle = np.random.default_rng(config.seed)
    best, best_epoch, best_state = float("inf"), 0, copy.deepcopy(net.state_dict())
    epoch = 0
    with tqdm(range(1, config.epochs + 1), desc=desc, unit="epoch", disable=not progress, mininterval=0.5) as bar:
        for epoch in bar:
            order = shuffle.permutation(train_rows)
            for first in range(0, len(order), config.batch):
                rows = order[first : first + config.batch]
                optimiser.zero_grad()
                member_loss(net, inputs[rows], targets[rows]).backward()
                optimiser.step()
            schedule.step()
            error = ensemble_error(net, inputs[validation_rows], targets[validation_rows])
            if error < best:
                best, best_epoch, best_state = error, epoch, copy.deepcopy(net.state_dict())
            if epoch - best_epoch >= config.patience:
                break
            if epoch % 50 == 0:
                bar.set_postfix(validation=f"{best:.3f}", refresh=False)
    net.load_state_dict(best_state)
    net.eval()
    return best, epoch


def member_loss(net: HopNet, stretches: Tensor, targets: Tensor) -> Tensor:
    """Mean squared error of the members in units of each output's spread; outputs that a hop lacks do not count."""
    wanted = (targets - net.output_mean) / net.output_scale
    known = torch.isfinite(wanted)
    error = torch.where(known, net.normalised(stretches) - torch.nan_to_num(wanted), 0.0)
    return (error**2).sum() / (known.sum() * net.config.members)


@torch.no_grad()
def ensemble_error(net: HopNet, stretches: Tensor, targets: Tensor) -> float:
    """Root mean square error of the ensemble's mean, in units of each output's spread."""
    wanted = (targets - net.output_mean) / net.output_scale
    known = torch.isfinite(wanted)
    error = torch.where(known, net.normalised(stretches).mean(dim=0) - torch.nan_to_num(wanted), 0.0)
    return float(torch.sqrt((error**2).sum() / known.sum()))


def main(config: TrainCommand) -> None:
    """Entry of ``python -m surrogate train``."""
    net, card = train(dataset.read(config.data), config)
    card["train"] = {k: str(v) if isinstance(v, Path) else v for k, v in card["train"].items()}
    model.save(net, config.out, card)
    shown = ", ".join(f"{name} {value:.3g}" for name, value in card["rmse"].get("test", card["rmse"]["train"]).items())
    print(f"{config.out}: {card['epochs']} epochs in {card['seconds']:.1f} s; RMSE {shown}")
