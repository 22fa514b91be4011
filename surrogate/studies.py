"""Trainings of other nets on the same hops: error against data size and net size, and what the symmetry is worth.

Every training is of one member with the same settings but for what is studied, and is kept as one JSON file, so that a study
killed is a study continued. Test hops are never trained on: they are those of the whole file's split.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from surrogate.dataset import HopData
from surrogate.model import NetConfig
from surrogate.scores import PLANES, of_data, rmse, speed
from surrogate.storage import ensure_folder, hash_of, read_json, write_json
from surrogate.train import TrainConfig, plain, train

#: Shares of the hops, for the error against data size.
SHARES = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
#: Of the JSON files, so that older ones are not read.
FORMAT = 2
#: Widths and depths of the chart of speed against accuracy.
WIDTHS, DEPTHS = (32, 64, 128, 256), (2, 4)

Cell = tuple[str, TrainConfig, int]  #: name, settings, hops to train on


def cells_of(study: str, data: HopData, steps: int) -> list[Cell]:
    """The trainings of one study."""
    base = TrainConfig(net=replace(NetConfig(), members=1), steps=steps)
    hops = len(data)
    nets: dict[str, NetConfig] = {}
    if study == "sizes":
        return [(f"{round(s * hops)}", base, round(s * hops)) for s in SHARES]
    if study == "nets":
        nets = {f"{d} x {w}": replace(base.net, hidden=(w,) * d) for w in WIDTHS for d in DEPTHS}
    if study == "symmetry":
        free = replace(base, net=replace(base.net, symmetric=False))
        return [("built in", base, hops), ("none", free, hops), ("images as data", replace(free, images=True), hops)]
    return [(name, replace(base, net=net), hops) for name, net in nets.items()]


def run(studies: Iterable[str], data: HopData, folder: Path, steps: int) -> dict[str, dict[str, Any]]:
    """Results by study and cell; those already in ``folder`` are read, not trained again."""
    results: dict[str, dict[str, Any]] = {}
    for study in studies:
        results[study] = {name: _cell(folder, data, config, n) for name, config, n in cells_of(study, data, steps)}
    return results


def _cell(folder: Path, data: HopData, config: TrainConfig, hops: int) -> dict[str, Any]:
    key = hash_of({"format": FORMAT, "data": data.digest, "train": plain(config), "hops": hops})
    path = ensure_folder(folder / "studies") / f"{key}.json"
    if path.exists():
        return read_json(path)
    started = time.process_time()
    net, card = train(data.rows(slice(0, hops)), config, desc=f"{hops} hops, {config.net.hidden}")
    seconds = time.process_time() - started
    test = data.rows(data.split(config.validation, config.test)["test"])
    error, targets = of_data(net, test), np.column_stack([test["landing"], test["touchdown"]])
    planes = {
        name: float(np.sqrt(np.nanmean(((error.mean[:, [x, y]] - targets[:, [x, y]]) ** 2).sum(axis=1))))
        for name, (x, y) in PLANES.items()
    }
    found = {
        "hops": card["hops"]["train"],
        "hidden": list(config.net.hidden),
        "parameters": sum(p.numel() for p in net.parameters()),
        "cpu_seconds": seconds,
        "rmse": rmse(net, test),
        "rms_distance": planes,
        "speed": speed(net),
    }
    write_json(path, found)
    return found
