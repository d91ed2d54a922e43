"""Isosurfaces, their checks, and volume, centroid and inertia of solids."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import sdf
from sorojax.sdf.base import absolute, norm
from sorojax.sdf.surface.sheets import sheets

METHODS = ("marching_cubes", "dual_contouring")


class Field(sdf.AbstractSdf):
    """Any field of three coordinates in a box of +-`reach`."""

    function: object = eqx.field(static=True)
    parameters: jax.Array
    reach: float = eqx.field(static=True, default=1.0)

    @property
    def dim(self):
        return 3

    def distance(self, *x):
        return self.function(self.parameters, *x)

    def bounding_box(self):
        return jnp.full(3, -self.reach), jnp.full(3, self.reach)


def _rod(p, *x):
    a, b, c = x
    r = jnp.minimum(jnp.minimum(norm(a, b), norm(b, c)), norm(c, a))
    return r - p


def _gyroid(p, x, y, z):
    w = 2 * jnp.pi / p
    x, y, z = w * x, w * y, w * z
    g = jnp.sin(x) * jnp.cos(y) + jnp.sin(y) * jnp.cos(z) + jnp.sin(z) * jnp.cos(x)
    return absolute(g) / (w * 3**0.5) - 0.03


def _torus(p, x, y, z):
    return norm(norm(x, y) - p[0], z) - p[1]


def _tilted_box(p, x, y, z):
    a, b = (0.8, 0.6), (0.28, 0.96)
    x, y = a[0] * x + a[1] * y, a[0] * y - a[1] * x
    y, z = b[0] * y + b[1] * z, b[0] * z - b[1] * y
    box = sdf.Box(jnp.stack([-p[0] / 2, -p[1] / 2, -p[2] / 2]), p / 2)
    return box.distance(x, y, z)


CSG = (sdf.Sphere([0, 0, 0], 1) & sdf.Box([-0.75] * 3, [0.75] * 3)) - Field(
    _rod, jnp.array(0.5), 2.0
)
GYROID = Field(_gyroid, jnp.array(0.5)) & sdf.Box([-0.75] * 3, [0.75] * 3)
TORUS = Field(_torus, jnp.array([0.7, 0.25]))
evaluate = eqx.filter_jit(lambda shape, p: shape(p))


def rms_at_centres(shape, surface):
    centres = surface.vertices[surface.triangles].mean(axis=1)
    return float(np.sqrt((np.asarray(evaluate(shape, jnp.asarray(centres))) ** 2).mean()))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shape, genus", [(TORUS, 1), (CSG, 5), (GYROID, 200)])
def test_surfaces_are_closed_and_manifold(shape, genus, method):
    report = sdf.surface_report(sdf.isosurface(shape, 2.2 / 64, method))
    assert report.watertight and report.manifold
    assert report.genus == genus and not len(report.crossings)
    assert report.volume > 0


def test_dual_contouring_keeps_edges():
    coarse, sharp = (sdf.isosurface(CSG, 2.2 / 96, method) for method in METHODS)
    assert rms_at_centres(CSG, sharp) < rms_at_centres(CSG, coarse) / 5
    box = sdf.Box([-0.3, -0.4, -0.5], [0.3, 0.4, 0.5])
    report = sdf.surface_report(sdf.isosurface(box, 0.05, "dual_contouring"))
    assert abs(report.volume / 0.48 - 1) < 1e-5
    assert abs(report.area / 3.76 - 1) < 1e-5


@pytest.mark.parametrize("method", METHODS)
def test_pruning_loses_nothing(method):
    """The same surface from blocks as from every cell of the grid."""
    from sorojax.sdf.surface import blocks
    from sorojax.sdf.surface.dual_contouring import dual_contouring
    from sorojax.sdf.surface.marching import marching_cubes

    grid = blocks.grid_around("test", CSG, 0.05)
    axes = [np.arange(0, n, blocks.LEAF) for n in grid.counts]
    every = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    extract = {"marching_cubes": marching_cubes, "dual_contouring": dual_contouring}[method]
    pruned = blocks.active_blocks("test", CSG, grid)
    assert len(pruned) < len(every)
    for a, b in zip(extract(CSG, grid, every), extract(CSG, grid, pruned), strict=True):
        assert a.shape == b.shape and np.allclose(np.sort(a, 0), np.sort(b, 0), atol=1e-12)


def test_numbers_do_not_recompile():
    from sorojax.sdf.surface import blocks

    sdf.isosurface(sdf.Sphere([0, 0, 0], 0.9), 0.1, "dual_contouring")
    before = blocks._sample._cached._cache_size()
    sdf.isosurface(sdf.Sphere([0.1, 0, 0.2], 0.7), 0.07, "dual_contouring")
    assert blocks._sample._cached._cache_size() == before


def test_sheets_of_every_sign_pattern_are_loops():
    for code in range(256):
        number, joined = sheets(code)
        cut = [n for n in number if n >= 0]
        assert all(cut.count(k) >= 3 for k in set(cut))
        assert (joined == 0) or max(number) >= 0
    assert max(sheets(0b10010110)[0]) == 3  # four corners that touch nowhere
    assert sheets(0)[0] == (-1,) * 12


def test_random_signs_give_a_manifold_surface(getkey):
    """The hardest case: a field that changes sign at random from node to node."""
    from sorojax.sdf.surface import blocks, dual_contouring as dc
    from sorojax.sdf.surface.sheets import (
        Faces,
        blocks_before,
        cell_sheets,
        cells_before,
        corner,
        doubtful_faces,
    )

    inside = np.zeros((17, 17, 17), bool)
    inside[1:16, 1:16, 1:16] = np.asarray(jax.random.bernoulli(getkey(), 0.5, (15, 15, 15)))
    grid = blocks.Grid(np.zeros(3), 1.0, np.array([16, 16, 16]))
    starts = 8 * np.array(list(np.ndindex(2, 2, 2)))
    before = blocks_before(grid, starts)
    every = corner(starts, np.arange(8 * 512))
    corners = [every + [c & 1, c >> 1 & 1, c >> 2] for c in range(8)]
    bits = [inside[tuple(n.T)].astype(np.uint8) << c for c, n in enumerate(corners)]
    code = np.bitwise_or.reduce(bits)
    name = np.flatnonzero((code > 0) & (code < 255))
    code = code[name]
    second = doubtful_faces(code)
    names = [cells_before(before, name[rows], 1 << f) for f, rows in enumerate(second)]
    axis = np.repeat(np.arange(3), [len(rows) for rows in second])
    first = np.searchsorted(name, np.concatenate(names))
    middle = np.asarray(jax.random.bernoulli(getkey(), 0.5, axis.shape))
    found = cell_sheets(code, Faces(first, np.concatenate(second), axis), middle)
    ends = np.concatenate([[0], np.cumsum(found.number[found.kind])]).astype(np.int32)
    cells = dc.Cells(name, code, found.kind, found.edges, ends)
    edges = [np.flatnonzero((code ^ code >> (1 << a)) & 1) for a in range(3)]
    quads = dc.quads_around(before, edges, cells, slice(0, len(name)), 0)
    quads = dc.outward(quads, code[np.concatenate(edges)])
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    points = np.repeat(corner(starts, name), np.diff(ends), axis=0)
    report = sdf.surface_report(sdf.Surface(points, triangles))
    assert report.manifold


BLOCK = sdf.Box([-0.7, -0.6, -0.5], [0.7, 0.6, 0.5])


@pytest.mark.parametrize(
    "body", [sdf.Sphere([0.01, 0.02, 0.03], 0.8), sdf.turn(BLOCK, [1, 2, 3], 0.5)]
)
def test_walls_as_thick_as_a_cell_have_no_holes(body):
    """Walls of one cell stay closed; thinner ones are refused with the size they need."""
    hollow = sdf.shell(body, 0.1)
    for cells in (1.0, 1.2):
        report = sdf.surface_report(sdf.isosurface(hollow, 0.1 / cells, METHODS[1]))
        assert report.manifold and report.num_shells == 2 and report.genus == 0
    with pytest.raises(ValueError, match="wall about .* m thick .* Use `size` <="):
        sdf.isosurface(hollow, 0.1 / 0.8, METHODS[1])


@pytest.mark.parametrize("lattice, genus", [(sdf.Gyroid, 72), (sdf.SchwarzP, 57)])
def test_rims_of_cut_lattices_stay_whole(lattice, genus):
    """Sheets run out in rims thinner than a cell; the genus is that of fine grids."""
    part = lattice(0.8, 0.1) & sdf.Sphere([0, 0, 0], 1)
    report = sdf.surface_report(sdf.isosurface(part, 0.03, METHODS[1]))
    assert report.printable
    assert report.num_shells == 1 and report.genus == genus


def test_triangles_around_an_edge_stay_apart(getkey):
    """Wherever four vertices lie in their cells, what is cut keeps to the edge's envelope."""
    from sorojax.sdf.surface.dual_contouring import Quads, split

    count, corners = 2000, np.array([[-1, -1], [0, -1], [0, 0], [-1, 0]])
    share = np.asarray(jax.random.uniform(getkey(), (count, 4, 3), minval=0.02, maxval=0.98))
    ends = share + np.concatenate([corners, np.zeros((4, 1))], axis=1)
    offset = np.zeros((count, 3), np.float32)
    offset[:, 2] = np.asarray(jax.random.uniform(getkey(), (count,)))
    normal = np.tile(np.array([0, 0, 1], np.float32), (count, 1))
    rows = np.arange(4 * count).reshape(-1, 4)
    zero = np.zeros((count, 3), int)
    quads = Quads(rows, zero, np.full(count, 2), offset, normal)
    pairs, more, hubs = split(ends.reshape(-1, 3), quads, 4 * count)
    assert 2 * len(hubs) == len(more) > 0
    points = np.concatenate([ends.reshape(-1, 3), hubs])
    # The edge meets what was cut in two exactly once.
    whole = ~np.isin(rows[:, 0], more) & (pairs < 4 * count).all(axis=(0, 2))
    t = points[pairs[:, whole]]
    turn = [
        t[..., k, 0] * t[..., (k + 1) % 3, 1] - t[..., k, 1] * t[..., (k + 1) % 3, 0]
        for k in range(3)
    ]
    hit = (np.minimum.reduce(turn) > 0) | (np.maximum.reduce(turn) < 0)
    assert whole.any() and (hit.sum(axis=0) == 1).all()
    height = (np.stack(turn) * t[..., [2, 0, 1], 2].transpose(2, 0, 1)).sum(axis=0)
    height = (height / np.stack(turn).sum(axis=0))[hit]
    assert ((height > 0) & (height < 1)).all()


