"""Strain modes from snapshots: proper orthogonal decomposition, strain by strain.

Reference: Caasenbrood et al., Sorotoki, IEEE Access 2024, section V-D4.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sorojax.reduction.backbone import Backbone
from sorojax.rod import SampledModes, StrainBasis
from sorojax.rod.basis import columns

_ROW = {"kappa_z": 0, "sigma_x": 1, "sigma_y": 2}
_REST = {"kappa_z": 0.0, "sigma_x": 1.0, "sigma_y": 0.0}


def weights(s: Float[Array, " samples"]) -> Float[np.ndarray, " samples"]:
    """Trapezoidal weights of samples in [0, 1]."""
    gaps = np.diff(np.asarray(s))
    return (np.concatenate([gaps, [0.0]]) + np.concatenate([[0.0], gaps])) / 2


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
        root = np.sqrt(weights(backbone.s))
        _, size, rows = np.linalg.svd(snapshots * root, full_matrices=False)
        rank = int(np.sum(size > 1e-10 * max(size[0], 1e-300)))
        if count < 1 or count > rank:
            raise ValueError(
                f"pod_basis: asked for {count} modes of `{name}`, the snapshots hold 1 to "
                f"{rank}. Add load steps or ask for fewer modes."
            )
        shapes = (rows[:count] / root).T
        sign = np.sign(np.sum(weights(backbone.s)[:, None] * shapes, axis=0))
        basis[name] = SampledModes(backbone.s, shapes * np.where(sign < 0, -1, 1))
    return StrainBasis(basis)


def captured_energy(backbone: Backbone, basis: StrainBasis) -> dict[str, float]:
    """Share of the snapshots' squared strain that the basis holds, per strain."""
    shares, q = {}, np.asarray(coordinates(backbone, basis))
    for name in basis.active:
        w = weights(backbone.s)
        total = np.sum(w * _snapshots(backbone, name) ** 2)
        shares[name] = float(np.sum(q[:, columns(basis, name)] ** 2) / max(total, 1e-300))
    return shares


def coordinates(backbone: Backbone, basis: StrainBasis) -> Float[Array, "steps dof"]:
    """Coordinates of the snapshots in an orthonormal basis on the samples."""
    w = jnp.asarray(weights(backbone.s))
    parts = []
    for name in basis.active:
        modes = basis.modes[name]
        shapes = jnp.asarray(modes(backbone.s))
        parts.append((backbone.strain[:, :, _ROW[name]] - _REST[name]) * w @ shapes)
    return jnp.concatenate(parts, axis=1)


def _snapshots(backbone: Backbone, name: str) -> Float[np.ndarray, "steps samples"]:
    return np.asarray(backbone.strain[:, :, _ROW[name]]) - _REST[name]
