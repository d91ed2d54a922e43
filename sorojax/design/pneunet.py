"""One cell of a bending actuator whose chamber is found by topology optimisation.

The cell is held on its left side; what counts is how far the right side turns under a
pressure that follows the design. Everything can be exchanged: `PneuNetCell` is put together
from the parts of this package.

Reference: Caasenbrood, Pogromsky, Nijmeijer, "Sorotoki: a Matlab toolkit for design,
modeling, and control of soft robots", IEEE Access 12, 2024, section VI-B.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.design.density.layout import Layout, Mirrored, Simp, layout
from sorojax.design.density.pressure import (
    Darcy,
    Flood,
    VoidPressure,
    darcy,
    flood,
    of_cells,
    of_nodes,
    void_pressure,
)
from sorojax.design.density.void import InterpolatedEnergy, interpolated_energy
from sorojax.design.objectives import Follower, replaced_load, solid_of
from sorojax.design.optimise.minimise import DesignStep, Optimised, minimise
from sorojax.design.optimise.mma import MMA
from sorojax.fem import Fixed, Foundation, PlaneStrain, Problem, problem
from sorojax.fem.problem import exchanged
from sorojax.material import presets
from sorojax.material.hyperelastic import AbstractHyperelastic
from sorojax.mesh import rectangle
from sorojax.mesh.elements.tensor import Quad4
from sorojax.mesh.mesh import boundary_facets
from sorojax.units import kPa, mm


class PneuNetCell(eqx.Module):
    """A cell, what fills it and what it is asked to do, by `pneunet_cell`.

    Attributes:
        problem: The solid cell with a `void_pressure` called "air".
        plan: From variables to densities.
        chamber: Share of the pressure by density, `Flood` or `Darcy`.
        selector: L, the share of every displacement in the output; of norm one.
        start: Variables to begin with: a hole in the middle.
        volume: Largest volume of solid over that of the domain [-].
        interpolation: Stiffness by density.
    """

    problem: Problem
    plan: Layout
    chamber: Flood | Darcy
    selector: Float[Array, "nodes dim"]
    start: Float[Array, " variables"]
    volume: Float[Array, ""] = eqx.field(converter=real)
    interpolation: Simp = eqx.field(default_factory=lambda: Simp(3.0, 1e-6))


def body(cell: PneuNetCell, density: Float[Array, " cells"]) -> Problem:
    """The boundary value problem of a design."""
    return _filled(cell, _parts(*_model(cell), density))


def body_of(
    cell: PneuNetCell, x: Float[Array, " variables"], sharpness: Float[Array, ""]
) -> Problem:
    """`body` of the densities `cell.plan(x, sharpness)`, at a smaller price of a gradient."""
    return _filled(cell, _planned(cell.plan, *_model(cell), x, sharpness))


def _model(cell: PneuNetCell):
    parts = cell.interpolation, cell.chamber
    return parts, solid_of(cell.problem), cell.problem.mesh.cells


def _filled(cell: PneuNetCell, parts: tuple[InterpolatedEnergy, Array]) -> Problem:
    material, share = parts
    air = next(load for load in cell.problem.loads if load.name == "air")
    made = exchanged(cell.problem, material=material)
    return replaced_load(made, VoidPressure(share=share, value=air.value, name="air"))


# Everything that follows a design in one program: started one by one, small ones take as
# long as the solve when they are differentiated.


@jax.jit
def _parts(parts, base: AbstractHyperelastic, cells, density):
    interpolation, chamber = parts
    spread = of_nodes if isinstance(chamber, Darcy) else of_cells
    return interpolated_energy(base, interpolation(density)), spread(chamber(density), cells)


@jax.jit
def _planned(plan: Layout, parts, base: AbstractHyperelastic, cells, x, sharpness):
    return _parts(parts, base, cells, plan(x, sharpness))


def output(cell: PneuNetCell, u: Float[Array, "nodes dim"]) -> Float[Array, ""]:
    """L'x: how far the right side has turned, in its displacements along x [m]."""
    return _chosen(cell.selector, u)


@jax.jit
def _chosen(selector, u):
    return jnp.sum(selector * u)


