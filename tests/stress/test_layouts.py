"""Stress cases of layouts."""

import jax
import jax.numpy as jnp
import pytest

from sorojax import design, fem, material, mesh
from sorojax._progress import silent
from sorojax.math.status import Status

GRID = mesh.rectangle([0, 0], [2, 1], divisions=(4, 2), element=mesh.Quad4())
MODEL = design.linear(
    fem.problem(
        GRID,
        material.neo_hookean(young_modulus=1.0, poisson_ratio=0.3),
        kinematics=fem.PlaneStress(1.0),
        supports=(fem.Fixed(GRID.node_sets["left"]),),
        loads=(fem.Traction(GRID.facet_sets["right"], [0.0, -1.0]),),
    )
)
SIMP = design.Simp(3.0, 1e-9)


@jax.jit
def loss(x):
    return design.compliance(MODEL, SIMP(x))


@pytest.mark.stress(27)
@pytest.mark.parametrize("density", [0.0, 1.0])
@pytest.mark.parametrize("share", [0.0, 1.0])
@pytest.mark.parametrize("optimiser", [design.OptimalityCriteria(), design.MMA(0.0, 1.0)])
def test_densities_at_their_bounds(density, share, optimiser):
    start = jnp.full(8, density)
    assert jnp.all(jnp.isfinite(jax.grad(loss)(start)))
    volume = jax.jit(lambda x: jnp.mean(x) - share)
    with silent():
        found = design.minimise(
            loss, start, constraints=(volume,), optimiser=optimiser, steps=60, tolerance=1e-4
        )
    assert jnp.all(jnp.isfinite(found.design)) and jnp.isfinite(found.objective)
    assert found.design.min() >= 0 and found.design.max() <= 1
    # Nothing left bears no load: then the weight of the constraint decides, and is reported.
    assert float(found.constraints[0]) < 1e-3 or found.status != Status.successful


@pytest.mark.stress(27)
def test_a_layout_of_one_cell():
    one = mesh.rectangle([0, 0], [1, 1], divisions=(1, 1), element=mesh.Quad4())
    smooth = design.cone_filter(one, 2.0)
    assert jnp.allclose(smooth(jnp.array([0.3])), 0.3)
