"""Rubbers with quoted tensile points and the fits to them.

The points are quoted from the soft-robotics materials database of Marechal et al.
(Soft Robotics 8, 2021, doi:10.1089/soro.2019.0115; Open Database License): uniaxial
pull to failure, one rate (450 mm/min), cross-head strain. Expect specimens to differ
by 30 % and more.
"""

import numpy as np

from sorojax.material.fit import fit_tensile
from sorojax.material.hyperelastic import Yeoh
from sorojax.units import kPa

#: Engineering strain [-] and engineering stress [Pa].
DRAGON_SKIN_30_POINTS = (
    np.array([0.5, 1.0, 2.0, 3.0]),
    np.array([214.0, 437.0, 960.0, 1530.0]) * kPa,
)
DRAGON_SKIN_10_POINTS = (
    np.array([0.5, 1.0, 2.0, 3.0]),
    np.array([53.0, 113.0, 272.8, 444.8]) * kPa,
)


def dragon_skin_30(*, poisson_ratio: float = 0.49) -> Yeoh:
    """Yeoh fit of Smooth-On Dragon Skin 30 for strains up to 300 %."""
    strain, stress = DRAGON_SKIN_30_POINTS
    return fit_tensile(strain, stress, poisson_ratio=poisson_ratio, density=1080.0).material


def dragon_skin_10(*, poisson_ratio: float = 0.49) -> Yeoh:
    """Yeoh fit of Smooth-On Dragon Skin 10 Medium for strains up to 300 %."""
    strain, stress = DRAGON_SKIN_10_POINTS
    return fit_tensile(strain, stress, poisson_ratio=poisson_ratio, density=1070.0).material
