"""Materials: stored energies, fits and presets."""

from sorojax.material import presets as presets
from sorojax.material.fit import TensileFit as TensileFit, fit_tensile as fit_tensile
from sorojax.material.hyperelastic import (
    AbstractHyperelastic as AbstractHyperelastic,
    NeoHookean as NeoHookean,
    Scaled as Scaled,
    Yeoh as Yeoh,
    bulk_modulus as bulk_modulus,
    elasticity_tensor as elasticity_tensor,
    first_piola_kirchhoff_stress as first_piola_kirchhoff_stress,
    neo_hookean as neo_hookean,
    small_strain_moduli as small_strain_moduli,
    strain_energy_density as strain_energy_density,
)
