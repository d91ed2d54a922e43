"""Slopes of energies and stresses in the deformation and in every constant."""

import jax.numpy as jnp
import numpy as np

from sorojax import material as M
from sorojax.material.fibre import fibre_stretch_square
from sorojax.material.growth import growth_volume
from tests.derivatives.case import Case

NONE = {
    "a search or a fit on the host, of numbers": "drucker_stability fit_cyclic fit_spectrum "
    "fit_tensile",
}

F = jnp.asarray(np.eye(3) + 0.2 * np.random.default_rng(2).uniform(-1, 1, (3, 3)))
STRETCH = jnp.array([0.8, 1.0, 1.7])
RUBBER = M.Yeoh(2e5, 3e4, 1e4, 5e6)
GENT = M.Gent(3e5, 20.0, 5e6)


def user(F, c):
    return c * (F[0][0] ** 2 + F[1][1] ** 2 + F[2][2] ** 2 - 3) + 0.3 * c * F[0][1] ** 2


def invariant(first, second, a, b):
    return a * (first - 3) + b * (second - 3) ** 2


SHEET = jnp.array([1.0, 0.4, 0.2])
ENERGIES = {
    "CompressibleNeoHookean": M.CompressibleNeoHookean(3e5, 5e6),
    "FibreReinforced": M.FibreReinforced(RUBBER, 1e6, SHEET),
    "FibreReinforced that stiffens": M.FibreReinforced(
        RUBBER, 1e6, SHEET, slack=0.9, stiffening=2.0
    ),
    "Gent": GENT,
    "Grown": M.Grown(RUBBER, [1.1, 1.2, 0.9]),
    "InvariantEnergy": M.InvariantEnergy(invariant, (2e5, 3e4), bulk_modulus=5e6),
    "Mixed": M.Mixed((RUBBER, GENT), [0.3, 0.7]),
    "MooneyRivlin": M.MooneyRivlin(2e5, 3e4, 5e6),
    "NeoHookean": M.NeoHookean(3e5, 5e6),
    "Ogden": M.Ogden((3e5, -1e5), (2.0, -2.0), 5e6),
    "Scaled": M.Scaled(RUBBER, 0.4),
    "Viscoelastic": M.Viscoelastic(RUBBER, M.Prony([0.3], [0.1])),
    "Softening below its peak": M.Softening(RUBBER, 1.8, 2e4, 0.2, 1e5),
    "Softening beyond its peak": M.Softening(RUBBER, 1.8, 2e4, 0.2, 1e3),
    "StVenantKirchhoff": M.StVenantKirchhoff(3e5, 5e6),
    "UserEnergy": M.UserEnergy(user, (2e5,), bulk_modulus=5e6),
    "Yeoh": RUBBER,
    "Logarithmic": M.NeoHookean(3e5, 5e6, volumetric=M.Logarithmic()),
    "SimoMiehe": M.NeoHookean(3e5, 5e6, volumetric=M.SimoMiehe()),
    "SimoTaylor": M.NeoHookean(3e5, 5e6, volumetric=M.SimoTaylor()),
}


SPECTRUM = M.Prony([0.3, 0.2], [0.1, 0.7])
UNLIKE = M.Prony([0.3, 0.0, 0.2], [0.1, 0.3, 0.7])  # a branch without a share
TESTS = (
    M.RelaxationTest([0.1, 1.0], [3e5, 2e5]), M.CreepTest([0.1, 1.0], [3e-6, 5e-6]),
    M.DynamicTest([0.3, 4.0], [3e5, 4e5], [2e4, 1e4]), M.RingDown([0.3, 4.0], [0.05, 0.2]),
)  # fmt: skip
SOFT = M.Softening(GENT, 1.8, 2e4, 0.2)
SILICONE, TIMES = M.Viscoelastic(GENT, SPECTRUM), jnp.array([0.1, 0.2, 0.6])


def rows(F):
    return tuple(tuple(F[i, j] for j in range(3)) for i in range(3))


def in_both(verb, law, other):
    return Case(lambda at: verb(*at), (law, other))


def regional(modulus):
    soft = M.neo_hookean(young_modulus=modulus, poisson_ratio=0.4)
    return M.by_region(4, {"wall": np.array([1, 2])}, RUBBER, {"wall": soft})


