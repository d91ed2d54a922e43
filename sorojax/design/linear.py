"""Small displacements of a body of graded stiffness: one factorisation for a design.

The stiffness of every cell at rest is assembled once; a design scales it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sorojax.fem import Problem
from sorojax.fem.cell_stiffness import assembled, stiffness_at_rest
from sorojax.fem.energy_form import load_force
from sorojax.fem.space import Space
from sorojax.fem.supports import known_dofs
from sorojax.math import sparse


class Linear(eqx.Module):
    """A problem linearised at rest, by `linear`."""

    space: Space
    stiffness: Float[Array, "blocks entries lanes"]
    others: Float[Array, " nnz"]
    force: Float[Array, "nodes dim"]
    known: Bool[Array, " dofs"]


def linear(problem: Problem) -> Linear:
    """`problem` for small displacements: its cells, loads, springs and supports at rest.

    Prescribed displacements count as zero.
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

    Differentiable in `factor` and `force` (that of the problem's loads if omitted), at one
    back-substitution with the same factorisation.
    """
    force = model.force if force is None else force
    system = model.space.system
    values = assembled(model.space, model.stiffness, factor) + model.others
    held = sparse.fix(system, values, model.known)
    right = jnp.where(model.known, jnp.zeros_like(force.ravel()), force.ravel())
    return sparse.solve(system, held, right).reshape(force.shape)


@jax.custom_jvp
def compliance(model: Linear, factor: Float[Array, " cells"]) -> Float[Array, ""]:
    """Work of the loads f'u [J]: small where the body is stiff.

    Its gradient takes no further solve.
    """
    return jnp.sum(model.force * displacement(model, factor))


@compliance.defjvp
def _(primals, tangents):
    model, factor = primals
    _, change = tangents
    u = jax.lax.stop_gradient(displacement(model, factor))

    def work(factor):
        values = assembled(model.space, model.stiffness, factor)
        flat = u.ravel()
        return -flat @ sparse.product(model.space.system, values, flat)

    _, slope = jax.jvp(work, (factor,), (change,))
    return jnp.sum(model.force * u), slope
