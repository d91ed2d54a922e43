"""Shapes of a finite-element body: eigenmodes, static responses to its loads, and their
derivatives, which hold how both change at large displacements."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import fem
from sorojax._types import real
from sorojax.fem.equilibrium.response import tangent_solve
from sorojax.fem.loads.loads import has_masses
from sorojax.fem.problem import load_force, residual
from sorojax.math.linalg.sparse import SparseSymmetric, product
from sorojax.systems.blocks.driven import with_values
from sorojax.systems.blocks.fem_body import FemBody

#: Shapes of which less than this share is new are left out.
_NEW = 1e-6
Modes = Float[Array, " modes"]


class Basis(eqx.Module):
    """`shapes` of unit modal mass about the equilibrium `displacement` [m]."""

    displacement: Float[Array, "nodes dim"]
    shapes: Float[Array, "modes nodes dim"]

    def __len__(self) -> int:
        return self.shapes.shape[0]


def modal_basis(
    body: FemBody,
    modes: int = 4,
    *,
    displacement: Float[Array, "nodes dim"] | None = None,
    bending: bool = True,
) -> Basis:
    """Shapes for `modal_body(body, basis)`, made once.

    The lowest eigenmodes about an equilibrium; the static answer to each driven load, without
    which a pressure would find few modes to work on; and, with `bending`, the static
    derivatives of all these along each other, which let thin walls turn without being
    stretched. They are made orthonormal in the mass.

    Args:
        body: The body with the loads that hold it at the equilibrium.
        modes: Number of eigenmodes.
        displacement: The equilibrium [m]; at rest when omitted.
        bending: Add the derivatives: with n shapes up to n (n + 1) / 2 more.

    Returns:
        The shapes.

    Raises:
        ValueError: If a rod is mounted on the body, whose mass depends on its motion.

    Differentiable once outside `jit`, in the numbers of the body and in the displacement. Which
    shapes are new enough to be kept has no derivative. Eigenmodes of one frequency have none of
    their own; what depends only on the displacements that the shapes span has.

    Reference:
        Idelsohn, Cardona, A reduction method for nonlinear structural dynamic analysis,
        Comput. Methods Appl. Mech. Engrg. 49, 1985, for the derivatives.
    """
    problem = body.problem
    constant_mass("modal_basis", body)
    u = jnp.zeros_like(problem.mesh.points) if displacement is None else real(displacement)
    found = [fem.eigenmodes(problem, u, modes).shapes] if modes else []
    found.append(_answers(body, u))
    first = jnp.concatenate(found).reshape(-1, u.size)
    system, mass = problem.space.system, body.matter().mass
    chosen = orthonormal(system, mass, first)
    if bending:
        more = _shape_derivatives(problem, u, chosen.reshape(-1, *u.shape))
        chosen = orthonormal(system, mass, jnp.concatenate([chosen, more]))
    return Basis(u, chosen.reshape(-1, *u.shape))


def _answers(body: FemBody, u) -> Float[Array, "loads nodes dim"]:
    """Static displacements by a unit of each component of each driven load."""
    problem = body.problem
    now = {name: load.value for name, load in body.drives.items()}
    if not now:
        return jnp.zeros((0, *u.shape), u.dtype)

    def force(values):
        loads = with_values(problem.loads, values)
        return load_force(eqx.tree_at(lambda p: p.loads, problem, loads), u).ravel()

    slopes = jax.jacfwd(force)(now)
    rows = [jnp.moveaxis(s, 0, -1).reshape(-1, u.size) for s in slopes.values()]
    found = tangent_solve(problem, u, jnp.concatenate(rows))
    return found.reshape(-1, *u.shape)


def _shape_derivatives(problem: fem.Problem, u, shapes) -> Float[Array, "pairs dofs"]:
    """How each shape changes, in equilibrium, on the way along another."""
    first, second = np.triu_indices(shapes.shape[0])

    def curvature(pair):
        a, b = shapes[pair[0]], shapes[pair[1]]

        def along(u):
            return jax.jvp(lambda u: residual(problem, u), (u,), (a,))[1]

        return jax.jvp(along, (u,), (b,))[1].ravel()

    pairs = jnp.asarray(np.stack([first, second], axis=1))
    forces = jax.lax.map(curvature, pairs)
    return tangent_solve(problem, u, -forces)


def orthonormal(
    system: SparseSymmetric, mass: Float[Array, " nnz"], rows: Float[Array, "rows dofs"]
) -> Float[Array, "kept dofs"]:
    """The rows one after the other, each without what those before it hold, by Gram and
    Schmidt; a row that holds next to nothing new is left out.

    The combinations are found on the host and held; what they make is orthonormal, so its
    Cholesky factor is one, with the derivative of the method.
    """
    mix = _combinations(system, *(np.asarray(jax.lax.stop_gradient(x)) for x in (mass, rows)))
    made = jnp.asarray(mix) @ rows
    weighed = jax.vmap(lambda row: product(system, mass, row))(made)
    factor = jnp.linalg.cholesky(made @ weighed.T)
    return jax.scipy.linalg.solve_triangular(factor, made, lower=True)


def _combinations(system, mass: np.ndarray, rows: np.ndarray) -> Float[np.ndarray, "kept rows"]:
    """Coefficients of the rows in each of the orthonormal ones that are kept."""
    kept: list[np.ndarray] = []
    heavy: list[np.ndarray] = []
    mixes: list[np.ndarray] = []
    for row, mix in zip(rows, np.eye(len(rows)), strict=True):
        size = np.sqrt(max(system.solver.product(mass, row) @ row, 0.0))
        if not size > 0:
            continue
        row, mix = row / size, mix / size
        for _ in range(2):
            for one, weighed, its in zip(kept, heavy, mixes, strict=True):
                share = weighed @ row
                row, mix = row - share * one, mix - share * its
        weighed = system.solver.product(mass, row)
        left = np.sqrt(max(weighed @ row, 0.0))
        if left > _NEW:
            kept.append(row / left)
            heavy.append(weighed / left)
            mixes.append(mix / left)
    return np.stack(mixes)


def displacement(basis: Basis, q: Modes) -> Float[Array, "nodes dim"]:
    """Displacement [m] of every node.

    Args:
        basis: From `modal_basis`.
        q: Modal coordinates.

    Returns:
        Displacement [m].
    """
    return basis.displacement + jnp.tensordot(q, basis.shapes, 1)


def coordinates(body: FemBody, basis: Basis, field) -> Modes:
    """Coordinates of a field of the nodes, nearest in the mass."""
    weighed = product(body.problem.space.system, body.matter().mass, field.ravel())
    return basis.shapes.reshape(len(basis), -1) @ weighed


def constant_mass(where: str, body: FemBody) -> None:
    if any(map(has_masses, body.problem.loads)):
        raise ValueError(
            f"{where}: got masses that are not at nodes, of a mounted rod, need a body of "
            "constant mass. Keep the FemBody."
        )
