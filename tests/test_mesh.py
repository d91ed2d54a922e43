"""Plane meshes: exact outline, good triangles, selection, motion with a shape."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import mesh as M, sdf
from sorojax.units import mm

LAYER = sdf.HalfPlane([0, 1 * mm], [0, 1])


def chambers(top=13 * mm):
    upper = jnp.stack([jnp.asarray(12 * mm), jnp.asarray(top)])
    first = sdf.Rectangle([6 * mm, 3 * mm], upper, 1 * mm)
    return sdf.repeat(first, [13 * mm, 0], 5, separate=True)


def bellows(top=13 * mm):
    notch = sdf.Rectangle([14 * mm, 3 * mm], [17 * mm, 30 * mm], 1 * mm)
    body = sdf.Rectangle([0, 0], [66 * mm, 15 * mm])
    return body - chambers(top) - sdf.repeat(notch, [13 * mm, 0], 4)


BELLOWS_AREA = (66 * 15 - (300 - 5 * (4 - np.pi)) - 4 * (3 * 12 - (2 - np.pi / 2))) * mm**2


@pytest.fixture(scope="module")
def body():
    return M.triangulate(bellows(), size=1 * mm, order=2, interfaces=(LAYER,))


def ring(radius=0.5):
    return sdf.Rectangle([-1, -1], [1, 1]) - sdf.Circle([0, 0], radius)


@pytest.fixture(scope="module")
def coarse():
    return M.triangulate(ring(), size=0.25, order=2)


def test_area_of_the_bellows_has_a_closed_form():
    assert np.isclose(sdf.area(bellows()), BELLOWS_AREA, rtol=2e-6)


@pytest.mark.parametrize(("size", "angle"), [(0.5, 25), (1, 25), (2, 22)])
def test_bellows_mesh_has_the_right_area_and_good_angles(size, angle):
    mesh = M.triangulate(bellows(), size=size * mm, order=2, interfaces=(LAYER,))
    quality = M.quality(mesh)
    assert np.isclose(quality.area, BELLOWS_AREA, rtol=1e-3)
    assert np.rad2deg(quality.min_angle) > angle
    assert quality.mean_radius_ratio > 0.88


def test_nodes_of_the_outline_lie_on_the_zero_sets(body):
    boundary = np.unique(M.boundary_facets(body))
    assert np.array_equal(boundary, np.unique(body.facet_sets["boundary"]))
    assert jnp.abs(bellows()(body.points[boundary])).max() < 1e-15
    line = body.node_sets["interface_0"]
    assert jnp.abs(LAYER(body.points[line])).max() < 1e-15
    assert {0.0, 66.0} <= set(np.round(np.asarray(body.points[line, 0]) / mm, 9))
    assert len(body.node_sets["corners"]) == 14  # 12 of the body, 2 where the layer ends


@pytest.mark.versions
def test_linear_triangles_fill_a_polygon_exactly():
    ell = sdf.Polygon([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]])
    quality = M.quality(M.triangulate(ell, size=0.2))
    assert np.isclose(quality.area, 3, rtol=1e-12)
    assert np.rad2deg(quality.min_angle) > 28


def test_crossing_interfaces_meet_in_a_node():
    lines = (sdf.HalfPlane([0, 1], [0, 1]), sdf.HalfPlane([1, 0], [1, 0.3]))
    mesh = M.triangulate(sdf.Rectangle([0, 0], [4, 2]), size=0.4, interfaces=lines)
    shared = np.intersect1d(mesh.node_sets["interface_0"], mesh.node_sets["interface_1"])
    assert len(shared) == 1
    assert jnp.allclose(mesh.points[shared[0]], jnp.array([0.7, 1.0]), rtol=0, atol=1e-12)


def test_facets_on_the_chambers_have_their_outline(body):
    facets = M.facets_on(body, chambers())
    x = np.asarray(body.points)[facets]
    curved = np.linalg.norm(x[:, 2] - x[:, 0], axis=1) + np.linalg.norm(
        x[:, 1] - x[:, 2], axis=1
    )
    outline = 5 * (2 * 4 + 2 * 8 + 2 * np.pi) * mm
    assert np.isclose(curved.sum(), outline, rtol=2e-3)
    assert M.facets_on(body, sdf.Circle([1, 1], 0.1)).shape == (0, 3)


def test_selectors_choose_by_place():
    mesh = M.rectangle([0, 0], [2, 1], divisions=(4, 2), order=2)
    left = M.nodes_where(mesh, lambda p: p[0] <= 0)
    assert set(left) == set(np.asarray(mesh.node_sets["left"])) and len(left) == 5
    assert len(M.facets_where(mesh, lambda p: p[1] >= 1)) == len(mesh.facet_sets["top"]) == 4
    assert len(M.cells_where(mesh, lambda p: p[0] < 1)) == 8
    assert M.nearest_node(mesh, [0.51, 0.01]) == M.nodes_where(
        mesh, lambda p: (p[0] == 0.5) & (p[1] == 0)
    )
    assert M.nodes_where(mesh, lambda p: p[0] > 5).shape == (0,)
    assert np.isclose(M.quality(mesh).area, 2, rtol=1e-14)


def test_move_to_the_same_shape_changes_nothing(body):
    moved = M.move(body, bellows(), interfaces=(LAYER,))
    assert jnp.abs(moved.points - body.points).max() < 1e-12 * 66 * mm


@pytest.mark.versions
def test_motion_is_differentiable_in_the_shape(coarse):
    @jax.jit
    def points(radius):
        return M.move(coarse, ring(radius)).points

    @jax.jit
    def area(radius):
        return jnp.sum(M.cell_areas(M.move(coarse, ring(radius))))

    step = 1e-5
    exact = jax.jvp(points, (0.5,), (1.0,))[1]
    central = (points(0.5 + step) - points(0.5 - step)) / (2 * step)
    assert jnp.allclose(exact, central, rtol=0, atol=1e-8)
    slope = jax.grad(area)(0.5)
    assert jnp.allclose(slope, (area(0.5 + step) - area(0.5 - step)) / (2 * step), rtol=1e-7)
    assert jnp.allclose(slope, -jnp.pi, rtol=1e-3)


def test_corners_and_interfaces_move_with_their_parameters():
    def fields(parameters):
        width, height, layer = parameters
        upper = jnp.stack([width, height])
        box = sdf.rotate(sdf.Rectangle([0, 0], upper), 0.2)
        return box, sdf.rotate(sdf.HalfPlane(jnp.stack([layer, layer]), [0, 1]), 0.2)

    start = jnp.array([2.0, 1.0, 0.3])
    shape, line = fields(start)
    mesh = M.triangulate(shape, size=0.25, interfaces=(line,))

    @jax.jit
    def points(parameters):
        shape, line = fields(parameters)
        return M.move(mesh, shape, interfaces=(line,)).points

    new = jnp.array([2.05, 0.97, 0.32])
    moved, (shape, line) = points(new), fields(new)
    assert jnp.abs(shape(moved[np.unique(M.boundary_facets(mesh))])).max() < 1e-12
    assert jnp.abs(line(moved[mesh.node_sets["interface_0"]])).max() < 1e-12
    c, s = jnp.cos(0.2), jnp.sin(0.2)
    corner = jnp.stack([c * 2.05 - s * 0.97, s * 2.05 + c * 0.97])
    assert jnp.linalg.norm(moved - corner[None], axis=1).min() < 1e-12
    direction = jnp.array([0.3, -0.5, 0.7])
    exact = jax.jvp(points, (new,), (direction,))[1]
    step = 1e-6
    central = (points(new + step * direction) - points(new - step * direction)) / (2 * step)
    assert jnp.allclose(exact, central, rtol=0, atol=1e-8)


def test_messages_name_the_remedy(coarse):
    with pytest.raises(ValueError, match="order"):
        M.triangulate(ring(), size=0.1, order=3)
    with pytest.raises(ValueError, match="empty"):
        M.triangulate(sdf.Circle([0, 0], 1) & sdf.Circle([1.5, 1.5], 1), size=0.1)
    with pytest.raises(ValueError, match="passes through"):
        M.triangulate(ring(), size=0.2, interfaces=(sdf.HalfPlane([0, 5], [0, 1]),))
    with pytest.raises(ValueError, match="same order"):
        M.move(coarse, ring(), interfaces=(LAYER,))
    with pytest.raises(ValueError, match="triangulate the new shape"):
        M.move(coarse, ring(0.95))
