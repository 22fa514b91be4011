"""Hops: find the equilibrium, unlock the actuators, roll out, report. And drops of the unloaded lattice."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tensegrity_gym.auto import choose_fidelity
from tensegrity_gym.batch import Progress
from tensegrity_gym.checks import is_number, or_default
from tensegrity_gym.core import records as rec
from tensegrity_gym.design import Design
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.fidelity import FIDELITIES, Fidelity, changed, named_fidelity
from tensegrity_gym.formfinding import Equilibria, form_find
from tensegrity_gym.hops import HopResult, hop, positive, run, time_step
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene
from tensegrity_gym.types import Floats

#: Height over the ground that a drop's masses start from at least: as good as none, and more than zero in float32 too [m].
LEAST_HEIGHT = 1e-30


def simulate(
    stretches: ArrayLike,
    *,
    design: Design | None = None,
    scene: Scene | None = None,
    lattice: Lattice | None = None,
    fidelity: Fidelity | str = "paper",
    tolerance: float | None = None,
    dt: float | None = None,
    integrator: str | None = None,
    precision: str | None = None,
    allow_unstable: bool = False,
    trajectory_rate: float | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
    equilibria: Equilibria | None = None,
) -> HopResult:
    """Hops of the lattice from the equilibria of ``stretches``, (n_actuators,) or (n, n_actuators).

    All actuators are unlocked at once at time 0 and the hop is followed to rest, at most for ``scene.duration``.

    * ``fidelity`` is "paper" (the paper's model), "single" (that in float32), "flown" (that, rigid in
      flight and followed no further than the landing), "reference" (the paper's converged in time), "auto" (the
      cheapest one known to hold ``tolerance`` [m] on the landing, by default the scene's floor; see ``docs/accuracy.md``) or a
      Fidelity.
    * ``dt`` [s], ``integrator`` and ``precision`` override the fidelity's. A ``dt`` above the critical step is refused unless
      ``allow_unstable``.
    * ``trajectory_rate`` [Hz] asks for frames; it changes nothing else. They are a whole number of 32 steps apart, one at least.
    * ``equilibria`` of the same stretches, lattice, gravity along the ground's normal and ``fidelity.design(design)`` (dampings
      apart, which do not count at rest) save finding them again.
    * ``progress`` is called with the number of hops newly ended, or not begun for want of an equilibrium.

    A hop that fails says so in ``status`` (see ``describe_failures``); its neighbours go on.

    Raises InvalidStretchesError and InvalidParameterError.
    """
    design, scene, lattice = (
        or_default(design, Design, "simulate"),
        Scene.of(scene, "simulate"),
        or_default(lattice, Lattice, "simulate"),
    )
    rate = 0.0 if trajectory_rate is None else positive("trajectory_rate", trajectory_rate)
    if fidelity == "auto":
        chosen = choose_fidelity(design, scene, lattice, tolerance)
    elif tolerance is not None:
        raise InvalidParameterError(f"simulate: expected a tolerance only with fidelity='auto', got fidelity={fidelity!r}")
    else:
        chosen = named_fidelity(fidelity)
    chosen = changed(chosen, {"integrator": integrator, "precision": precision})
    modelled = chosen.design(design)
    if equilibria is None:
        time_step(dt, modelled, lattice, chosen, allow_unstable)  # refused before the search, not after it
        equilibria = form_find(stretches, design=modelled, scene=scene, lattice=lattice, threads=threads)
    else:
        _check_equilibria(equilibria, stretches, modelled, scene, lattice)
    return hop(
        equilibria,
        design=design,
        scene=scene,
        lattice=lattice,
        fidelity=chosen,
        dt=dt,
        allow_unstable=allow_unstable,
        rate=rate,
        threads=threads,
        progress=progress,
    )


def _check_equilibria(found: Equilibria, stretches: ArrayLike, design: Design, scene: Scene, lattice: Lattice) -> None:
    if np.shape(np.atleast_2d(stretches)) != found.stretches.shape or not np.allclose(stretches, found.stretches):
        raise InvalidParameterError("simulate: expected the stretches that the equilibria were found for, got others")
    if found.lattice != lattice:
        raise InvalidParameterError(f"simulate: expected equilibria of {lattice}, got some of {found.lattice}; find them anew")
    if found.design.undamped() != design.undamped():
        wanted, came = (f"{type(d).__name__} {vars(d)}" for d in (design, found.design))
        if type(design) is type(found.design):
            other = [name for name, value in vars(design.undamped()).items() if getattr(found.design.undamped(), name) != value]
            wanted, came = (", ".join(f"{name} {getattr(d, name):g}" for name in other) for d in (design, found.design))
        raise InvalidParameterError(
            f"simulate: expected equilibria of a design with {wanted}, got some with {came}; find them with "
            "form_find(..., design=fidelity.design(design))"
        )
    gravity = -float(scene.gravity_vector[2])
    if not np.isclose(found.gravity, gravity, rtol=1e-6, atol=0.0):
        raise InvalidParameterError(
            f"simulate: expected equilibria under {gravity:.7g} m/s^2 along the ground's normal, got some under "
            f"{found.gravity:.7g}; find them with form_find(..., scene=scene)"
        )


def drop(
    velocity: ArrayLike,
    *,
    height: float = 0.0,
    attitude: ArrayLike = (1.0, 0.0, 0.0, 0.0),
    spin: ArrayLike = (0.0, 0.0, 0.0),
    design: Design | None = None,
    scene: Scene | None = None,
    lattice: Lattice | None = None,
    fidelity: Fidelity | str = "paper",
    dt: float | None = None,
    trajectory_rate: float | None = None,
    threads: int | None = None,
) -> HopResult:
    """Landings of the unloaded lattice, dropped with its lowest mass ``height`` [m] above the ground; a batch by broadcasting.

    Args:
        velocity: of the centre of mass [m/s], shape (3,) or (n, 3).
        height: [m], at least 0.
        attitude: unit quaternion (w, x, y, z) from the design's frame to the ground's, shape (4,) or (n, 4).
        spin: angular velocity [rad/s], shape (3,) or (n, 3).

    The rest is as for :func:`simulate`, but for fidelity "auto", which only hops have; the result's take-off is the moment of
    release, its stretches are 1.

    Raises InvalidParameterError.
    """
    design, scene, lattice = or_default(design, Design, "drop"), Scene.of(scene, "drop"), or_default(lattice, Lattice, "drop")
    chosen = named_fidelity(fidelity, tuple(FIDELITIES))  # "auto" knows the errors of hops, not those of drops
    modelled = chosen.design(design)
    rows = [_as_rows(name, a) for name, a in (("velocity", velocity), ("attitude", attitude), ("spin", spin))]
    n = max(len(row) for row in rows)
    for name, row, width in zip(("velocity", "attitude", "spin"), rows, (3, 4, 3), strict=True):
        if row.ndim != 2 or row.shape[1] != width or len(row) not in (1, n) or not np.isfinite(row).all():
            raise InvalidParameterError(f"drop: expected {name} finite, of shape ({width},) or ({n}, {width}), got {row!r}")
    if not is_number(height) or height < 0:
        raise InvalidParameterError(f"drop: expected height to be a finite number >= 0 [m], got {height!r}")
    wide = [np.broadcast_to(row, (n, row.shape[1])) for row in rows]
    starts = _falling(modelled, lattice, wide[0], wide[1], wide[2], height)
    rate = 0.0 if trajectory_rate is None else positive("trajectory_rate", trajectory_rate, "drop")
    return run(
        starts,
        np.ones(n, dtype=bool),
        np.zeros(n),
        np.ones((n, lattice.n_cells)),
        phase=rec.FLYING,
        design=modelled,
        scene=scene,
        lattice=lattice,
        fidelity=chosen,
        dt=time_step(dt, modelled, lattice, chosen, caller="drop"),
        rate=rate,
        threads=threads,
    )


def _as_rows(name: str, values: ArrayLike) -> Floats:
    try:
        return np.atleast_2d(np.asarray(values, dtype=np.float64))
    except (TypeError, ValueError):
        raise InvalidParameterError(f"drop: expected {name} as an array of finite numbers, got {values!r}") from None


def _falling(
    design: Design, lattice: Lattice, velocity: np.ndarray, attitude: np.ndarray, spin: np.ndarray, height: float
) -> np.ndarray:
    """Positions and velocities of unloaded lattices, shape (n, 2, n_masses, 3), centres of mass above the origin."""
    length = np.linalg.norm(attitude, axis=1, keepdims=True)
    if (np.abs(length - 1.0) > 1e-3).any():
        raise InvalidParameterError(f"drop: expected attitude to be unit quaternions, got lengths {length.ravel()}")
    w, axis = attitude[:, :1] / length, attitude[:, 1:] / length
    mass = design.structure(lattice).mass
    shape = design.unloaded_positions(lattice)
    shape = shape - (mass[:, None] * shape).sum(axis=0) / mass.sum()
    # q r q*: r + 2 w (u x r) + 2 u x (u x r)
    turn = np.cross(axis[:, None], shape[None])
    arms = shape + 2 * w[:, None] * turn + 2 * np.cross(axis[:, None], turn)
    lift = np.zeros((len(arms), 1, 3))
    lift[:, 0, 2] = height - arms[:, :, 2].min(axis=1)
    positions = arms + lift
    # a mass at the very height of the ground would be stopped before it came down, and its touchdown be missed
    positions[:, :, 2] = np.maximum(positions[:, :, 2], LEAST_HEIGHT)
    return np.stack([positions, velocity[:, None] + np.cross(spin[:, None], arms)], axis=1)
