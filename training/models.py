"""Models of a hop that learning and comparing may use, by name."""

from __future__ import annotations

from typing import Any

from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.fidelity import Fidelity

#: Arguments of ``simulate``. "flown" is the paper's model in single precision, flies rigidly between take-off and touchdown
#: and stops where the landing is read.
MODELS: dict[str, dict[str, Any]] = {
    "paper": {},
    "single": {"precision": "float32"},
    "flown": {"fidelity": Fidelity(precision="float32", flight="rigid", stop="landing")},
}


def levers_of(model: str) -> dict[str, Any]:
    """Arguments of ``simulate`` for a model's name."""
    if model not in MODELS:
        raise InvalidParameterError(f"fidelity: expected one of {sorted(MODELS)}, got {model!r}")
    return dict(MODELS[model])