@pytest.mark.stress(31)
def test_report_names_what_is_wrong():
    box = sdf.isosurface(sdf.Box([0, 0, 0], [1, 1, 1]), 0.3)
    holed = sdf.surface_report(box._replace(triangles=box.triangles[1:]))
    assert len(holed.open_edges) == 3 and not holed.watertight
    assert set(holed.open_edges.ravel()) == set(box.triangles[0])
    flipped = box.triangles.copy()
    flipped[0] = flipped[0][::-1]
    assert len(sdf.surface_report(box._replace(triangles=flipped)).turned_edges) == 3
    # Two tetrahedra that share an edge, then only a vertex.
    tetra = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    edge = np.concatenate([tetra, np.array([0, 1, 4, 5])[tetra]])
    vertex = np.concatenate([tetra, np.array([0, 4, 5, 6])[tetra]])
    more = np.concatenate([points, points[1:] - 2])
    assert sdf.surface_report(sdf.Surface(more, edge)).crowded_edges.tolist() == [[0, 1]]
    pinched = sdf.surface_report(sdf.Surface(more, vertex))
    assert pinched.watertight and not pinched.manifold
    assert pinched.pinched_vertices.tolist() == [0]
    with pytest.raises(ValueError, match="triangle 0 is"):
        sdf.surface_report(sdf.Surface(points, np.array([[0, 1, 4]])))
    with pytest.raises(ValueError, match="not finite"):
        sdf.surface_report(sdf.Surface(points * np.nan, tetra))


