"""The bellows actuator as a boundary value problem on its cross-section."""

from collections.abc import Sequence
from typing import Any

from sorojax import fem, mesh
from sorojax._types import Numbers
from sorojax.material import AbstractHyperelastic
from sorojax.robots.bellows import BellowsActuator
from sorojax.units import mm


def bellows_problem(
    actuator: BellowsActuator,
    cells: mesh.Mesh,
    rubber: AbstractHyperelastic,
    *,
    depth: float = 20 * mm,
    gravity: Numbers | None = None,
    pushed: Sequence[int] = (),
) -> fem.Problem:
    """Clamped at its left end, with a pressure called "air" [Pa] in all chambers.

    Args:
        actuator: Its dimensions; concrete.
        cells: Of `mesh.triangulate(actuator.body(), ...)`.
        rubber: One material, or one value per cell.
        depth: Width across the plane of the side view [m].
        gravity: Acceleration [m/s^2]; a load called "gravity" where it is given.
        pushed: Bellows, counted from the clamp from 0 on, whose backs carry forces called
            "push_0", "push_2" and so on [N], zero to begin with.

    Raises:
        ValueError: If there is no such bellow.
    """
    loads: list[Any] = [fem.Pressure(mesh.facets_on(cells, actuator.chambers()), name="air")]
    if gravity is not None:
        loads.append(fem.Gravity(gravity))
    for k in pushed:
        nodes = mesh.nodes_on_line(cells, *actuator.back(k))
        loads.append(fem.Force(nodes, [0.0, 0.0], name=f"push_{k}"))
    clamped = mesh.nodes_where(cells, lambda p: p[0] < 1e-9)
    return fem.problem(
        cells,
        rubber,
        kinematics=fem.PlaneStrain(depth),
        supports=(fem.Fixed(clamped),),
        loads=tuple(loads),
    )
