"""How far the surrogate's predictions are from simulated hops, how sure it should be, how fast it is, and pictures of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro

from surrogate import dataset, model
from surrogate.dataset import SPLITS, HopData
from surrogate.kriging import fit_process, without_images
from surrogate.model import HopNet
from surrogate.outputs import OUTPUTS, target_columns
from surrogate.scores import LEVELS, PLANES, coverage, disagreement, nearest_hop_noise, of_data, ranking, rmse, speed, spread
from surrogate.storage import ensure_folder, write_json
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.types import Floats


@dataclass(frozen=True)
class EvaluateConfig:
    """Errors, calibration and speed of a trained surrogate on one split of a file of hops."""

    model: Annotated[Path, tyro.conf.Positional]
    """Checkpoint made by `python -m surrogate train`."""
    data: Annotated[Path, tyro.conf.Positional]
    """HDF5 file of hops."""
    split: str = "test"
    """train, validation, test, or all (for a file that was not trained on)."""
    out: Path | None = None
    """Folder for evaluation.json and pictures; None: print only."""
    floor: int = 0
    """Simulate so many of the hops again from starts 10 um off, and give errors in multiples of how far that moves them."""
    studies: tuple[Literal["sizes", "nets", "symmetry"], ...] = ()
    """Train other nets on the same file, into --out: error against data size, widths and depths, the symmetry; resumable."""
    study_steps: int = 3000
    """Gradient steps of each of the studies' trainings (of one member each)."""

    def __post_init__(self) -> None:
        if self.floor < 0:
            raise InvalidParameterError(f"floor: expected a number of hops >= 0, got {self.floor}; 0 leaves it out")


@dataclass(frozen=True)
class Evaluation:
    """What `evaluate` found; its fields are the JSON's."""

    split: str
    hops: int
    rmse: dict[str, float]
    spread: dict[str, float]
    nearest_hop_noise: dict[str, float]
    levels: list[float]
    coverage: dict[str, list[float]]
    coverage_gap: dict[str, float]
    ranking: dict[str, dict[str, float]]
    distance: dict[str, dict[str, float]]
    reach: dict[str, float]
    speed: dict[str, Any]
    mended: dict[str, dict[str, float]] = field(default_factory=dict)
    floor: dict[str, dict[str, float]] = field(default_factory=dict)


def mended(net: HopNet, rows: HopData, whole: HopData, shares: tuple[float, float]) -> dict[str, dict[str, float]]:
    """Errors on the test hops ``rows``, by name as in PLANES, corrected by what the net misses on the others near them.

    ``shares``: of validation and test hops, as the net was trained with. Empty where hops are too few.
    """
    found = {}
    simulated = without_images(net, whole)
    for name, plane in PLANES.items():
        data = simulated.rows(simulated.usable & np.isfinite(simulated[name]).all(axis=1))
        images = net.permutations.numpy(), net.signs[:, plane].numpy().astype(np.float64)
        process = fit_process(data["stretches"], data[name] - _seen(net, data, plane), images, data.split(*shares), 0.0)
        if process is not None:
            error = rows[name] - _seen(net, rows, plane) - process.shift(rows["stretches"])[0]
            found[name] = _quantiles(np.linalg.norm(error, axis=1))
    return found


@torch.no_grad()
def _seen(net: HopNet, rows: HopData, plane: tuple[int, int]) -> Floats:
    """Two outputs of the ensemble, shape (n, 2) [m]."""
    return net(torch.from_numpy(rows["stretches"].astype(np.float32))).mean(dim=0)[:, plane].numpy()


def _quantiles(error: Floats) -> dict[str, float]:
    error = error[np.isfinite(error)]
    return {"rms": float(np.sqrt((error**2).mean())), **{f"p{q}": float(np.percentile(error, q)) for q in (50, 90, 99)}}


