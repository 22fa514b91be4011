"""Where the robot hops: gravity, slope, ground contact, how long to look, and where a landing is read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from tensegrity_gym.errors import InvalidParameterError, UnknownPresetError
from tensegrity_gym.types import Floats, Ground

LANDINGS = ("rest", "touchdown")
#: Gravity on Earth [m/s^2], and how long hops are followed there [s]: past touchdown, a third of them to rest.
EARTH_GRAVITY, EARTH_DURATION = 9.80665, 3.0
#: By which power of gravity hops are followed longer where it is weaker: it puts the presets' durations within 5 %.
SLOWNESS = 0.76
#: Longest duration that a scene may have [s].
LONGEST = 1e4


def usual_duration(gravity: float) -> float:
    """How long to follow hops under ``gravity`` [m/s^2], so that all come down: flights last as 1/g [s].

    At most what a scene may have; for a gravity that no scene has, Earth's.
    """
    slower = (EARTH_GRAVITY / gravity) ** SLOWNESS if gravity > 0 else 1.0
    return min(EARTH_DURATION * max(1.0, slower), LONGEST)


@dataclass(frozen=True)
class Scene:
    """A planet's ground. SI units, angles in radians."""

    gravity: float = EARTH_GRAVITY
    """Acceleration of gravity [m/s^2]."""
    slope: float = 0.0
    """Inclination of the ground [rad]."""
    slope_direction: float = 0.0
    """Azimuth of the downhill direction from +x towards +y [rad]."""
    friction: float = 0.5
    """Coulomb friction coefficient mu [-]."""
    restitution: float = 0.0
    """Newton's coefficient of restitution e of each point mass on the ground [-]."""
    duration: float = None  # type: ignore[assignment]
    """Longest time that a hop is simulated after its release [s]; None: ``usual_duration`` of the gravity."""
    landing: str = "rest"
    """Where ``landing`` is read: "rest" (hop over) or "touchdown" (first impact after flight)."""

    PRESETS: ClassVar[dict[str, dict[str, float]]] = {
        "earth": {"gravity": EARTH_GRAVITY, "duration": EARTH_DURATION},
        "moon": {"gravity": 1.625, "duration": 12.0},
        "mars": {"gravity": 3.7208, "duration": 6.0},
        "titan": {"gravity": 1.352, "duration": 14.0},
        "slope": {"gravity": EARTH_GRAVITY, "slope": float(np.radians(10.0)), "friction": 0.7, "duration": EARTH_DURATION},
    }

    def __post_init__(self) -> None:
        bounds = {
            "gravity": (0.0, 1e3),
            "slope": (0.0, np.pi / 2),
            "slope_direction": (-2 * np.pi, 2 * np.pi),
            "friction": (0.0, 1e3),
            "restitution": (0.0, 1.0),
            "duration": (0.0, LONGEST),
        }
        for name, (low, high) in bounds.items():
            value = getattr(self, name)
            if name == "duration" and value is None:
                value = usual_duration(self.gravity)
                object.__setattr__(self, name, value)
            if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not low <= value <= high:
                raise InvalidParameterError(f"Scene.{name}: expected a number in [{low:g}, {high:g}], got {value!r}")
        if self.slope == np.pi / 2:
            raise InvalidParameterError(
                f"Scene.slope: expected less than pi/2 [rad], got {self.slope!r}: along a vertical wall nothing would ever land; "
                "take a gentler slope"
            )
        if self.gravity == 0 or self.duration == 0:
            raise InvalidParameterError("Scene.gravity and Scene.duration: expected > 0, got 0; nothing would ever land")
        if self.landing not in LANDINGS:
            raise InvalidParameterError(f"Scene.landing: expected one of {LANDINGS}, got {self.landing!r}")

    @classmethod
    def preset(cls, name: str, **changes: Any) -> Scene:
        """A named scene: one of ``Scene.PRESETS``, with fields changed by keyword.

        Where gravity is made weaker and no duration is given, hops are followed longer, for their ``usual_duration``.

        Raises UnknownPresetError for a name that is not there.
        """
        if name not in cls.PRESETS:
            raise UnknownPresetError(f"Scene.preset: expected one of {sorted(cls.PRESETS)}, got {name!r}")
        scene = replace(cls(**cls.PRESETS[name]), **changes)  # type: ignore[arg-type]
        return scene.lasting() if "gravity" in changes and "duration" not in changes else scene

    def lasting(self, least_gravity: float | None = None) -> Scene:
        """The scene with a duration that does for its own gravity, or for ``least_gravity`` [m/s^2], if it has not one yet."""
        wanted = usual_duration(self.gravity if least_gravity is None else least_gravity)
        return self if self.duration >= wanted else replace(self, duration=wanted)

    @classmethod
    def of(cls, scene: Any, caller: str) -> Scene:
        """``scene``, or the default one for None; InvalidParameterError, in the name of ``caller``, for anything else."""
        if scene is None:
            return cls()
        if not isinstance(scene, Scene):
            known = isinstance(scene, str) and scene in cls.PRESETS
            fix = f"use Scene.preset({scene!r})" if known else f"use Scene(...), or Scene.preset(name) of {sorted(cls.PRESETS)}"
            raise InvalidParameterError(f"{caller}: expected scene to be a Scene or None, got {scene!r}; {fix}")
        return scene

    @property
    def gravity_vector(self) -> Floats:
        """Gravity in the frame of the ground, whose normal is +z, shape (3,) [m/s^2]."""
        downhill = np.array((np.cos(self.slope_direction), np.sin(self.slope_direction), 0.0))
        return self.gravity * (np.sin(self.slope) * downhill - np.cos(self.slope) * np.array((0.0, 0.0, 1.0)))

    @property
    def ground(self) -> Ground:
        """What the kernels need of the scene."""
        return Ground(self.gravity_vector, float(self.friction), float(self.restitution))
