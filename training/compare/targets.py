"""The targets of the comparison, drawn once and kept in the repository before any method was run on them.

``python -m training.compare.targets`` writes targets.json anew: the same numbers, as long as the reachable regions stay.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tensegrity_gym import Scene
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.scene import LANDINGS
from tensegrity_gym.task import TARGET_PLACES, sample_targets

PATH = Path(__file__).parent / "targets.json"
SEED = 20261122
SCENES = ("earth", "moon", "slope")
#: Targets inside the reachable region, on its boundary, and beyond it.
COUNTS = dict(zip(TARGET_PLACES, (32, 16, 16), strict=True))


def draw() -> dict[str, dict[str, dict[str, list[list[float]]]]]:
    """Targets by scene, landing and place [m], to a tenth of a millimetre."""
    found: dict[str, dict[str, dict[str, list[list[float]]]]] = {}
    for i, name in enumerate(SCENES):
        found[name] = {}
        for j, landing in enumerate(LANDINGS):
            rng = np.random.default_rng([SEED, i, j])
            scene = Scene.preset(name, landing=landing)
            found[name][landing] = {
                place: np.round(sample_targets(rng, count, scene, place), 4).tolist() for place, count in COUNTS.items()
            }
    return found


def read(scene: str, landing: str, most: int | None = None) -> dict[str, np.ndarray]:
    """The registered targets of a scene by place, each (n, 2) [m]; the first ``most`` of each place."""
    known = json.loads(PATH.read_text(encoding="utf-8"))
    if scene not in known or landing not in known[scene]:
        raise InvalidParameterError(f"scene: expected one of {sorted(known)}, for which targets are registered, got {scene!r}")
    return {place: np.array(points)[:most] for place, points in known[scene][landing].items()}


if __name__ == "__main__":
    text = json.dumps(draw(), separators=(",", ":")).replace('{"', '{\n"').replace('},"', '},\n"')
    PATH.write_text(text + "\n", encoding="utf-8")
