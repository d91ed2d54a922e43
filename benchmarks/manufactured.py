"""A smooth displacement and the body force that makes it an equilibrium."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import fem, material, mesh
from sorojax._types import real
from sorojax.fem.assembly.space import AbstractFormulation
from sorojax.fem.loads.loads import AbstractLoad
from sorojax.mesh import Mesh
from sorojax.mesh.elements.base import quadrature, shape_functions, shape_gradients


class NodalForces(AbstractLoad):
    """Dead forces [N], one for each node, times `value`."""

    forces: Float[Array, "nodes dim"] = eqx.field(converter=real)
    value: Float[Array, ""] = eqx.field(converter=real, default=1.0)
    name: str = eqx.field(static=True, default="body force")

    def potential(self, problem, u):
        return -self.value * jnp.sum(self.forces * u)

    def curved_part(self, problem):
        return None


def displacement(X: Float[Array, " dim"]) -> Float[Array, " dim"]:
    """A field with strains of about 15 %, no polynomial."""
    ahead = jnp.roll(X, -1)
    return 0.08 * jnp.sin(1.5 * X + 0.4) * jnp.cos(1.2 * ahead) + 0.03 * jnp.exp(0.7 * ahead)


def body_force(rubber, X: Float[Array, " dim"]) -> Float[Array, " dim"]:
    """-Div P of the field, in plane strain or in space [N/m^3]."""

    def stress(X):
        F = jnp.eye(3).at[: X.size, : X.size].add(jax.jacfwd(displacement)(X))
        return material.first_piola_kirchhoff_stress(rubber, F)[: X.size, : X.size]

    return -jnp.einsum("ijj->i", jax.jacfwd(stress)(X))


def body(
    element: mesh.AbstractElement,
    divisions: int,
    poisson_ratio: float,
    formulation: AbstractFormulation | None = None,
    side: float = 1.0,
) -> fem.Problem:
    """A square or cube with cells that change smoothly in shape; its boundary is known."""
    dim = element.dim
    make = mesh.rectangle if dim == 2 else mesh.box
    grid = make([0] * dim, [1] * dim, divisions=(divisions,) * dim, element=element)  # type: ignore
    bump = jnp.prod(jnp.sin(jnp.pi * grid.points), axis=1, keepdims=True)
    return placed(
        Mesh(grid.points + 0.1 * bump, grid.cells, element), poisson_ratio, formulation, side
    )


def placed(cells: Mesh, poisson_ratio, formulation=None, side=1.0, space=None) -> fem.Problem:
    """The problem on `cells` of a unit square or cube, scaled by `side` about its centre:
    a small body sees the leading terms of the field there, so that halving `side` shows the
    order of convergence as halving the cells does."""
    cells = Mesh(0.5 + side * (cells.points - 0.5), cells.cells, cells.element)
    rubber = material.neo_hookean(young_modulus=1.0, poisson_ratio=poisson_ratio)
    edge = np.unique(mesh.boundary_facets(cells))
    exact = jax.vmap(displacement)(cells.points)
    return fem.problem(
        cells,
        rubber,
        kinematics=fem.PlaneStrain(1.0) if cells.element.dim == 2 else fem.Solid(),
        supports=(fem.Prescribed(edge, exact[edge]),),
        loads=(NodalForces(_forces(cells, rubber)),),
        formulation=formulation,
        space=space,
    )


def _degree(element: mesh.AbstractElement) -> int:
    """The highest tabulated for triangles and tetrahedra."""
    if element.num_corners == element.dim + 1:
        return 4 if element.dim == 2 else 5
    return 7


def _points(cells: Mesh):
    """Shape functions, places and volumes of an accurate rule."""
    rule = quadrature(cells.element, _degree(cells.element))
    N = jnp.asarray(shape_functions(cells.element, rule.points))
    slopes = jnp.asarray(shape_gradients(cells.element, rule.points))
    x = cells.points[cells.cells]
    jacobian = jnp.einsum("cai,qad->cqid", x, slopes)
    volumes = jnp.linalg.det(jacobian) * jnp.asarray(rule.weights)[None]
    return N, jnp.einsum("qa,cai->cqi", N, x), volumes


@jax.jit
def _forces(cells: Mesh, rubber) -> Float[Array, "nodes dim"]:
    N, places, volumes = _points(cells)
    force = jax.vmap(jax.vmap(lambda X: body_force(rubber, X)))(places)
    by_cell = jnp.einsum("cq,qa,cqi->cai", volumes, N, force)
    return jnp.zeros_like(cells.points).at[cells.cells].add(by_cell)


@jax.jit
def error(problem: fem.Problem, u: Float[Array, "nodes dim"]) -> Float[Array, ""]:
    """Root mean square of the error of `u` over the body."""
    N, places, volumes = _points(problem.mesh)
    found = jnp.einsum("qa,cai->cqi", N, u[problem.mesh.cells])
    off = found - jax.vmap(jax.vmap(displacement))(places)
    return jnp.sqrt(jnp.sum(volumes[..., None] * off**2) / jnp.sum(volumes))
