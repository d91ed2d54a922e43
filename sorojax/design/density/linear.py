"""Small displacements of a body of graded stiffness: one factorisation for a design.

The stiffness of every cell at rest is assembled once; a design scales it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from sorojax.fem import Problem
from sorojax.fem.assembly.space import Space, block_entries
from sorojax.fem.equilibrium.jit import assembled, stiffness_at_rest
from sorojax.fem.problem import load_force
from sorojax.fem.supports import known_dofs
from sorojax.math.linalg import sparse
from sorojax.mesh.elements.base import AbstractElement


class Linear(eqx.Module):
    """A problem linearised at rest, by `linear`.

    Attributes:
        space: Of the problem.
        stiffness: Matrices of the cells, in the blocks of the space.
        others: What loads add to the tangent, in the order of its values.
        force: Of the loads on every node [N].
        known: Unknowns that supports hold.
    """

    space: Space
    stiffness: Float[Array, "blocks entries lanes"]
    others: Float[Array, " nnz"]
    force: Float[Array, "nodes dim"]
    known: Bool[Array, " dofs"]


def linear(problem: Problem) -> Linear:
    """`problem` for small displacements: its cells, loads, springs and supports at rest.

    Prescribed displacements count as zero. Differentiable in every number of the problem.

    Args:
        problem: The problem.

    Returns:
        What `displacement` and `compliance` solve.
    """
    rest = jnp.zeros_like(problem.mesh.points)
    known = known_dofs(problem.supports, problem.mesh.num_nodes, problem.mesh.element.dim)
    cells, others = stiffness_at_rest(problem)
    return Linear(problem.space, cells, others, load_force(problem, rest), jnp.asarray(known))


@eqx.filter_jit
def displacement(
    model: Linear,
    factor: Float[Array, " cells"],
    force: Float[Array, "nodes dim"] | None = None,
) -> Float[Array, "nodes dim"]:
    """Displacement [m] when cell c has `factor[c]` times its stiffness.

    Differentiable in `model`, `factor` and `force` (that of the problem's loads if omitted),
    at one back-substitution with the same factorisation.

    Args:
        model: From `linear`.
        factor: Of the stiffness of each cell [-].
        force: On every node [N].

    Returns:
        Displacement of the nodes [m].
    """
    return _solved(model, factor, model.force if force is None else force)


@jax.custom_jvp
def _solved(model: Linear, factor, force):
    return _answer(model, _held(model, factor), force)


def _solved_derivative(primals, tangents):
    model, factor, force = primals
    model_dot, factor_dot, force_dot = tangents
    held = _held(model, factor)
    u = _answer(model, held, force)
    rate = jnp.zeros_like(u)
    if not isinstance(force_dot, SymbolicZero):
        rate = rate + force_dot
    if not isinstance(factor_dot, SymbolicZero):
        rate = rate - _weighed(model.space, _cell_forces(model, u), factor_dot)
    if (moved := _stiffened(model, model_dot, factor, u)) is not None:
        rate = rate - moved
    return u, _answer(model, held, rate)


_solved.defjvp(_solved_derivative, symbolic_zeros=True)


def _stiffened(
    model: Linear, model_dot: Linear, factor, u: Float[Array, "nodes dim"]
) -> Float[Array, "nodes dim"] | None:
    """Force at `u` of the change of the stiffness of cells and loads [N], if there is one."""
    changes = (model_dot.stiffness, model_dot.others)
    if all(isinstance(change, SymbolicZero) for change in changes):
        return None
    cells, others = (
        jnp.zeros_like(x) if isinstance(change, SymbolicZero) else change
        for x, change in zip((model.stiffness, model.others), changes, strict=True)
    )
    values = assembled(model.space, cells, factor) + others
    return sparse.product(model.space.system, values, u.ravel()).reshape(u.shape)


def _held(model: Linear, factor: Float[Array, " cells"]) -> Float[Array, " nnz"]:
    """Values of the tangent with the rows of supports exchanged."""
    values = assembled(model.space, model.stiffness, factor) + model.others
    return sparse.fix(model.space.system, values, model.known)


def _answer(model: Linear, held, force):
    """Of the free unknowns to `force`; those of supports do not move."""
    right = jnp.where(model.known, jnp.zeros_like(force.ravel()), force.ravel())
    return sparse.solve(model.space.system, held, right).reshape(force.shape)


def _cell_forces(
    model: Linear, u: Float[Array, "nodes dim"]
) -> Float[Array, "blocks cell_dofs lanes"]:
    """Force of every cell of full stiffness on its nodes at `u` [N], component by component."""
    space = model.space
    own = jnp.moveaxis(u[space.cells], -1, 1)
    own = own.reshape(own.shape[0], -1, own.shape[-1])
    whole = model.stiffness[:, _places(space.element)]
    return jnp.where(space.real[:, None], jnp.sum(whole * own[:, None], axis=2), 0.0)


def _weighed(
    space: Space, forces: Float[Array, "blocks cell_dofs lanes"], factor
) -> Float[Array, "nodes dim"]:
    """Sum at every node of `factor` times the forces of its cells [N]."""
    scaled = forces * factor[space.ids][:, None]
    parts = scaled.reshape(scaled.shape[0], space.dim, -1, scaled.shape[-1])
    total = jnp.zeros((space.num_nodes, space.dim), forces.dtype)
    return total.at[space.cells].add(jnp.moveaxis(parts, 1, -1))


def _places(element: AbstractElement) -> Int[np.ndarray, "cell_dofs cell_dofs"]:
    """Where the entries of a whole cell matrix, component by component, lie in a block."""
    n, size = element.num_nodes, element.num_nodes * element.dim
    number = np.zeros((size, size), int)
    number[np.triu_indices(size)] = np.arange(size * (size + 1) // 2)
    number = np.maximum(number, number.T)
    place = np.argsort(block_entries(element))[number]
    order = np.arange(size).reshape(n, element.dim).T.ravel()
    return place[np.ix_(order, order)]


@eqx.filter_jit
def compliance(model: Linear, factor: Float[Array, " cells"]) -> Float[Array, ""]:
    """Work of the loads f'u [J]: small where the body is stiff.

    Differentiable in `model` and `factor`; its gradient takes no further solve.

    Args:
        model: From `linear`.
        factor: Of the stiffness of each cell [-].

    Returns:
        Work [J].
    """
    return _work(model, factor)


@jax.custom_jvp
def _work(model: Linear, factor) -> Float[Array, ""]:
    return jnp.sum(model.force * displacement(model, factor))


def _work_derivative(primals, tangents):
    model, factor = primals
    model_dot, factor_dot = tangents
    u = displacement(model, factor)
    slope = jnp.zeros((), u.dtype)
    if not isinstance(factor_dot, SymbolicZero):
        slope = slope - jnp.sum(u * _weighed(model.space, _cell_forces(model, u), factor_dot))
    if not isinstance(model_dot.force, SymbolicZero):
        slope = slope + 2 * jnp.sum(u * model_dot.force)
    if (moved := _stiffened(model, model_dot, factor, u)) is not None:
        slope = slope - jnp.sum(u * moved)
    return jnp.sum(model.force * u), slope


_work.defjvp(_work_derivative, symbolic_zeros=True)
