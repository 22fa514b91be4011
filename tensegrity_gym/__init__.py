"""Soft tensegrity robots that store energy by buckling their bars, and hop: simulator and Gymnasium environment."""

from tensegrity_gym.design import Design
from tensegrity_gym.env import register_envs
from tensegrity_gym.errors import (
    DataFileError,
    InvalidParameterError,
    InvalidStretchesError,
    OutputFolderError,
    TensegrityError,
    UnknownPresetError,
)
from tensegrity_gym.fidelity import Fidelity
from tensegrity_gym.formfinding import STRETCH_RANGE, Equilibria, form_find
from tensegrity_gym.hops import HopResult, Trajectory
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.scene import Scene
from tensegrity_gym.simulate import drop, simulate
from tensegrity_gym.types import ENERGY_NAMES, HopStatus
from tensegrity_gym.version import MODEL_VERSION, __version__

register_envs()

__all__ = [
    "ENERGY_NAMES",
    "MODEL_VERSION",
    "STRETCH_RANGE",
    "DataFileError",
    "Design",
    "Equilibria",
    "Fidelity",
    "HopResult",
    "HopStatus",
    "InvalidParameterError",
    "InvalidStretchesError",
    "Lattice",
    "OutputFolderError",
    "Scene",
    "TensegrityError",
    "Trajectory",
    "UnknownPresetError",
    "__version__",
    "drop",
    "form_find",
    "simulate",
]
