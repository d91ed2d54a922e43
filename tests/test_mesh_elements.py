"""Cells with inner nodes: shape functions, quadrature, and `enrich`."""

from itertools import product
from math import factorial, prod

import numpy as np
import pytest
from patches import patch

from sorojax import fem, io, mesh as M
from sorojax.material import neo_hookean
from sorojax.mesh.elements import base as tables
from sorojax.mesh.elements.base import mirror_order

CELLS = (M.Tri7(), M.Quad9(), M.Tet15())


@pytest.mark.parametrize("cell", CELLS, ids=lambda c: c.name)
def test_shape_functions_are_consistent(cell):
    at = np.random.default_rng(0).random((6, cell.dim)) / 4
    x, value = tables.nodes(cell), tables.shape_functions(cell, at)
    slope = tables.shape_gradients(cell, at)
    assert np.allclose(tables.shape_functions(cell, x), np.eye(len(x)), rtol=0, atol=1e-13)
    assert np.allclose(value.sum(axis=1), 1, rtol=0, atol=1e-13)
    assert np.allclose(value @ x, at, rtol=0, atol=1e-13)
    step = 1e-6 * np.eye(cell.dim)
    for axis in range(cell.dim):
        ends = [tables.shape_functions(cell, at + s * step[axis]) for s in (1, -1)]
        assert np.allclose(slope[:, :, axis], (ends[0] - ends[1]) / 2e-6, atol=1e-8)


@pytest.mark.parametrize("cell", CELLS, ids=lambda c: c.name)
def test_functions_hold_every_quadratic(cell):
    at = np.random.default_rng(1).random((5, cell.dim)) / 4
    x, value = tables.nodes(cell), tables.shape_functions(cell, at)
    for power in product(range(3), repeat=cell.dim):
        if sum(power) <= 2:
            exact = np.prod(at**power, axis=1)
            assert np.allclose(value @ np.prod(x**power, axis=1), exact, rtol=0, atol=1e-13)


@pytest.mark.parametrize("cell", [M.Tri7(), M.Tet15()], ids=lambda c: c.name)
def test_inner_functions_vanish_on_the_facets_that_they_do_not_belong_to(cell):
    x = tables.nodes(cell)
    weights = np.random.default_rng(2).dirichlet(np.ones(cell.dim), size=4)
    for number, facet in enumerate(cell.facets):
        on = weights @ x[list(facet[: cell.dim])]
        away = [a for a in range(len(x)) if a not in facet]
        assert np.allclose(tables.shape_functions(cell, on)[:, away], 0, atol=1e-13), number


@pytest.mark.parametrize("cell", [M.Tri7(), M.Tet15()], ids=lambda c: c.name)
def test_stiffness_rules_are_exact_for_products_of_quadratic_slopes(cell):
    rule, degree = tables.quadrature(cell), 4
    assert np.all(rule.weights > 0)
    for power in product(range(degree + 1), repeat=cell.dim):
        if sum(power) <= degree:
            exact = prod(map(factorial, power)) / factorial(sum(power) + cell.dim)
            assert np.isclose(rule.weights @ np.prod(rule.points**power, axis=1), exact)


@pytest.mark.parametrize("cell", CELLS, ids=lambda c: c.name)
def test_enriched_cells_have_the_shape_and_the_nodes_of_the_plain_ones(cell):
    rich = patch(cell)
    plain = M.Mesh(
        rich.points[: int(np.asarray(rich.cells)[:, : -_inner(cell)].max()) + 1],
        np.asarray(rich.cells)[:, : -_inner(cell)],
        {"Tri7": M.Tri6(), "Quad9": M.Quad8(), "Tet15": M.Tet10()}[cell.name],
    )
    again = M.enrich(plain)
    assert np.allclose(again.points, rich.points) and np.array_equal(again.cells, rich.cells)
    size = M.cell_areas if cell.dim == 2 else M.cell_volumes
    assert np.allclose(size(rich), size(plain), rtol=1e-13)
    assert np.isclose(np.sum(size(rich)), 1)
    at = tables.shape_functions(plain.element, tables.nodes(cell))
    where = np.einsum("an,cni->cai", at, np.asarray(plain.points)[np.asarray(plain.cells)])
    assert np.allclose(np.asarray(rich.points)[np.asarray(rich.cells)], where, atol=1e-14)


