"""Silicones in tension: stresses at large strain from the first part of a tensile test.

The points are read from mean curves of Marechal et al., "Toward a common framework and
database of materials for soft robotics", Soft Robotics 8, 2021, doi:10.1089/soro.2019.0115
(Open Database License 1.0, contents DbCL 1.0): pull to failure at 450 mm/min, strain from the
cross-head. Specimens of one batch differ by about 1 %, see `material.presets.table`.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sorojax import material
from sorojax.material import AbstractHyperelastic, Ogden, Yeoh
from sorojax.material.fit import TensileFit
from sorojax.units import kPa

STRAIN = np.array([0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0])
STRESS = {
    "Ecoflex 00-10": np.array([4.4, 8.1, 11.4, 14.7, 21.9, 31.1, 43.1, 56.3]) * kPa,
    "Ecoflex 00-30": np.array([8.9, 16.6, 23.2, 29.2, 40.3, 52.5, 65.9, 80.3]) * kPa,
    "Ecoflex 00-50": np.array([12.3, 22.8, 32.2, 40.9, 59.3, 79.1, 101.2, 125.9]) * kPa,
    "Dragon Skin 10": np.array([26.7, 53.2, 82.2, 113.0, 190.9, 272.9, 356.2, 444.9]) * kPa,
    "Dragon Skin 20": np.array([72.3, 151.0, 232.7, 318.4, 509.3, 722.3, 952.7, 1194.4]) * kPa,
    "Dragon Skin 30": np.array([110.9, 214.2, 322.4, 437.2, 689.5, 959.5, 1238.9, 1529.5])
    * kPa,
}
FITTED_TO = 2.0  # strain up to which the points are fitted
MODELS: dict[str, type[AbstractHyperelastic]] = {"Yeoh": Yeoh, "Ogden": Ogden}
RATIO, USUAL_RATIO = 0.4999, 0.49  # Poisson ratios: that of rubber, and the default


class Prediction(NamedTuple):
    """One law of one rubber.

    Attributes:
        fit: To the points up to `FITTED_TO`.
        stress: At all of `STRAIN` [Pa].
        error: Over the measured stress there [-].
    """

    fit: TensileFit
    stress: Float[np.ndarray, " points"]
    error: Float[np.ndarray, " points"]


def predict(
    rubber: str, model: type[AbstractHyperelastic], poisson_ratio: float = RATIO
) -> Prediction:
    """Stresses of a stable law, beyond those that are fitted too."""
    measured, seen = STRESS[rubber], STRAIN <= FITTED_TO
    options = {"model": model, "terms": 1, "stable": True, "poisson_ratio": poisson_ratio}
    fit = material.fit_tensile(STRAIN[seen], measured[seen], **options)
    stress = np.asarray(material.uniaxial_stress(fit.material, 1 + jnp.asarray(STRAIN)))
    return Prediction(fit, stress, stress / measured - 1)
