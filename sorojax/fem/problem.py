"""The boundary value problem, the constructor that checks it, and its total potential energy.

The energy is written for differentiation by parameters: the derivative of the residual in any
number of the problem, forward or reverse, costs a few elementwise passes between two products
with the shape gradients.
"""

import copy
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._arguments import sized
from sorojax._display import displayed
from sorojax._jax.jit import once
from sorojax.fem import checks
from sorojax.fem.assembly.energy import Body, energy_density
from sorojax.fem.assembly.geometry import Points, deformation, quadrature_points
from sorojax.fem.assembly.space import (
    AbstractFormulation,
    Space,
    default_formulation,
    modes,
    space as make_space,
)
from sorojax.fem.kinematics import AbstractKinematics, Solid
from sorojax.fem.loads import checks as checks_loads
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.fem.supports import AbstractSupport
from sorojax.material.hyperelastic import AbstractHyperelastic
from sorojax.math.linalg.sparse import ConjugateGradient
from sorojax.mesh.mesh import Mesh, axis_lengths


@displayed
class Problem(eqx.Module):
    """A hyperelastic body, how it is held and what loads it.

    Every number in it can carry a gradient; print it to see what is paid for.

    Attributes:
        mesh: The body at rest.
        material: Its stored energy and density, with one number or one per cell.
        kinematics: Plane strain, plane stress, axisymmetric or solid.
        supports: Displacements that are known.
        loads: What acts on the body, each with a potential.
        formulation: How the pressure varies inside a cell.
        space: Unknowns of the mesh and pattern of the tangent, from mesh and loads.
    """

    mesh: Mesh
    material: AbstractHyperelastic
    kinematics: AbstractKinematics
    supports: tuple[AbstractSupport, ...]
    loads: tuple[AbstractLoad, ...]
    formulation: AbstractFormulation
    space: Space

    def __repr__(self) -> str:
        system, mesh = self.space.system, self.mesh
        rows = [
            f"Problem: {mesh.num_cells} {mesh.element.name} cells, {self.space.num_dofs} dof",
            f"  body      {type(self.material).__name__}, {type(self.kinematics).__name__}, "
            f"{type(self.formulation).__name__}",
            f"  tangent   {system.num_values} entries, {system.means}",
        ]
        for support in self.supports:
            rows.append(f"  support   {type(support).__name__} on {support.nodes.size} nodes")
        rows += [f"  load      {_described(load)}" for load in self.loads]
        return "\n".join(rows)


def _described(load: AbstractLoad) -> str:
    """The nodes that a load acts on, and the entries that it adds to the tangent."""
    text = f"{type(load).__name__} '{load.name}'"
    for what in ("facets", "nodes"):
        if (ids := getattr(load, what, None)) is not None:
            text += f" on {len(ids)} {what}"
    if (groups := load.couples()) is not None:
        text += f", couples {groups.shape[0]} group(s) of {groups.shape[1]} nodes"
    return text


@sized(Problem)
def _(problem: Problem) -> dict[str, int]:
    return axis_lengths(problem.mesh)


def unsupported(problem: Problem) -> Problem:
    """`problem` for kernels that no support enters, so that other supports do not compile
    them again."""
    return exchanged(problem, supports=())


def body(problem: Problem) -> Problem:
    """`problem` for kernels that neither supports nor loads enter."""
    return exchanged(problem, supports=(), loads=())


def exchanged(problem: Problem, **parts: Any) -> Problem:
    """`problem` with other `parts`: what `dataclasses.replace` returns."""
    # many calls of every solve: a copy, as the checks of a constructor take longer
    other = copy.copy(problem)
    for name, part in parts.items():
        object.__setattr__(other, name, part)
    return other


def with_terms(problem: Problem, terms: tuple) -> Problem:
    """`problem` under other loads and supports, with another material if there is a third."""
    loads, supports, *material = terms
    other = exchanged(problem, loads=loads, supports=supports)
    return exchanged(other, material=material[0]) if material else other


