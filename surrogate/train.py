"""Train the surrogate on a file of hops: heteroscedastic likelihood, early stopping on held-back hops, resumable."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from tqdm import tqdm

from surrogate import dataset, model
from surrogate.dataset import HopData
from surrogate.descent import Descent, Rows
from surrogate.model import HopNet, NetConfig, one_thread
from surrogate.outputs import OUTPUTS, scene_columns, target_columns
from surrogate.scores import calibrate, rmse
from surrogate.storage import NET_STATE, beside, hash_of
from tensegrity_gym import Lattice, Scene
from tensegrity_gym.errors import InvalidParameterError, MissingExtraError


@dataclass(frozen=True)
class TrainConfig:
    """How the surrogate is trained."""

    net: NetConfig = field(default_factory=NetConfig)
    """Size of the net."""
    epochs: int = 2000
    """Most passes over the training hops."""
    steps: int = 12_000
    """Most gradient steps, though never less than one pass over the hops; the learning rate falls to a hundredth over as many as
    there will be."""
    patience: int = 300
    """Stop after so many passes without a better validation error."""
    batch: int = 512
    """Hops per gradient step."""
    lr: float = 3e-3
    """AdamW's learning rate at the start; it falls along a cosine."""
    weight_decay: float = 0.0
    """AdamW's weight decay."""
    beta: float = 0.5
    """Exponent of the beta-NLL (Seitzer 2022): 0 is the Gaussian likelihood, 1 weighs all hops alike in the means."""
    images: bool = False
    """Train on each hop's images under the symmetries too: for a net that is not symmetric; one that is learns nothing new."""
    validation: float = 0.1
    """Share of the hops held back to stop on."""
    test: float = 0.1
    """Share of the hops never looked at in training."""
    seed: int = 0
    """Seed of weights and batches."""
    device: str = "auto"
    """Where to train: cpu, cuda, or auto (cuda where there is one)."""

    def __post_init__(self) -> None:
        for name in ("epochs", "steps", "patience", "batch"):
            if getattr(self, name) < 1:
                raise InvalidParameterError(
                    f"{name}: expected an integer >= 1, got {getattr(self, name)}; with less nothing is learnt"
                )
        if not 0 < self.lr < math.inf:
            raise InvalidParameterError(f"lr: expected a finite number > 0, got {self.lr:g}; {TrainConfig.lr:g} is usual")
        if not 0 <= self.weight_decay < math.inf:
            raise InvalidParameterError(f"weight_decay: expected a finite number >= 0, got {self.weight_decay:g}; 0 is none")
        if not 0 <= self.beta <= 1:
            raise InvalidParameterError(f"beta: expected a number from 0 to 1, got {self.beta:g}; {TrainConfig.beta:g} is usual")
        if not (self.validation >= 0 and self.test >= 0 and self.validation + self.test < 1):
            raise InvalidParameterError(
                f"validation and test: expected shares >= 0 that leave some hops to train on, got {self.validation:g} and "
                f"{self.test:g}; choose them so that their sum is below 1"
            )
        if not 0 <= self.seed < 2**64:
            raise InvalidParameterError(f"seed: expected an integer from 0 to 2^64 - 1, got {self.seed}; choose another")


@dataclass(frozen=True)
class TrainCommand(TrainConfig):
    """Train the surrogate on a file of hops."""

    data: Annotated[Path, tyro.conf.Positional] = tyro.MISSING
    """HDF5 file made by `python -m surrogate generate`."""
    out: Path = Path("runs/surrogate.safetensors")
    """Checkpoint to write; its card goes beside it as .json. Killed before, the same command goes on where it was."""
    log: Path | None = None
    """Folder for TensorBoard's event files."""


@one_thread()
def train(
    data: HopData,
    config: TrainConfig,
    *,
    progress: bool = True,
    desc: str = "surrogate",
    state: Path | None = None,
    log: Path | None = None,
) -> tuple[HopNet, dict[str, Any]]:
    """Train on the usable hops of ``data``; returns the net with the least validation error and its card.

    With ``state``, a file that training saves itself in from time to time: found again with the same data and settings, it
    is continued, and ends with the bits of a training that was never interrupted. It stays there for the caller to remove when
    the net is safely written: until then it is all that a failure to write leaves of the training.
    """
    started = time.perf_counter()
    split = data.split(config.validation, config.test)
    # a handful of hops may leave nothing to stop on: then stop on the training error, and the card says so
    stop_on = "validation" if len(split["validation"]) else "train"
    if not len(split["train"]):
        raise InvalidParameterError(
            f"data: expected at least one usable training hop, got {len(data)} hops of which none is; generate more"
        )
    net, rows = _start(data, config)
    net.fit_normalisers(rows.targets[torch.from_numpy(split["train"]).to(rows.targets.device)])
    if config.images:
        rows, split = _with_images(rows, split, data, net.scene)
    fingerprint = hash_of({"data": data.digest, "train": plain(config), "outputs": [o.name for o in OUTPUTS]})
    descent = Descent(net, rows, split["train"], split[stop_on], config)
    before = descent.resume(state, fingerprint)
    _descend(descent, config, progress, desc, state, fingerprint, _logger(log, descent.epoch))
    if not np.isfinite(descent.best):  # the best weights are those that it began with
        raise InvalidParameterError(
            f"lr: expected one small enough for a finite {stop_on} error, got {config.lr:g}, with which none of {descent.epoch} "
            "epochs had one; choose a smaller one"
        )
    held_back = data.rows(data.split(config.validation, config.test)[stop_on])
    calibrate(net, held_back)
    card = {
        "data_digest": data.digest,
        "configuration": data.configuration,
        "train": plain(config),
        "hops": {name: len(kept) for name, kept in split.items()},
        "stopped_on": stop_on,
        "epochs": descent.epoch,
        "validation_error": descent.best,
        "seconds": before + time.perf_counter() - started,
        "variance_factor": net.variance_factor.tolist(),
        "rmse": {
            name: rmse(net, data.rows(kept)) for name, kept in data.split(config.validation, config.test).items() if len(kept)
        },
    }
    return net, card