def of_constants(verb, *names):
    values = {"young_modulus": 1e6, "poisson_ratio": 0.4}
    return Case(lambda at: verb(**at), {name: values[name] for name in names})


CASES = (
    {
        f"strain_energy_density of {name}": in_both(
            lambda law, F: M.strain_energy_density(law, rows(F)), law, F
        )
        for name, law in ENERGIES.items()
    }
    | {
        f"first_piola_kirchhoff_stress of {name}": in_both(
            M.first_piola_kirchhoff_stress, law, F
        )
        for name, law in ENERGIES.items()
    }
    | {
        f"{verb.__name__} of {type(law).__name__}": in_both(verb, law, STRETCH)
        for verb in (
            M.equibiaxial_stress,
            M.lateral_stretch,
            M.pure_shear_stress,
            M.uniaxial_stress,
        )
        for law in (RUBBER, ENERGIES["Ogden"])
    }
    | {
        f"{verb.__name__}": in_both(verb, SPECTRUM, jnp.array([0.05, 0.9]))
        for verb in (M.loss_modulus, M.relaxation_modulus, M.storage_modulus)
    }
    | {
        f"predicted_readings of {type(test).__name__}": in_both(
            lambda modulus, spectrum, test=test: M.predicted_readings(test, modulus, spectrum),
            2e5,
            SPECTRUM,
        )
        for test in TESTS
    }  # fmt: skip
    | {
        "creep_compliance": in_both(M.creep_compliance, SPECTRUM, jnp.array([0.05, 0.9])),
        "creep_compliance with an empty branch": Case(
            lambda times: M.creep_compliance(M.Prony(UNLIKE.shares, times), 0.2), UNLIKE.times
        ),
        "long_time_share": Case(M.long_time_share, SPECTRUM),
        "bulk_modulus": Case(lambda at: M.bulk_modulus(*at), (3e5, 0.4)),
        "by_region": Case(regional, 2e6),
        "cauchy_stress": in_both(M.cauchy_stress, RUBBER, F),
        "cauchy_stress of nearly incompressible": in_both(
            M.cauchy_stress, M.neo_hookean(young_modulus=1e6, poisson_ratio=0.4999), F
        ),
        "elasticity_tensor": in_both(M.elasticity_tensor, RUBBER, F),
        "fibre_direction": Case(M.fibre_direction, jnp.array([0.3, 2.0])),
        "fibre_stretch_square": Case(
            lambda at: fibre_stretch_square(rows(at[0]), tuple(at[1])), (F, SHEET)
        ),
        "growth_volume": Case(growth_volume, ENERGIES["Grown"]),
        "locking_stretch": Case(M.locking_stretch, GENT),
        "neo_hookean": of_constants(M.neo_hookean, "young_modulus", "poisson_ratio"),
        "st_venant_kirchhoff": of_constants(
            M.st_venant_kirchhoff, "young_modulus", "poisson_ratio"
        ),
        "ogden_shear_modulus": Case(M.ogden_shear_modulus, ENERGIES["Ogden"]),
        "rest_stretches": Case(M.rest_stretches, ENERGIES["Grown"]),
        "simple_shear_stress": in_both(M.simple_shear_stress, RUBBER, jnp.array([-0.5, 0.2])),
        "prony_of_instantaneous": Case(
            lambda at: M.prony_of_instantaneous(*at),
            (jnp.array([0.2, 0.1]), jnp.array([0.1, 0.7])),
        ),
        "uniaxial_spectrum": Case(
            lambda at: M.uniaxial_spectrum(*at), (SPECTRUM, jnp.asarray(0.3))
        ),
        "stress_history": Case(
            lambda at: M.stress_history(*at), (SILICONE, TIMES, jnp.stack([F, F.T, F @ F]))
        ),
        "stress_history of softening": in_both(
            lambda law, F: M.stress_history(law, None, F),
            SOFT,
            jnp.stack([F, F @ F, F.T, F @ F @ F]),
        ),
        "dissipated_energy": in_both(M.dissipated_energy, SOFT, 3e4),
        "preconditioned": Case(
            lambda at: M.uniaxial_stress(M.preconditioned(at[0], stretch=at[1]), STRETCH),
            (SOFT, 2.0),
        ),
        "small_strain_moduli": Case(M.small_strain_moduli, ENERGIES["Ogden"]),
    }
)
