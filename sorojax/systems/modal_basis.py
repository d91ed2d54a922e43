"""Shapes that a body moves in: eigenmodes, answers to its loads, and how both bend."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax import fem
from sorojax._types import real
from sorojax.fem.energy_form import load_force, residual
from sorojax.fem.linear import linearise, prepare
from sorojax.math import sparse
from sorojax.systems.fem_body import FemBody, with_values

#: Shapes of which less than this share is new are left out.
_NEW = 1e-6


class Basis(eqx.Module):
    """Shapes of unit modal mass about the equilibrium `displacement` [m]."""

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
    """Shapes for `reduced(body, basis)`, made once, on the host.

    The lowest eigenmodes about an equilibrium; the static answer to each driven load, without
    which a pressure would find few modes to work on; and, with `bending`, the static
    derivatives of all these along each other, which let thin walls turn without being
    stretched. They are made orthonormal in the mass.

    Args:
        body: The body with the loads that hold it at the equilibrium.
        modes: Number of eigenmodes.
        displacement: The equilibrium [m]; at rest when omitted.
        bending: Add the derivatives: with n shapes up to n (n + 1) / 2 more.

    Reference:
        Idelsohn, Cardona, A reduction method for nonlinear structural dynamic analysis,
        Comput. Methods Appl. Mech. Engrg. 49, 1985, for the derivatives.
    """
    problem = body.problem
    u = jnp.zeros_like(problem.mesh.points) if displacement is None else real(displacement)
    found = [fem.eigenmodes(problem, u, modes).shapes] if modes else []
    found.append(_answers(body, u))
    first = jnp.concatenate(found).reshape(-1, u.size)
    mass = body.matter().mass
    chosen = _orthonormal(problem.space.system, mass, np.asarray(first))
    if bending:
        more = _derivatives(problem, u, jnp.asarray(chosen).reshape(-1, *u.shape))
        chosen = _orthonormal(
            problem.space.system, mass, np.concatenate([chosen, np.asarray(more)])
        )
    return Basis(u, jnp.asarray(chosen).reshape(-1, *u.shape))


def _tangent(problem: fem.Problem, u) -> tuple[Array, Array]:
    """Tangent at `u` with the supports applied, and which unknowns are known."""
    prepared = prepare(problem)
    values = linearise(problem, prepared, u, u).values
    return sparse.fix(problem.space.system, values, prepared.known), prepared.known


def _solved(problem, matrix, known, forces: Float[Array, "rows dofs"]) -> Array:
    right = jnp.where(known[None], jnp.zeros_like(forces), forces)
    return jax.vmap(lambda b: sparse.solve(problem.space.system, matrix, b))(right)


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
    found = _solved(problem, *_tangent(problem, u), jnp.concatenate(rows))
    return found.reshape(-1, *u.shape)


def _derivatives(problem: fem.Problem, u, shapes) -> Float[Array, "pairs dofs"]:
    """How each shape changes, in equilibrium, on the way along another."""
    first, second = np.triu_indices(shapes.shape[0])

    def curvature(pair):
        a, b = shapes[pair[0]], shapes[pair[1]]

        def along(u):
            return jax.jvp(lambda u: residual(problem, u), (u,), (a,))[1]

        return jax.jvp(along, (u,), (b,))[1].ravel()

    pairs = jnp.asarray(np.stack([first, second], axis=1))
    forces = jax.jit(lambda pairs: jax.lax.map(curvature, pairs))(pairs)
    return _solved(problem, *_tangent(problem, u), -forces)


def _orthonormal(system, mass, rows: np.ndarray) -> np.ndarray:
    """The rows one after the other, each without what those before it hold."""
    kept: list[np.ndarray] = []
    heavy: list[np.ndarray] = []
    for row in rows:
        size = _norm(system, mass, row)
        if not size > 0:
            continue
        row = row / size
        for _ in range(2):
            for one, weighed in zip(kept, heavy, strict=True):
                row = row - (weighed @ row) * one
        left = _norm(system, mass, row)
        if left > _NEW:
            kept.append(row / left)
            heavy.append(np.asarray(sparse.product(system, mass, jnp.asarray(kept[-1]))))
    return np.stack(kept)


def _norm(system, mass, row: np.ndarray) -> float:
    weighed = np.asarray(sparse.product(system, mass, jnp.asarray(row)))
    return float(np.sqrt(max(weighed @ row, 0.0)))
