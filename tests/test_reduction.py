"""From solid to rod: backbone strains, POD, identified laws, mesh location."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import SE2, SE3, fem, material, mesh, reduction, rod
from sorojax.reduction.backbone import line_strain, pose_strain, reference, section_axes
from sorojax.reduction.pod import leading_directions, weights
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


@jax.jit
def line_with_slopes(places):
    def found(places):
        return line_strain(places, jnp.asarray(LENGTH))

    return found(places), jax.jacrev(found)(places)


@pytest.mark.versions
def test_strain_of_a_circular_arc_is_constant():
    s, curvature, stretch = np.linspace(0, 1, 61), 20.0, 1.05
    angle = curvature * stretch * LENGTH * s
    arc = np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1) / curvature
    strain = np.asarray(line_with_slopes(arc)[0])
    # curvature per rest length; chords are shorter than arcs by (step angle)^2 / 24
    assert np.allclose(strain[:-1, 0], curvature * stretch, rtol=1e-10)
    assert np.allclose(strain[:, 1], stretch, rtol=2e-5)


def test_a_line_at_rest_has_no_strain_and_finite_slopes():
    s = np.linspace(0, 1, 61)
    strain, slopes = line_with_slopes(np.stack([LENGTH * s, 0 * s], axis=1))
    assert np.allclose(strain, np.array([[0.0, 1.0, 0.0]]), atol=1e-13)
    assert np.all(np.isfinite(slopes))


STRAIN = np.array([8.0, -20.0, 60.0, 1.1, 0.05, -0.1])


@jax.jit
def strain_of(poses, step):
    return pose_strain(poses[:, :3, :3], poses[:, :3, 3], step)


@jax.jit
def poses(arc, strain):
    return jax.vmap(SE3().exp)(arc[:, None] * strain[None])


@pytest.mark.parametrize("turn", [0.9, 0.02])  # half turns between neighbours but one
def test_the_strain_of_a_helix_is_exact_at_any_spacing(turn):
    step = turn * np.pi / 2 / np.linalg.norm(STRAIN[:3])
    found = strain_of(poses(step * np.arange(21), STRAIN), step)
    assert np.allclose(found, STRAIN[None], rtol=1e-5, atol=1e-9)


def test_strain_of_poses_is_of_second_order():
    s = np.linspace(0, 1, 41)
    basis = rod.chebyshev(kappa_x=2, kappa_y=3, kappa_z=3, sigma_x=2)
    stuff = dict(young_modulus=1e6, poisson_ratio=0.3, density=1e3)
    body = rod.rod(SE3(), basis, rod.circle(3 * mm), length=0.1, nodes=24, **stuff)
    q = np.array([5.0, 9, 20, -30, 12, 40, 25, -12, 0.05, 0.1])
    both = jax.jit(lambda q: (rod.forward_kinematics(body, q, s), rod.strain(body, q, s)))
    found, exact = map(np.asarray, both(q))

    def error(rows, every):
        strain = strain_of(found[rows], 0.1 / 40 * every)
        return np.abs(strain - exact[rows])

    # Both halves of the fine samples, less where they meet, against every other sample.
    fine = max(error(slice(0, 21), 1)[:-1].max(), error(slice(20, 41), 1)[1:].max())
    assert 3.5 < error(slice(0, 41, 2), 2).max() / fine < 4.5


@pytest.mark.versions
def test_strain_is_smooth_at_rest():
    rest = np.asarray(poses(0.025 * np.arange(5), np.array([0.0, 0, 0, 1, 0, 0])))

    def moved(shift):
        axes = section_axes(rest[:, :3, 1] + shift[:, 0], rest[:, :3, 2] + shift[:, 1])
        return pose_strain(axes, rest[:, :3, 3] + shift[:, 2], jnp.asarray(0.025))

    slopes = np.asarray(jax.jit(jax.jacrev(moved))(np.zeros((5, 3, 3))))
    assert np.all(np.isfinite(slopes)) and np.any(slopes != 0)


def helix(s):
    turn = 4.0 * s
    return 0.03 * jnp.stack([jnp.cos(turn), jnp.sin(turn), turn / 2], axis=1)


def test_frames_along_a_helix_do_not_turn_about_it():
    found = reference(reduction.Curve(helix), 81)
    assert np.isclose(found.length, 0.03 * 4 * np.sqrt(1.25), rtol=1e-7)
    gaps = np.linalg.norm(np.diff(found.position, axis=0), axis=1)
    assert np.allclose(gaps, gaps[0], rtol=1e-6)
    frames = np.concatenate([found.frame, found.position[:, :, None]], axis=2)
    parts = [strain_of(frames[k : k + 21], found.length / 80) for k in (0, 20, 40, 60)]
    rest = np.concatenate(parts)
    assert np.allclose(rest[:, 0], 0, atol=1e-2) and np.allclose(rest[:, 3], 1, atol=1e-3)
    bent = np.linalg.norm(rest[:, 1:3], axis=1)
    assert np.allclose(bent, 1 / 0.03 / 1.25, rtol=1e-3)


@pytest.mark.versions
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
        assert jnp.all(w @ shapes >= -1e-12)  # of either sign that with the positive mean
    captured = reduction.captured_energy(backbone, basis)
    assert captured["kappa_z"] > 0.9999 and captured["sigma_x"] > 0.99
    q = reduction.coordinates(backbone, basis)
    enough = reduction.pod_basis(backbone, modes={"kappa_z": 0.99})
    count = enough.modes["kappa_z"].count
    assert reduction.captured_energy(backbone, enough)["kappa_z"] >= 0.99
    if count > 1:
        less = reduction.pod_basis(backbone, modes={"kappa_z": count - 1})
        assert reduction.captured_energy(backbone, less)["kappa_z"] < 0.99
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


def test_modes_that_leave_out_a_strain_are_told_by_the_line(tube_path):
    """The stiffness of one bending mode fits to 1e-4, and the rod is 13 % off the solid."""
    backbone = reduction.strain_along(tube_path, LINE, samples=41)
    basis = reduction.pod_basis(backbone, modes={"kappa_z": 1})
    with pytest.warns(UserWarning, match=r"13% of its way .* or \['sigma_x', 'sigma_y'\]"):
        fit = reduction.identify(tube_path, basis, backbone, LINE)
    assert fit.stiffness_error < 1e-3
    rubber = rod.elastic(tube_path.problem.material)
    body = rod.rod(SE2(), basis, fit.section, rubber, length=fit.length, nodes=40)
    loads = (fit.elastic, rod.Pressurised(fit.pressure, tube_path.values[-1]))
    rest = rod.equilibrium(body, loads)
    points = rod.forward_kinematics(body, rest.q, backbone.s)[:, :2, 2]
    straight = jnp.stack([backbone.s * LENGTH, 0 * backbone.s], axis=1)
    gap, way = (
        jnp.max(jnp.linalg.norm(x - backbone.positions[-1], axis=1)) for x in (points, straight)
    )
    assert jnp.isclose(fit.position_error, gap / way, rtol=1e-2)


def test_pressure_map_gives_the_volume_of_the_solid(tube_path):
    backbone = reduction.strain_along(tube_path, LINE, samples=41)
    basis = reduction.pod_basis(backbone, modes={"kappa_z": 2})
    fit = reduction.identify(tube_path, basis, backbone, LINE)
    q = reduction.coordinates(backbone, basis)
    facets = tube_path.problem.loads[0].facets
    volume_of = jax.jit(jax.grad(fit.pressure.coenergy, argnums=1))
    for k in (0, 4, 8):
        volume = volume_of(q[k], tube_path.values[k])
        exact = fem.enclosed_volume(tube_path.problem, tube_path.displacements[k], facets)
        assert jnp.allclose(volume, exact, rtol=1e-4)
    assert fit.pressure.coenergy(q[3], jnp.array(0.0)) == 0


def test_mean_section_has_the_mass_of_the_body(tube_path):
    section = reduction.mean_section(tube_path.problem, LINE)
    thickness = tube_path.problem.kinematics.thickness
    assert jnp.isclose(section.second_moment_y, section.area * thickness**2 / 12, rtol=1e-12)
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
    with pytest.raises(ValueError, match="lower `arm`"):
        reduction.strain_along(tube_path, LINE, arm=50 * mm)
    with pytest.raises(ValueError, match="hold 0.*more modes"):
        reduction.pod_basis(backbone, modes={"kappa_z": 1 - 1e-9}, within=rod.Legendre(2))
    with pytest.raises(ValueError, match="asked for 1.5 modes"):
        reduction.pod_basis(backbone, modes={"kappa_z": 1.5})
    with pytest.raises(ValueError, match="21 samples, need as many"):
        reduction.pod_basis(backbone, modes={"kappa_z": 1}, within=rod.Legendre(30))
    with pytest.raises(ValueError, match="got 2 samples, need 3"):
        reduction.strain_along(tube_path, LINE, samples=2)
    basis = reduction.pod_basis(backbone, modes={"kappa_z": 1})
    short = eqx.tree_at(
        lambda p: (p.values, p.displacements),
        tube_path,
        (tube_path.values[:3], tube_path.displacements[:3]),
    )
    with pytest.raises(ValueError, match="the path holds 3 states"):
        reduction.identify(short, basis, backbone, LINE)


BEAM = reduction.Line([0.0, 0.0, 0.0], [LENGTH, 0.0, 0.0])
PULL = jnp.array([-200.0, 600.0, 1200.0])  # Pa, along the axis and out of both planes


@pytest.fixture(scope="module")
def beam_path():
    """A solid cantilever, 6 mm by 8 mm, pulled sideways at its tip."""
    half = np.array([3 * mm, 4 * mm])
    body = mesh.box([0, *-half], [LENGTH, *half], divisions=(16, 2, 2))
    tip = mesh.facets_where(body, lambda p: p[0] > LENGTH - 1e-9)
    problem = fem.problem(
        body,
        material.neo_hookean(young_modulus=1e6, poisson_ratio=0.3, density=1000.0),
        supports=(fem.Fixed(mesh.nodes_where(body, lambda p: p[0] < 1e-9)),),
        loads=(fem.Traction(tip, name="pull", value=jnp.zeros(3)),),
    )
    return fem.solve_path(problem, pull=jnp.linspace(0, 1, 4)[:, None] * PULL[None])


@pytest.mark.parametrize("sizes", [(1.0, 1e-3, 1e-5), (1.0, 1.0, 1e-5), (1.0, 1.0 + 1e-9, 0.0)])
def test_modes_that_come_together_span_what_differences_say(sizes):
    """Of equal singular values each mode turns at a bounded rate, and the projection on both
    has its exact slope, the same compiled and not."""
    draw = np.random.default_rng(0)
    left = np.linalg.qr(draw.normal(size=(7, 3)))[0]
    right = np.linalg.qr(draw.normal(size=(5, 3)))[0]
    snapshots = jnp.asarray(left * np.array(sizes) @ right.T)
    way = jnp.asarray(draw.normal(size=(7, 5)))

    def projection(snapshots):
        modes = leading_directions(snapshots, 2)
        return modes @ modes.T

    least = sorted(sizes)[1]
    step = 1e-4 * least
    ends = [projection(snapshots + k * step * way) for k in (-2, -1, 1, 2)]
    seen = (8 * (ends[2] - ends[1]) - (ends[3] - ends[0])) / (12 * step)
    for call in (projection, jax.jit(projection)):
        found = jax.jvp(call, (snapshots,), (way,))[1]
        assert np.allclose(found, seen, rtol=0, atol=1e-8 / least)
        pulled = jax.vjp(call, snapshots)[1](seen)[0]
        assert np.isclose(jnp.vdot(pulled, way), jnp.vdot(seen, seen), rtol=1e-8)
    turns = jax.jvp(lambda a: leading_directions(a, 2), (snapshots,), (way,))[1]
    assert np.all(np.isfinite(turns))


def test_the_span_of_modes_has_second_derivatives():
    """Against differences of the first, at singular values down to 1e-4 of the largest."""
    draw = np.random.default_rng(1)
    snapshots = jnp.asarray(draw.normal(size=(7, 5)) * 10.0 ** -np.arange(5))
    way = jnp.asarray(draw.normal(size=(7, 5))) * snapshots
    test = jnp.asarray(draw.normal(size=(7, 7)))

    def seen(snapshots):
        modes = leading_directions(snapshots, 3)
        return jnp.sum(modes @ modes.T * test)

    slope = jax.jit(jax.grad(seen))
    found = jax.jvp(slope, (snapshots,), (way,))[1]
    step = 1e-4
    differences = (slope(snapshots + step * way) - slope(snapshots - step * way)) / (2 * step)
    assert np.allclose(found, differences, rtol=0, atol=1e-6 * np.abs(differences).max())
    along = jax.hessian(lambda size: seen(snapshots + size * way))(0.0)
    assert np.isclose(along, jnp.vdot(found, way), rtol=1e-8)


def test_a_rod_stands_where_the_solid_in_space_stands(beam_path):
    sides = dict(samples=17, arm=2 * mm)
    backbone = reduction.strain_along(beam_path, BEAM, **sides)
    assert jnp.allclose(backbone.strain[0], backbone.rest_or_straight, rtol=0, atol=1e-12)
    modes = {"kappa_x": 1, "kappa_y": 2, "kappa_z": 2, "sigma_x": 1}
    basis = reduction.pod_basis(backbone, modes=modes, within=rod.Legendre(5))
    captured = reduction.captured_energy(backbone, basis)
    assert captured["kappa_z"] > 0.999 and captured["kappa_y"] > 0.999
    problem = beam_path.problem
    section = reduction.mean_section(problem, BEAM)
    assert jnp.isclose(section.area, 48 * mm**2) and jnp.isclose(
        section.second_moment_y, 6 * 8**3 / 12 * mm**4
    )
    body = rod.rod(SE3(), basis, section, rod.elastic(problem.material), length=LENGTH)
    stiffness = reduction.condensed_stiffness(beam_path, basis, BEAM, **sides)[0]
    assert np.allclose(stiffness, stiffness.T) and np.linalg.eigvalsh(stiffness)[0] > 0
    law = rod.LinearElastic(stiffness)
    sway = jnp.linalg.norm(backbone.positions[-1, -1] - backbone.positions[0, -1])
    assert sway > 0.3 * LENGTH
    force = jnp.concatenate([jnp.zeros(3), PULL * 48 * mm**2])
    rest = rod.equilibrium(body, (law, rod.TipWrench(force)))
    recovered = reduction.coordinates(backbone, basis)[-1]
    # Shear has no mode (1.3 % here); with the condensed stiffness at rest 3.6 %.
    for q, error in ((recovered, 2e-2), (rest.q, 5e-2)):
        points = rod.forward_kinematics(body, q, backbone.s)[:, :3, 3]
        gap = jnp.linalg.norm(points - backbone.positions[-1], axis=1)
        assert jnp.max(gap) < error * sway


def test_one_end_of_a_line_may_be_traced():
    middle = jax.jacfwd(lambda end: reduction.Line([0.0, 0.0], end)(jnp.array([0.5]))[0])
    np.testing.assert_array_equal(middle(jnp.array([2.0, 1.0])), 0.5 * np.eye(2))