def test_report_finds_shells_that_face_the_wrong_way():
    boxes = [sdf.Box([-r] * 3, [r] * 3) for r in (1, 0.7, 0.4)]
    outer, cavity, core = (sdf.isosurface(box, 0.3) for box in boxes)
    count = len(outer.triangles)
    points = np.concatenate([s.vertices for s in (outer, cavity, core)])
    rows = [outer.triangles, cavity.triangles + len(outer.vertices)]
    rows.append(core.triangles + len(outer.vertices) + len(cavity.vertices))
    wrong = sdf.surface_report(sdf.Surface(points, np.concatenate(rows)))
    mended = np.arange(count, count + len(rows[1]))
    assert wrong.watertight and wrong.inverted_triangles.tolist() == mended.tolist()
    assert "inverted_triangles" in repr(wrong)
    rows[1] = rows[1][:, ::-1]
    right = sdf.surface_report(sdf.Surface(points, np.concatenate(rows)))
    assert not len(right.inverted_triangles)
    inside_out = sdf.surface_report(outer._replace(triangles=outer.triangles[:, ::-1]))
    assert len(inside_out.inverted_triangles) == count and inside_out.volume < 0


def test_report_measures_walls_and_finds_crossings():
    hollow = sdf.Sphere([0, 0, 0], 1) - sdf.Sphere([0, 0, 0], 0.7)
    report = sdf.surface_report(sdf.isosurface(hollow, 0.1))
    assert report.printable and abs(report.wall_thickness / 0.3 - 1) < 0.03
    plate = sdf.isosurface(sdf.Box([0, 0, 0], [1, 0.5, 0.2]), 0.05, "dual_contouring")
    assert abs(sdf.surface_report(plate).wall_thickness / 0.2 - 1) < 0.01
    moved = plate.vertices + np.array([0.3, 0.2, 0.07])
    both = sdf.Surface(
        np.concatenate([plate.vertices, moved]),
        np.concatenate([plate.triangles, plate.triangles + len(moved)]),
    )
    report = sdf.surface_report(both)
    assert report.manifold and not report.printable
    first, second = report.crossings.T
    assert (first < len(plate.triangles)).all() and (second >= len(plate.triangles)).all()


