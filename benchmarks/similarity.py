"""What it brings to learn lengths as they would be on Earth, and what the documented reach leaves out where friction varies.

``python -m benchmarks.similarity [runs/flown/varied.h5]``, on the file of hops that ``docs/results.md`` has the command of.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

from surrogate import dataset
from surrogate.dataset import HopData
from surrogate.frozen import FrozenLanding
from surrogate.model import NetConfig
from surrogate.train import TrainConfig, train
from tensegrity_gym.task import reach
from training.compare.targets import scenes_of
from training.hops import VariedHops
from training.similarity import alike_data, likeness
from training.varied import scene_values

#: Hops that are never learnt from: the file's last ones, whose scenes are their own.
HELD = 2048
SCENES = scenes_of("varied", "touchdown")


def missed(known: HopData, held: HopData, alike: bool) -> np.ndarray:
    """Distances of predicted from simulated landings of ``held``, shape (n,) [m]."""
    data = alike_data(known, SCENES) if alike else known
    settings = TrainConfig(net=NetConfig(hidden=(64, 64, 64)), steps=3000, test=0.0, device="cpu")
    net, _ = train(data, settings, progress=False)
    values = scene_values(held, SCENES)
    with torch.no_grad():
        inputs = (torch.from_numpy(a.astype(np.float32)) for a in (held["stretches"], values))
        seen = FrozenLanding(net, SCENES.observed)(*inputs).mean(dim=0).numpy()
    factor = likeness(values, SCENES.observed)[:, None] if alike else 1.0
    return np.linalg.norm(seen / factor - held["landing"], axis=1)


def main(path: Path) -> None:
    """Print both."""
    data = dataset.read(path)
    held = data.rows(slice(len(data) - HELD, len(data)))
    scenes = VariedHops(SCENES, {})
    reaches = np.array([reach(scenes.at(values)) for values in scene_values(held, SCENES)])
    share, friction = np.linalg.norm(held["landing"], axis=1) / reaches, held["scene_friction"]
    for low, high in ((0.3, 0.45), (0.45, 0.6), (0.6, 0.8)):
        there = share[(friction >= low) & (friction < high)]
        print(f"friction {low:g} to {high:g}: 95 % of landings within {np.quantile(there, 0.95):.2f} reaches")
    for hops in (1000, 10_000):
        for alike in (False, True):
            error = 100 * missed(data.rows(slice(0, hops)), held, alike) / reaches
            name = "as on Earth" if alike else "as they are"
            print(f"{hops} hops, lengths {name}: {np.sqrt((error**2).mean()):.2f} % of reach (rms of {HELD} others)", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/flown/varied.h5"))
