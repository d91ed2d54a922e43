"""Stress cases of meshing: ordinary bodies are meshed, thin ones refused by thickness."""

import tracemalloc

import numpy as np
import pytest

from sorojax import mesh, sdf
from sorojax.mesh.plane.delaunay import Missing, constrained
from sorojax.mesh.plane.outline import Outline
from sorojax.sdf.sampling import values_and_gradients
from sorojax.sdf.surface.marching import Surface

O = [0.0, 0.0, 0.0]


def tube(facets: int, inner: float, outer: float, height: float):
    """Vertices and triangles of a tube open at both ends, as an STL file holds it."""
    angle = 2 * np.pi * np.arange(facets) / facets
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(facets)], axis=1)
    up = np.array([0, 0, height])
    rings = [outer * ring, outer * ring + up, inner * ring + up, inner * ring]
    here = np.arange(facets)
    there, triangles = (here + 1) % facets, []
    for k in range(4):
        a, b = k * facets, (k + 1) % 4 * facets
        triangles += [np.stack([a + here, a + there, b + there], axis=1)]
        triangles += [np.stack([a + here, b + there, b + here], axis=1)]
    return np.concatenate(rings), np.concatenate(triangles)


@pytest.mark.stress(68)
@pytest.mark.parametrize("size", [0.12, 0.16])
def test_an_edge_without_length_takes_no_memory(size):
    turned = sdf.rotate(
        sdf.Rectangle([-0.117, 0.0336], [0.9127, 0.4455]), 4.3066, [0.3978, 0.2396]
    )
    body = turned - sdf.Rectangle([0.4122, 0.1672], [1.492, 0.7678])
    tracemalloc.start()
    quality = mesh.quality(mesh.triangulate(body, size=size))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**25 and quality.watertight
    assert quality.area == pytest.approx(float(sdf.area(body)), rel=1e-3)
    assert np.rad2deg(quality.min_angle) > 15


@pytest.mark.stress(69)
def test_what_is_too_thin_is_named_with_its_thickness():
    tips = sdf.Circle([0.17724, 0.71957], 0.45998) - sdf.Circle([0.07605, 0.60481], 0.32127)
    tips = tips - (
        sdf.Circle([0.6863, -0.72922], 0.94368) & sdf.Circle([-0.20407, 0.41044], 0.55226)
    )
    with pytest.raises(ValueError, match=r"(wall|gap) near .* m is about .* m thick"):
        mesh.triangulate(tips, size=0.1)
    split = sdf.shell(sdf.Sphere(O, 1), 0.02)
    with pytest.raises(ValueError, match=r"near .* m is about 0\.02 m thick"):
        mesh.tetrahedralise(split, size=0.3)


@pytest.mark.stress(69)
def test_a_fin_much_thinner_than_the_size_is_seen():
    body = sdf.Rectangle([0, 0], [1, 1]) | sdf.Rectangle([1, 0.53], [3, 0.55])
    assert mesh.quality(mesh.triangulate(body, size=0.4)).area == pytest.approx(1.04)


