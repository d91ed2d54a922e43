"""Sections: closed forms against the mesh, torsion and shear, derivatives, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import mesh, rod as R, sdf
from sorojax.rod.model.torsion import plane_constants

NU = 0.3
FIELDS = ("area", "second_moment_y", "second_moment_z", "torsion_constant")


def grid(half_y, half_z, change=lambda p: p):
    """Six-node triangles in a box, their points changed; one structure for all tests."""
    body = mesh.rectangle([-1, -1], [1, 1], divisions=(12, 12), order=2)
    points = np.asarray(body.points) * [half_y, half_z]
    return mesh.Mesh(change(points), body.cells, body.element)


def quads():
    return mesh.rectangle([0, 0], [1, 1], divisions=(2, 2), element=mesh.Quad4())


@pytest.fixture(scope="module")
def disc():
    return mesh.triangulate(sdf.Circle([0.0, 0.0], 5e-3), size=0.8e-3, order=2)


@pytest.fixture(scope="module")
def tube():
    return mesh.triangulate(sdf.Ring(3e-3, 5e-3), size=0.8e-3, order=2)


def assert_same(found, exact, constants, shear):
    for field in FIELDS:
        assert np.isclose(getattr(found, field), getattr(exact, field), rtol=constants), field
    along_z = exact.shear_factor if exact.shear_factor_z is None else exact.shear_factor_z
    assert np.isclose(found.shear_factor, exact.shear_factor, rtol=shear)
    assert np.isclose(found.shear_factor_z, along_z, rtol=shear)


@pytest.mark.parametrize("sizes", [(1.0, 1.0), (0.6, 1.3)])
def test_the_mesh_of_an_ellipse_gives_its_closed_form(disc, sizes):
    b, a = sizes[0] * 5e-3, sizes[1] * 5e-3
    flat = mesh.Mesh(disc.points * jnp.array([[a, b]]) / 5e-3, disc.cells, disc.element)
    found = R.from_mesh(flat, poisson_ratio=NU)
    assert_same(found, R.ellipse(b, a, poisson_ratio=NU), 2e-5, 2e-5)
    if a == b:
        assert_same(found, R.circle(a, shear_factor=6 * (1 + NU) / (7 + 6 * NU)), 2e-5, 2e-6)


def test_a_ring_is_multiply_connected(tube):
    found = R.from_mesh(tube, poisson_ratio=NU)
    assert_same(found, R.ring(5e-3, 3e-3, poisson_ratio=NU), 2e-5, 5e-4)


# The cells of the second are four times as long as wide.
@pytest.mark.parametrize("half_y, half_z, error", [(1.0, 1.0, 1e-4), (2.0, 0.5, 1e-3)])
def test_a_rectangle_by_mesh_and_by_series(half_y, half_z, error):
    found = R.from_mesh(grid(half_y, half_z), poisson_ratio=NU)
    shear = 10 * (1 + NU) / (12 + 11 * NU)
    exact = R.rectangle(2 * half_z, 2 * half_y, shear_factor=shear)
    assert_same(found, exact, error, 2e-3)


def test_torsion_of_a_square_and_of_a_strip():
    assert np.isclose(R.rectangle(1.0, 1.0).torsion_constant, 0.1405770149551540, rtol=1e-14)
    strip = R.rectangle(1e-2, 1.0).torsion_constant
    assert np.isclose(strip, 1e-6 * (1 / 3 - 2.1008e-3), rtol=1e-6)


def test_torsion_of_a_triangle():
    found = R.from_shape(sdf.triangle([0, 0], [6e-3, 0], [3e-3, 3e-3 * 3**0.5]), size=0.6e-3)
    assert np.isclose(found.torsion_constant, np.sqrt(3) / 80 * 6e-3**4, rtol=3e-5)
    assert np.isclose(found.second_moment_y, np.sqrt(3) / 96 * 6e-3**4, rtol=1e-12)


def test_a_squircle_lies_between_disc_and_square(disc):
    assert np.isclose(R.squircle(2.0, 2.0).torsion_constant, R.circle(2.0).torsion_constant)
    power = 4.0

    def bulge(points):
        r = np.linalg.norm(points, axis=1)
        size = (np.abs(points) ** power).sum(axis=1) ** (1 / power)
        return points * (r / np.where(size > 0, size, 1))[:, None]

    round_off = mesh.Mesh(bulge(np.asarray(disc.points)), disc.cells, disc.element)
    found, exact = R.from_mesh(round_off), R.squircle(5e-3, power)
    for field in FIELDS:
        assert np.isclose(getattr(found, field), getattr(exact, field), rtol=2e-4), field
    torsion = jax.jit(lambda n: R.squircle(1.0, n).torsion_constant)
    slope = jax.jit(jax.grad(torsion))(power)
    ends = [torsion(power + h) for h in (1e-4, -1e-4)]
    assert np.isclose(slope, (ends[0] - ends[1]) / 2e-4, rtol=1e-5)


def test_a_turned_shape_is_refused_or_turned_back():
    angle = np.deg2rad(25.0)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    turned = grid(2.0, 0.5, lambda p: p @ turn + [3.0, -1.0])
    with pytest.raises(ValueError, match=r"lie 25\.00 degrees from y.*principal=True"):
        R.from_mesh(turned)
    straight, found = R.from_mesh(grid(2.0, 0.5)), R.from_mesh(turned, principal=True)
    for field in (*FIELDS, "shear_factor", "shear_factor_z"):
        assert np.isclose(getattr(found, field), getattr(straight, field), rtol=1e-9), field
    assert np.allclose(plane_constants(turned).centroid, [3.0, -1.0], atol=1e-12)


def test_derivatives_by_the_points_are_those_of_the_closed_forms(disc):
    def torsion(sizes):
        flat = mesh.Mesh(disc.points * sizes[None] / 5e-3, disc.cells, disc.element)
        found = R.from_mesh(flat, poisson_ratio=NU)
        return jnp.stack([found.torsion_constant * 1e9, found.shear_factor])

    def closed(sizes):
        found = R.ellipse(sizes[1], sizes[0], poisson_ratio=NU)
        return jnp.stack([found.torsion_constant * 1e9, found.shear_factor])

    sizes = jnp.array([6.5e-3, 3e-3])
    found, exact = jax.jacrev(torsion)(sizes), jax.jacrev(closed)(sizes)
    # Torsion is the least of an energy, so its derivative converges twice as fast.
    assert np.allclose(found[0], exact[0], rtol=1e-5)
    assert np.allclose(found[1], exact[1], rtol=1e-3)


def test_a_section_of_a_shape_follows_its_parameters(tube):
    def torsion(inner):
        return R.from_shape(sdf.Ring(inner, 5e-3), mesh=tube).torsion_constant

    slope = jax.grad(torsion)(jnp.array(3e-3))
    assert np.isclose(slope, -2 * np.pi * 3e-3**3, rtol=1e-3)


def test_scaling_and_tapering():
    whole = R.ellipse(3e-3, 5e-3)
    half = R.scaled(whole, 0.5)
    assert np.isclose(half.torsion_constant, R.ellipse(1.5e-3, 2.5e-3).torsion_constant)
    s = np.array([0.0, 0.5, 1.0])
    made = R.taper(R.rectangle, (8e-3, 6e-3), (4e-3, 6e-3))(s)
    assert np.allclose(made.area, np.array([8, 6, 4]) * 6e-6)
    shrunk = R.taper(lambda k: R.scaled(whole, k), 1.0, 0.5)(s)
    assert np.isclose(shrunk.second_moment_y[-1], half.second_moment_y)


@pytest.mark.parametrize(
    "wrong, message",
    [
        (lambda: R.circle(0.0), "`radius` must be positive"),
        (lambda: R.ring(3e-3, 5e-3), "`radius - inner_radius` must be positive"),
        (lambda: R.squircle(1.0, 1.0), "`power` must lie in"),
        (lambda: R.scaled(R.circle(1.0), -1.0), "`factor` must be positive"),
        (lambda: R.taper(R.rectangle, (1.0, 2.0), (1.0,)), "`start` has 2 sizes and `end` 1"),
        (lambda: R.from_mesh(quads()), "got Quad4 cells, need triangles"),
        (lambda: R.from_shape(sdf.Sphere([0.0, 0.0, 0.0], 1.0)), "need 2-D"),
    ],
)
def test_bad_input_names_the_remedy(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()


def test_ends_of_intervals_are_taken_in_single_precision():
    half, two, one = np.float32([0.5, 2.0, 1.0])
    made = R.Elastic(np.float32(1e6), half, np.float32(1e3))
    assert made.poisson_ratio.dtype == jnp.float32 and made.poisson_ratio == 0.5
    R.squircle(one, two)
    R.PointWrench(np.zeros(6, np.float32), s=one)
    R.PointWrench(np.zeros(6), s=1 + 1e-15)  # as sums of shares come out
    with pytest.raises(ValueError, match=r"must lie in \(-1, 0.5\]"):
        R.Elastic(1e6, 0.51, 1e3)
