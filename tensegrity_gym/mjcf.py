"""Export of a lattice to MuJoCo's MJCF, as an independent oracle for its springs in flight.

Point masses are bodies on three slides, springs are spatial tendons; a cable's dead band from 0 to its natural length makes
it tension-only. MuJoCo has no bending spring between three masses: hinge forces are left out, and so is contact, which is a
soft constraint there and not comparable with impulses.
"""

from __future__ import annotations

from itertools import pairwise
from xml.etree import ElementTree as ET

import numpy as np

from tensegrity_gym.design import Design
from tensegrity_gym.lattice import Lattice
from tensegrity_gym.types import Floats


def _number(value: float) -> str:
    return repr(float(value))


def to_mjcf(lattice: Lattice, design: Design, positions: Floats, *, gravity: Floats, dt: float) -> str:
    """MJCF text of the unlocked lattice at ``positions`` (n_masses, 3) [m], stepped by ``dt`` [s] with MuJoCo's Euler.

    Degrees of freedom are ordered mass by mass, x, y, z; ``qpos`` is the displacement from ``positions``. ``gravity`` [m/s^2]
    has shape (3,). Undamped: MuJoCo's damping is implicit and not comparable.
    """
    structure = design.structure(lattice)
    root = ET.Element("mujoco", model=f"tensegrity {lattice.nx}x{lattice.ny}")
    option = ET.SubElement(root, "option", timestep=_number(dt), integrator="Euler", gravity=" ".join(map(_number, gravity)))
    ET.SubElement(option, "flag", contact="disable", constraint="disable", eulerdamp="disable")
    world = ET.SubElement(root, "worldbody")
    for i, (mass, where) in enumerate(zip(structure.mass, positions, strict=True)):
        body = ET.SubElement(world, "body", name=f"m{i}", pos=" ".join(map(_number, where)))
        for axis in ("1 0 0", "0 1 0", "0 0 1"):
            ET.SubElement(body, "joint", type="slide", axis=axis)
        ET.SubElement(body, "inertial", mass=_number(mass), pos="0 0 0", diaginertia="1e-6 1e-6 1e-6")
        ET.SubElement(body, "site", name=f"s{i}")
    tendons = ET.SubElement(root, "tendon")

    def spring(i: int, j: int, stiffness: float, natural: float, tension_only: bool) -> None:
        length = f"0 {_number(natural)}" if tension_only else _number(natural)
        tendon = ET.SubElement(tendons, "spatial", stiffness=_number(stiffness), springlength=length)
        ET.SubElement(tendon, "site", site=f"s{i}")
        ET.SubElement(tendon, "site", site=f"s{j}")

    for (i, j), stiffness, natural in zip(structure.cables, structure.cable_stiffness, structure.cable_length, strict=True):
        spring(i, j, stiffness, natural, True)
    for (i, j), rigidity, natural in zip(
        structure.actuators, structure.actuator_rigidity, structure.actuator_length, strict=True
    ):
        spring(i, j, rigidity / natural, natural, True)
    for bar, stiffness, natural in zip(structure.bars, structure.segment_stiffness, structure.segment_length, strict=True):
        for i, j in pairwise(bar):
            spring(i, j, stiffness, natural, False)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode")


def mujoco_state(positions: Floats, start: Floats) -> Floats:
    """``qpos`` of masses at ``positions`` in a model exported at ``start``, shape (3 n_masses,) [m]."""
    return np.ascontiguousarray(positions - start).reshape(-1)