def pneunet_cell(
    rubber: AbstractHyperelastic | None = None,
    *,
    size: tuple[float, float] = (15 * mm, 30 * mm),
    divisions: tuple[int, int] = (25, 50),
    hole: float = 5 * mm,
    pressure: float = 20 * kPa,
    volume: float = 0.45,
    wall: float = 1.2 * mm,
    base: float = 2.4 * mm,
    radius: float = 1.5 * mm,
    thickness: float = 25 * mm,
    output_stiffness: float = 3e4,
    chamber: str = "darcy",
) -> PneuNetCell:
    """The cell of the reference: clamped on its left side, springs on its right one.

    The reference does not tell pressure, volume, springs or passive parts. Here its sides
    and its roof are solid, where the next cells are glued and so that no design leaks, and
    its base, the layer that hardly stretches; the right half mirrors the left.

    Args:
        rubber: The material; `presets.flexible_80a()` if omitted.
        size: Width and height [m].
        divisions: Square cells along both.
        hole: Radius of the hole in the middle to begin with [m].
        pressure: In the chamber [Pa, gauge].
        volume: Largest volume of solid over that of the domain.
        wall: Of the solid sides and roof [m].
        base: Of the solid base [m].
        radius: Of the filter [m].
        thickness: Depth of the cell [m].
        output_stiffness: Of the springs on the right side, in all [N/m].
        chamber: How the pressure finds the void, "darcy" or "flood".

    Returns:
        Mesh, problem and filters of the cell.

    Raises:
        ValueError: If a size is not positive or `chamber` is neither.
    """
    if chamber not in ("darcy", "flood"):
        raise ValueError(f"pneunet_cell: got chamber={chamber!r}, need 'darcy' or 'flood'.")
    _check.between("pneunet_cell", "volume", volume, 0.0, 1.0, "", "0.5 is half solid.")
    grid = rectangle([0, 0], size, divisions=divisions, element=Quad4())
    kinematics = PlaneStrain(thickness)
    rubber = presets.flexible_80a() if rubber is None else rubber
    left, right = (np.asarray(grid.node_sets[side]) for side in ("left", "right"))
    made = problem(
        grid,
        interpolated_energy(rubber, jnp.ones(grid.num_cells)),
        kinematics=kinematics,
        supports=(Fixed(left),),
        loads=(
            void_pressure(grid, jnp.zeros(grid.num_cells), pressure, name="air"),
            Foundation(right, output_stiffness / len(right), name="spring"),
        ),
    )
    middle = np.asarray(size) / 2
    centres = np.asarray(grid.points)[np.asarray(grid.cells)].mean(axis=1)
    away = np.linalg.norm(centres - middle, axis=1)
    core = np.flatnonzero(away < 1.01 * away.min())
    frame = np.flatnonzero(
        (np.minimum(centres[:, 0], size[0] - centres[:, 0]) < wall)
        | (centres[:, 1] < base)
        | (centres[:, 1] > size[1] - wall)
    )
    plan = layout(
        grid, radius=radius, void=core, solid=frame, symmetries=(Mirrored(0, float(middle[0])),)
    )
    height = np.asarray(grid.points)[right, 1]
    selector = np.zeros(grid.points.shape)
    selector[right, 0] = height / np.linalg.norm(height)
    start = np.where(away < hole, 0.0, 1.0)
    start[frame] = 1.0
    held = np.isin(np.arange(len(start)), frame)
    rest = (volume * len(start) - np.sum(held)) / np.sum(start[~held])
    start[~held] *= np.clip(rest, 0.0, 1.0)
    return PneuNetCell(
        made,
        plan,
        _chamber(chamber, grid, made, core, radius),
        jnp.asarray(selector),
        plan.variables(jnp.asarray(start)),
        volume,
    )


def _chamber(kind: str, grid, made: Problem, core, radius: float) -> Flood | Darcy:
    if kind == "flood":
        return flood(grid, core, threshold=0.3)
    edge = np.unique(boundary_facets(grid))
    inlet = np.unique(np.asarray(grid.cells)[core])
    return darcy(
        grid,
        made.space,
        made.kinematics,
        sources=inlet,
        drains=edge,
        depth=radius,
        threshold=0.1,
        sharpness=20.0,
    )


def optimise_pneunet(
    cell: PneuNetCell,
    *,
    steps: int = 100,
    move: float = 0.05,
    on_step: Callable[[DesignStep], None] | None = None,
    resume: DesignStep | None = None,
) -> Optimised:
    """The chamber that turns the right side most, by moving asymptotes.

    The projection becomes steeper over the first six tenths of the steps (`sharpness`), then
    the move limit falls to a tenth, and for the last fifth to a fiftieth. Densities of a step
    are `cell.plan(step.design, sharpness(step.count - 1, steps))`.

    Args:
        cell: Of `pneunet_cell`.
        steps: Steps in all.
        move: Largest change of a variable in a step.
        on_step: As in `minimise`.
        resume: As in `minimise`.

    Returns:
        The design, and how the loop went.
    """
    solved = Follower()
    plan = cell.plan

    def loss(x, beta):
        return -output(cell, solved(body_of(cell, x, beta)).displacement)

    @jax.jit
    def held(x, beta):
        return plan.volume_fraction(plan(x, beta)) / cell.volume - 1

    def run(until, method, begin):
        return minimise(
            loss,
            cell.start,
            constraints=(held,),
            optimiser=method,
            steps=until,
            scale=scale,
            schedule=lambda k: (sharpness(k, steps),),
            on_step=on_step,
            resume=begin,
        )

    scale = 0.01 * float(jnp.sqrt(jnp.sum(cell.plan.volumes)))
    histories = []
    for share, slower in ((0.6, 1), (0.8, 10), (1.0, 50)):
        until, method = int(share * steps), MMA(move=move / slower)
        if resume is None or resume.count < until:
            found = run(until, method, resume)
            resume = found.last
            histories.append(found.history)
    joined = {key: np.concatenate([h[key] for h in histories]) for key in histories[0]}
    return eqx.tree_at(lambda f: f.history, found, joined)


def sharpness(step: int, steps: int = 100) -> Float[Array, ""]:
    """Sharpness of the projection at a step: from 1 to 32, evenly doubled over the first
    six tenths, so that no step is a jump and the rest converges."""
    return real(32.0 ** min(1.0, step / max(0.6 * steps, 1.0)))
