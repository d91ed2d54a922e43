"""The linearised problem: residual and tangent of body and loads, with supports applied."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sorojax._jax.jit import jit, once
from sorojax._types import from_host
from sorojax.fem.assembly import assemble as asm
from sorojax.fem.assembly.geometry import Geometry, geometry
from sorojax.fem.loads.facets import CurvedPart, group_matrices
from sorojax.fem.problem import Problem, load_force, unsupported
from sorojax.fem.supports import known_dofs
from sorojax.math.linalg import sparse


class Prepared(NamedTuple):
    """Computed once per solve: shape gradients, known unknowns, slots of load stiffness,
    and the size of the largest cell [m]."""

    geometry: Geometry
    known: Bool[Array, " dofs"]
    length: Float[Array, ""]
    group_slots: tuple[Int[Array, "groups entries"], ...]


class Linearised(NamedTuple):
    """Residual [N] and tangent values [N/m] of the whole problem at one state.

    `reference` is the largest load or support reaction [N], that residuals are judged by;
    `rounding` is the residual that rounding of u and of F = I + Grad u leaves [N].
    """

    residual: Float[Array, " dofs"]
    values: Float[Array, " nnz"]
    volume_ratio: Float[Array, ""]
    residual_norm: Float[Array, ""]
    reference: Float[Array, ""]
    rounding: Float[Array, ""]


def prepare(problem: Problem) -> Prepared:
    """Geometry and index maps of `problem` (slots of loads on the host, once per solve)."""
    dim = problem.mesh.element.dim
    known = known_dofs(problem.supports, problem.mesh.num_nodes, dim)
    points, slots = np.asarray(problem.mesh.points), []
    for groups in map(np.asarray, _curved_groups(unsupported(problem))):
        dofs = (groups[:, :, None] * dim + np.arange(dim)).reshape(len(groups), -1)
        slots.append(sparse.slots_of(problem.space.system, dofs))
    return Prepared(
        geometry(problem.space, problem.kinematics, problem.formulation, problem.mesh.points),
        from_host(known),
        jnp.asarray(_largest_cell(points, np.asarray(problem.mesh.cells))),
        tuple(slots),
    )


def _largest_cell(points: np.ndarray, cells: np.ndarray) -> float:
    """Longest edge of the boxes around the cells [m]; node by node and coordinate by
    coordinate, as rows and reductions over so short an axis take eight times as long."""
    longest, nodes = 0.0, np.ascontiguousarray(cells.T)
    for coordinate in np.ascontiguousarray(points.T):
        low = high = coordinate[nodes[0]]
        for column in nodes[1:]:
            here = coordinate[column]
            low, high = np.minimum(low, here), np.maximum(high, here)
        longest = max(longest, np.max(high - low))
    return longest


def linearise(
    problem: Problem,
    prepared: Prepared,
    u: Float[Array | np.ndarray, "nodes dim"],
    u_before: Float[Array | np.ndarray, "nodes dim"],
) -> Linearised:
    """Residual and tangent at `u`; see `assemble` for the part of `u_before`."""
    return _linearise(unsupported(problem), prepared, u, u_before)


#: Numbers in an array, as slots of matrices, from which on speed is worth a longer compilation:
#: 0.7 s are those of some 5,000 evaluations on 1,300 cells of Tri6, of 60 on 100,000.
_LARGEST = 2_000_000


@functools.partial(jit, kernels=False, largest=_LARGEST)
def _linearise(problem: Problem, prepared: Prepared, u, u_before) -> Linearised:
    body = asm.assemble(
        problem.space, prepared.geometry, problem.material, problem.kinematics, u, u_before
    )
    residual, norm, largest, length = unbalanced(problem, prepared, body.force, u)
    values = add_load_stiffness(problem, prepared, u, body.values)
    epsilon = 2 * jnp.finfo(u.dtype).eps
    return Linearised(
        residual=residual,
        values=values,
        volume_ratio=body.volume_ratio,
        residual_norm=norm,
        reference=largest,
        rounding=epsilon * jnp.max(jnp.abs(values)) * length,
    )


def unbalanced(problem: Problem, prepared: Prepared, force: Float[Array, " dofs"], u):
    """Internal `force` minus the loads [N], its largest free entry, the largest load or
    reaction that it is judged by, and the length [m] that rounding is judged by."""
    load = load_force(problem, u).ravel()
    residual = force - load
    zero = jnp.zeros_like(residual)
    free = jnp.where(prepared.known, zero, residual)
    reaction = jnp.where(prepared.known, residual, zero)
    largest = jnp.maximum(jnp.max(jnp.abs(load)), jnp.max(jnp.abs(reaction)))
    length = jnp.max(jnp.abs(u)) + prepared.length
    if any(load.stiff_in_positions for load in problem.loads):
        length = length + jnp.max(jnp.abs(problem.mesh.points))
    return residual, jnp.max(jnp.abs(free)), largest, length


def _curved_parts(problem: Problem) -> list[CurvedPart]:
    parts = [load.curved_part(problem) for load in problem.loads]
    return [part for part in parts if part is not None]


@once
def _curved_groups(problem: Problem) -> list[Int[Array, "groups group_nodes"]]:
    return [part.groups for part in _curved_parts(problem)]


def add_load_stiffness(problem: Problem, prepared: Prepared, u, values: Array) -> Array:
    """Tangent `values` of the body with the stiffness of its loads."""
    for part, slots in zip(_curved_parts(problem), prepared.group_slots, strict=True):
        x = (problem.mesh.points + u)[part.groups]
        values = values.at[slots].add(group_matrices(part, x))
    for load in problem.loads:
        if (constant := load.tangent_values(problem)) is not None:
            values = values + constant
    return values


@eqx.filter_jit
def load_stiffness(
    problem: Problem, prepared: Prepared, u: Float[Array, "nodes dim"]
) -> Float[Array, " nnz"]:
    """What the loads of an `unsupported` problem add to the tangent at `u` [N/m]."""
    nothing = jnp.zeros(problem.space.system.num_values, u.dtype)
    return add_load_stiffness(problem, prepared, u, nothing)


@once
def constrain(
    system: sparse.SparseSymmetric,
    values: Float[Array, " nnz"],
    residual: Float[Array | np.ndarray, " dofs"],
    known: Bool[Array, " dofs"],
) -> tuple[Float[Array, " nnz"], Float[Array, " dofs"]]:
    """Matrix and right-hand side of a Newton step in which known unknowns stay. Where they
    move, the tangent times their move is part of the `residual`."""
    rhs = -residual
    return sparse.fix(system, values, known), jnp.where(known, jnp.zeros_like(rhs), rhs)


class NewtonStep(NamedTuple):
    """A Newton step [m] on the host, `None` if the tangent is singular or the iterative solver
    does not get there; the number of negative eigenvalues; the factor, if a new one."""

    du: np.ndarray | None
    negative_eigenvalues: int
    factor: sparse.Factor | None


class Neighbour(NamedTuple):
    """A factor to solve with, from which guess [m], and to which relative error."""

    factor: sparse.Factor
    start: np.ndarray | None
    tolerance: float


def step(
    problem: Problem,
    prepared: Prepared,
    values: Float[Array, " nnz"],
    residual: Float[Array | np.ndarray, " dofs"],
    move: Float[np.ndarray, " dofs"],
    near: Neighbour | None = None,
) -> NewtonStep:
    """The Newton step at a tangent, by a `near` factor where that converges at once."""
    system = problem.space.system
    if np.any(move != 0):
        residual = np.asarray(residual) + system.solver.product(np.asarray(values), move)
    matrix, rhs = constrain(system, values, residual, prepared.known)
    matrix, rhs = np.asarray(matrix), np.asarray(rhs)
    shape = -1, problem.mesh.element.dim
    if near is not None:
        factor, start, tolerance = near
        du = system.solver.solve_by(factor, matrix, rhs, start, tolerance)
        if du is not None:
            return NewtonStep((du + move).reshape(shape), 0, None)
    factor = system.solver.factor(matrix)
    if factor is None:
        return NewtonStep(None, -1, None)
    if isinstance(factor, sparse.IterativeFactor):
        du, negative = factor.step(rhs)
        if du is None:
            return NewtonStep(None, -1, None)
        return NewtonStep((du + move).reshape(shape), negative, None)
    du = factor.solve(rhs)
    return NewtonStep((du + move).reshape(shape), factor.negative_eigenvalues, factor)
