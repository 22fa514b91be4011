"""Numbers that say how good a surrogate is: errors, calibration of its scatter, ranking of its doubt, speed."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.optimize import nnls
from scipy.spatial import cKDTree
from scipy.special import ndtri
from scipy.stats import spearmanr

from surrogate.dataset import HopData
from surrogate.frozen import FrozenLanding
from surrogate.model import HopNet, Prediction, one_thread
from surrogate.outputs import OUTPUTS, scene_columns, target_columns
from tensegrity_gym import STRETCH_RANGE, Lattice
from tensegrity_gym.types import Floats

#: Nominal coverages of the intervals that calibration is looked at on.
LEVELS = np.linspace(0.05, 0.95, 19)
#: Pairs of outputs that are one horizontal vector: where the landing is read, and the touchdown.
PLANES = {"landing": (0, 1), "touchdown": (2, 3)}


def of_data(net: HopNet, data: HopData) -> Prediction:
    """The net's prediction of stored hops, with their own scenes."""
    return net.predict(data["stretches"], scene_columns(data) if net.scene_names else None)


def rmse(net: HopNet, data: HopData) -> dict[str, float]:
    """Root mean square error per output over the hops that have it [m, m/s or s, see OUTPUTS]."""
    error = of_data(net, data).mean - target_columns(data)
    with np.errstate(invalid="ignore"):
        known = np.isfinite(error).sum(axis=0)
        square = np.nansum(error**2, axis=0) / np.maximum(known, 1)
    return {o.name: float(np.sqrt(square[k])) if known[k] else float("nan") for k, o in enumerate(OUTPUTS)}


def spread(data: HopData) -> dict[str, float]:
    """Standard deviation of each output over the hops: the RMSE of always predicting the mean [units of OUTPUTS]."""
    columns = target_columns(data)
    columns = columns if len(columns) else np.full((1, len(OUTPUTS)), np.nan, dtype=np.float32)
    return {o.name: float(value) for o, value in zip(OUTPUTS, np.nanstd(columns, axis=0), strict=True)}


def coverage(prediction: Prediction, targets: Floats, levels: Floats = LEVELS) -> Floats:
    """Share of hops inside each central Gaussian interval, shape (levels, 9); not-a-number for outputs that no hop has."""
    distance = np.abs(targets - prediction.mean) / prediction.deviation
    known = np.isfinite(targets)
    inside = (distance[None] <= ndtri(0.5 + levels / 2)[:, None, None]) & known
    total = known.sum(axis=0)
    return np.where(total > 0, inside.sum(axis=1) / np.maximum(total, 1), np.nan)


def calibrate(net: HopNet, data: HopData) -> None:
    """Set the net's factor on each output's variance so that intervals cover what they say on ``data``.

    One factor per output, the one whose largest departure from nominal over LEVELS is least: a recalibration (Kuleshov 2018)
    by a scale instead of a curve, so that what is predicted stays a Gaussian.
    """
    net.variance_factor.fill_(1.0)
    if not len(data):
        return
    prediction, targets = of_data(net, data), target_columns(data)
    scales = np.exp(np.linspace(np.log(0.2), np.log(5.0), 161))
    gaps = np.array(
        [
            np.abs(coverage(prediction._replace(deviation=scale * prediction.deviation), targets) - LEVELS[:, None]).max(axis=0)
            for scale in scales
        ]
    )
    best = scales[np.nan_to_num(gaps, nan=np.inf).argmin(axis=0)]
    best[~np.isfinite(gaps).all(axis=0)] = 1.0
    net.variance_factor.copy_(torch.from_numpy(best**2))


def ranking(prediction: Prediction, disagreement: Floats, targets: Floats) -> dict[str, dict[str, float]]:
    """Spearman's rank correlation of real errors with the predicted deviation, its scatter and the members' spread.

    For the horizontal vectors of PLANES; ``disagreement`` is the members' standard deviation, shape (n, 9).
    """
    error = np.abs(prediction.mean - targets)
    scatter = np.sqrt(np.maximum(prediction.deviation**2 - disagreement**2, 0.0))
    found = {}
    for name, (x, y) in PLANES.items():
        length = np.hypot(error[:, x], error[:, y])
        known = np.isfinite(length)
        signs = {"deviation": prediction.deviation, "scatter": scatter, "disagreement": disagreement}
        found[name] = {
            kind: float(spearmanr(np.hypot(values[known, x], values[known, y]), length[known]).statistic)
            for kind, values in signs.items()
        }
    return found


