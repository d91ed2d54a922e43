"""Solid and plane meshes that follow their shape: derivatives against differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import mesh as M, sdf


def can(v):
    """A cylinder of radius v[0] and height v[1] around a spherical chamber."""
    centre = jnp.stack([v[3], jnp.zeros_like(v[3]), jnp.zeros_like(v[3])])
    return sdf.Cylinder(v[0], v[1]) - sdf.Sphere(centre, v[2])


CAN = np.array([0.5, 1.0, 0.25, 0.05])


def slopes_agree(function, at, rtol=1e-6):
    # One program for the values and their derivatives.
    both = jax.jit(lambda v: (function(v), jax.jacrev(function)(v)))
    exact = np.asarray(both(at)[1])
    step = 1e-5
    ends = [[np.asarray(both(at + s * step * e)[0]) for s in (1, -1)] for e in np.eye(len(at))]
    central = np.stack([(a - b) / (2 * step) for a, b in ends], axis=-1)
    assert np.abs(exact - central).max() < rtol * np.abs(central).max()
    return exact


@pytest.fixture(scope="module")
def hollow():
    return M.chambers(M.tetrahedralise(can(CAN), size=0.16)).mesh


def test_sharp_edges_are_in_the_mesh(hollow):
    rim = np.asarray(hollow.points)[hollow.node_sets["ridges"]]
    assert len(rim) > 30 and len(hollow.node_sets["corners"]) == 0
    assert np.allclose(np.hypot(rim[:, 0], rim[:, 1]), 0.5, atol=1e-9)
    assert np.allclose(np.abs(rim[:, 2]), 0.5, atol=1e-9)


def test_volume_chamber_and_inertia_follow_every_parameter(hollow):
    chamber = hollow.facet_sets["chamber_0"]

    def measures(v):
        moved = M.move(hollow, can(v))
        x = jnp.mean(moved.points[moved.cells], axis=1)
        volume = M.cell_volumes(moved)
        inertia = jnp.sum(volume * (x[:, 0] ** 2 + x[:, 1] ** 2))
        return jnp.stack([jnp.sum(volume), M.enclosed_volume(moved, chamber), inertia])

    exact = slopes_agree(measures, CAN)
    assert np.isclose(exact[0, 1], np.pi / 4, rtol=2e-2)  # of a flat end
    same = M.move(hollow, can(CAN))
    assert jnp.abs(same.points - hollow.points).max() < 1e-9
    moved = M.move(hollow, can(1.04 * CAN))
    skin = np.unique(M.boundary_facets(moved))
    assert jnp.abs(can(1.04 * CAN)(moved.points[skin])).max() < 1e-9
    assert not M.distortion(hollow, moved).remesh
    with pytest.raises(ValueError, match="mesh the new shape"):
        M.move(hollow, can(CAN * np.array([1, 1, 1.9, 1])))


@pytest.mark.parametrize("cell", [M.Hex8(), M.Tet10()], ids=["Hex8", "Tet10"])
def test_a_box_keeps_its_corners_and_edges(cell):
    mesh = M.box([0, 0, 0], [1, 0.9, 0.8], divisions=(2, 2, 2), element=cell)

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def volume(upper):
        moved = M.move(mesh, sdf.Box([0, 0, 0], upper))
        return jnp.sum(M.cell_volumes(moved)), moved.points

    _, slope = volume(np.array([1, 0.9, 0.8]))
    assert np.allclose(slope, [0.72, 0.8, 0.9], rtol=1e-9)
    (found, points), _ = volume(np.array([1.05, 0.95, 0.76]))
    assert np.abs(np.asarray(points).max(axis=0) - [1.05, 0.95, 0.76]).max() < 1e-12
    assert np.isclose(found, 1.05 * 0.95 * 0.76, rtol=1e-12)


def test_plane_quadrilaterals_follow_and_other_meshes_are_refused():
    mesh = M.rectangle([0, 0], [2, 1], divisions=(3, 2), element=M.Quad8())
    moved = M.move(mesh, sdf.Rectangle([0, 0], [2.1, 0.9]))
    assert np.isclose(M.quality(moved).area, 1.89, rtol=1e-12)
    assert float(M.distortion(mesh, moved).size_ratio) > 0.9
    with pytest.raises(ValueError, match="2-D"):
        M.move(mesh, sdf.Sphere([0, 0, 0], 1))
    cells = M.polymesher(sdf.Rectangle([0, 0], [1, 1]), 5, key=jax.random.key(0))
    with pytest.raises(ValueError, match="triangulate"):
        M.move(cells, sdf.Rectangle([0, 0], [1, 1]))


def test_a_round_edge_that_ends_in_a_fillet_is_no_ridge():
    """A node on it that counted as one moved otherwise than its derivative said, by 0.75."""

    def shape(x):
        zero, top = 0 * x[0], jnp.ones_like(x[0])
        post = sdf.Box(jnp.stack([-x[0], -x[0], zero]), jnp.stack([x[0], x[0], 6 * top]))
        low, high = (
            jnp.stack([-x[0] - x[1], -0.9 * top, zero]),
            jnp.stack([zero, 0.9 * top, 5 * top]),
        )
        return sdf.SmoothUnion(post, sdf.Box(low, high, x[2]), 0.8)

    at, step = jnp.array([2.1, 1.1, 0.6]), 1e-5
    solid = M.tetrahedralise(shape(at), size=0.8)

    def points(x):
        return M.move(solid, shape(x)).points

    for way in step * jnp.eye(3):
        slope = jax.jvp(points, (at,), (way,))[1]
        difference = (points(at + way) - points(at - way)) / 2
        assert float(jnp.abs(slope - difference).max()) < 0.01 * step


def test_a_round_chamber_takes_its_nodes_along():
    """Nothing sharp holds them, and no side may be stretched while another is squeezed."""

    def block(x):
        chamber = sdf.Rectangle([x - 0.6, 0.5], [x + 0.6, 1.5], 0.3)
        return sdf.Rectangle([0, 0], [4, 2]) - chamber

    cells = M.triangulate(block(jnp.array(2.0)), size=0.2)
    moved = M.move(cells, block(jnp.array(2.1)))
    x = np.asarray(cells.points)
    inner = np.all(np.abs(x - [2.0, 1.0]) < [0.61, 0.51], axis=1)
    shift = np.asarray(moved.points - cells.points)[inner]
    assert len(shift) > 15
    assert np.abs(shift - [0.1, 0.0]).max() < 0.01

    def along(x):
        return jnp.sum(M.move(cells, block(x)).points)

    for verb in (along, jax.grad(along)):
        verb(jnp.array(2.3))
        with pytest.raises(ValueError, match="turns inside out"):
            verb(jnp.array(2.6))


def notched(v):
    """A block with a notch, open above, and a chamber below it."""
    width, height, depth = v
    block = sdf.Rectangle([0, 0], jnp.stack([width, height]))
    notch = sdf.Rectangle(
        jnp.stack([width / 2 - 0.4, height - depth]),
        jnp.stack([width / 2 + 0.4, height + 1.0]),
        0.2,
    )
    chamber = sdf.Circle(jnp.stack([width / 2, 0.5 + 0 * width]), 0.3)
    return block - notch - chamber


def test_nodes_go_far_through_drawings_in_between():
    start, end = np.array([4.0, 2.0, 0.7]), np.array([4.6, 2.3, 0.9])
    cells = M.triangulate(notched(start), size=0.25, order=2)
    far = functools.partial(M.move, cells, before=notched(start), stages=8)
    moved = far(notched(end))
    outline = np.asarray(moved.points)[np.unique(M.boundary_facets(moved))]
    assert np.abs(np.asarray(notched(end)(outline))).max() < 1e-9
    assert M.distortion(cells, moved).shape_ratio > 0.6
    assert np.sum(M.cell_areas(moved)) == pytest.approx(
        4.6 * 2.3 - 0.72 - 0.09 * np.pi, rel=0.01
    )

    def moment(v):  # of the areas, which knows where each node went
        new = far(notched(v))
        x = jnp.mean(new.points[new.cells], axis=1)
        weights = jnp.arange(cells.num_cells) / cells.num_cells
        return jnp.sum(weights * M.cell_areas(new) * (x[:, 0] + x[:, 1] ** 2))

    slopes_agree(moment, end)
    with pytest.raises(ValueError, match="another kind of drawing"):
        far(notched(end) - sdf.Circle([0.5, 0.5], 0.1))
