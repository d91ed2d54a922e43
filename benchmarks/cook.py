"""Cook's membrane at finite strain in nearly incompressible rubber.

A tapered panel, 48 wide, clamped at the left (44 high), with a dead shear force of 100 per
depth spread over the right end (16 high); plane strain, neo-Hookean, E = 240.565. The corner
at the clamp is singular, so that every mesh converges at about first order.
"""

import jax.numpy as jnp
import numpy as np

from sorojax import fem, material, mesh
from sorojax.fem.assembly.space import AbstractFormulation
from sorojax.mesh import Mesh

YOUNG_MODULUS = 240.565
#: Vertical displacement of the upper right corner by Poisson ratio: biquadratic cells with
#: linear pressures, 48 a side, of an independent code.
REFERENCE = {0.49: 6.99332, 0.499: 6.93540, 0.4999: 6.92950}


def rubber(poisson_ratio: float) -> material.NeoHookean:
    return material.neo_hookean(young_modulus=YOUNG_MODULUS, poisson_ratio=poisson_ratio)


def tapered(grid: Mesh) -> Mesh:
    """The unit square (or cube) as the panel; sides of cells stay straight."""
    x, y = grid.points[:, 0], grid.points[:, 1]
    upright = 44 * x + y * (44 - 28 * x)
    moved = jnp.stack([48 * x, upright, *grid.points[:, 2:].T], axis=1)
    return Mesh(moved, grid.cells, grid.element, grid.node_sets, grid.facet_sets)


def plane_panel(
    element: mesh.AbstractElement,
    divisions: int,
    poisson_ratio: float,
    formulation: AbstractFormulation | None = None,
) -> fem.Problem:
    """The panel in plane strain, one deep, with `divisions` cells a side."""
    grid = mesh.rectangle([0, 0], [1, 1], divisions=(divisions, divisions), element=element)
    return _panel(grid, fem.PlaneStrain(1.0), (), poisson_ratio, formulation)


def solid_panel(
    element: mesh.AbstractElement,
    divisions: int,
    poisson_ratio: float,
    formulation: AbstractFormulation | None = None,
) -> fem.Problem:
    """A slice of the panel one cell deep between two planes of symmetry."""
    depth = 48 / divisions
    size = (divisions, divisions, 1)
    grid = mesh.box([0, 0, 0], [1, 1, depth], divisions=size, element=element)
    faces = np.union1d(grid.node_sets["bottom"], grid.node_sets["top"])
    held = (fem.Fixed(faces, components=(2,)),)
    return _panel(grid, fem.Solid(), held, poisson_ratio, formulation)


def _panel(grid, kinematics, held, poisson_ratio, formulation) -> fem.Problem:
    panel = tapered(grid)
    pull = np.zeros(panel.element.dim)
    pull[1] = 100 / 16
    return fem.problem(
        panel,
        rubber(poisson_ratio),
        kinematics=kinematics,
        supports=(fem.Fixed(panel.node_sets["left"]), *held),
        loads=(fem.Traction(panel.facet_sets["right"], pull),),
        formulation=formulation,
    )


def tip(problem: fem.Problem, solution: fem.Solution) -> float:
    """Vertical displacement of the upper right corner."""
    corner = np.zeros(problem.mesh.element.dim)
    corner[:2] = 48, 60
    return float(solution.displacement[mesh.nearest_node(problem.mesh, corner), 1])