@torch.no_grad()
def disagreement(net: HopNet, data: HopData) -> Floats:
    """Calibrated standard deviation over the members, shape (n, 9) [units of OUTPUTS]."""
    scene = torch.from_numpy(scene_columns(data).astype(np.float32)).to(net.output_mean) if net.scene_names else None
    mean = net(torch.from_numpy(data["stretches"].astype(np.float32)).to(net.output_mean), scene)
    return torch.sqrt(net.variance_factor * mean.var(dim=0, unbiased=False)).cpu().numpy()


def nearest_hop_noise(data: HopData, pairs: int = 8) -> dict[str, float]:
    """RMS per output that no smooth function of the stretches explains, from how near hops differ: the variogram's nugget.

    Half the squared difference of two hops, averaged, against the distance d of their stretches, is fitted by
    n + a d + b d^2 with n, a, b >= 0 over each hop's ``pairs`` nearest ones, images under the symmetries included; sqrt(n)
    is returned. Where the map is rough below the spacing of the hops, roughness counts as noise: they cannot resolve it.
    Hops of varied scenes are apart in more than their stretches: not-a-number for them.
    """
    lattice = Lattice(**data.configuration["lattice"])
    if data.configuration.get("scene_ranges") or len(data) <= pairs:
        return {o.name: float("nan") for o in OUTPUTS}
    usable = data.rows(data.usable & (data["image"] == 0))
    stretches, targets = usable["stretches"], target_columns(usable).astype(np.float64)
    axes = np.array([-1 if o.axis is None else o.axis for o in OUTPUTS])
    images = np.concatenate([stretches[:, p] for p in lattice.symmetries])
    turned = np.concatenate([targets * np.where(axes < 0, 1, s[axes]) for s in lattice.symmetry_signs])
    distance, which = cKDTree(images).query(stretches, k=pairs + 1)
    other = which % len(stretches) != np.arange(len(stretches))[:, None]
    # a slope breaks some symmetries: then only the hops themselves are near each other
    if data.configuration["scene"]["slope"] != 0:
        other &= which < len(stretches)
    design = np.stack([np.ones_like(distance), distance, distance**2], axis=-1)[other]
    found = {}
    for k, output in enumerate(OUTPUTS):
        half = 0.5 * (turned[which, k] - targets[:, None, k])[other] ** 2
        known = np.isfinite(half)
        found[output.name] = float(np.sqrt(nnls(design[known], half[known])[0][0])) if known.any() else float("nan")
    return found


@torch.no_grad()
def speed(net: HopNet, batch: int = 4096, seconds: float = 1.0) -> dict[str, Any]:
    """Predictions per second in batches, of one member and of all, and milliseconds for a single one.

    Predictions are of all outputs and their scatter; landings are what planners ask for, of ``FrozenLanding``
    (not-a-number where the net is told a slope). Of one core its own time is counted, not the clock's, so that other work
    on the machine does not count; ``landings_per_second_machine`` is by the clock, with as many threads as torch has.
    """
    low, high = STRETCH_RANGE
    points = low + (high - low) * torch.rand(batch, net.permutations.shape[1], generator=torch.Generator().manual_seed(0))
    scene = ((net.scene_low + net.scene_high) / 2).expand(batch, -1).cpu() if net.scene_names else None
    nets = {"member": net.member(0).cpu(), "ensemble": copy.deepcopy(net).cpu()}

    def duration(ask: Callable[..., Any], rows: int, clock: Callable[[], float]) -> float:
        inputs = points[:rows], None if scene is None else scene[:rows]
        ask(*inputs)
        times: list[float] = []
        stop = time.perf_counter() + seconds / 2
        while time.perf_counter() < stop or len(times) < 5:
            started = clock()
            ask(*inputs)
            times.append(clock() - started)
        return float(np.median(times))

    found: dict[str, Any] = {"batch": batch}
    frozen = None if {"slope", "slope_direction"} & set(net.scene_names) else {k: FrozenLanding(v) for k, v in nets.items()}
    with one_thread():
        for name, one in nets.items():
            found[f"predictions_per_second_{name}"] = batch / duration(one, batch, time.thread_time)
            asked = duration(frozen[name], batch, time.thread_time) if frozen else float("nan")
            found[f"landings_per_second_{name}"] = batch / asked
        found["single_milliseconds"] = 1e3 * duration(nets["ensemble"], 1, time.thread_time)
    found["threads"] = torch.get_num_threads()
    found["landings_per_second_machine"] = (
        batch / duration(frozen["ensemble"], batch, time.perf_counter) if frozen else float("nan")
    )
    return found
