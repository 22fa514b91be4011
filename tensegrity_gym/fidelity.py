"""How finely a hop is modelled: every lever that trades accuracy for speed, in one value. docs/accuracy.md charts them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from tensegrity_gym.design import Design
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.timestep import MARGIN

CHOICES = {
    "integrator": ("symplectic_euler", "velocity_verlet", "runge_kutta"),
    "precision": ("float64", "float32"),
    "flight": ("full", "rigid"),
    "contact": ("all", "nodes"),
    "stop": ("rest", "landing"),
}
#: Largest step over symplectic Euler's critical one at which an integrator is stable.
STABLE_STEPS = {"symplectic_euler": 1.0, "velocity_verlet": 1.0, "runge_kutta": float(np.sqrt(2.0))}


@dataclass(frozen=True)
class Fidelity:
    """A model of the hop; the defaults are the paper's."""

    bar_segments: int | None = None
    """Segments of a bar, 1 for bars that cannot buckle; None for the design's (3 is the paper's)."""
    bar_softening: float = 1.0
    """Axial stiffness of the bars is divided by it, their buckling load is not: larger steps, longer axial waves."""
    integrator: str = "symplectic_euler"
    """One of ``CHOICES["integrator"]``."""
    step: float = MARGIN
    """Time step over the critical one of symplectic Euler [-]."""
    precision: str = "float64"
    """"float64" in 8 lanes or "float32" in 16."""
    flight: str = "full"
    """"rigid": between take-off and touchdown the unloaded lattice flies as a rigid body, in closed form but for its rotation."""
    clearance: float = 0.25
    """Height of the lowest mass over the ground from which a flight may be rigid, over the cell's height l [-]."""
    contact: str = "all"
    """Masses that meet the ground: "all", or only the "nodes" where bars end."""
    stop: str = "rest"
    """"landing": follow a hop no further than where ``scene.landing`` is read; its rest is then not a number."""
    reason: str = field(default="", compare=False)
    """Why it was chosen, in words."""

    def __post_init__(self) -> None:
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise InvalidParameterError(f"Fidelity.{name}: expected one of {choices}, got {getattr(self, name)!r}")
        for name, least in (("bar_softening", 1.0), ("step", 0.0), ("clearance", 0.0)):
            value = getattr(self, name)
            number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool) and np.isfinite(value)
            if not number or value < least or (name == "step" and value == 0):
                bound = "> 0" if name == "step" else f">= {least:g}"
                raise InvalidParameterError(f"Fidelity.{name}: expected a finite number {bound}, got {value!r}")
        segments = self.bar_segments
        if segments is not None and (isinstance(segments, bool) or not isinstance(segments, (int, np.integer)) or segments < 1):
            raise InvalidParameterError(f"Fidelity.bar_segments: expected an integer >= 1 or None, got {segments!r}")

    def design(self, design: Design) -> Design:
        """``design`` as this fidelity models it: what to find the equilibria of its hops with."""
        segments = design.bar_segments if self.bar_segments is None else self.bar_segments
        return replace(design, bar_segments=segments, bar_softening=design.bar_softening * self.bar_softening)

    def levers(self) -> dict[str, Any]:
        """All fields but the reason."""
        content = asdict(self)
        del content["reason"]
        return content

    def __str__(self) -> str:
        parts = ["the design's bars" if self.bar_segments is None else f"bars of {self.bar_segments} segments"]
        if self.bar_softening != 1.0:
            parts[0] += f" softened {self.bar_softening:g} times"
        parts += [f"{self.integrator} at {self.step:g} of the critical step", self.precision]
        if self.flight == "rigid":
            parts.append("rigid flight")
        if self.contact == "nodes":
            parts.append("contact at nodes only")
        if self.stop == "landing":
            parts.append("followed as far as the landing")
        return ", ".join(parts) + (f" ({self.reason})" if self.reason else "")


#: Fidelities by name; "auto" is chosen for a scene and a tolerance, see :mod:`tensegrity_gym.auto`.
FIDELITIES = {
    "paper": Fidelity(reason="the paper's model"),
    "single": Fidelity(precision="float32", reason="the paper's model in single precision"),
    "flown": Fidelity(
        precision="float32",
        flight="rigid",
        stop="landing",
        reason="the paper's model in single precision, rigid in flight and followed as far as the landing",
    ),
    "reference": Fidelity(step=MARGIN / 8, reason="the paper's model, converged in time"),
}
NAMES = ("auto", *FIDELITIES)


def named_fidelity(fidelity: Fidelity | str, names: tuple[str, ...] = NAMES) -> Fidelity:
    """A fidelity given by value or by one of the names in ``FIDELITIES``; InvalidParameterError for anything else.

    ``names`` are those that the caller takes, as the error lists them.
    """
    if isinstance(fidelity, Fidelity):
        return fidelity
    if not isinstance(fidelity, str) or fidelity not in FIDELITIES:
        raise InvalidParameterError(f"fidelity: expected a Fidelity or one of {names}, got {fidelity!r}")
    return FIDELITIES[fidelity]


def changed(fidelity: Fidelity, levers: dict[str, Any]) -> Fidelity:
    """``fidelity`` with the levers that are not None put in its place."""
    given = {name: value for name, value in levers.items() if value is not None}
    unknown = sorted(set(given) - {f.name for f in fields(Fidelity)})
    if unknown:
        raise InvalidParameterError(f"fidelity: expected levers out of {[f.name for f in fields(Fidelity)]}, got {unknown}")
    if not given:
        return fidelity
    reason = f"{fidelity.reason}; then by hand: {', '.join(sorted(given))}" if fidelity.reason else ""
    return replace(fidelity, reason=reason, **given)
