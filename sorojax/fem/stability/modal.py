"""Small vibrations about an equilibrium, motion reduced to a few modes, and derivatives of
eigenvalues and shapes in the numbers of a problem.

Extreme eigenvalues are those of Lanczos with the direct factor of the tangent.

References:
    Ericsson and Ruhe, "The spectral transformation Lanczos method for the numerical solution
    of large sparse generalized symmetric eigenvalue problems", Mathematics of Computation 35,
    1980.
    Nelson, "Simplified calculation of eigenvector derivatives", AIAA Journal 14, 1976.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._display import displayed, number
from sorojax._jax.jit import once
from sorojax._jax.trace_state import is_traced
from sorojax._types import real
from sorojax.fem.dynamics.damping import mass_matrix
from sorojax.fem.equilibrium.jit import known_mask, prepare_traced
from sorojax.fem.equilibrium.lanes import moving_part
from sorojax.fem.equilibrium.linear import linearise, prepare
from sorojax.fem.problem import Problem
from sorojax.fem.supports import known_dofs
from sorojax.math.linalg import sparse

_DENSE = 40  # below this many unknowns Lanczos has no room


class Pencil(NamedTuple):
    """A symmetric matrix and its factor, with the unknowns that are free."""

    system: sparse.SparseSymmetric
    values: Float[np.ndarray, " nnz"]
    free: np.ndarray
    factor: sparse.Factor
    shift: float

    @property
    def negative_eigenvalues(self) -> int:
        return self.factor.negative_eigenvalues


def pencil_of(
    system: sparse.SparseSymmetric,
    values: Float[Array, " nnz"],
    known: np.ndarray,
    mass: Float[Array, " nnz"] | None = None,
) -> Pencil:
    """Factor K, or K - sigma M with a tiny sigma where K is singular to rounding."""
    diagonal = np.asarray(system.rows == system.cols).astype(float)
    metric = diagonal if mass is None else np.asarray(mass)
    fixed = jnp.asarray(known)
    host = np.asarray(values)
    scale = np.abs(host * diagonal).max() / np.abs(metric * diagonal).max()
    for shift in (0.0, -1e-12 * scale, -1e-9 * scale):
        matrix = sparse.fix(system, jnp.asarray(host - shift * metric), fixed)
        factor = system.solver.factor(np.asarray(matrix))
        if factor is not None:
            return Pencil(system, host, np.flatnonzero(~known), factor, shift)
    raise ValueError(
        "eigenvalues: the tangent is singular or not finite, need a state at which it can be "
        "factored. Check the supports and the displacement."
    )


def free_matrix(pencil: Pencil, values: np.ndarray):
    """Values in the pattern as a SciPy matrix over the free unknowns."""
    import scipy.sparse as sp

    system, size = pencil.system, pencil.system.size
    at = np.asarray(system.rows), np.asarray(system.cols)
    upper = sp.csr_matrix((np.asarray(values), at), (size, size))
    return (upper + sp.triu(upper, 1).T).tocsr()[pencil.free][:, pencil.free]


def lowest(
    pencil: Pencil, count: int, mass: Float[Array, " nnz"] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The `count` lowest eigenvalues of K phi = mu M phi, rising, and vectors (count, dofs)
    with phi' M phi = 1; M is the identity when omitted.

    Shift and invert finds those nearest zero. The inertia of K says how many of them are
    negative, so that none below is missed.
    """
    stiffness = free_matrix(pencil, pencil.values)
    metric = None if mass is None else free_matrix(pencil, np.asarray(mass))
    negative = max(0, pencil.negative_eigenvalues)
    wanted = count + negative
    while True:
        values, vectors = _near_zero(pencil, stiffness, metric, wanted)
        tolerance = abs(pencil.shift)
        if np.sum(values < tolerance) >= negative or len(values) == len(pencil.free):
            order = np.argsort(values)[:count]
            return values[order], _embed(pencil, vectors[:, order])
        wanted = 2 * wanted


def _near_zero(pencil: Pencil, stiffness, metric, count: int):
    options = {"sigma": pencil.shift, "OPinv": _inverse(pencil), "ncv": max(2 * count + 1, 20)}
    return _few(stiffness, metric, count, lambda values: np.abs(values), **options)


def lowest_of_pair(pencil: Pencil, other: np.ndarray, count: int):
    """The `count` most negative eigenvalues of `other` phi = nu K phi for a positive
    definite K, and their vectors (count, dofs)."""
    stiffness, other = free_matrix(pencil, pencil.values), free_matrix(pencil, other)
    options = {"Minv": _inverse(pencil), "which": "SA", "ncv": max(4 * count, 40)}
    values, vectors = _few(other, stiffness, count, lambda values: values, **options)
    order = np.argsort(values)
    return values[order], _embed(pencil, vectors[:, order])


def _few(matrix, metric, count: int, rank, ncv: int, **options):
    """The first `count` eigenvalues by `rank` and their vectors, by Lanczos with `options`
    where there is room for it."""
    import scipy.linalg
    import scipy.sparse.linalg as spla

    size = matrix.shape[0]
    if count >= size - 1 or size <= _DENSE:
        metric = None if metric is None else metric.toarray()
        values, vectors = scipy.linalg.eigh(matrix.toarray(), metric)
        first = np.argsort(rank(values))[:count]
        return values[first], vectors[:, first]
    start = np.random.default_rng(0).standard_normal(size)
    return spla.eigsh(matrix, k=count, M=metric, v0=start, ncv=min(size, ncv), **options)


