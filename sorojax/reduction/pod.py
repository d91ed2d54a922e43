"""Strain modes from snapshots: proper orthogonal decomposition, strain by strain.

Reference: Caasenbrood et al., Sorotoki, IEEE Access 2024, section V-D4.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax._edit import without_derivatives
from sorojax._jax.jit import once
from sorojax._jax.trace_state import evaluated_now, is_traced
from sorojax.math.linalg.dense import least_squares
from sorojax.math.two_programs import two_programs
from sorojax.reduction.backbone import PLANAR, Backbone, rest_or_straight
from sorojax.rod import AbstractModes, StrainBasis, orthonormalise
from sorojax.rod.model.basis import STRAINS, Combined, SampledModes, columns

#: Of the largest singular value: what a further mode has at least.
RANK = 1e-10


def weights(s: Float[Array | np.ndarray, " samples"]) -> Float[Array, " samples"]:
    """Trapezoidal weights of samples in [0, 1]."""
    gaps = jnp.pad(jnp.diff(s), 1)
    return (gaps[1:] + gaps[:-1]) / 2


def pod_basis(
    backbone: Backbone,
    *,
    modes: dict[str, int] | dict[str, float],
    within: AbstractModes | None = None,
) -> StrainBasis:
    """A strain basis of the modes that hold most of the strain of snapshots.

    Proper orthogonal decomposition, strain by strain: left singular vectors of the snapshots,
    orthonormal on [0, 1].

    Args:
        backbone: Snapshots, from `strain_along`.
        modes: Number of modes per strain, as `{"kappa_z": 3}`, or the share of the squared
            strain that they must hold [-], as `{"kappa_z": 0.999}`.
        within: Smooth functions that the modes are combined of, e.g. `Legendre(12)`; fewer
            Gauss nodes then resolve them. By default they are linear between samples.

    Returns:
        The basis; a coordinate has the unit of its strain, [1/m] or [-].

    Raises:
        ValueError: If a strain is unknown, there are fewer independent snapshots than
            modes, or `within` has more functions than there are samples.

    Differentiable in the snapshots, with the number of modes and their signs held, also where
    two singular values come together: a mode then turns at a bounded rate towards the other,
    and what depends only on the functions that the modes span, as a reduced rod does, has its
    exact derivative. See `leading_directions`.

    Example:
        >>> s = jnp.linspace(0.0, 1.0, 13)
        >>> strain = jnp.stack([s, 0 * s + 1, 0 * s], axis=1)[None] * jnp.ones((4, 1, 1))
        >>> backbone = reduction.Backbone(s, jnp.array(0.06), jnp.zeros((4, 13, 2)), strain)
        >>> basis = reduction.pod_basis(backbone, modes={"kappa_z": 1})
        >>> print(f"{float(basis(np.array([1.0]))[0, 0, 0]):.2f}")  # sqrt(3) s
        1.73

    Reference:
        Caasenbrood, Pogromsky and Nijmeijer, Sorotoki, IEEE Access 12, 2024, section V-D4.
    """
    basis = {}
    for name, wanted in modes.items():
        if name not in backbone.names:
            raise ValueError(
                f"pod_basis: the strain `{name}` is not one of {', '.join(backbone.names)}. A "
                "planar backbone bends about z."
            )
        inner = _functions(backbone, name, within)
        given = backbone.s, backbone.strain, backbone.rest, backbone.names.index(name), inner
        count = _count(name, wanted, *without_derivatives(given))
        basis[name] = _modes(backbone.s, inner, _leading(*given, count))
    return StrainBasis(basis)


def _functions(backbone: Backbone, name: str, within: AbstractModes | None):
    """Functions in which the snapshots are written, if any are given.

    Orthonormal ones: then singular vectors give orthonormal modes.
    """
    if within is None:
        return None
    if within.count > len(backbone.s):
        raise ValueError(
            f"pod_basis: `within` has {within.count} modes, the backbone {len(backbone.s)} "
            "samples, need as many or more. Take more samples."
        )
    return orthonormalise(StrainBasis({name: within})).modes[name]


@functools.partial(two_programs, optimised=False)
def _leading(
    s, strain, rest, column: int, inner: AbstractModes | None, count: int
) -> Float[Array, "functions count"]:
    """Combinations of the functions, or values at the samples, from most to least energy,
    their integrals positive."""
    root = jnp.sqrt(weights(s))
    change = strain - rest_or_straight(strain, rest)[None]
    snapshots = root[:, None] * change[:, :, column].T
    if inner is None:
        mix = values = leading_directions(snapshots, count) / root[:, None]
    else:
        functions = jnp.asarray(inner(s))
        coefficients = least_squares(root[:, None] * functions, snapshots)
        mix = leading_directions(coefficients, count)
        values = functions @ mix
    return mix * jnp.where(root**2 @ values < 0, -1.0, 1.0)[None]


def _modes(s, inner: AbstractModes | None, mix: Array) -> AbstractModes:
    return SampledModes(s, mix) if inner is None else Combined(inner, mix)


def _count(name: str, wanted: int | float, s, strain, rest, column: int, inner) -> int:
    """The number of modes, from what is wanted: a number, or a share of the snapshots."""
    is_number = isinstance(wanted, int | np.integer) and not isinstance(wanted, bool)
    if is_traced((strain, rest)):
        most = min(strain.shape[0], len(s) if inner is None else inner.count)
        if is_number and 1 <= wanted <= most:
            return int(wanted)
        if is_number:
            raise ValueError(
                f"pod_basis: asked for {wanted} modes of `{name}`, the snapshots hold 1 to "
                f"{most}. Add load steps or ask for fewer modes."
            )
        raise ValueError(
            f"pod_basis: asked for {wanted} of `{name}` of traced snapshots, need a number of "
            "modes there. Choose it outside jit, by the length of a basis."
        )
    with evaluated_now():
        root = np.sqrt(weights(np.asarray(s)))
        change = np.asarray(strain) - np.asarray(rest_or_straight(strain, rest))[None]
        values = np.eye(len(s)) if inner is None else root[:, None] * np.asarray(inner(s))
    snapshots = root[:, None] * change[:, :, column].T
    coefficients = np.linalg.lstsq(values, snapshots, rcond=None)[0]
    left, size, right = np.linalg.svd(coefficients, full_matrices=False)
    rank = int(np.sum(size > RANK * max(size[0], 1e-300)))
    if isinstance(wanted, float) and 0 < wanted < 1:
        return _enough(name, wanted, snapshots, values @ left, size[:, None] * right)
    if not is_number or wanted < 1 or wanted > rank:
        raise ValueError(
            f"pod_basis: asked for {wanted} modes of `{name}`, the snapshots hold 1 to "
            f"{rank}. Add load steps or ask for fewer modes, or for a share below 1."
        )
    return int(wanted)


def _enough(name: str, wanted: float, snapshots, shapes, parts) -> int:
    """How many modes hold the share `wanted` of the squared snapshots, at the samples."""
    total, held = max(np.sum(snapshots**2), 1e-300), 0.0
    for count in range(1, len(parts) + 1):
        left_out = snapshots - shapes[:, :count] @ parts[:count]
        held = 1 - np.sum(left_out**2) / total
        if held >= wanted:
            return count
    raise ValueError(
        f"pod_basis: asked for {wanted} of `{name}`, all modes of `within` hold {held:.6f}. "
        "Ask for less, or give `within` more modes."
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def leading_directions(
    snapshots: Float[Array, "rows snapshots"], count: int
) -> Float[Array, "rows count"]:
    r"""The first left singular vectors U, orthonormal, with derivatives that stay finite.

    A change dA turns vector j towards another of them, k, at the rate

        w_kj = (u_k' dA r_j + r_k' dA' u_j) / d,    r_j = A' u_j,  d = |r_j|^2 - |r_k|^2,

    and out of their span by x, with P = I - U U' and B = P A,

        (|r_j|^2 I - B B') x = P (dA r_j + B dA' u_j).

    In place of 1 / d stands d / (d^2 + e^2), where e is 1e-6 |r_j| |r_k|: where two singular
    values come together the vectors may turn in their plane at any rate, and what depends on
    the subspace alone, as a rod with its identified laws does, does not see it. Where the
    last that is asked for and the first that is not come together, the subspace itself has
    no derivative, and none is made up. Only A and U are in these equations, so they have
    derivatives of every order.
    """
    return jnp.linalg.svd(snapshots, full_matrices=False)[0][:, :count]


@leading_directions.defjvp
def _leading_directions_jvp(count, primals, tangents):
    (A,), (dA,) = primals, tangents
    U = leading_directions(A, count)
    along = A.T @ U
    squares = jnp.sum(along**2, axis=0)
    rates = dA @ along
    inside = U.T @ rates
    turned = U @ ((inside + inside.T) * _inverse_gaps(squares))
    outside = _without(U, A)
    sources = _without(U, rates + outside @ (dA.T @ U))
    rows = jnp.eye(A.shape[0], dtype=A.dtype)
    remaining = squares[:, None, None] * rows[None] - (outside @ outside.T)[None]
    leaving = jnp.linalg.solve(remaining, sources.T[:, :, None])[:, :, 0].T
    return U, turned + _without(U, leaving)


def _without(U: Float[Array, "rows count"], a: Float[Array, "rows columns"]) -> Array:
    """`a` without its part in the span of U, taken out twice against rounding."""
    for _ in range(2):
        a = a - U @ (U.T @ a)
    return a


def _inverse_gaps(squares: Float[Array, " count"]) -> Float[Array, "count count"]:
    """d / (d^2 + e^2) of every pair of squared singular values, 0 of one with itself."""
    gaps = squares[None, :] - squares[:, None]
    blurred = gaps**2 + 1e-12 * squares[None, :] * squares[:, None]
    apart = blurred > 0
    return jnp.where(apart, gaps, 0.0) / jnp.where(apart, blurred, 1.0)


def captured_energy(backbone: Backbone, basis: StrainBasis) -> dict[str, Float[Array, ""]]:
    """Share of the snapshots' squared strain that the basis holds, per strain.

    Args:
        backbone: Snapshots, from `strain_along`.
        basis: Modes, e.g. from `pod_basis`.

    Returns:
        A share of at most 1 for each strain [-].
    """
    return _shares(backbone, basis)


@once
def _shares(backbone: Backbone, basis: StrainBasis) -> dict[str, Float[Array, ""]]:
    shares, q, w = {}, coordinates(backbone, basis), weights(backbone.s)
    for name in basis.active:
        held = q[:, columns(basis, name)] @ basis.modes[name](backbone.s).T
        total = jnp.sum(w[:, None] * _snapshots(backbone, name) ** 2)
        shares[name] = jnp.sum(w[None] * held**2) / jnp.maximum(total, 1e-300)
    return shares


@once
def coordinates(backbone: Backbone, basis: StrainBasis) -> Float[Array, "steps dof"]:
    """Coordinates of the snapshots: least squares at the samples, any basis.

    Args:
        backbone: Snapshots, from `strain_along`.
        basis: Modes, e.g. from `pod_basis`.

    Returns:
        One row per snapshot.
    """
    return jax.vmap(lambda change: project(change, backbone.s, basis))(backbone.change)


def project(
    change: Float[Array, "samples strain"], s: Float[Array, " samples"], basis: StrainBasis
) -> Float[Array, " dof"]:
    """Coordinates of the change of strain from rest, sampled at `s`."""
    names, w, parts = STRAINS if change.shape[1] == 6 else PLANAR, weights(s), []
    for name in basis.active:
        shapes = jnp.asarray(basis.modes[name](s))
        gram = (w[:, None] * shapes).T @ shapes
        load = (w * change[:, names.index(name)]) @ shapes
        parts.append(jnp.linalg.solve(gram, load))
    return jnp.concatenate(parts)


def _snapshots(backbone: Backbone, name: str) -> Float[Array, "samples steps"]:
    return backbone.change[:, :, backbone.names.index(name)].T
