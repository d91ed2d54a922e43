"""Checks of the numbers of materials."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from sorojax import _check
from sorojax._types import Numbers, real

MODULUS = "Moduli are in Pa: write 0.2 * MPa."


def reals(values: Sequence[Numbers]) -> tuple[Array, ...]:
    """One leaf for each of several numbers."""
    return tuple(real(value) for value in values)


def leaves(where: str, material: Any) -> None:
    """Raise unless every leaf is a number or one number per cell of the same mesh."""
    shapes = {np.shape(leaf) for leaf in jax.tree.leaves(material)} - {()}
    if len(shapes) > 1 or any(len(shape) != 1 for shape in shapes):
        raise ValueError(
            f"{where}: got numbers of shapes {sorted(shapes)}, need () or one number per "
            "cell, (cells,), with the same count everywhere. Batch with jax.vmap instead."
        )


def moduli(where: str, material: Any, shear: Any, bulk: Any, density: Any) -> None:
    """Raise unless the shapes fit and the constants at rest are positive."""
    leaves(where, material)
    _check.positive(where, "shear modulus", shear, "Pa", MODULUS)
    _check.positive(where, "bulk_modulus", bulk, "Pa", MODULUS)
    mass(where, density)


def mass(where: str, density: Any) -> None:
    if density is not None:
        _check.positive(where, "density", density, "kg/m^3", "Rubber is about 1070.")


def finite(where: str, **coefficients: Any) -> None:
    for name, value in coefficients.items():
        _check.finite(where, name, value, MODULUS)


def poisson_ratio(where: str, value: Any) -> None:
    _check.between(
        where,
        "poisson_ratio",
        value,
        -1.0,
        0.5,
        "",
        "For a nearly incompressible rubber use 0.49: at 0.5 the bulk modulus is infinite.",
    )
