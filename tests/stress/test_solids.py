"""Stress cases of solids and materials."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import Status, fem, material, mesh
from sorojax.mesh import Mesh

RUBBER = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.49, density=1000.0)
GRID = mesh.rectangle([0, 0], [1, 1], divisions=(3, 3), order=2)


def block(rubber=RUBBER, pull=1e4, grid=GRID) -> fem.Problem:
    """A unit square held on the left and pulled on the right."""
    return fem.problem(
        grid,
        rubber,
        kinematics=fem.PlaneStrain(1.0),
        supports=(fem.Fixed(grid.node_sets["left"]),),
        loads=(fem.Traction(grid.facet_sets["right"], [pull, 0.0], name="pull"),),
    )


def other_side(scale):
    """Displacements that turn the square inside out, or take it all to one point."""
    return jnp.asarray(GRID.points) * jnp.array([[scale, 0.0]])


LAWS = {
    "neo_hookean": RUBBER,
    "mooney_rivlin": material.MooneyRivlin(1e5, 5e4, 1e7, 1000.0),
    "yeoh": material.Yeoh(1e5, 1e3, 10.0, 1e7, 1000.0),
    "gent": material.Gent(2e5, 30.0, 1e7, 1000.0),
    "ogden": material.Ogden([2e5], [2.0], 1e7, 1000.0),
}


@pytest.mark.stress(12)
@pytest.mark.parametrize("law", LAWS)
def test_a_thin_sheet_still_resists(law):
    for thin in (1e-3, 1e-8):
        F = jnp.diag(jnp.array([thin, 1.0, 1.0]))
        P = material.first_piola_kirchhoff_stress(LAWS[law], F)
        assert jnp.all(jnp.isfinite(P)) and P[0, 0] < 0


@pytest.mark.stress(12)
def test_no_step_goes_where_a_cell_would_vanish():
    """Squeezed flat in one step: cut, or given up with the last state that is in balance."""
    answer = fem.solve(block(RUBBER, -1e9), max_cuts=4, throw=False)
    assert jnp.all(jnp.isfinite(answer.displacement))
    assert answer.status == Status.not_converged
    assert 0 <= answer.load_fraction < 1 and answer.stats.reason


@pytest.mark.stress(13, 14)
@pytest.mark.parametrize("scale", [-1.5, -1.0])
def test_a_start_inside_out_or_in_one_line_is_left_for_rest(scale):
    start = other_side(scale)
    answer = fem.solve(block(), start=start, throw=False)
    assert answer.status == Status.successful
    rest = fem.solve(block())
    assert jnp.allclose(answer.displacement, rest.displacement, rtol=0, atol=1e-9)


@pytest.mark.stress(13)
def test_cells_drawn_inside_out_are_named():
    cells = np.array(GRID.cells)
    cells[[1, 5]] = cells[[1, 5]][:, [0, 2, 1, 5, 4, 3]]
    flipped = Mesh(GRID.points, cells, GRID.element, GRID.node_sets, GRID.facet_sets)
    with pytest.raises(ValueError, match=r"1, 5"):
        block(grid=flipped)


@pytest.mark.stress(15)
@pytest.mark.parametrize("nu", [0.49, 0.499, 0.4999, 0.499999])
def test_bending_does_not_lock(nu):
    grid = mesh.enrich(mesh.rectangle([0, 0], [25, 1], divisions=(50, 2), order=2))
    rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=nu)
    problem = fem.problem(
        grid,
        rubber,
        kinematics=fem.PlaneStrain(1.0),
        supports=(fem.Fixed(grid.node_sets["left"]),),
        loads=(fem.Traction(grid.facet_sets["right"], [0.0, 0.1]),),
    )
    answer = fem.solve(problem)
    tip = answer.displacement[grid.node_sets["right"], 1].mean()
    beam = 25.0**3 / 3 / (1e6 / (1 - nu**2) / 12) + 25 / (5 / 6 * 1e6 / 2 / (1 + nu))
    assert answer.stats.iterations <= 10 and jnp.isclose(tip, 0.1 * beam, rtol=0.02)


@pytest.mark.stress(16)
@pytest.mark.parametrize(
    "young, nu", [(1e6, 0.5), (1e6, 0.7), (1e6, -1.0), (0.0, 0.3), (-1, 0)]
)
def test_constants_that_no_solid_has(young, nu):
    with pytest.raises(ValueError, match="poisson_ratio" if young > 0 else "young_modulus"):
        material.neo_hookean(young_modulus=young, poisson_ratio=nu)


@pytest.mark.stress(17)
def test_solids_refuse_single_precision():
    with jax.enable_x64(False), pytest.raises(ValueError, match="float64"):
        grid = mesh.rectangle([0, 0], [1, 1], divisions=(2, 2))
        rubber = material.neo_hookean(young_modulus=1e6, poisson_ratio=0.4999)
        held = (fem.Fixed(grid.node_sets["left"]),)
        fem.problem(grid, rubber, kinematics=fem.PlaneStrain(1.0), supports=held)


@pytest.mark.stress(18)
def test_neighbours_a_million_times_as_stiff():
    stiff = (jnp.arange(GRID.cells.shape[0]) % 2).astype(float)
    counts = []
    for ratio in (1.0, 1e6):
        rubber = eqx.tree_at(
            lambda m: m.shear_modulus, RUBBER, RUBBER.shear_modulus * ratio**stiff
        )
        rubber = eqx.tree_at(
            lambda m: m.bulk_modulus, rubber, rubber.bulk_modulus * ratio**stiff
        )
        counts.append(fem.solve(block(rubber)).stats.iterations)
    assert counts[1] < 3 * counts[0]


@pytest.mark.stress(21)
def test_the_stress_measure_at_rest_has_a_slope():
    problem = block()

    def worst(scale):
        u = scale * jnp.asarray(GRID.points) ** 2
        return jnp.sum(fem.von_mises_stress(problem, u))

    value, slope = jax.value_and_grad(worst)(jnp.zeros(()))
    assert value == 0 and jnp.isfinite(slope)


@pytest.mark.stress(24)
def test_a_load_a_hundred_times_the_step_that_converges():
    problem = block(pull=-5e5)
    small = fem.solve(problem, steps=100)
    large = fem.solve(problem, max_cuts=10, throw=False)
    assert large.status == Status.successful
    assert jnp.allclose(large.displacement, small.displacement, rtol=0, atol=1e-8)


@pytest.mark.stress(25)
def test_a_body_without_supports_counts_its_rigid_motions():
    with pytest.raises(ValueError, match=r"3 rigid-body mode"):
        fem.problem(GRID, RUBBER, kinematics=fem.PlaneStrain(1.0), supports=())


@pytest.mark.stress(26)
def test_needles_are_listed():
    points = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [2, 5e-4], [2, 0]], float)
    cells = np.array([[0, 1, 2], [1, 3, 2], [1, 5, 4]])
    bad = mesh.quality(Mesh(points, cells, mesh.Tri3()))
    assert bad.worst[0] == 2 and bad.min_angle < 2e-3
