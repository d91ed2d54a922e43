"""Drawing, rubber, mesh and problem of the bellows actuator."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax import fem, material, mesh, robots, sdf
from sorojax.robots import BellowsActuator
from sorojax.units import kPa, mm

DEPTH = 20 * mm
LAYER_STIFFNESS = 10.0
TOP_PRESSURE = 20 * kPa
DENSITY = 1080.0


class Design(NamedTuple):
    """The actuator, its rubber and the boundary value problem on its cross-section."""

    actuator: BellowsActuator
    tensile: material.TensileFit
    problem: fem.Problem
    area: float
    meshed_area: float

    @property
    def chamber_facets(self) -> Int[Array, "facets facet_nodes"]:
        (air,) = self.problem.loads
        assert isinstance(air, fem.Pressure)
        return air.facets


def draw(size: float) -> Design:
    """The design with cells of about `size` [m]."""
    actuator = BellowsActuator()
    tensile = material.fit_tensile(
        *material.presets.DRAGON_SKIN_30_POINTS, poisson_ratio=0.49, density=DENSITY
    )
    body = actuator.body()
    cells = mesh.triangulate(body, size=size, order=2, interfaces=(actuator.layer(),))
    return Design(
        actuator,
        tensile,
        bellows_problem(actuator, cells, tensile.material, DEPTH),
        float(sdf.area(body)),
        float(jnp.sum(mesh.cell_areas(cells))),
    )


def bellows_problem(
    actuator: BellowsActuator,
    cells: mesh.Mesh,
    rubber: material.AbstractHyperelastic,
    depth: float,
) -> fem.Problem:
    """Clamped at its left end, stiffer in its layer, pressure called "air"."""
    layer = actuator.layer()
    stiff = np.ones(cells.num_cells)
    stiff[mesh.cells_where(cells, lambda p: layer(p) < 0)] = LAYER_STIFFNESS
    return robots.bellows_problem(
        actuator, cells, material.Scaled(rubber, stiff), depth=depth,
        formulation=fem.Displacement(),  # stiffer by some 1.5 %: two cells through a wall
    )  # fmt: skip


class Sensitivity(NamedTuple):
    """Tip rotation [rad] at the top pressure and its derivative in every dimension.

    `difference` is the central difference (order 4) in the wall thickness [rad/m].
    """

    rotation: float
    gradient: dict[str, float]
    difference: float

    @property
    def error(self) -> float:
        return abs(self.gradient["wall_thickness"] / self.difference - 1)


def sensitivity(design: Design, path: fem.Path) -> Sensitivity:
    """d(tip rotation)/d(dimensions) by reverse mode, through mesh motion and equilibrium."""
    value, slopes = jax.value_and_grad(lambda a: tip_rotation(a, design, path))(design.actuator)
    names = (
        "wall_thickness",
        "bellow_width",
        "gap",
        "base",
        "chamber_height",
        "roof",
        "fillet",
    )
    return Sensitivity(
        float(value),
        {name: float(getattr(slopes, name)) for name in names},
        _difference(design, path, 10e-6),
    )


def tip_rotation(actuator: BellowsActuator, design: Design, path: fem.Path) -> Float[Array, ""]:
    """Rotation of the end face [rad] at the last pressure of `path`, negative when the
    actuator curls towards its layer."""
    flat = design.problem.mesh
    moved = mesh.move(flat, actuator.body(), interfaces=(actuator.layer(),))
    problem = eqx.tree_at(
        lambda p: (p.mesh.points, p.loads[0].value),
        design.problem,
        (moved.points, path.values[-1]),
    )
    tight = fem.Newton(residual_tolerance=1e-12)
    solution = fem.solve(problem, start=path.displacements[-1], newton=tight)
    low, high = end_face(design)
    face = (problem.mesh.points + solution.displacement)[jnp.array([low, high])]
    across = face[1] - face[0]
    return jnp.arctan2(-across[0], across[1])


def end_face(design: Design) -> tuple[int, int]:
    """Lowest and highest node of the free end."""
    a, flat = design.actuator, design.problem.mesh
    return (
        mesh.nearest_node(flat, [a.length, 0.0]),
        mesh.nearest_node(flat, [a.length, a.height]),
    )


def _difference(design: Design, path: fem.Path, h: float) -> float:
    def at(k: int) -> float:
        wall = design.actuator.wall_thickness + k * h
        changed = eqx.tree_at(lambda a: a.wall_thickness, design.actuator, wall)
        return float(tip_rotation(changed, design, path))

    return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * h)