def test_flying_edges_give_the_same_surface(monkeypatch):
    pytest.importorskip("vtkmodules")
    ours = sdf.surface_report(sdf.isosurface(CSG, 2.2 / 48))
    monkeypatch.setattr(
        "sorojax.sdf.surface.marching.importlib.util.find_spec", lambda name: None
    )
    theirs = sdf.surface_report(sdf.isosurface(CSG, 2.2 / 48))
    assert ours.manifold and ours.genus == theirs.genus
    assert abs(ours.volume / theirs.volume - 1) < 1e-4


def test_smooth_solids_are_of_fourth_order():
    def sphere(radius, resolution):
        return sdf.volume(sdf.Sphere([0.013, 0.027, -0.031], radius), resolution)

    errors = [abs(float(sphere(1.0, n)) / (4 / 3 * np.pi) - 1) for n in (24, 48)]
    assert errors[0] / errors[1] > 12 and errors[1] < 2e-7
    slope = jax.grad(sphere)(1.0, 48)
    assert abs(float(slope) / (4 * np.pi) - 1) < 2e-7


def test_torus_at_128_cells():
    exact = 2 * np.pi**2 * 0.7 * 0.25**2
    spin = exact * (0.7**2 + 0.75 * 0.25**2)
    assert abs(float(sdf.volume(TORUS)) / exact - 1) < 1e-7
    inertia = sdf.inertia_tensor(TORUS, density=2.0)
    assert abs(float(inertia[2, 2]) / (2 * spin) - 1) < 1e-7
    assert jnp.allclose(sdf.centroid(TORUS), 0, atol=1e-8)


def test_tilted_box_at_64_cells():
    def volume(width):
        sides = jnp.array([1.0, 1.0, 0.8]).at[0].set(width)
        return sdf.volume(Field(_tilted_box, sides), 64)

    value, slope = jax.value_and_grad(volume)(jnp.array(1.2))
    assert abs(float(value) / 0.96 - 1) < 1e-3
    assert abs(float(slope) / 0.8 - 1) < 1e-3


def test_inertia_moves_with_the_body():
    at = sdf.inertia_tensor(sdf.Sphere([3.0, -2.0, 1.0], 0.5), 1000.0, 32)
    exact = 0.4 * 1000 * 4 / 3 * np.pi * 0.5**5
    assert jnp.allclose(at, exact * jnp.eye(3), rtol=0, atol=1e-5 * exact)


@pytest.mark.parametrize(
    "shape, size, message",
    [
        (sdf.Sphere([0, 0, 0], 1), -1.0, "positive"),
        (sdf.Sphere([0, 0, 0], 1), 1e-6, "Raise `size`"),
        (sdf.Sphere([0, 0, 0], 1) & sdf.Sphere([1.9, 1.2, 0], 1), 0.1, "empty"),
        (sdf.Circle([0, 0], 1), 0.1, "2-D"),
        (Field(lambda p, x, y, z: jnp.sqrt(x - p), jnp.array(9.0)), 0.1, "NaN"),
        (Field(lambda p, x, y, z: norm(x, y) - p, jnp.array(0.5)), 0.1, "Check `lipschitz`"),
    ],
)
@pytest.mark.stress(38)
def test_bad_shapes_name_the_remedy(shape, size, message):
    with pytest.raises(ValueError, match=message):
        sdf.isosurface(shape, size, "dual_contouring")


def test_unknown_method_and_traced_shape():
    with pytest.raises(ValueError, match="need 'marching_cubes' or 'dual_contouring'"):
        sdf.isosurface(sdf.Sphere([0, 0, 0], 1), 0.1, "marching")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda r: jnp.asarray(sdf.isosurface(sdf.Sphere([0, 0, 0], r), 0.1).vertices))(
            1.0
        )