@pytest.mark.stress(70)
def test_walls_are_measured_to_the_surface():
    box = np.array([[x, y, z] for x in (0, 20) for y in (0, 10) for z in (0, 6)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    assert sdf.surface_report(Surface(box, faces)).wall_thickness == pytest.approx(6.0)
    for facets in (12, 48, 256):
        report = sdf.surface_report(Surface(*tube(facets, 8.0, 10.0, 40.0)))
        assert report.wall_thickness == pytest.approx(2 * np.cos(np.pi / facets), rel=0.02)


@pytest.mark.stress(71)
@pytest.mark.parametrize(
    "radius, size", [(1.4660164924869092, 0.2), (1.4660164924869092, 0.12), (1.4, 0.15)]
)
def test_octants_of_shells_are_meshed(radius, size):
    shell = sdf.Sphere(O, radius) - sdf.Sphere(O, 1.0)
    octant = shell & sdf.Box(O, [2.0, 2.0, 2.0])
    quality = mesh.quality(mesh.tetrahedralise(octant, size=size))
    assert quality.watertight and not quality.inverted
    assert quality.area == pytest.approx(np.pi / 6 * (radius**3 - 1), rel=0.02)


@pytest.mark.stress(72)
@pytest.mark.parametrize("facets", [12, 24])
def test_imported_tubes_are_meshed_and_follow(facets):
    points, triangles = tube(facets, 8.0, 10.0, 6.0)
    body = sdf.TriangleMesh(points, triangles)
    made = mesh.tetrahedralise(body, size=1.0)
    sector = np.sin(2 * np.pi / facets) * facets / 2
    assert mesh.quality(made).area == pytest.approx(36 * 6 * sector, rel=5e-3)
    # a body that did not change: nothing moves
    moved = np.asarray(mesh.move(made, body).points)
    assert np.abs(moved - np.asarray(made.points)).max() < 1e-6


@pytest.mark.stress(72)
def test_the_slope_on_the_surface_is_that_of_a_face():
    """On the edges between coplanar triangles too, where rounding decides which is nearest."""
    points, triangles = tube(12, 8.0, 10.0, 40.0)
    body = sdf.TriangleMesh(points, triangles)
    corners = points[triangles[:12]]  # every other one of the outside
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    for share in np.linspace(0.05, 0.95, 19):
        diagonal = (1 - share) * corners[:, 0] + share * corners[:, 2]
        slope = values_and_gradients(body, diagonal)[1]
        np.testing.assert_allclose(slope, normal, rtol=0, atol=1e-9)


@pytest.mark.stress(73)
def test_boxes_hold_their_shapes():
    round_ = sdf.Sphere(O, 1.0)
    for shape, reach in (
        (sdf.shell(round_, 0.4), 1.2),
        (sdf.offset(round_, 0.3), 1.3),
        (sdf.shell(sdf.offset(round_, 0.1), 0.2), 1.2),
    ):
        lower, upper = (np.asarray(corner) for corner in shape.bounding_box())
        np.testing.assert_allclose(upper, reach, rtol=1e-12)
        np.testing.assert_allclose(lower, -reach, rtol=1e-12)


@pytest.mark.stress(74)
def test_a_cell_that_would_turn_inside_out_is_named():
    """The hole moves through the plate by more than the cells beside it are wide."""

    def plate(x):
        return sdf.Rectangle([0, 0], [4, 1]) - sdf.Circle([x, 0.5], 0.2)

    made = mesh.triangulate(plate(1.0), size=0.2)
    with pytest.raises(ValueError, match="cell turns inside out near"):
        mesh.move(made, plate(2.0))


@pytest.mark.stress(75)
def test_edges_that_a_delaunay_triangulation_lacks_are_put_in():
    points = np.array([[0, 0], [4, 0], [4, 1], [2, 0.02], [0, 1]], float)
    edges = np.array([[0, 1], [1, 2], [2, 3], [3, 4], [4, 0]])
    lines = Outline(points, edges, np.zeros(5, int), np.ones(5, bool))
    crowd = np.concatenate([points, [[2.0, 0.9], [2.0, -0.05]]])
    cells = constrained(crowd, lines)
    sides = {tuple(sorted(s)) for c in cells.tolist() for s in (c[:2], c[1:], [c[2], c[0]])}
    assert {tuple(sorted(e)) for e in edges.tolist()} <= sides and cells.max() < 5
    crossing = lines._replace(points=np.where(points == 0.02, -0.02, points))
    with pytest.raises(Missing):
        constrained(crossing.points, crossing)
    # edges that face the corners of a frame around lie on the hull without one of these
    diamond = np.array([[1.0, 0], [2, 1], [1, 2], [0, 1]])
    edges = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
    lines = Outline(diamond, edges, np.zeros(4, int), np.ones(4, bool))
    assert len(constrained(diamond, lines)) == 2
