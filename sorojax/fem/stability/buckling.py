"""Linear buckling about a state, and imperfections in the shape of a mode."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.fem.problem import Problem
from sorojax.fem.stability.arc_length import Loading, tangent_state
from sorojax.fem.stability.modal import check_state, lowest_of_pair, pencil_of


class CriticalLoads(eqx.Module):
    """Load `factors` at which the tangent is predicted to be singular, nearest first, and the
    `shapes` of the modes there, with a largest entry of one."""

    factors: Float[Array, " modes"]
    shapes: Float[Array, "modes nodes dim"]


def critical_loads(
    problem: Problem,
    name: str | None = None,
    *,
    displacement: Float[Array, "nodes dim"] | None = None,
    factor: float = 0.0,
    count: int = 1,
) -> CriticalLoads:
    """Linear buckling about an equilibrium: (K + (f - factor) dK/df) phi = 0.

    dK/df is the derivative of the tangent along the path of equilibria, by central differences.
    The result is a prediction: the nearer the state is to the critical point, the better.
    `continuation` finds the point itself. Runs on the host with concrete numbers; it has no
    derivative.

    Args:
        problem: Its loads and supports at factor one.
        name: The load that grows; all loads and prescribed displacements by default.
        displacement: A stable equilibrium at `factor` [m]; zero by default.
        factor: Load factor of `displacement` [-].
        count: Number of critical factors above `factor`.

    Returns:
        Critical load factors [-], nearest first, and modes with a largest entry of one; fewer
        than `count` where the load does not reduce the stiffness.

    Raises:
        ValueError: If the state is unstable, the displacement has the wrong shape, or no load
            has that name.

    Example:
        >>> column = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1),
        ...                         element=mesh.Quad9())
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000)
        >>> problem = fem.problem(
        ...     column, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...     supports=(fem.Fixed(column.node_sets["left"]),),
        ...     loads=(fem.Force(column.node_sets["right"], [-1, 0]),))
        >>> print(f"{float(fem.critical_loads(problem).factors[0]):.2f} N")  # Euler: 1.61 N
        1.60 N

    Reference:
        Bathe, Finite Element Procedures, 1996.
    """
    where = "fem.critical_loads"
    u = jnp.zeros_like(problem.mesh.points) if displacement is None else real(displacement)
    check_state(where, problem, u)
    loading = Loading(where, problem, name)
    prepared = prepare(problem)
    state = tangent_state(loading, prepared, np.asarray(u), factor)
    here = loading.at(factor)
    values = linearise(here, prepared, u, u).values
    pencil = pencil_of(problem.space.system, values, np.asarray(prepared.known))
    if state is None or pencil.negative_eigenvalues != 0:
        raise ValueError(
            f"{where}: the state at factor {factor:g} is not stable, need a positive definite "
            "tangent. Start from a smaller load."
        )
    slope = _tangent_slope(loading, prepared, u, factor, state.rate)
    free = int(np.sum(~np.asarray(prepared.known)))
    nu, vectors = lowest_of_pair(pencil, slope, min(count, free))
    ahead = nu < -1e-12 * np.abs(nu).max()
    shapes = vectors[ahead].reshape(-1, *u.shape)
    shapes = shapes / np.abs(shapes).max(axis=(1, 2), keepdims=True)
    return CriticalLoads(jnp.asarray(factor - 1 / nu[ahead]), jnp.asarray(shapes))


def _tangent_slope(loading, prepared, u, factor: float, rate: np.ndarray) -> np.ndarray:
    """dK/df along the path, by a central difference whose step balances its two errors."""
    step = 1e-5 * float(prepared.length) / np.abs(rate).max()
    sides = [
        linearise(loading.at(factor + s), prepared, moved, moved).values
        for s in (-step, step)
        for moved in [u + s * jnp.asarray(rate)]
    ]
    return (np.asarray(sides[1]) - np.asarray(sides[0])) / (2 * step)


def with_imperfection(
    problem: Problem, shape: Float[Array, "nodes dim"], amplitude: float
) -> Problem:
    """`problem` with its nodes moved, free of stress, by `shape` scaled to a largest entry
    of `amplitude` [m]: the seed that makes a path follow a buckling mode.

    Args:
        problem: The boundary value problem.
        shape: Displacement of the nodes, in any scale.
        amplitude: Its largest entry [m].

    Returns:
        The problem on the mesh with these nodes.
    """
    shape = real(shape)
    check_state("fem.with_imperfection", problem, shape)
    moved = problem.mesh.points + amplitude * shape / jnp.max(jnp.abs(shape))
    return eqx.tree_at(lambda p: p.mesh.points, problem, moved)