def plain(config: TrainConfig) -> dict[str, Any]:
    """The settings that decide what is learnt, JSON-like."""
    names = set(TrainConfig.__dataclass_fields__) - {"device"}
    return {k: v for k, v in asdict(config).items() if k in names}


def device_of(name: str) -> torch.device:
    """The device that ``name`` asks for; InvalidParameterError where there is none."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:  # torch without CUDA asserts
        raise InvalidParameterError(f"device: expected cpu, auto or a device of this machine, got {name!r} ({error})") from error


def _start(data: HopData, config: TrainConfig) -> tuple[HopNet, Rows]:
    """A fresh net and the tensors that it learns from, on the device asked for."""
    device = device_of(config.device)
    torch.manual_seed(config.seed)
    scene, lattice = Scene(**data.configuration["scene"]), Lattice(**data.configuration["lattice"])
    ranges = data.configuration.get("scene_ranges") or {}
    net = HopNet(config.net, *model.scene_symmetries(lattice, scene, list(ranges)), scene, ranges).to(device)
    columns = (data["stretches"].astype(np.float32), scene_columns(data).astype(np.float32), target_columns(data))
    return net, Rows(*(torch.from_numpy(c).to(device) for c in columns))


def _with_images(rows: Rows, split: dict[str, np.ndarray], data: HopData, scene: Scene) -> tuple[Rows, dict[str, np.ndarray]]:
    """Each training hop's images under the symmetries appended to the rows, and their numbers to the training rows."""
    if data.configuration.get("scene_ranges"):
        raise InvalidParameterError(
            f"images: expected hops of one scene, got scenes that vary in {sorted(data.configuration['scene_ranges'])}; "
            "generate with --symmetry instead"
        )
    permutations, signs = model.scene_symmetries(Lattice(**data.configuration["lattice"]), scene)
    parts, numbers = [rows], [split["train"]]
    for permutation, sign in zip(permutations[1:], signs[1:], strict=True):
        turn = rows.targets.new_tensor([1 if o.axis is None else sign[o.axis] for o in OUTPUTS])
        kept = [values[split["train"]] for values in rows]
        numbers.append(np.arange(len(split["train"])) + sum(len(p.targets) for p in parts))
        parts.append(Rows(kept[0][:, permutation.tolist()], kept[1], kept[2] * turn))
    joined = Rows(*(torch.cat(values) for values in zip(*parts, strict=True)))
    return joined, split | {"train": np.concatenate(numbers)}


def _descend(
    descent: Descent,
    config: TrainConfig,
    progress: bool,
    desc: str,
    state: Path | None,
    fingerprint: str,
    log: Callable[[int, dict[str, float]], None],
) -> None:
    """Epochs until there are no more or none helped for long; leaves the best weights in the net."""
    with tqdm(total=descent.epochs, initial=descent.epoch, desc=desc, unit="epoch", disable=not progress, mininterval=0.5) as bar:
        while descent.epoch < descent.epochs and descent.epoch - descent.best_epoch < config.patience:
            loss = descent.run_epoch()
            log(descent.epoch, {"loss/train": loss, "error/validation": descent.error, "lr": descent.rate})
            bar.update()
            if state is not None:
                descent.save_at_times(state, fingerprint)
            if descent.epoch % 50 == 0:
                bar.set_postfix(validation=f"{descent.best:.4f}", refresh=False)
    descent.finish()


def _logger(folder: Path | None, done: int) -> Callable[[int, dict[str, float]], None]:
    """A function that writes numbers of an epoch for TensorBoard, or does nothing; ``done`` epochs are already written."""
    if folder is None:
        return lambda epoch, values: None
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as missing:
        raise MissingExtraError(
            "log: expected tensorboard to be installed, it is not; pip install 'tensegrity-gym[learn]'"
        ) from missing
    writer = SummaryWriter(str(folder), purge_step=done + 1 if done else None)

    def write(epoch: int, values: dict[str, float]) -> None:
        for name, value in values.items():
            writer.add_scalar(name, value, epoch)

    return write


def main(config: TrainCommand) -> None:
    """Entry of ``python -m surrogate train``."""
    state = beside(config.out, NET_STATE)
    net, card = train(dataset.read(config.data), config, state=state, log=config.log)
    model.save(net, config.out, card)
    state.unlink(missing_ok=True)
    shown = ", ".join(f"{name} {value:.3g}" for name, value in card["rmse"].get("test", card["rmse"]["train"]).items())
    print(f"{config.out}: {card['epochs']} epochs in {card['seconds']:.1f} s; RMSE {shown}")
