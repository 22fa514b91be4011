"""Models of a hop that learning and comparing may use, by name."""

from __future__ import annotations

from typing import Any

from tensegrity_gym.task import check_fidelity

#: The paper's model in single precision, which flies rigidly between take-off and touchdown and stops where the landing is
#: read: several times cheaper.
FLOWN = {"precision": "float32", "flight": "rigid", "stop": "landing"}


def levers_of(model: str) -> dict[str, Any]:
    """Arguments of ``simulate`` for "flown", or for a fidelity that the envs know by name."""
    return check_fidelity(FLOWN if model == "flown" else model)