def evaluate(
    net: HopNet, rows: HopData, whole: HopData, split: str, floor: int = 0, shares: tuple[float, float] | None = None
) -> Evaluation:
    """All numbers about ``net`` on the hops ``rows``, a split of ``whole``; ``shares`` as for :func:`mended`, None without."""
    prediction, targets = of_data(net, rows), target_columns(rows)
    covered = coverage(prediction, targets)
    distance, reach = {}, {}
    for name, (x, y) in PLANES.items():
        distance[name] = _quantiles(np.hypot(*(prediction.mean - targets)[:, [x, y]].T))
        reach[name] = float(np.nanpercentile(np.hypot(targets[:, x], targets[:, y]), 95))
    measured: dict[str, dict[str, float]] = {}
    if floor:
        from surrogate.floor import measure_floor

        measured = measure_floor(whole, floor)
    names = [o.name for o in OUTPUTS]
    return Evaluation(
        split=split,
        hops=len(rows),
        rmse=rmse(net, rows),
        spread=spread(rows),
        nearest_hop_noise=nearest_hop_noise(whole),
        levels=LEVELS.tolist(),
        coverage={name: covered[:, k].tolist() for k, name in enumerate(names)},
        coverage_gap={name: float(np.abs(covered[:, k] - LEVELS).max()) for k, name in enumerate(names)},
        ranking=ranking(prediction, disagreement(net, rows), targets),
        distance=distance,
        reach=reach,
        speed=speed(net),
        mended={} if shares is None else mended(net, rows, whole, shares),
        floor=measured,
    )


def rows_of(config: EvaluateConfig, data: HopData, card: dict[str, Any]) -> HopData:
    """The hops that ``config.split`` names; DataFileError where the net was trained on another configuration."""
    model.check_data(card, data.configuration, str(config.data))
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
    return rows


def table(found: Evaluation) -> str:
    """The numbers as text, one output a line."""
    floor = found.floor.get("start moved by 1e-05 m", {})
    head = f"{'output':<20}{'RMSE':>10}{'spread':>10}{'noise':>10}{'floor':>10}{'x floor':>9}{'coverage':>10}  unit"
    lines = [f"{found.split}: {found.hops} hops", head]
    for output in OUTPUTS:
        name, least = output.name, floor.get(output.name, float("nan"))
        lines.append(
            f"{name:<20}{found.rmse[name]:>10.5f}{found.spread[name]:>10.5f}{found.nearest_hop_noise[name]:>10.5f}"
            f"{least:>10.5f}{found.rmse[name] / least:>9.1f}{100 * found.coverage_gap[name]:>8.1f} %  {output.unit}"
        )
    for name, values in found.distance.items():
        lines.append(
            f"{name} error: rms {1e3 * values['rms']:.2f} mm, median {1e3 * values['p50']:.2f}, 90 % {1e3 * values['p90']:.2f}; "
            f"{100 * values['rms'] / found.reach[name]:.1f} % of reach ({found.reach[name]:.3f} m); Spearman of error with "
            + ", ".join(f"{kind} {value:.2f}" for kind, value in found.ranking[name].items())
        )
    for name, values in found.mended.items():
        lines.append(
            f"{name} error, mended by the hops stored nearby: rms {1e3 * values['rms']:.2f} mm, "
            f"median {1e3 * values['p50']:.2f}, 90 % {1e3 * values['p90']:.2f}"
        )
    for what in ("predictions", "landings"):
        member, whole = (found.speed[f"{what}_per_second_{k}"] for k in ("member", "ensemble"))
        lines.append(f"a second of one core: {member:.3g} {what} of one member, {whole:.3g} of all")
    machine, threads = found.speed["landings_per_second_machine"], found.speed["threads"]
    lines.append(
        f"a second by the clock, {threads} threads: {machine:.3g} landings of all; "
        f"a single prediction takes {found.speed['single_milliseconds']:.2f} ms"
    )
    return "\n".join(lines)


def main(config: EvaluateConfig) -> None:
    """Entry of ``python -m surrogate evaluate``."""
    net, card = model.load(config.model)
    data = dataset.read(config.data)
    rows = rows_of(config, data, card)
    if config.studies and config.out is None:
        raise InvalidParameterError("studies: expected a folder to keep them in, got none; give --out")
    shares = (card["train"]["validation"], card["train"]["test"]) if config.split == "test" and not net.scene_names else None
    found = evaluate(net, rows, data, config.split, config.floor, shares)
    print(table(found))
    if config.out is None:
        return
    from surrogate import evaluation_figures, studies

    ensure_folder(config.out)
    results = studies.run(config.studies, data, config.out, config.study_steps)
    write_json(config.out / "evaluation.json", {**vars(found), "card": card, "studies": results})
    for path in evaluation_figures.draw(net, rows, found, results, config.out):
        print(path)
