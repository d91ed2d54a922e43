"""Total potential energy in a form made for differentiation by parameters.

The derivative of the residual in any leaf of the problem, forward or reverse, costs a few
elementwise passes between two products with the shape gradients.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.fem.energy import Body, energy_density
from sorojax.fem.points import Points, deformation, pressure_modes, quadrature_points
from sorojax.fem.problem import Problem, unsupported


def load_potential(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, ""]:
    """Potential energy of all loads [J]."""
    terms = (load.potential(problem, u) for load in problem.loads)
    return sum(terms, start=jnp.zeros((), u.dtype))


def body_at(problem: Problem, points: Points) -> Body:
    """What the energy at the quadrature points of all cells is made of."""
    material = jax.tree.map(
        lambda leaf: leaf[None] if jnp.ndim(leaf) == 1 else leaf, problem.material
    )
    modes = pressure_modes(problem.formulation, points)
    return Body(material, problem.kinematics, modes, points.volumes)


def potential_energy(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, ""]:
    """Stored energy plus the potential of all loads [J]."""
    return _potential_energy(unsupported(problem), u)


@jax.jit
def _potential_energy(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, ""]:
    points = quadrature_points(problem.mesh, problem.kinematics)
    F = deformation(problem.mesh, problem.kinematics, points, u)
    density = energy_density(body_at(problem, points), F)
    return jnp.sum(points.volumes * density) + load_potential(problem, u)


def residual(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, "nodes dim"]:
    """Unbalanced force at every node [N]: zero at equilibrium, reactions at supports."""
    return _residual(unsupported(problem), u)


@jax.jit
def _residual(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, "nodes dim"]:
    return jax.grad(_potential_energy, argnums=1)(problem, u)


@jax.jit
def load_force(problem: Problem, u: Float[Array, "nodes dim"]) -> Float[Array, "nodes dim"]:
    """Force of all loads on the nodes [N]."""
    return -jax.grad(load_potential, argnums=1)(problem, u)