def _inner(cell) -> int:
    return {"Tri7": 1, "Quad9": 1, "Tet15": 5}[cell.name]


@pytest.mark.parametrize("cell", CELLS, ids=lambda c: c.name)
def test_sets_of_a_structured_mesh_hold_the_new_nodes(cell):
    if cell.dim == 2:
        grid = M.rectangle([0, 0], [2, 1], divisions=(3, 2), element=cell)
    else:
        grid = M.box([0, 0, 0], [2, 1, 1], divisions=(3, 2, 2), element=cell)
    X = np.asarray(grid.points)
    for name, axis, place in (("left", 0, 0.0), ("right", 0, 2.0), ("bottom", -1, 0.0)):
        on = np.flatnonzero(np.abs(X[:, axis] - place) < 1e-12)
        assert set(np.asarray(grid.node_sets[name]).tolist()) == set(on.tolist())
        assert set(np.unique(grid.facet_sets[name]).tolist()) == set(on.tolist())
    facets = set(map(tuple, np.asarray(M.boundary_facets(grid)).tolist()))
    assert set(map(tuple, np.asarray(grid.facet_sets["left"]).tolist())) <= facets


def test_neighbouring_tetrahedra_share_the_nodes_of_their_faces():
    rich = patch(M.Tet15())
    plain = np.asarray(rich.cells)[:, :10].max() + 1
    faces = np.asarray(rich.cells)[:, 10:14].ravel()
    outer = np.unique(np.asarray(M.boundary_facets(rich))[:, -1])
    count = np.bincount(faces - plain)
    assert np.all(count[outer - plain] == 1)
    inner = np.setdiff1d(np.unique(faces), outer)
    assert np.all(count[inner - plain] == 2)
    assert rich.num_nodes == plain + len(outer) + len(inner) + rich.num_cells


@pytest.mark.parametrize("cell", CELLS, ids=lambda c: c.name)
def test_inner_nodes_change_neither_the_quality_nor_the_repair_of_cells(cell):
    plain = patch(cell.plain)
    rich = M.enrich(plain)
    found, known = M.quality(rich), M.quality(plain)
    assert found._replace(num_nodes=0, area=0.0) == known._replace(num_nodes=0, area=0.0)
    assert found.area == pytest.approx(known.area) and found.watertight
    cells = np.asarray(rich.cells)[:, mirror_order(cell)]
    mended = M.repair(rich.points, cells, cell)
    assert np.array_equal(mended.turned, np.arange(rich.num_cells))
    assert M.quality(mended.mesh) == found


@pytest.mark.parametrize("cell", CELLS, ids=lambda c: c.name)
def test_fields_go_to_files_by_a_cell_that_these_know(cell, tmp_path):
    meshio = pytest.importorskip("meshio")
    body = M.enrich(patch(cell.plain))
    problem = fem.problem(
        body,
        neo_hookean(young_modulus=1e5, poisson_ratio=0.45),
        kinematics=fem.PlaneStrain() if cell.dim == 2 else fem.Solid(),
        supports=(fem.Fixed([0, 1, 2, 3]),),
    )
    (file,) = io.export_fields(tmp_path / "rest.vtu", problem, np.zeros(body.points.shape))
    (block,) = meshio.read(file).cells
    known = cell if cell.cell_type else cell.plain
    assert block.type == known.cell_type and block.data.shape == (
        body.num_cells,
        known.num_nodes,
    )


def test_enrich_names_what_it_takes():
    with pytest.raises(ValueError, match="need one of Tet10, Tri6, Quad8"):
        M.enrich(M.rectangle([0, 0], [1, 1], divisions=(1, 1)))
    with pytest.raises(ValueError, match="need one of Tri3, Tri6, Tri7"):
        M.rectangle([0, 0], [1, 1], divisions=(1, 1), element=M.Tet15())
