"""Materials: stored energies, fits and presets."""

from sorojax._arguments import check_package as _check_package
from sorojax.material import presets
from sorojax.material.fibre import FibreReinforced, fibre_direction
from sorojax.material.fit import fit_tensile
from sorojax.material.growth import Grown
from sorojax.material.homogeneous import (
    drucker_stability,
    equibiaxial_stress,
    lateral_stretch,
    pure_shear_stress,
    simple_shear_stress,
    uniaxial_stress,
)
from sorojax.material.hyperelastic import (
    AbstractHyperelastic,
    AbstractVolumetricLaw,
    Logarithmic,
    Quadratic,
    SimoMiehe,
    SimoTaylor,
    bulk_modulus,
    cauchy_stress,
    elasticity_tensor,
    first_piola_kirchhoff_stress,
    rest_stretches,
    small_strain_moduli,
    strain_energy_density,
)
from sorojax.material.mixture import Mixed, Scaled, by_region
from sorojax.material.rubbers import (
    Gent,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    Yeoh,
    locking_stretch,
    neo_hookean,
    ogden_shear_modulus,
)
from sorojax.material.softening.fit import fit_cyclic
from sorojax.material.softening.law import Softening, dissipated_energy, preconditioned
from sorojax.material.spectrum.fit import SpectrumFit, fit_spectrum
from sorojax.material.spectrum.records import (
    AbstractViscoelasticTest,
    CreepTest,
    DynamicTest,
    RelaxationTest,
    RingDown,
    creep_compliance,
    predicted_readings,
)
from sorojax.material.user import (
    CompressibleNeoHookean,
    InvariantEnergy,
    StVenantKirchhoff,
    UserEnergy,
    st_venant_kirchhoff,
)
from sorojax.material.viscoelastic import (
    Prony,
    Viscoelastic,
    long_time_share,
    loss_modulus,
    prony_of_instantaneous,
    relaxation_modulus,
    storage_modulus,
    stress_history,
    uniaxial_spectrum,
)

__all__ = [
    "AbstractHyperelastic",
    "AbstractViscoelasticTest",
    "AbstractVolumetricLaw",
    "CompressibleNeoHookean",
    "CreepTest",
    "DynamicTest",
    "FibreReinforced",
    "Gent",
    "Grown",
    "InvariantEnergy",
    "Logarithmic",
    "Mixed",
    "MooneyRivlin",
    "NeoHookean",
    "Ogden",
    "Prony",
    "Quadratic",
    "RelaxationTest",
    "RingDown",
    "Scaled",
    "SimoMiehe",
    "SimoTaylor",
    "Softening",
    "SpectrumFit",
    "StVenantKirchhoff",
    "UserEnergy",
    "Viscoelastic",
    "Yeoh",
    "bulk_modulus",
    "by_region",
    "cauchy_stress",
    "creep_compliance",
    "dissipated_energy",
    "drucker_stability",
    "elasticity_tensor",
    "equibiaxial_stress",
    "fibre_direction",
    "first_piola_kirchhoff_stress",
    "fit_cyclic",
    "fit_spectrum",
    "fit_tensile",
    "lateral_stretch",
    "locking_stretch",
    "long_time_share",
    "loss_modulus",
    "neo_hookean",
    "ogden_shear_modulus",
    "preconditioned",
    "predicted_readings",
    "presets",
    "prony_of_instantaneous",
    "pure_shear_stress",
    "relaxation_modulus",
    "rest_stretches",
    "simple_shear_stress",
    "small_strain_moduli",
    "st_venant_kirchhoff",
    "storage_modulus",
    "strain_energy_density",
    "stress_history",
    "uniaxial_spectrum",
    "uniaxial_stress",
]

_check_package(__name__)
