"""How far the surrogate's predictions are from simulated hops."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surrogate import dataset, model
from surrogate.dataset import SPLITS
from surrogate.outputs import OUTPUTS
from surrogate.scores import rmse, spread
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
