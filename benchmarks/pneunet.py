"""A fast PneuNet in plane strain: thin walls 0.55 mm apart that touch at a few kPa."""

import numpy as np

from sorojax import fem, material, mesh
from sorojax.cli.demo.design import bellows_problem
from sorojax.robots import BellowsActuator
from sorojax.units import MPa, kPa, mm

RUBBER = material.NeoHookean(200 * kPa, 10 * MPa, density=1080.0)


def actuator(num_bellows: int = 4) -> BellowsActuator:
    return BellowsActuator(
        wall_thickness=1 * mm,
        bellow_width=7 * mm,
        gap=0.55 * mm,
        base=2.5 * mm,
        roof=1.5 * mm,
        fillet=0.25 * mm,
        num_bellows=num_bellows,
    )


def pneunet(
    size: float, touching: bool = True, stiffness: float | None = None, num_bellows: int = 4
) -> fem.Problem:
    """The actuator with cells of about `size` [m], one metre deep; `touching` lets the
    walls of neighbouring chambers push on each other."""
    shape = actuator(num_bellows)
    cells = mesh.triangulate(shape.body(), size=size, order=2, interfaces=(shape.layer(),))
    base = bellows_problem(shape, cells, RUBBER, 1.0, fem.Displacement())
    if not touching:
        return base
    walls = mesh.facets_on(cells, shape.notches())
    contact = fem.SelfContact(walls, stiffness=stiffness, reach=0.8 * mm, name="walls")
    return fem.problem(
        cells,
        base.material,
        kinematics=base.kinematics,
        supports=base.supports,
        loads=(*base.loads, contact),
        formulation=base.formulation,
    )


def tip_turn(problem: fem.Problem, u) -> float:
    """Rotation of the free end [degrees], positive towards the layer."""
    points, moved = np.asarray(problem.mesh.points), np.asarray(problem.mesh.points + u)
    right = points[:, 0].max()
    low = mesh.nearest_node(problem.mesh, [right, 0.0])
    high = mesh.nearest_node(problem.mesh, [right, points[:, 1].max()])
    across = moved[high] - moved[low]
    return float(np.degrees(np.arctan2(across[0], across[1])))
