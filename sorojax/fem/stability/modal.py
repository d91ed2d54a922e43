"""Small vibrations about an equilibrium, motion reduced to a few modes, and derivatives of
eigenvalues and shapes in the numbers of a problem.

Reference: Nelson, "Simplified calculation of eigenvector derivatives", AIAA Journal 14,
1976.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from sorojax._display import displayed, number
from sorojax._jax.trace_state import is_traced
from sorojax._types import real
from sorojax.fem.dynamics.damping import mass_matrix
from sorojax.fem.equilibrium.jit import known_mask, prepare_traced
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.fem.problem import Problem
from sorojax.fem.stability import spectrum
from sorojax.fem.supports import known_dofs
from sorojax.math.linalg import sparse

_APART = 1e-8  # of the larger eigenvalue: below that two modes are no functions by themselves

Find = Callable[[Problem, Array], tuple[Array, Array]]


class _Call:
    """A search with all that is no number; compared by identity, so it may be a parameter."""

    def __init__(self, where: str, find: Find, rest: Any, tree: Any, massive: bool):
        self.where, self.find, self.rest = where, find, rest
        self.tree, self.massive = tree, massive

    def inputs(self, leaves) -> tuple[Problem, Array]:
        return eqx.combine(jax.tree.unflatten(self.tree, leaves), self.rest)

    def moving(self, leaves, dots) -> tuple[Any, Any, Any]:
        """The numbers that move, all else, and how they move."""
        moves = [not isinstance(dot, SymbolicZero) for dot in dots]

        def pick(values, wanted):
            kept = [x if m == wanted else None for x, m in zip(values, moves, strict=True)]
            return jax.tree.unflatten(self.tree, kept)

        rest = eqx.combine(pick(leaves, False), self.rest)
        return pick(leaves, True), rest, pick(dots, True)


def differentiable(
    where: str, find: Find, problem: Problem, u: Float[Array, "nodes dim"], massive: bool
) -> tuple[Float[Array, " modes"], Float[Array, "modes nodes dim"]]:
    """`find(problem, u)`, eigenvalues and shapes, with derivatives in every number of both.

    Each shape takes one factorisation for all directions. Modes of one eigenvalue have no
    derivative by themselves: NaN.

    Raises:
        ValueError: Inside `jit` and `vmap`, where there are no numbers to search with.
    """
    moving, rest = eqx.partition((problem, u), eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(moving)
    return _found(_Call(where, find, rest, tree, massive), leaves)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _found(call: _Call, leaves):
    if is_traced(leaves):
        raise ValueError(
            f"{call.where}: called inside jit or vmap, need concrete numbers. Call it outside; "
            "grad, jvp and jacfwd of it are fine."
        )
    return call.find(*call.inputs(leaves))


class _Pair(NamedTuple):
    """Values of K and M, and how they move."""

    K: Array
    M: Array
    dK: Array
    dM: Array


def _derivative(call: _Call, primals, tangents):
    (leaves,), (dots,) = primals, tangents
    eigenvalues, shapes = _found(call, leaves)
    problem, _ = call.inputs(leaves)
    moving, rest, dot = call.moving(leaves, dots)

    def matrices(moving):
        return _matrices(moving, rest, call.massive)

    (K, M), (dK, dM) = jax.jvp(matrices, (moving,), (dot,))
    known = known_mask(problem.supports, *shapes.shape[1:])
    pair, moves = _Pair(K, M, dK, dM), []
    for k in range(len(eigenvalues)):
        shape = shapes[k].ravel()
        moves.append(_moved(problem.space.system, pair, known, eigenvalues[k], shape))
    slopes, vectors = (jnp.stack(column) for column in zip(*moves, strict=True))
    alone = _alone(eigenvalues)
    vectors = vectors.reshape(shapes.shape) * alone[:, None, None]
    return (eigenvalues, shapes), (slopes * alone, vectors)


_found.defjvp(_derivative, symbolic_zeros=True)


@eqx.filter_jit
def _matrices(moving, rest, massive: bool) -> tuple[Array, Array]:
    """Values of K, and of M or the identity."""
    problem, u = eqx.combine(moving, rest)
    system = problem.space.system
    K = linearise(problem, prepare_traced(problem), u, u).values
    if massive:
        return K, mass_matrix(problem)
    return K, jnp.where(system.rows == system.cols, jnp.ones_like(K), jnp.zeros_like(K))


def _moved(system: sparse.SparseSymmetric, pair: _Pair, known, value, shape):
    """How one eigenvalue and its shape of unit mass move."""

    def product(values, x):
        return sparse.product(system, values, x)

    change = product(pair.dK, shape) - value * product(pair.dM, shape)
    change = jnp.where(known, jnp.zeros_like(change), change)
    slope = shape @ change
    weight = product(pair.M, shape)
    # the largest entry stays: what is left of K - value M is regular
    fixed = known.at[jnp.argmax(jnp.abs(shape))].set(True)
    matrix = _fix(system, pair.K - value * pair.M, fixed)
    rhs = jnp.where(fixed, jnp.zeros_like(change), slope * weight - change)
    part = sparse.solve(system, matrix, rhs)
    along = weight @ part + shape @ product(pair.dM, shape) / 2
    return slope, part - along * shape


_fix = jax.jit(sparse.fix)


def _alone(eigenvalues: Float[Array, " modes"]) -> Float[Array, " modes"]:
    """One for eigenvalues apart from all others, NaN for the rest."""
    gap = jnp.abs(eigenvalues[:, None] - eigenvalues[None])
    size = jnp.maximum(jnp.abs(eigenvalues)[:, None], jnp.abs(eigenvalues)[None])
    other = ~jnp.eye(len(eigenvalues), dtype=bool)
    crowded = jnp.any(other & (gap <= _APART * size), axis=1)
    return jnp.where(crowded, jnp.nan, jnp.ones_like(eigenvalues))


# Small vibrations about an equilibrium, and motion reduced to a few of their modes


@displayed
class Modes(eqx.Module):
    """Shapes and eigenvalues about the equilibrium `displacement`, lowest first.

    Vibration modes have `eigenvalues` omega^2 [1/s^2] and shapes of unit modal mass;
    those of the tangent alone have the stiffness [N/m] and shapes of unit length. An
    unstable equilibrium has negative ones.
    """

    problem: Problem
    displacement: Float[Array, "nodes dim"]
    eigenvalues: Float[Array, " modes"]
    shapes: Float[Array, "modes nodes dim"]

    def __len__(self) -> int:
        return self.eigenvalues.shape[0]

    @property
    def frequencies(self) -> Float[Array, " modes"]:
        """omega / (2 pi) [Hz]; minus the rate of growth over 2 pi where unstable."""
        omega = jnp.sign(self.eigenvalues) * jnp.sqrt(jnp.abs(self.eigenvalues))
        return omega / (2 * jnp.pi)

    def _text(self) -> str:
        rows = (f"  {k + 1}: {number(f, 'Hz')}" for k, f in enumerate(self.frequencies))
        return "\n".join([f"Modes: {len(self)}", *rows])


def eigenmodes(
    problem: Problem, displacement: Float[Array, "nodes dim"] | None = None, count: int = 6
) -> Modes:
    """The lowest vibration modes about an equilibrium: K phi = omega^2 M phi.

    K is the tangent there, load stiffness included, and may be indefinite. Eigenvalues and
    shapes are differentiable in every number of the problem and in the displacement: pass
    that of `fem.solve` for derivatives that include the change of the equilibrium. Not under
    `jit`.

    Args:
        problem: The body with the loads that hold it there; its material needs a density.
        displacement: The equilibrium [m]; zero by default.
        count: Number of modes.

    Returns:
        Eigenvalues omega^2 [1/s^2], rising, and shapes of unit modal mass [1/sqrt(kg)].

    Raises:
        ValueError: If the material has no density, the displacement has another shape than the
            points of the mesh, or `count` is not between 1 and the number of free unknowns.

    Example:
        >>> bar = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1),
        ...                      element=mesh.Quad9())
        >>> rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.45, density=1000)
        >>> problem = fem.problem(bar, rubber, kinematics=fem.PlaneStrain(10 * mm),
        ...                       supports=(fem.Fixed(bar.node_sets["left"]),))
        >>> modes = fem.eigenmodes(problem, count=1)
        >>> print(f"{float(modes.frequencies[0]):.1f} Hz")
        33.8 Hz

    Reference:
        Ericsson and Ruhe, The spectral transformation Lanczos method, Math. Comp. 35, 1980;
        Nelson, Simplified calculation of eigenvector derivatives, AIAA J. 14, 1976.
    """
    return _modes("fem.eigenmodes", problem, displacement, count, True)


def tangent_modes(
    problem: Problem, displacement: Float[Array, "nodes dim"] | None = None, count: int = 1
) -> Modes:
    """The lowest eigenvalues of the tangent stiffness [N/m]: the first one is positive at a
    stable equilibrium and vanishes at a critical point, whose mode it gives.

    Args:
        problem: The body with the loads that hold it there.
        displacement: The equilibrium [m]; at rest when omitted.
        count: Number of eigenvalues.

    Raises:
        ValueError: If `count` is no possible number.
    """
    return _modes("fem.tangent_modes", problem, displacement, count, False)


def _modes(where: str, problem: Problem, displacement, count: int, massive: bool) -> Modes:
    u = jnp.zeros_like(problem.mesh.points) if displacement is None else real(displacement)
    check_state(where, problem, u)
    known = known_dofs(problem.supports, *u.shape)
    free = int(np.sum(~known))
    if not 1 <= count <= free:
        raise ValueError(f"{where}: `count` is {count}, need 1 to {free}, the free unknowns.")

    def find(problem: Problem, u):
        mass = mass_matrix(problem) if massive else None
        values = linearise(problem, prepare(problem), u, u).values
        pencil = spectrum.pencil(problem.space.system, values, known, mass)
        eigenvalues, vectors = spectrum.lowest(pencil, count, mass)
        shapes = _signed(vectors.reshape(count, *u.shape))
        return jnp.asarray(eigenvalues), jnp.asarray(shapes)

    return Modes(problem, u, *differentiable(where, find, problem, u, massive))


def check_state(where: str, problem: Problem, u: Float[Array, "..."]) -> None:
    if u.shape != problem.mesh.points.shape:
        raise ValueError(
            f"{where}: `displacement` has shape {u.shape}, need {problem.mesh.points.shape}. "
            "Pass `solution.displacement` of the same mesh."
        )


def _signed(shapes: np.ndarray) -> np.ndarray:
    """Shapes whose largest entry is positive, so that a run repeats."""
    flat = shapes.reshape(len(shapes), -1)
    largest = np.take_along_axis(flat, np.abs(flat).argmax(axis=1)[:, None], axis=1)
    return (flat * np.sign(largest)).reshape(shapes.shape)


def modal_displacement(
    modes: Modes, coordinates: Float[Array, "... modes"]
) -> Float[Array, "... nodes dim"]:
    """Displacement [m] of modal coordinates q: u = u_0 + sum_k q_k phi_k."""
    moved = jnp.tensordot(real(coordinates), modes.shapes, axes=1)
    lead = (1,) * (moved.ndim - 2)
    return modes.displacement.reshape(*lead, *modes.displacement.shape) + moved


def modal_force(modes: Modes, force: Float[Array, "nodes dim"]) -> Float[Array, " modes"]:
    """Generalised force phi_k . f of a nodal force [N]; with unit modal mass the reduced
    motion is q'' + omega^2 q = phi . f."""
    return jnp.einsum("kni,ni->k", modes.shapes, real(force))


def modal_coordinates(
    modes: Modes, displacement: Float[Array, "nodes dim"]
) -> Float[Array, " modes"]:
    """Modal coordinates of a displacement: phi_k' M (u - u_0), for modes of `eigenmodes`."""
    system = modes.problem.space.system
    moved = (real(displacement) - modes.displacement).ravel()
    momentum = sparse.product(system, mass_matrix(modes.problem), moved)
    return modes.shapes.reshape(len(modes), -1) @ momentum
