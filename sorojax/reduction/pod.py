"""Strain modes from snapshots: proper orthogonal decomposition, strain by strain.

Reference: Caasenbrood et al., Sorotoki, IEEE Access 2024, section V-D4.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.reduction.backbone import Backbone
from sorojax.rod import SampledModes, StrainBasis
from sorojax.rod.basis import columns

_ROW = {"kappa_z": 0, "sigma_x": 1, "sigma_y": 2}
_REST = {"kappa_z": 0.0, "sigma_x": 1.0, "sigma_y": 0.0}


def weights(s: Float[Array, " samples"]) -> Float[Array, " samples"]:
    """Trapezoidal weights of samples in [0, 1]."""
    gaps = jnp.pad(jnp.diff(s), 1)
    return (gaps[1:] + gaps[:-1]) / 2


def pod_basis(backbone: Backbone, *, modes: dict[str, int]) -> StrainBasis:
    """Modes that hold most of the snapshots' strain, orthonormal on [0, 1].

    Args:
        backbone: Snapshots, from `strain_along`.
        modes: Number of modes per strain, as `{"kappa_z": 3}`.

    Raises:
        ValueError: If a strain is unknown, or there are fewer independent snapshots than
            modes.
    """
    basis = {}
    for name, count in modes.items():
        if name not in _ROW:
            raise ValueError(
                f"pod_basis: the strain `{name}` is not one of {', '.join(_ROW)}. A planar "
                "backbone bends about z."
            )
        snapshots = _snapshots(backbone, name)
        w = np.asarray(weights(backbone.s))
        root = np.sqrt(w)
        _, size, rows = np.linalg.svd(snapshots * root, full_matrices=False)
        rank = int(np.sum(size > 1e-10 * max(size[0], 1e-300)))
        if count < 1 or count > rank:
            raise ValueError(
                f"pod_basis: asked for {count} modes of `{name}`, the snapshots hold 1 to "
                f"{rank}. Add load steps or ask for fewer modes."
            )
        shapes = (rows[:count] / root).T
        sign = np.sign(w @ shapes)
        basis[name] = SampledModes(backbone.s, shapes * np.where(sign < 0, -1, 1))
    return StrainBasis(basis)


def captured_energy(backbone: Backbone, basis: StrainBasis) -> dict[str, float]:
    """Share of the snapshots' squared strain that the basis holds, per strain."""
    shares, q = {}, np.asarray(coordinates(backbone, basis))
    for name in basis.active:
        w = np.asarray(weights(backbone.s))
        total = np.sum(w * _snapshots(backbone, name) ** 2)
        shares[name] = float(np.sum(q[:, columns(basis, name)] ** 2) / max(total, 1e-300))
    return shares


def coordinates(backbone: Backbone, basis: StrainBasis) -> Float[Array, "steps dof"]:
    """Coordinates of the snapshots in a basis that is orthonormal on the samples."""
    return jax.vmap(lambda strain: project(strain, backbone.s, basis))(backbone.strain)


def project(
    strain: Float[Array, "samples 3"], s: Float[Array, " samples"], basis: StrainBasis
) -> Float[Array, " dof"]:
    """Coordinates of one strain field, sampled at `s`, in an orthonormal basis."""
    w = weights(s)
    parts = [
        (w * (strain[:, _ROW[name]] - _REST[name])) @ jnp.asarray(basis.modes[name](s))
        for name in basis.active
    ]
    return jnp.concatenate(parts)


def _snapshots(backbone: Backbone, name: str) -> Float[np.ndarray, "steps samples"]:
    return np.asarray(backbone.strain[:, :, _ROW[name]]) - _REST[name]
