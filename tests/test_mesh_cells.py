"""Reference cells, structured and swept meshes, repair, selection."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sorojax import mesh as M, sdf
from sorojax.mesh.elements import base as tables

CELLS = (
    M.Tri3(), M.Tri6(), M.Quad4(), M.Quad8(), M.PolyN(3), M.PolyN(5), M.PolyN(8), M.Tet4(),
    M.Tet10(), M.Hex8(),
)  # fmt: skip
NAMES = [cell.name for cell in CELLS]


@pytest.mark.parametrize("cell", CELLS, ids=NAMES)
def test_shape_functions_are_consistent(cell):
    at = np.random.default_rng(0).random((6, cell.dim)) / 4
    x, value = tables.nodes(cell), tables.shape_functions(cell, at)
    slope = tables.shape_gradients(cell, at)
    assert np.allclose(value.sum(axis=1), 1, rtol=0, atol=1e-14)
    assert np.allclose(value @ x, at, rtol=0, atol=1e-14)  # linear completeness
    assert np.allclose(np.einsum("pad,ai->pid", slope, x), np.eye(cell.dim), atol=1e-13)
    assert np.allclose(tables.shape_functions(cell, x), np.eye(len(x)), atol=1e-13)
    step = 1e-6 * np.eye(cell.dim)
    for axis in range(cell.dim):
        ends = [tables.shape_functions(cell, at + s * step[axis]) for s in (1, -1)]
        assert np.allclose(slope[:, :, axis], (ends[0] - ends[1]) / 2e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("cell", "degree"),
    [(M.Tri3(), 1), (M.Tri6(), 4), (M.Tet4(), 1), (M.Tet10(), 2), (M.Tet10(), 5)],
)
def test_simplex_rules_are_exact_to_their_degree(cell, degree):
    from math import factorial, prod

    rule = tables.quadrature(cell, degree)
    powers = np.indices((degree + 1,) * cell.dim).reshape(cell.dim, -1).T
    for power in powers[powers.sum(axis=1) <= degree]:
        exact = prod(map(factorial, power.tolist())) / factorial(power.sum() + cell.dim)
        assert np.isclose(rule.weights @ np.prod(rule.points**power, axis=1), exact, rtol=1e-12)
    with pytest.raises(ValueError, match="highest"):
        tables.quadrature(cell, 20)


@pytest.mark.parametrize("cell", [M.Quad4(), M.Quad8(), M.Hex8(), M.PolyN(6)])
def test_other_rules_fill_their_cell(cell):
    rule = tables.quadrature(cell)
    full = {2: 4.0, 3: 8.0}[cell.dim] if not isinstance(cell, M.PolyN) else 1.5 * 3**0.5
    assert np.isclose(rule.weights.sum(), full, rtol=1e-13)
    if not isinstance(cell, M.PolyN):
        assert np.isclose(rule.weights @ rule.points[:, 0] ** 2, full / 3, rtol=1e-13)


@pytest.mark.parametrize("cell", [M.Tri3(), M.Tri6(), M.Quad4(), M.Quad8()])
def test_rectangles_of_every_cell(cell):
    mesh = M.rectangle([0, 0], [2, 1], divisions=(4, 3), element=cell)
    quality = M.quality(mesh)
    assert np.isclose(quality.area, 2, rtol=1e-14) and quality.watertight
    assert [len(mesh.facet_sets[s]) for s in ("left", "top")] == [3, 4]
    assert len(M.boundary_facets(mesh)) == 14


@pytest.mark.parametrize("cell", [M.Hex8(), M.Tet4(), M.Tet10()])
def test_boxes_of_every_cell(cell):
    mesh = M.box([0, 0, 0], [2, 1, 3], divisions=(4, 3, 2), element=cell)
    assert np.isclose(jnp.sum(M.cell_volumes(mesh)), 6, rtol=1e-13)
    assert jnp.all(M.cell_volumes(mesh) > 0) and M.quality(mesh).watertight
    assert np.isclose(M.enclosed_volume(mesh, M.boundary_facets(mesh)), -6, rtol=1e-13)
    assert len(mesh.node_sets["corners"]) == 8


@pytest.mark.parametrize("cell", [M.Tri3(), M.Quad4()])
def test_sweeps_have_the_right_volume(cell):
    flat = M.rectangle([0.5, 0], [2, 1], divisions=(4, 3), element=cell)
    straight = M.extrude(flat, 3.0, layers=5)
    assert np.isclose(jnp.sum(M.cell_volumes(straight)), 4.5, rtol=1e-13)
    assert len(straight.node_sets["left"]) == 4 * 6
    assert len(straight.facet_sets["start"]) == flat.num_cells
    ring = M.revolve(flat, layers=40)
    prism = np.sin(2 * np.pi / 40) * 40 / 2  # of a regular polygon of radius 1
    assert np.isclose(jnp.sum(M.cell_volumes(ring)), prism * (4 - 0.25), rtol=1e-12)
    assert M.quality(ring).watertight and "start" not in ring.facet_sets


def test_triangles_may_be_revolved_about_their_edge():
    disc = M.revolve(M.rectangle([0, 0], [1, 1], divisions=(3, 3)), layers=24)
    prism = np.sin(2 * np.pi / 24) * 24 / 2
    assert np.isclose(jnp.sum(M.cell_volumes(disc)), prism, rtol=1e-12)
    assert M.quality(disc).watertight
    with pytest.raises(ValueError, match="leave a hole"):
        M.revolve(M.rectangle([0, 0], [1, 1], divisions=(3, 3), element=M.Quad4()), layers=24)
    with pytest.raises(ValueError, match="x >= 0"):
        M.revolve(M.rectangle([-1, 0], [1, 1], divisions=(3, 3)), layers=24)


@pytest.mark.stress(28, 29, 30)
def test_repair_mends_or_refuses_with_ids():
    points = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [1, 0], [5, 5.0]])
    mended = M.repair(points, [[0, 4, 2], [0, 3, 2]], M.Tri3())
    assert mended.merged.tolist() == [4] and mended.removed.tolist() == [5]
    assert mended.turned.tolist() == [1] and mended.mesh.num_nodes == 4
    assert np.isclose(jnp.sum(M.cell_areas(mended.mesh)), 1)
    with pytest.raises(ValueError, match=r"cells \[1\] name nodes"):
        M.repair(points, [[0, 1, 2], [0, 1, 9]], M.Tri3())
    with pytest.raises(ValueError, match=r"cells \[1\] have no area"):
        M.repair(points, [[0, 1, 2], [0, 1, 4]], M.Tri3())
    with pytest.raises(ValueError, match=r"points \[2\] are not finite"):
        M.repair(np.where(np.arange(6)[:, None] == 2, np.nan, points), [[0, 1, 3]], M.Tri3())


def test_selection_by_box_line_shape_name_and_flood():
    line = sdf.HalfPlane([0.5, 0], [1, 0])
    box = sdf.Rectangle([0, 0], [1, 1])
    mesh = M.triangulate(box, size=0.2, interfaces=(line,))
    left = M.cells_inside(mesh, line)
    flood = M.cells_connected(mesh, [0.1, 0.1], M.named(mesh, "interface_0"))
    assert np.array_equal(left, flood) and 0 < len(left) < mesh.num_cells
    assert len(M.cells_connected(mesh, [0.1, 0.1])) == mesh.num_cells
    cut = M.nodes_on_line(mesh, [0.5, 1], [0.5, 0])
    assert set(cut) == set(np.unique(M.named(mesh, "interface_0")))
    assert np.all(np.diff(mesh.points[cut, 1]) < 0)
    assert set(M.nodes_in_box(mesh, [0, 0], [0.5, 1])) == set(M.nodes_inside(mesh, line, 1e-9))
    with pytest.raises(ValueError, match="interface_0"):
        M.named(mesh, "wall")
    solid = M.box([0, 0, 0], [1, 1, 1], divisions=(2, 2, 2))
    assert len(M.cells_connected(solid, [0, 0, 0])) == 8
    assert len(M.facets_where(solid, lambda p: p[2] >= 1)) == 4


def test_distortion_says_when_to_mesh_anew():
    mesh = M.rectangle([0, 0], [1, 1], divisions=(4, 4))
    flat = M.Mesh(mesh.points * jnp.array([[1.0, 0.1]]), mesh.cells, mesh.element)
    assert not M.distortion(mesh, mesh).remesh
    assert np.isclose(M.distortion(mesh, mesh).shape_ratio, 1)
    report = jax.jit(lambda m: M.distortion(mesh, m))(flat)
    assert bool(report.remesh) and np.isclose(report.size_ratio, 0.1)


@pytest.mark.parametrize("cell", [M.Tri3(), M.Tet4()], ids=lambda cell: cell.name)
def test_linear_cells_become_quadratic_with_their_sets(cell):
    plain = (
        M.rectangle([0, 0], [2, 1], divisions=(2, 2), element=cell)
        if cell.dim == 2
        else M.box([0, 0, 0], [2, 1, 1], divisions=(2, 2, 1), element=cell)
    )
    left = M.nodes_where(plain, lambda p: p[0] < 1e-9)
    own = M.facets_where(plain, lambda p: p[0] < 1e-9)
    plain = M.Mesh(
        plain.points, plain.cells, plain.element, {"left": left}, {"left": own}, {"all": [0]}
    )
    made = M.quadratic(plain)
    assert made.element.name == {"Tri3": "Tri6", "Tet4": "Tet10"}[cell.name]
    assert jnp.array_equal(made.points[: plain.num_nodes], plain.points)
    assert np.isclose(M.quality(made).area, 2) and not M.quality(made).inverted
    at = M.nodes_where(made, lambda p: p[0] < 1e-9)
    assert set(np.asarray(made.node_sets["left"])) == set(np.asarray(at))
    assert np.allclose(made.points[made.facet_sets["left"]][..., 0], 0)
    expected = M.facets_where(made, lambda p: p[0] < 1e-9)
    rows = np.sort(np.asarray(made.facet_sets["left"]), axis=1)
    assert set(map(tuple, rows)) == set(map(tuple, np.sort(np.asarray(expected), axis=1)))
    assert M.enrich(made).element.plain.name == made.element.name
    with pytest.raises(ValueError, match="ready for `enrich`"):
        M.quadratic(made)
    with pytest.raises(ValueError, match="mesh.quadratic"):
        M.enrich(plain)