def problem(
    mesh: Mesh,
    material: AbstractHyperelastic,
    *,
    kinematics: AbstractKinematics | None = None,
    supports: tuple[AbstractSupport, ...],
    loads: tuple[AbstractLoad, ...] = (),
    formulation: AbstractFormulation | None = None,
    space: Space | None = None,
    solver: str | ConjugateGradient = "direct",
    free: bool = False,
) -> Problem:
    """A checked boundary value problem: a hyperelastic body, how it is held and what loads it.

    Its equilibrium is a stationary point of the stored energy of the cells plus the potential
    of the loads (total Lagrangian). What can be checked without solving is checked here.

    Args:
        mesh: Cells in the reference configuration, points [m]; points may be traced, cells not.
        material: Stored energy per reference volume [J/m^3]; its numbers are scalars or arrays
            with one entry per cell.
        kinematics: `PlaneStrain(thickness)`, `PlaneStress(thickness)` or `Axisymmetric()`
            for a plane mesh, thickness [m]; `Solid()`, the default, in space.
        supports: `Fixed(nodes)`, `Prescribed(nodes, displacement)` [m], `Rotated(...)`.
        loads: `Pressure`, `Traction`, `Force`, `Torque`, `Gravity`, `Spring`, `Foundation`,
            `Tendon`, `Cable`, `Contact`, `rigid(mesh, nodes)` and `embedded_rod(mesh, points)`;
            none by default.
        formulation: How the pressure varies in a cell. By default `LinearPressure()` for
            Tri7, Quad9 and Tet15, `ConstantPressure()` for Quad4, Hex8 and polygons, and
            `Displacement()` for the rest and in plane stress.
        space: The mesh's `space(mesh, loads)`, to share between problems on the same
            topology; made anew by default.
        solver: How linear systems are solved, unless `space` says so: "direct",
            "conjugate_gradient" or `ConjugateGradient(...)`.
        free: Accept a body that could move rigidly, for `simulate`.

    Returns:
        The problem; every number in it can carry a derivative.

    Raises:
        ValueError: If the body could move rigidly, a set is empty, a cell is inverted, the
            material does not fit the mesh, the formulation would lock or oscillate, a
            pressure acts on an open run of facets, or the points are not float64.

    Example:
        >>> bar = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1),
        ...                      element=mesh.Quad9())
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000)
        >>> problem = fem.problem(
        ...     bar, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...     supports=(fem.Fixed(bar.node_sets["left"]),),
        ...     loads=(fem.Force(bar.node_sets["right"], [0, -0.02], name="push"),))
        >>> problem.space.num_dofs
        54
    """
    _check.float64("fem.problem", mesh.points)
    supports, loads = tuple(supports), tuple(loads)
    kinematics = checks.kinematics(
        mesh, kinematics if mesh.element.dim == 2 or kinematics else Solid()
    )
    checks.cells(mesh)
    checks.material(mesh, material)
    if formulation is None:
        formulation = default_formulation(mesh.element, kinematics)
        checks.locking(mesh, material, kinematics, formulation)
    checks.formulation(mesh, kinematics, formulation)
    known = checks.supports(mesh, kinematics, supports)
    loads = tuple(checks_loads.enriched(mesh, load) for load in loads)
    checks_loads.sets(mesh, loads)
    loads = tuple(load.completed(mesh, material, kinematics) for load in loads)
    loads = checks_loads.parallel_to_ends(mesh, kinematics, loads, known)
    checks_loads.loads(mesh, kinematics, material, loads, known)
    if space is None:
        space = make_space(mesh, loads, solver)
    else:
        checks.space(mesh, space)
        checks_loads.room(space, loads)
    made = Problem(mesh, material, kinematics, supports, loads, formulation, space)
    if not free:
        checks.held(made, known)
    return made


# Total potential energy in a form made for differentiation by parameters


def load_potential(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, ""]:
    """Potential energy of all loads [J]."""
    terms = (load.potential(problem, u) for load in problem.loads)
    return sum(terms, start=jnp.zeros((), u.dtype))


def body_at(problem: Problem, points: Points) -> Body:
    """Data of the energy at the quadrature points of all cells."""
    material = jax.tree.map(
        lambda leaf: leaf[None] if jnp.ndim(leaf) == 1 else leaf, problem.material
    )
    pressures = modes(problem.formulation, points.position, points.volumes)
    return Body(material, problem.kinematics, pressures, points.volumes)


def potential_energy(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, ""]:
    """Stored energy plus the potential of all loads [J].

    Args:
        problem: The boundary value problem.
        u: Displacement of the nodes [m].

    Returns:
        Energy [J].
    """
    return _potential_energy(unsupported(problem), u)


@once
def _potential_energy(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, ""]:
    points = quadrature_points(problem.mesh, problem.kinematics)
    F = deformation(problem.mesh, problem.kinematics, points, u)
    density = energy_density(body_at(problem, points), F)
    return jnp.sum(points.volumes * density) + load_potential(problem, u)


def residual(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, "nodes dim"]:
    """Slope of the potential energy by every node [N]: zero at equilibrium but at supports,
    where `reactions` tells what these exert.

    Args:
        problem: The boundary value problem.
        u: Displacement of the nodes [m].

    Returns:
        Force [N].
    """
    return _residual(unsupported(problem), u)


@once
def _residual(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, "nodes dim"]:
    return jax.grad(_potential_energy, argnums=1)(problem, u)


@jax.jit
def load_force(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, "nodes dim"]:
    """Force of all loads on the nodes [N]."""
    return -jax.grad(load_potential, argnums=1)(problem, u)
