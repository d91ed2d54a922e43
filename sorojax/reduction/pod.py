"""Strain modes from snapshots: proper orthogonal decomposition, strain by strain.

Reference: Caasenbrood et al., Sorotoki, IEEE Access 2024, section V-D4.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.reduction.backbone import PLANAR, Backbone
from sorojax.rod import AbstractModes, StrainBasis, orthonormalise
from sorojax.rod.model.basis import STRAINS, Combined, SampledModes


@jax.jit
def weights(s: Float[Array, " samples"]) -> Float[Array, " samples"]:
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
        inner, columns = _shapes(backbone, name, within)
        root = np.sqrt(np.asarray(weights(backbone.s)))
        coefficients = np.linalg.lstsq(
            root[:, None] * columns, (root * _snapshots(backbone, name)).T, rcond=None
        )[0]
        left, size, right = np.linalg.svd(coefficients, full_matrices=False)
        rank = int(np.sum(size > 1e-10 * max(size[0], 1e-300)))
        if isinstance(wanted, float) and 0 < wanted < 1:
            shapes, parts = root[:, None] * (columns @ left), size[:, None] * right
            wanted = _enough(name, wanted, (root * _snapshots(backbone, name)).T, shapes, parts)
        count = _count(name, wanted, rank)
        sign = np.sign((root**2) @ columns @ left[:, :count])
        mix = left[:, :count] * np.where(sign < 0, -1, 1)
        basis[name] = _modes(backbone, inner, columns, mix)
    return StrainBasis(basis)


def _shapes(backbone: Backbone, name: str, within: AbstractModes | None):
    """Functions in which the snapshots are written, and their values at the samples.

    Orthonormal ones: then singular vectors give orthonormal modes.
    """
    root = np.sqrt(np.asarray(weights(backbone.s)))
    if within is None:
        return None, np.diag(1 / root)
    if within.count > len(backbone.s):
        raise ValueError(
            f"pod_basis: `within` has {within.count} modes, the backbone {len(backbone.s)} "
            "samples, need as many or more. Take more samples."
        )
    inner = orthonormalise(StrainBasis({name: within})).modes[name]
    return inner, np.asarray(inner(np.asarray(backbone.s)))


def _modes(backbone: Backbone, inner, columns: np.ndarray, mix: np.ndarray) -> AbstractModes:
    return SampledModes(backbone.s, columns @ mix) if inner is None else Combined(inner, mix)


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


def _count(name: str, wanted: int | float, rank: int) -> int:
    if isinstance(wanted, bool | float) or wanted < 1 or wanted > rank:
        raise ValueError(
            f"pod_basis: asked for {wanted} modes of `{name}`, the snapshots hold 1 to "
            f"{rank}. Add load steps or ask for fewer modes, or for a share below 1."
        )
    return int(wanted)


def captured_energy(backbone: Backbone, basis: StrainBasis) -> dict[str, float]:
    """Share of the snapshots' squared strain that the basis holds, per strain."""
    shares, q, start = {}, np.asarray(coordinates(backbone, basis)), 0
    w = np.asarray(weights(backbone.s))
    for name in basis.active:
        shapes = np.asarray(basis.modes[name](backbone.s))
        held = q[:, start : start + shapes.shape[1]] @ shapes.T
        start += shapes.shape[1]
        total = np.sum(w * _snapshots(backbone, name) ** 2)
        shares[name] = float(np.sum(w * held**2) / max(total, 1e-300))
    return shares


@eqx.filter_jit
def coordinates(backbone: Backbone, basis: StrainBasis) -> Float[Array, "steps dof"]:
    """Coordinates of the snapshots: least squares at the samples, any basis."""
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


def _snapshots(backbone: Backbone, name: str) -> Float[np.ndarray, "steps samples"]:
    return np.asarray(backbone.change[:, :, backbone.names.index(name)])
