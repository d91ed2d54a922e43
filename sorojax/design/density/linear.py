"""Small displacements of a body of graded stiffness: one factorisation for a design.

The stiffness of every cell at rest is assembled once; a design scales it.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.fem import Problem
from sorojax.fem.assembly.space import Space
from sorojax.fem.equilibrium.jit import assembled, stiffness_at_rest
from sorojax.fem.problem import load_force
from sorojax.fem.supports import known_dofs
from sorojax.math.linalg import sparse


class Linear(eqx.Module):
    """A problem linearised at rest, by `linear`."""

    space: Space
    stiffness: Float[Array, "blocks entries lanes"]
    others: Float[Array, " nnz"]
    force: Float[Array, "nodes dim"]
    known: Bool[Array, " dofs"]


def linear(problem: Problem) -> Linear:
    """`problem` for small displacements: its cells, loads, springs and supports at rest.

    Prescribed displacements count as zero. Differentiable in every number of the problem.
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
    """
    force = model.force if force is None else force
    system = model.space.system
    held = sparse.fix(system, _values(model, factor), model.known)
    right = jnp.where(model.known, jnp.zeros_like(force.ravel()), force.ravel())
    return sparse.solve(system, held, right).reshape(force.shape)


def _values(model: Linear, factor: Float[Array, " cells"]) -> Float[Array, " nnz"]:
    """Of the tangent of a design."""
    return assembled(model.space, model.stiffness, factor) + model.others


@eqx.filter_jit
def compliance(model: Linear, factor: Float[Array, " cells"]) -> Float[Array, ""]:
    """Work of the loads f'u [J]: small where the body is stiff.

    Differentiable in `model` and `factor`; its gradient takes no further solve.
    """
    return _work(model, factor)


@eqx.filter_custom_jvp
def _work(model: Linear, factor) -> Float[Array, ""]:
    return jnp.sum(model.force * displacement(model, factor))


@_work.def_jvp
def _(primals, tangents):
    u = displacement(*primals)

    def stationary(model, factor):
        """Twice the work less u' K u, which no displacement of the free unknowns changes."""
        values = _values(model, factor)
        held = sparse.product(model.space.system, values, u.ravel())
        return 2 * jnp.sum(model.force * u) - held @ u.ravel()

    return eqx.filter_jvp(stationary, primals, tangents)
