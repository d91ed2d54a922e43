"""Hyperelastic coefficients from uniaxial tensile tests."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sorojax import _check
from sorojax.material.hyperelastic import Yeoh, bulk_modulus


@dataclass(frozen=True)
class TensileFit:
    """A fitted material with the range that it is good for.

    `rms` is the root-mean-square error of engineering stress [Pa], `strain_range`
    the fitted strains, and `stable_stretch` the uniaxial stretch at which the fitted
    stiffness turns negative (infinite if it never does below a stretch of 20).
    """

    material: Yeoh
    rms: float
    strain_range: tuple[float, float]
    stable_stretch: float


def _design(stretch: np.ndarray) -> np.ndarray:
    """Columns: engineering stress per unit c1, c2, c3 of an incompressible Yeoh bar."""
    x = stretch**2 + 2 / stretch - 3
    slope = 2 * (stretch - stretch**-2)
    return slope[:, None] * np.stack([np.ones_like(x), 2 * x, 3 * x**2], axis=1)


def fit_tensile(
    strain: Float[np.ndarray, " points"],
    stress: Float[np.ndarray, " points"],
    *,
    poisson_ratio: float = 0.49,
    density: float | None = None,
) -> TensileFit:
    """Yeoh coefficients by linear least squares on engineering stress.

    The bar is taken as incompressible, sigma = 2 (l - l^-2) (c1 + 2 c2 x + 3 c3 x^2)
    with x = l^2 + 2/l - 3; `poisson_ratio` only sets the bulk modulus of the result.

    Args:
        strain: Engineering strain [-], 1.0 is 100 %.
        stress: Engineering stress [Pa].
        poisson_ratio: Small-strain ratio of the returned material, below 0.5.
        density: Mass per reference volume [kg/m^3].

    Raises:
        ValueError: If there are fewer than three points, or they do not determine a
            material with a positive modulus.

    Reference: Yeoh, Rubber Chem. Technol. 66, 1993.
    """
    strain, stress = np.asarray(strain, float), np.asarray(stress, float)
    if strain.shape != stress.shape or strain.ndim != 1 or len(strain) < 3:
        raise ValueError(
            f"fit_tensile: got strain {strain.shape} and stress {stress.shape}, need two "
            "equal lists of at least 3 points: three coefficients are fitted."
        )
    _check.finite("fit_tensile", "strain, stress", np.stack([strain, stress]), "Drop NaN.")
    if np.any(strain <= -1) or np.max(np.abs(strain)) > 20:
        raise ValueError(
            f"fit_tensile: strains {strain.min():g} to {strain.max():g} are not engineering "
            "strains of a tensile test; divide percent by 100."
        )
    stretch = 1 + strain
    columns = _design(stretch)
    coefficients, *_ = np.linalg.lstsq(columns, stress, rcond=None)
    if coefficients[0] <= 0:
        raise ValueError(
            f"fit_tensile: the fit gives c1 = {coefficients[0]:.3g} Pa, need a positive "
            "modulus at rest. Add points at small strain."
        )
    rms = float(np.sqrt(np.mean((columns @ coefficients - stress) ** 2)))
    c1, c2, c3 = coefficients
    bulk = bulk_modulus(2 * c1, poisson_ratio)
    return TensileFit(
        material=Yeoh(c1, c2, c3, bulk, density),
        rms=rms,
        strain_range=(float(strain.min()), float(strain.max())),
        stable_stretch=_stable_stretch(coefficients),
    )


def _stable_stretch(coefficients: np.ndarray) -> float:
    stretch = np.linspace(1.0, 20.0, 4000)
    falling = np.flatnonzero(np.diff(_design(stretch) @ coefficients) <= 0)
    return float(stretch[falling[0]]) if len(falling) else float("inf")
