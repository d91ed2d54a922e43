"""Stress and tangent at single points, for every kinematics and kind of energy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import fem, material
from sorojax.fem.assembly.energy import (
    Body,
    energy_density,
    extrapolated_piola,
    response,
    second_piola,
    shape_response,
    shape_stress,
    tangent_entries,
)
from sorojax.fem.kinematics import component_pairs, entries_of, identity

pytestmark = pytest.mark.quick

KINEMATICS = (fem.PlaneStrain(1.0), fem.PlaneStress(1.0), fem.Axisymmetric(), fem.Solid())
RUBBERS = (
    material.neo_hookean(young_modulus=1.0, poisson_ratio=0.45),
    material.Yeoh(0.2, 0.3, 0.1, 3.0),
    material.Ogden((0.3, -0.1), (2.0, -2.0), 3.0),
)
POINTS = (2, 3)


def _name(value):
    return type(value).__name__


def _gradients(kinematics, number: int) -> jax.Array:
    """F of points, entry by entry."""
    random = np.random.default_rng(number).standard_normal((len(kinematics.slots), *POINTS))
    return jnp.asarray(np.asarray(identity(kinematics))[:, None, None] + 0.1 * random)


def _at_once(work):
    return work()


@pytest.mark.parametrize("kinematics", KINEMATICS, ids=_name)
@pytest.mark.parametrize("rubber", RUBBERS, ids=_name)
@pytest.mark.parametrize("extrapolated", [True, False])
def test_stress_and_tangent_are_derivatives_of_the_energy(kinematics, rubber, extrapolated):
    F = _gradients(kinematics, 0)
    body = Body(rubber, kinematics, None, jnp.ones(POINTS))
    answer = response(body, F, F if extrapolated else None, _at_once)

    def energy(F):
        return jnp.sum(energy_density(body, F))

    stress = jax.grad(energy)(F)
    assert np.abs(answer.stress - stress).max() < 1e-13 * np.abs(stress).max()
    blocks = tangent_entries(kinematics, answer.tangent)
    for e in range(len(F)):
        row = jax.jvp(jax.grad(energy), (F,), (jnp.zeros_like(F).at[e].set(1.0),))[1]
        for (i, k), block in zip(component_pairs(kinematics.dim), blocks, strict=True):
            for a, (first, _) in enumerate(entries_of(kinematics, i)):
                for b, (second, _) in enumerate(entries_of(kinematics, k)):
                    if first == e:
                        gap = np.abs(block[a][b] - row[second]).max()
                        assert gap < 1e-12 * np.abs(row).max()


@pytest.mark.parametrize("kinematics", KINEMATICS, ids=_name)
def test_extrapolated_stress_is_the_linear_one(kinematics):
    F, step, rubber = _gradients(kinematics, 0), 0.1 * _gradients(kinematics, 1), RUBBERS[1]

    def second(F):
        return jnp.stack(second_piola(kinematics, F, shape_stress(rubber, kinematics, F)))

    P, rate = jax.jvp(lambda F: shape_stress(rubber, kinematics, F), (F,), (step,))
    S, change = jax.jvp(second, (F,), (step,))
    found = jnp.stack(extrapolated_piola(kinematics, F, step, P, rate))
    assert np.abs(found - (S + change)).max() < 1e-13 * np.abs(S).max()


@pytest.mark.parametrize(("rubber", "linear"), [(RUBBERS[0], True), (RUBBERS[1], False)])
def test_an_energy_linear_in_the_invariant_has_no_second_slope(rubber, linear):
    shape = shape_response(rubber, fem.Solid(), _gradients(fem.Solid(), 0))[1]
    assert (shape.second is None) is linear
