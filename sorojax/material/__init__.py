"""Materials: stored energies, fits and presets."""

from sorojax._arguments import check_package as _check_package
from sorojax.material import presets as presets
from sorojax.material.fibre import (
    FibreReinforced as FibreReinforced,
    fibre_direction as fibre_direction,
    fibre_stretch_square as fibre_stretch_square,
)
from sorojax.material.fit import TensileFit as TensileFit, fit_tensile as fit_tensile
from sorojax.material.growth import Grown as Grown, growth_volume as growth_volume
from sorojax.material.homogeneous import (
    Stability as Stability,
    drucker_stability as drucker_stability,
    equibiaxial_stress as equibiaxial_stress,
    lateral_stretch as lateral_stretch,
    pure_shear_stress as pure_shear_stress,
    simple_shear_stress as simple_shear_stress,
    uniaxial_stress as uniaxial_stress,
)
from sorojax.material.hyperelastic import (
    AbstractHyperelastic as AbstractHyperelastic,
    AbstractVolumetricLaw as AbstractVolumetricLaw,
    Logarithmic as Logarithmic,
    Quadratic as Quadratic,
    SimoMiehe as SimoMiehe,
    SimoTaylor as SimoTaylor,
    bulk_modulus as bulk_modulus,
    cauchy_stress as cauchy_stress,
    elasticity_tensor as elasticity_tensor,
    first_piola_kirchhoff_stress as first_piola_kirchhoff_stress,
    rest_stretches as rest_stretches,
    small_strain_moduli as small_strain_moduli,
    strain_energy_density as strain_energy_density,
)
from sorojax.material.mixture import (
    Mixed as Mixed,
    Scaled as Scaled,
    by_region as by_region,
)
from sorojax.material.rubbers import (
    Gent as Gent,
    MooneyRivlin as MooneyRivlin,
    NeoHookean as NeoHookean,
    Ogden as Ogden,
    Yeoh as Yeoh,
    locking_stretch as locking_stretch,
    neo_hookean as neo_hookean,
    ogden_shear_modulus as ogden_shear_modulus,
)
from sorojax.material.user import (
    CompressibleNeoHookean as CompressibleNeoHookean,
    InvariantEnergy as InvariantEnergy,
    StVenantKirchhoff as StVenantKirchhoff,
    UserEnergy as UserEnergy,
    st_venant_kirchhoff as st_venant_kirchhoff,
)

_check_package(__name__)
