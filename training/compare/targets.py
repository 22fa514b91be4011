"""The targets of the comparison, drawn once and kept in the repository before any method was run on them.

Methods were developed with their errors on these in sight; second_targets.json was drawn when that was over, to confirm.
``python -m training.compare.targets`` writes both anew: the same numbers, as long as the reachable regions stay.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from tensegrity_gym import Scene
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.scene import LANDINGS
from tensegrity_gym.scene_ranges import SceneRanges, scene_ranges
from tensegrity_gym.task import TARGET_PLACES, draw_episode, sample_targets

#: Files, and the seeds that they were drawn with.
FILES = {Path(__file__).parent / "targets.json": 20261122, Path(__file__).parent / "second_targets.json": 20261123}
PATH, SECOND = FILES
SCENES = ("earth", "moon", "slope")
#: Scenes that vary, by name: level ground from the Moon's gravity to Earth's, from slippery to rough. Hops are followed for as
#: long as on the Moon. Registered at touchdown alone: where a hop comes to rest is chaotic, and its reach as a function of
#: friction, which there decides how far it slides, is not documented.
VARIED: dict[str, dict[str, Any]] = {"varied": {"preset": "moon", "gravity": (1.6, 9.81), "friction": (0.3, 0.8)}}
#: Targets inside the reachable region, on its boundary, and beyond it.
COUNTS = dict(zip(TARGET_PLACES, (32, 16, 16), strict=True))


def scenes_of(name: str, landing: str, **changes: Any) -> SceneRanges:
    """What a registered scene's name means, with values of the scene changed by keyword."""
    if name in VARIED:
        return scene_ranges(VARIED[name] | changes, landing)
    return SceneRanges(Scene.preset(name, landing=landing, **changes))


def draw(seed: int = FILES[PATH]) -> dict[str, dict[str, dict[str, list[list[float]]]]]:
    """Targets by scene, landing and place [m], to a tenth of a millimetre; where scenes vary, with gravity and friction."""
    found: dict[str, dict[str, dict[str, list[list[float]]]]] = {}
    for i, name in enumerate(SCENES):
        found[name] = {}
        for j, landing in enumerate(LANDINGS):
            rng = np.random.default_rng([seed, i, j])
            scene = Scene.preset(name, landing=landing)
            found[name][landing] = {
                place: np.round(sample_targets(rng, count, scene, place), 4).tolist() for place, count in COUNTS.items()
            }
    for i, name in enumerate(VARIED, len(SCENES)):
        rng = np.random.default_rng([seed, i, LANDINGS.index("touchdown")])
        scenes = scenes_of(name, "touchdown")
        drawn = {place: [draw_episode(rng, scenes, place).observation for _ in range(count)] for place, count in COUNTS.items()}
        found[name] = {"touchdown": {p: np.round(np.array(rows, dtype=np.float64), 4).tolist() for p, rows in drawn.items()}}
    return found


def read(scene: str, landing: str, most: int | None = None, path: Path = PATH) -> dict[str, np.ndarray]:
    """The registered targets of a scene by place, each (n, 2) [m]; the first ``most`` of each place.

    Where scenes vary they are observations, (n, 2 + k): each target has a scene of its own.
    """
    known = json.loads(path.read_text(encoding="utf-8"))
    if scene not in known or landing not in known[scene]:
        names = [f"{name} at {there}" for name, landings in sorted(known.items()) for there in sorted(landings)]
        raise InvalidParameterError(
            f"scene: expected one for which targets are registered, {', '.join(names)}; got {scene!r} at {landing!r}"
        )
    return {place: np.array(points)[:most] for place, points in known[scene][landing].items()}


if __name__ == "__main__":
    for path, seed in FILES.items():
        text = json.dumps(draw(seed), separators=(",", ":")).replace('{"', '{\n"').replace('},"', '},\n"')
        path.write_text(text + "\n", encoding="utf-8")