def _inverse(pencil: Pencil):
    """(K - shift M)^-1 on the free unknowns."""
    import scipy.sparse.linalg as spla

    def solve(b: np.ndarray) -> np.ndarray:
        return pencil.factor.solve(_embed(pencil, b.reshape(-1, 1))[0])[pencil.free]

    return spla.LinearOperator((len(pencil.free),) * 2, matvec=solve, dtype=float)


def _embed(pencil: Pencil, vectors: np.ndarray) -> np.ndarray:
    full = np.zeros((vectors.shape[1], pencil.system.size))
    full[:, pencil.free] = vectors.T
    return full


_APART = 1e-8  # of the larger eigenvalue: below that two modes are no functions by themselves

Find = Callable[[Problem, Array], tuple[Array, Array]]


def differentiable(
    where: str, find: Find, problem: Problem, u: Float[Array, "nodes dim"], massive: bool
) -> tuple[Float[Array, " modes"], Float[Array, "modes nodes dim"]]:
    """`find(problem, u)`, eigenvalues and shapes, with derivatives in every number of both.

    Each shape takes one factorisation for all directions. Modes of one eigenvalue have no
    derivative by themselves: NaN.

    Raises:
        ValueError: Inside `jit` and `vmap`, where there are no numbers to search with.
    """
    params, static = eqx.partition((problem, u), eqx.is_inexact_array)

    @jax.custom_jvp
    def found(params):
        if is_traced(params):
            raise ValueError(
                f"{where}: called inside jit or vmap, need concrete numbers. Call it outside; "
                "grad, jvp and jacfwd of it are fine."
            )
        return find(*eqx.combine(params, static))

    def derivative(primals, tangents):
        (params,), (rates,) = primals, tangents
        moving, held, dot = moving_part(params, rates)
        rest = eqx.combine(held, static)
        answer = found(params)

        def matrices(moving):
            return _matrices(moving, rest, massive)

        (K, M), (dK, dM) = jax.jvp(matrices, (moving,), (dot,))
        problem = eqx.combine(params, static)[0]
        return answer, _rates(problem, _Pair(K, M, dK, dM), *answer)

    found.defjvp(derivative, symbolic_zeros=True)
    return found(params)


class _Pair(NamedTuple):
    """Values of K and M, and how they move."""

    K: Array
    M: Array
    dK: Array
    dM: Array


def _rates(problem: Problem, pair: _Pair, eigenvalues, shapes) -> tuple[Array, Array]:
    """How eigenvalues and shapes move."""
    known = known_mask(problem.supports, *shapes.shape[1:])
    moves = [
        _moved(problem.space.system, pair, known, value, shape.ravel())
        for value, shape in zip(eigenvalues, shapes, strict=True)
    ]
    slopes, vectors = (jnp.stack(column) for column in zip(*moves, strict=True))
    alone = _alone(eigenvalues)
    return slopes * alone, vectors.reshape(shapes.shape) * alone[:, None, None]


@once
def _matrices(moving, rest, massive: bool) -> tuple[Array, Array]:
    """Values of K, and of M or the identity."""
    problem, u = eqx.combine(moving, rest)
    system = problem.space.system
    K = linearise(problem, prepare_traced(problem), u, u).values
    if massive:
        return K, mass_matrix(problem, u)
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
    matrix = sparse.fix(system, pair.K - value * pair.M, fixed)
    rhs = jnp.where(fixed, jnp.zeros_like(change), slope * weight - change)
    part = sparse.solve(system, matrix, rhs)
    along = weight @ part + shape @ product(pair.dM, shape) / 2
    return slope, part - along * shape


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
    """`shapes` and `eigenvalues` about the equilibrium `displacement` [m] of a `problem`,
    lowest first.

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

    Returns:
        Eigenvalues [N/m], rising, and their modes.

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
        mass = mass_matrix(problem, u) if massive else None
        values = linearise(problem, prepare(problem), u, u).values
        pencil = pencil_of(problem.space.system, values, known, mass)
        eigenvalues, vectors = lowest(pencil, count, mass)
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
    """Displacement [m] of modal coordinates q: u = u_0 + sum_k q_k phi_k.

    Args:
        modes: Modes, from `eigenmodes`.
        coordinates: One per mode; axes in front are samples.

    Returns:
        Displacement of the nodes [m].
    """
    moved = jnp.tensordot(real(coordinates), modes.shapes, axes=1)
    lead = (1,) * (moved.ndim - 2)
    return modes.displacement.reshape(*lead, *modes.displacement.shape) + moved


def modal_force(modes: Modes, force: Float[Array, "nodes dim"]) -> Float[Array, " modes"]:
    """Generalised force phi_k . f of a nodal force [N]; with unit modal mass the reduced
    motion is q'' + omega^2 q = phi . f.

    Args:
        modes: Modes, from `eigenmodes`.
        force: On every node [N].

    Returns:
        One generalised force per mode.
    """
    return jnp.einsum("kni,ni->k", modes.shapes, real(force))


def modal_coordinates(
    modes: Modes, displacement: Float[Array, "nodes dim"]
) -> Float[Array, " modes"]:
    """Modal coordinates of a displacement: phi_k' M (u - u_0), for modes of `eigenmodes`.

    Args:
        modes: Modes, from `eigenmodes`.
        displacement: Of the nodes [m].

    Returns:
        One coordinate per mode.
    """
    system = modes.problem.space.system
    moved = (real(displacement) - modes.displacement).ravel()
    mass = mass_matrix(modes.problem, modes.displacement)
    momentum = sparse.product(system, mass, moved)
    return modes.shapes.reshape(len(modes), -1) @ momentum
