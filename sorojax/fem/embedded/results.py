"""Forces in and from embedded rods at a solution."""

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax.fem.embedded import line
from sorojax.fem.embedded.bonded import BondedRod
from sorojax.fem.embedded.rods import EmbeddedRod

if TYPE_CHECKING:
    from sorojax.fem.problem import Problem


class RodForces(NamedTuple):
    """What rods carry, and what they do to the solid.

    Attributes:
        positions: Of the vertices [m].
        tension: In the segments between them [N].
        moment: Bending moment at the vertices that turn [N m], in space about the director
            and about the axis across both, in the plane counter-clockwise; `None` in fibres.
        on_solid: Force of each vertex on the solid [N].
        slip: Of each vertex along the rod [m]; `None` where it is bonded for good.
    """

    positions: Float[Array, "rods points dim"]
    tension: Float[Array, "rods segments"]
    moment: Float[Array, "rods turns axes"] | None
    on_solid: Float[Array, "rods points dim"]
    slip: Float[Array, "rods points"] | None


def rod_forces(
    problem: "Problem", u: Float[Array, "nodes dim"], name: str = "rod"
) -> RodForces:
    """Tension and moment along the embedded rods called `name` at displacement `u` [m], and
    their forces on the solid. Differentiable.

    Args:
        problem: With an `EmbeddedRod` or a `BondedRod`.
        u: Displacement [m], of a solution.
        name: Of the term.

    Returns:
        Tension, moment, force on the solid and slip at the vertices.

    Raises:
        ValueError: If there is no such rod.

    Example:
        >>> rubber = material.neo_hookean(young_modulus=1e5, poisson_ratio=0.3)
        >>> block = mesh.box([0, 0, 0], [40 * mm, 10 * mm, 10 * mm], divisions=(4, 2, 2))
        >>> wire = fem.embedded_rod(block, [[0, 5 * mm, 5 * mm], [40 * mm, 5 * mm, 5 * mm]],
        ...                         axial_stiffness=10.0)
        >>> left, right = (block.node_sets[side] for side in ("left", "right"))
        >>> problem = fem.problem(block, rubber, loads=(wire,), supports=(
        ...     fem.Fixed(left), fem.Prescribed(right, [0.4 * mm, 0, 0])))
        >>> found = fem.rod_forces(problem, fem.solve(problem).displacement)
        >>> print(f"{float(found.tension.mean()):.4f} N")
        0.1000 N
    """
    rods = [
        load
        for load in problem.loads
        if load.name == name and isinstance(load, EmbeddedRod | BondedRod)
    ]
    if not rods:
        names = [x.name for x in problem.loads if isinstance(x, EmbeddedRod | BondedRod)]
        raise ValueError(f"fem.rod_forces: got name {name!r}, need one of {names}.")
    return _forces(rods[0], problem, problem.mesh.points + u)


@jax.jit
def _forces(load: EmbeddedRod | BondedRod, problem: "Problem", x) -> RodForces:
    X, slip = problem.mesh.points, None
    if isinstance(load, BondedRod):
        rod, (ends, start) = load.rod, (points[load.nodes][None] for points in (x, X))
        slip = load.slips(problem, x - X)[None]
    else:
        rod, (ends, start) = load, (load.vertices(points) for points in (x, X))
    rest = line.norm(start[:, 1:] - start[:, :-1])
    strain = line.norm(ends[:, 1:] - ends[:, :-1]) / rest - 1 + load.value
    strain = jnp.maximum(strain, jnp.zeros_like(strain)) if rod.tension_only else strain
    tension = jnp.broadcast_to(rod.axial_stiffness, (rod.rods,))[:, None] * strain
    moment = _moment(load, rod, problem, x)
    return RodForces(ends, tension, moment, load.on_solid(problem, x), slip)


def _moment(load, rod: EmbeddedRod, problem, x):
    if rod.bending_stiffness is None:
        return None
    part = load.curved_part(problem)

    def one(nodal, data):
        return line.moment(data.turn, *load.chain(nodal, data))

    moments = jax.vmap(one)(x[part.groups], part.data)
    moments = moments.reshape(rod.rods, -1, moments.shape[-1])
    return moments[:, 1:-1] if isinstance(load, BondedRod) else moments
