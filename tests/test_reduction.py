"""From solid to rod: backbone strains, POD, identified laws, mesh location."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import SE2, fem, material, mesh, reduction, rod
from sorojax.reduction.backbone import line_strain
from sorojax.reduction.pod import weights
from sorojax.units import kPa, mm

LENGTH = 60 * mm


@pytest.fixture(scope="module")
def tube_path():
    """A beam with one chamber above its axis, bent by pressure."""
    block = mesh.rectangle([0, 0], [LENGTH, 12 * mm], divisions=(24, 6), order=2)
    centres = np.asarray(block.points)[np.asarray(block.cells)[:, :3]].mean(axis=1)
    hole = (np.abs(centres[:, 1] - 8 * mm) < 2 * mm) & (
        np.abs(centres[:, 0] - 30 * mm) < 12.4 * mm
    )
    used, cells = np.unique(np.asarray(block.cells)[~hole], return_inverse=True)
    body = mesh.Mesh(np.asarray(block.points)[used], cells.reshape(-1, 6), block.element)
    inside = mesh.facets_where(
        body,
        lambda p: (jnp.abs(p[1] - 8 * mm) < 2.1 * mm) & (jnp.abs(p[0] - 30 * mm) < 13 * mm),
    )
    problem = fem.problem(
        body,
        material.neo_hookean(young_modulus=3e6, poisson_ratio=0.45, density=1000.0),
        kinematics=fem.PlaneStrain(20 * mm),
        supports=(fem.Fixed(mesh.nodes_where(body, lambda p: p[0] < 1e-9)),),
        loads=(fem.Pressure(inside, name="air"),),
    )
    return fem.solve_path(problem, air=jnp.linspace(0, 3 * kPa, 9))


LINE = reduction.Line([0.0, 1 * mm], [LENGTH, 1 * mm])


def test_strain_of_a_circular_arc_is_constant():
    s, curvature, stretch = np.linspace(0, 1, 61), 20.0, 1.05
    angle = curvature * stretch * LENGTH * s
    arc = np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1) / curvature
    strain = line_strain(jnp.asarray(arc), jnp.asarray(LENGTH))
    # curvature per rest length; chords are shorter than arcs by (step angle)^2 / 24
    assert jnp.allclose(strain[:-1, 0], curvature * stretch, rtol=1e-10)
    assert jnp.allclose(strain[:, 1], stretch, rtol=2e-5)


def test_a_line_at_rest_has_no_strain_and_finite_slopes():
    s = jnp.linspace(0, 1, 21)
    straight = jnp.stack([LENGTH * s, jnp.zeros_like(s)], axis=1)
    strain = line_strain(straight, jnp.asarray(LENGTH))
    assert jnp.allclose(strain, jnp.array([[0.0, 1.0, 0.0]]), atol=1e-13)
    slopes = jax.jacrev(lambda r: line_strain(r, jnp.asarray(LENGTH)))(straight)
    assert jnp.all(jnp.isfinite(slopes))


def test_location_reproduces_quadratic_fields(tube_path, getkey):
    body = tube_path.problem.mesh
    points = np.stack([np.linspace(0, LENGTH, 15), np.full(15, 1.3 * mm)], axis=1)
    field = body.points**2 + 0.01 * body.points[:, ::-1]
    found = mesh.locate(body, points)(field)
    assert jnp.allclose(found, points**2 + 0.01 * points[:, ::-1], rtol=0, atol=1e-15)
    with pytest.raises(ValueError, match="outside the mesh"):
        mesh.locate(body, np.array([[30 * mm, 8 * mm]]))


def test_modes_are_orthonormal_and_hold_the_snapshots(tube_path):
    backbone = reduction.strain_along(tube_path, LINE, samples=41)
    basis = reduction.pod_basis(backbone, modes={"kappa_z": 3, "sigma_x": 1})
    w = weights(backbone.s)
    for modes in basis.modes.values():
        shapes = modes(backbone.s)
        gram = (w[:, None] * shapes).T @ shapes
        assert jnp.allclose(gram, jnp.eye(len(gram)), atol=1e-10)
    captured = reduction.captured_energy(backbone, basis)
    assert captured["kappa_z"] > 0.9999 and captured["sigma_x"] > 0.99
    q = reduction.coordinates(backbone, basis)
    rebuilt = q[:, :3] @ basis.modes["kappa_z"](backbone.s).T
    worst = jnp.max(jnp.abs(rebuilt - backbone.strain[:, :, 0]))
    assert worst < 0.02 * jnp.max(jnp.abs(backbone.strain[:, :, 0]))


def test_identified_rod_stands_where_the_solid_stands(tube_path):
    backbone = reduction.strain_along(tube_path, LINE, samples=41)
    basis = reduction.pod_basis(backbone, modes={"kappa_z": 3, "sigma_x": 2})
    fit = reduction.identify(tube_path, basis, backbone, LINE)
    rubber = rod.elastic(tube_path.problem.material)
    body = rod.rod(SE2(), basis, fit.section, rubber, length=fit.length, nodes=40)
    assert fit.stiffness_error < 0.05 and fit.volume_error < 0.01
    stiffness = fit.elastic.stiffness
    assert jnp.allclose(stiffness, stiffness.T) and jnp.linalg.eigvalsh(stiffness)[0] > 0
    for k in (2, 5, 8):
        loads = (fit.elastic, rod.Pressurised(fit.pressure, tube_path.values[k]))
        q = rod.equilibrium(body, loads).q
        points = rod.forward_kinematics(body, q, backbone.s)[:, :2, 2]
        gap = jnp.linalg.norm(points - backbone.positions[k], axis=1)
        bent = jnp.max(jnp.abs(backbone.positions[k, :, 1]))
        assert jnp.mean(gap) < 0.01 * bent
        assert jnp.allclose(q, reduction.coordinates(backbone, basis)[k], rtol=0, atol=2e-5)


def test_pressure_map_gives_the_volume_of_the_solid(tube_path):
    backbone = reduction.strain_along(tube_path, LINE, samples=41)
    basis = reduction.pod_basis(backbone, modes={"kappa_z": 2})
    fit = reduction.identify(tube_path, basis, backbone, LINE)
    q = reduction.coordinates(backbone, basis)
    facets = tube_path.problem.loads[0].facets
    for k in (0, 4, 8):
        volume = jax.grad(fit.pressure.coenergy, argnums=1)(q[k], tube_path.values[k])
        exact = fem.enclosed_volume(tube_path.problem, tube_path.displacements[k], facets)
        assert jnp.allclose(volume, exact, rtol=1e-4)
    assert fit.pressure.coenergy(q[3], jnp.array(0.0)) == 0


def test_mean_section_has_the_mass_of_the_body(tube_path):
    section = reduction.mean_section(tube_path.problem, LINE)
    solid = (LENGTH * 12 * mm - 25 * mm * 4 * mm) * 20 * mm
    assert jnp.allclose(section.area * LENGTH, solid, rtol=1e-12)


def test_bad_input_names_the_remedy(tube_path):
    backbone = reduction.strain_along(tube_path, LINE, samples=21)
    with pytest.raises(ValueError, match="is not one of kappa_z"):
        reduction.pod_basis(backbone, modes={"kappa_y": 1})
    with pytest.raises(ValueError, match="the snapshots hold 1 to"):
        reduction.pod_basis(backbone, modes={"kappa_z": 50})
    with pytest.raises(ValueError, match="Give two points"):
        reduction.Line([0.0, 0.0], [0.0, 0.0])
    with pytest.raises(ValueError, match="outside the mesh"):
        reduction.strain_along(tube_path, reduction.Line([0, 8 * mm], [LENGTH, 8 * mm]))
    basis = reduction.pod_basis(backbone, modes={"kappa_z": 1})
    short = eqx.tree_at(
        lambda p: (p.values, p.displacements),
        tube_path,
        (tube_path.values[:3], tube_path.displacements[:3]),
    )
    with pytest.raises(ValueError, match="the path holds 3 states"):
        reduction.identify(short, basis, backbone, LINE)
