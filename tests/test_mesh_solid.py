"""Tetrahedra from a shape, their chambers, Voronoi cells, size fields, pictures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import mesh as M, sdf
from sorojax.mesh.mesh import valences
from sorojax.mesh.plane.polymesh import is_convex

RING = sdf.Circle([0, 0], 1) - sdf.Circle([0, 0], 0.5)
SQUARE = sdf.rotate(sdf.Rectangle([-1, -1], [1, 1]), np.pi / 4) - sdf.Circle([0, 0], 0.5)
HOLLOW = sdf.Sphere([0, 0, 0], 1) - sdf.Sphere([0, 0, 0], 0.6)


def pneunet():
    """Six cells in a row, a duct below them; area 832, 693 of it air."""
    cuts = sdf.repeat(sdf.Rectangle([14, 8.5], [16, 19]), [15, 0], 5)
    cells = sdf.repeat(sdf.Rectangle([3, 4], [12, 16]), [15, 0], 6)
    return sdf.Rectangle([0, 0], [90, 18]) - cuts - (cells | sdf.Rectangle([3, 4], [87, 5.5]))


DOMAINS = {
    "ring": (RING, 0.06, 0.75 * np.pi),
    "square": (SQUARE, 0.07, 4 - np.pi / 4),
    "pneunet": (pneunet(), 0.75, 832.0),
}


@pytest.mark.parametrize("part", [1, 0.6, 0.5])
@pytest.mark.parametrize("name", DOMAINS)
def test_triangles_of_the_reference_domains_are_good(name, part):
    shape, size, area = DOMAINS[name]
    quality = M.quality(M.triangulate(shape, size=part * size))
    assert np.rad2deg(quality.min_angle) > 30
    assert quality.mean_radius_ratio > 0.96 and quality.watertight
    assert np.isclose(quality.area, area, rtol=1e-12 if name == "pneunet" else 1e-3)


@pytest.mark.parametrize(("name", "count"), [("ring", 150), ("square", 150), ("pneunet", 600)])
def test_voronoi_cells_are_convex_and_fill_the_shape(name, count):
    shape, _, area = DOMAINS[name]
    errors = []
    mesh = M.polymesher(
        shape, count, key=jax.random.key(0), on_step=lambda _, e: errors.append(e)
    )
    x, cells, valence = np.asarray(mesh.points), np.asarray(mesh.cells), valences(mesh)
    assert all(is_convex(x, c[:n].tolist()) for c, n in zip(cells, valence, strict=True))
    areas = np.asarray(M.cell_areas(mesh))
    outline = M.enclosed_volume(mesh, M.boundary_facets(mesh))
    assert np.isclose(areas.sum(), -outline, rtol=1e-10) and areas.min() > 0
    assert errors[-1] < 6e-3 < errors[0]
    if name != "pneunet":
        assert mesh.num_cells == count and areas.std() < 0.1 * areas.mean()
        # Chords of the ring's two circles nearly cancel, those of one hole do not.
        assert np.isclose(areas.sum(), area, rtol=2e-3 if name == "ring" else 4e-3)
    else:
        assert np.isclose(areas.sum(), area, rtol=1e-10)


@pytest.mark.parametrize("seed", [0, 2])
def test_cells_are_even_where_the_shape_ends_in_cusps(seed):
    """Figure 5 of the paper: a turned square less the circle that touches its sides."""
    square = sdf.rotate(sdf.Rectangle([-1, -1], [1, 1]), np.pi / 4)
    mesh = M.polymesher(square - sdf.Circle([0, 0], 1.0), 150, key=jax.random.key(seed))
    areas = np.asarray(M.cell_areas(mesh))
    assert areas.std() < 0.13 * areas.mean()


@pytest.mark.parametrize("order", [1, 2])
def test_tetrahedra_of_a_hollow_sphere(order):
    mesh = M.tetrahedralise(HOLLOW, size=0.15, order=order)
    quality = M.quality(mesh)
    assert np.rad2deg(quality.min_angle) > 15 and quality.watertight
    assert jnp.all(M.cell_volumes(mesh) > 0)
    exact = 4 / 3 * np.pi * np.array([1 - 0.216, 0.216])
    assert np.isclose(quality.area, exact[0], rtol=5e-3 if order == 1 else 2e-5)
    found = M.chambers(mesh)
    assert np.isclose(found.volumes["chamber_0"], exact[1], rtol=2e-2 if order == 1 else 1e-4)
    skin = np.unique(mesh.facet_sets["boundary"])
    assert np.abs(HOLLOW(mesh.points[skin])).max() < (1e-9 if order == 1 else 1e-3)
    walls = found.mesh.facet_sets["chamber_0"]
    assert len(M.facets_on(mesh, sdf.Sphere([0, 0, 0], 0.6), tol=1e-3)) == len(walls)
    assert np.array_equal(found.largest(), walls)
    with pytest.raises(ValueError, match="need 1 to 1"):
        found.largest(2)


def test_chambers_are_found_and_follow_the_shape():
    assert np.isclose(M.chambers(M.triangulate(pneunet(), size=2)).volumes["chamber_0"], 693)

    def shape(radius):
        holes = sdf.repeat(sdf.Circle(jnp.array([0.5, 0.5]), radius), [1, 0], 2, separate=True)
        return sdf.Rectangle([0, 0], [2, 1]) - holes

    mesh, volumes = M.chambers(M.triangulate(shape(0.25), size=0.12, order=2))
    assert list(volumes) == ["chamber_0", "chamber_1"]
    facets = np.asarray(mesh.facet_sets["chamber_1"])

    @jax.jit
    def volume(radius):
        return M.enclosed_volume(M.move(mesh, shape(radius)), facets)

    assert np.isclose(volume(0.25), np.pi / 16, rtol=3e-4)
    slope, step = jax.jit(jax.grad(volume))(0.25), 1e-4
    ends = [volume(0.25 + k * step) for k in (-2, -1, 1, 2)]
    central = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)
    assert np.isclose(slope, central, rtol=1e-6)
    assert np.isclose(slope, np.pi / 2, rtol=1e-3)


def test_size_follows_a_field():
    near = sdf.Circle([1, 0], 0.05)
    mesh = M.triangulate(RING, size=M.grade(near, near=0.015, far=0.15))
    quality = M.quality(mesh)
    assert np.rad2deg(quality.min_angle) > 24
    x = np.asarray(mesh.points)[np.asarray(mesh.cells)].mean(axis=1)
    side = np.sqrt(np.asarray(M.cell_areas(mesh)) * 4 / 3**0.5)
    close = np.linalg.norm(x - [1, 0], axis=1) < 0.1
    assert side[close].mean() < 0.03 and side[x[:, 0] < 0].mean() > 0.1


def test_polygons_and_pictures_become_meshes():
    ring = [[0, 0], [2, 0], [2, 1], [0, 1]]
    hole = [[0.5, 0.25], [1, 0.25], [1, 0.75]]
    assert np.isclose(
        M.quality(M.from_polygon(ring, (hole,), size=0.2)).area, 1.875, rtol=1e-12
    )
    with pytest.raises(ValueError, match="touches or crosses"):
        M.from_polygon([[0, 0], [1, 1], [1, 0], [0, 1]], size=0.1)
    x, y = np.meshgrid(np.arange(120) + 0.5, np.arange(100) + 0.5)
    r = np.hypot(x - 60, y - 40)
    fine = np.clip(40 - r, 0, 1) * np.clip(r - 15, 0, 1)
    mesh = M.from_image(255 * fine, pixel=0.01, size=0.1)
    exact = np.pi * (0.395**2 - 0.155**2)
    assert np.isclose(M.quality(mesh).area, exact, rtol=5e-3)
    middle = (mesh.points.min(axis=0) + mesh.points.max(axis=0)) / 2
    assert np.allclose(middle, [0.6, 0.6], atol=5e-3)  # the picture is 1 m high, y up
    with pytest.raises(ValueError, match="does not exist"):
        M.from_image(np.ones((9, 9)), pixel=0.1, size=0.1)


@pytest.mark.stress(29, 38)
def test_bad_input_is_refused_before_memory_is_taken():
    with pytest.raises(ValueError, match="Raise `size`"):
        M.triangulate(RING, size=1e-9)
    with pytest.raises(ValueError, match="Raise `size`"):
        M.tetrahedralise(HOLLOW, size=1e-6)
    with pytest.raises(ValueError, match="positive"):
        M.triangulate(RING, size=float("nan"))
    with pytest.raises(ValueError, match="one length per point"):
        M.triangulate(RING, size=lambda p: p)
    with pytest.raises(ValueError, match="Lower|lower"):
        M.tetrahedralise(sdf.shell(sdf.Sphere([0, 0, 0], 1), 0.02), size=0.3)
    with pytest.raises(ValueError, match="empty"):
        M.polymesher(
            sdf.Circle([0, 0], 1) & sdf.Circle([1.5, 1.5], 1), 50, key=jax.random.key(0)
        )
