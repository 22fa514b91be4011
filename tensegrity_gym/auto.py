"""The cheapest model that holds a tolerance on the landing."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

from tensegrity_gym.calibration import LADDER, Calibration, calibrate, sample_stretches, stored_calibration
from tensegrity_gym.design import Design
from tensegrity_gym.errors import InvalidParameterError
from tensegrity_gym.fidelity import FIDELITIES, Fidelity
from tensegrity_gym.formfinding import form_find
from tensegrity_gym.hops import positive
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene

#: Hops that a scene unknown to the package is tried on, and their reference and unknowns: a dozen seconds at the 2x2 lattice.
PILOT_SAMPLES, PILOT_REFERENCE, PILOT_UNKNOWNS = 16, Fidelity(step=0.4), 2


def choose_fidelity(design: Design, scene: Scene, lattice: Lattice, tolerance: float | None = None) -> Fidelity:
    """The cheapest model of the ladder whose landings stay within ``tolerance`` [m] of the converged ones.

    By default the tolerance is the floor: what no one can know of the start and the material moves 95 % of the landings by less.
    Presets with the default design and lattice are looked up in the package's calibration; anything else is first tried on a
    few hops, once a process.

    Raises InvalidParameterError for a tolerance that is no finite number > 0.
    """
    if tolerance is not None:
        tolerance = positive("tolerance", tolerance)
    name = preset_of(scene) if design == Design() and lattice == Lattice() else None
    stored = stored_calibration(name, scene.landing) if name else None
    calibration = stored or pilot(design, scene, lattice)
    asked = calibration.floor if tolerance is None else tolerance
    named = "the floor of" if tolerance is None else "a tolerance of"
    known = f"{calibration.samples} hops {'stored for ' + str(name) if stored else 'tried here'}"
    for rung in calibration.rungs:
        if rung.error <= asked:
            reason = (
                f"auto: the cheapest of {len(calibration.rungs)} that holds {named} {_length(asked)} at {scene.landing}, "
                f"97 % of {known} within {_length(rung.error)}"
            )
            return replace(rung.fidelity, reason=reason)
    return replace(FIDELITIES["reference"], reason=f"auto: nothing cheaper is known to hold {named} {_length(asked)}, by {known}")


def preset_of(scene: Scene) -> str | None:
    """The preset that ``scene`` is, wherever its landing is read."""
    return next((name for name in Scene.PRESETS if Scene.preset(name, landing=scene.landing) == scene), None)


@lru_cache(maxsize=16)
def pilot(design: Design, scene: Scene, lattice: Lattice) -> Calibration:
    """A small calibration of the scene at hand; bars that no equilibrium loads to buckling may be modelled by one spring."""
    models = tuple(model for model in LADDER[scene.landing] if _suits(model, design))
    found = form_find(sample_stretches(PILOT_SAMPLES, 1, lattice.n_cells), design=design, scene=scene, lattice=lattice)
    if models and (found.bar_load < 0.9 * design.critical_load).all():
        models = (replace(models[0], bar_segments=1, bar_softening=1.0), *models)
    return calibrate(
        scene,
        PILOT_SAMPLES,
        design=design,
        lattice=lattice,
        ladder={scene.landing: models},
        unknowns=PILOT_UNKNOWNS,
        reference=PILOT_REFERENCE,
        threads=None,
    )[scene.landing]


def _suits(model: Fidelity, design: Design) -> bool:
    """Whether a model can have bars of that design: those that are softened must still bear their prestress."""
    try:
        model.design(design)
    except InvalidParameterError:
        return False
    return True


def _length(metres: float) -> str:
    return f"{1e3 * metres:.2g} mm" if metres < 0.01 else f"{metres:.2g} m"
