"""Materials against closed forms, at rest, and the fit to quoted tensile points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sorojax as sj
from sorojax import material
from sorojax.units import kPa

MATERIALS = {
    "NeoHookean": material.neo_hookean(young_modulus=3e5, poisson_ratio=0.45),
    "Yeoh": material.Yeoh(1e5, 2e3, -50.0, 5e6),
    "Scaled": material.Scaled(material.Yeoh(1e5, 2e3, -50.0, 5e6), 10.0),
}


@pytest.mark.parametrize("name", MATERIALS)
def test_rubber_is_stress_free_at_rest(name):
    P = material.first_piola_kirchhoff_stress(MATERIALS[name], jnp.eye(3))
    assert jnp.max(jnp.abs(P)) < 1e-15 * 5e7  # rounding of the bulk modulus


@pytest.mark.parametrize("name", MATERIALS)
def test_stress_is_the_derivative_of_energy_and_rotates_with_the_body(name, getkey):
    rubber = MATERIALS[name]
    F = jnp.eye(3) + 0.2 * jax.random.normal(getkey(), (3, 3))
    R, _ = jnp.linalg.qr(jax.random.normal(getkey(), (3, 3)))
    R = R * jnp.sign(jnp.linalg.det(R))
    P = material.first_piola_kirchhoff_stress(rubber, F)
    assert jnp.allclose(material.first_piola_kirchhoff_stress(rubber, R @ F), R @ P, rtol=1e-10)
    A = material.elasticity_tensor(rubber, F)
    h = 1e-6 * jax.random.normal(getkey(), (3, 3))
    low, high = (material.first_piola_kirchhoff_stress(rubber, F + s * h) for s in (-1, 1))
    error = jnp.einsum("ijkl,kl->ij", A, h) - (high - low) / 2
    assert jnp.max(jnp.abs(error)) < 1e-7 * jnp.max(jnp.abs(high - low))


def test_uniaxial_yeoh_approaches_the_incompressible_closed_form():
    c1, c2, c3 = 1e5, 2e3, -50.0
    for stretch in (0.7, 1.5, 3.0):
        lateral = stretch**-0.5
        F = jnp.diag(jnp.array([stretch, lateral, lateral]))
        P = material.first_piola_kirchhoff_stress(material.Yeoh(c1, c2, c3, 1e9), F)
        # at J = 1 the lateral stress is the pressure that incompressibility would carry
        axial = P[0, 0] - P[1, 1] * lateral / stretch
        x = stretch**2 + 2 / stretch - 3
        exact = 2 * (stretch - stretch**-2) * (c1 + 2 * c2 * x + 3 * c3 * x**2)
        assert jnp.allclose(axial, exact, rtol=1e-12)


def test_small_strain_moduli_are_those_asked_for():
    shear, bulk = material.small_strain_moduli(MATERIALS["NeoHookean"])
    assert jnp.allclose(shear, 3e5 / 2.9, rtol=1e-12)
    assert jnp.allclose(bulk, 3e5 / 0.3, rtol=1e-12)


def test_fit_recovers_its_own_material():
    strain = np.linspace(0.1, 3.0, 12)
    stretch = 1 + strain
    x = stretch**2 + 2 / stretch - 3
    stress = 2 * (stretch - stretch**-2) * (9e4 + 2 * 4e3 * x - 3 * 60.0 * x**2)
    fit = material.fit_tensile(strain, stress, density=1080.0)
    found = np.array([fit.material.c1, fit.material.c2, fit.material.c3])
    assert np.allclose(found, [9e4, 4e3, -60.0], rtol=1e-9)
    assert fit.rms < 1e-4 and fit.strain_range == (0.1, 3.0)
    assert fit.stable_stretch > 4


def test_dragon_skin_30_fits_its_quoted_points_within_two_percent():
    fit = material.fit_tensile(*material.presets.DRAGON_SKIN_30_POINTS)
    assert fit.rms < 0.02 * 1530 * kPa
    assert 1.8e5 < 2 * fit.material.c1 < 2.3e5  # small-strain shear modulus [Pa]


def test_editing_a_modulus_never_retraces():
    traces = []

    @jax.jit
    def stiffness(rubber):
        traces.append(1)
        return material.small_strain_moduli(rubber)[0]

    rubber = MATERIALS["NeoHookean"]
    for modulus in (1.0e5, 2, 3e5):
        stiffness(sj.replace(rubber, lambda r: r.shear_modulus, modulus))
    assert len(traces) == 1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: material.neo_hookean(young_modulus=1e5, poisson_ratio=0.5), "use 0.49"),
        (lambda: material.NeoHookean(-1.0, 1e6), "must be positive, got -1 Pa"),
        (lambda: material.Yeoh(float("nan"), 0.0, 0.0, 1e6), "must be positive"),
        (lambda: material.fit_tensile(np.ones(2), np.ones(2)), "at least 3 points"),
        (
            lambda: material.fit_tensile(np.array([50.0, 100, 200]), np.ones(3)),
            "divide percent",
        ),
    ],
)
def test_bad_numbers_name_the_remedy(call, message):
    with pytest.raises(ValueError, match=message):
        call()
