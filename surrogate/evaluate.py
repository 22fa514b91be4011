"""How far the surrogate's predictions are from simulated hops."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from surrogate import dataset, model
from surrogate.dataset import SPLITS, HopData
from surrogate.model import OUTPUTS, HopNet
from tensegrity_gym.errors import DataFileError, InvalidParameterError


@dataclass(frozen=True)
class EvaluateConfig:
    """RMSE of a trained surrogate on one split of a file of hops."""

    model: Annotated[Path, tyro.conf.Positional]
    """Checkpoint made by `python -m surrogate train`."""
    data: Annotated[Path, tyro.conf.Positional]
    """HDF5 file of hops."""
    split: str = "test"
    """train, validation, test, or all (for a file that was not trained on)."""


def rmse(net: HopNet, data: HopData) -> dict[str, float]:
    """Root mean square error per output over the hops that have it [m, m/s or s, see OUTPUTS]."""
    error = net.predict(data["stretches"])[0] - model.target_columns(data)
    with np.errstate(invalid="ignore"):
        known = np.isfinite(error).sum(axis=0)
        square = np.nansum(error**2, axis=0) / np.maximum(known, 1)
    return {o.name: float(np.sqrt(square[k])) if known[k] else float("nan") for k, o in enumerate(OUTPUTS)}


def spread(data: HopData) -> dict[str, float]:
    """Standard deviation of each output over the hops: the RMSE of always predicting the mean [units of OUTPUTS]."""
    return {o.name: float(value) for o, value in zip(OUTPUTS, np.nanstd(target_columns_or_nan(data), axis=0), strict=True)}


def target_columns_or_nan(data: HopData) -> np.ndarray:
    """Outputs of stored hops, shape (n, 9); a row of not-a-number when there is no hop at all."""
    columns = model.target_columns(data)
    return columns if len(columns) else np.full((1, len(OUTPUTS)), np.nan, dtype=np.float32)


def main(config: EvaluateConfig) -> None:
    """Entry of ``python -m surrogate evaluate``."""
    net, card = model.load(config.model)
    data = dataset.read(config.data)
    for name in ("model_version", "design", "scene", "lattice"):
        if card["configuration"].get(name) != data.configuration.get(name):
            raise DataFileError(
                f"{config.data}: expected {name} {card['configuration'].get(name)!r}, which the surrogate was trained on, "
                f"got {data.configuration.get(name)!r}; use data of the same configuration"
            )
    if config.split == "all":
        rows = data.rows(data.usable)
    elif config.split in SPLITS:
        rows = data.rows(data.split(card["train"]["validation"], card["train"]["test"])[config.split])
    else:
        raise InvalidParameterError(f"split: expected one of {SPLITS} or 'all', got {config.split!r}")
    if not len(rows):
        raise InvalidParameterError(
            f"split: expected at least one hop in {config.split!r}, got none of {len(data)}; use more hops"
        )
    errors, spreads = rmse(net, rows), spread(rows)
    print(f"{config.split}: {len(rows)} hops\n{'output':<20}{'RMSE':>10}{'spread':>10}  unit")
    for output in OUTPUTS:
        print(f"{output.name:<20}{errors[output.name]:>10.4f}{spreads[output.name]:>10.4f}  {output.unit}")
