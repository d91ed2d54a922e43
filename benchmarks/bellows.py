"""Reference case A: the bellows actuator in a neo-Hookean rubber under pressure.

Side view of 66 x 15 mm, plane strain; mu = 400 kPa, K = 20 MPa, ten times that in the
layer 0 <= y <= 1 mm; left edge fixed, follower pressure in all five chambers.
"""

import numpy as np

from sorojax import fem, material, mesh
from sorojax.cli.demo.design import bellows_problem
from sorojax.robots import BellowsActuator
from sorojax.units import MPa, kPa, mm

#: Displacement [mm] of the lower corner of the free end by pressure [kPa]: converged
#: solution of an independent code (six-node triangles of 0.16 mm, another mesher).
REFERENCE = {
    5.0: (-0.747749, -7.253550),
    10.0: (-2.317061, -13.242433),
    15.0: (-4.332888, -18.179925),
    20.0: (-6.577883, -22.275917),
}
PRESSURES = np.array(sorted(REFERENCE)) * kPa
RUBBER = material.NeoHookean(400 * kPa, 20 * MPa, density=1080.0)


def case_a(size: float, linear_pressure: bool = False) -> fem.Problem:
    """The problem with cells of about `size` [m], one metre deep: Tri6, or Tri7 with
    `linear_pressure`."""
    actuator = BellowsActuator()
    cells = mesh.triangulate(
        actuator.body(), size=size, order=2, interfaces=(actuator.layer(),)
    )
    cells = mesh.enrich(cells) if linear_pressure else cells
    plain = None if linear_pressure else fem.Displacement()
    return bellows_problem(actuator, cells, RUBBER, 1.0, plain)


def tip_errors(problem: fem.Problem, displacements) -> np.ndarray:
    """Length of the error vector at the tip over that of the reference, per pressure."""
    tip = mesh.nearest_node(problem.mesh, [66 * mm, 0.0])
    found = np.asarray(displacements)[:, tip] / mm
    wanted = np.array([REFERENCE[p] for p in sorted(REFERENCE)])
    return np.linalg.norm(found - wanted, axis=1) / np.linalg.norm(wanted, axis=1)
