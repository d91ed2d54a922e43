"""Meshes on given lines, without some of their cells, and with their mirror image."""

import numpy as np
import pytest

from sorojax import mesh as M, sdf
from sorojax.mesh.elements.base import mirror_order


def inside_out(cells: M.Mesh) -> bool:
    """Whether a cell has no volume or a negative one."""
    measure = M.cell_areas if cells.element.dim == 2 else M.cell_volumes
    return bool(np.min(np.asarray(measure(cells))) <= 0)


@pytest.mark.parametrize("element", [M.Tri6(), M.Quad8(), M.Quad9(), M.Tet10(), M.Hex8()])
def test_a_mesh_and_its_image_are_one(element):
    dim = element.dim
    make = M.rectangle if dim == 2 else M.box
    part = make([0.0] * dim, [2.0, 3.0, 1.0][:dim], divisions=(2, 3, 1)[:dim], element=element)
    part = M.Mesh(
        part.points, part.cells, element, part.node_sets, part.facet_sets, {"all": [0]}
    )
    both = M.mirror(part, 0, 2.0)
    assert not inside_out(both)
    plane = np.abs(np.asarray(part.points)[:, 0] - 2.0) < 1e-12
    assert both.num_nodes == 2 * part.num_nodes - plane.sum()
    volume = -float(M.enclosed_volume(both, M.boundary_facets(both)))  # facets look outwards
    assert volume == pytest.approx(4.0 * 3.0)
    np.testing.assert_array_equal(both.regions["all"], [0, part.num_cells])
    # the right side has become the middle, the left one is there twice, outward on both
    assert len(both.facet_sets["right"]) == 0
    known = {tuple(row) for row in M.boundary_facets(both).tolist()}
    left = np.asarray(both.facet_sets["left"])
    assert len(left) == 2 * len(part.facet_sets["left"])
    if dim == 2:
        assert {tuple(row) for row in left.tolist()} <= known
    ends = np.unique(np.asarray(both.points)[both.node_sets["left"], 0])
    np.testing.assert_allclose(ends, [0.0, 4.0], atol=1e-12)


def test_the_image_of_a_cell_is_a_cell_of_the_same_kind():
    for element in (M.Tri3(), M.Tri7(), M.Quad4(), M.Tet4(), M.Tet15()):
        order = mirror_order(element)
        assert sorted(order) == list(range(element.num_nodes))
        assert not np.array_equal(order, np.arange(element.num_nodes))


def test_a_mesh_across_the_plane_has_no_image():
    part = M.rectangle([0.0, 0.0], [1.0, 1.0], divisions=(2, 2))
    with pytest.raises(ValueError, match="need all of it on one side"):
        M.mirror(part, 1, 0.5)
    with pytest.raises(ValueError, match="got polygons"):
        M.mirror(M.Mesh(np.eye(3, 2), [[0, 1, 2]], M.PolyN(3)), 0, 0.0)


@pytest.mark.parametrize("element", [M.Quad8(), M.Tri3(), M.Hex8()])
def test_cells_lie_between_the_lines(element):
    lines = ([0.0, 1.0, 1.5, 4.0], [-1.0, 0.0, 3.0], [0.0, 0.1])[: element.dim]
    grid = M.between_lines(*lines, element=element)
    assert not inside_out(grid)
    for axis, line in enumerate(lines):
        corners = np.asarray(grid.points)[
            np.asarray(grid.cells)[:, : element.num_corners], axis
        ]
        assert np.array_equal(np.unique(corners), line)
    assert len(grid.facet_sets["left"]) > 0
    with pytest.raises(ValueError, match="rising numbers"):
        M.between_lines(*lines[:-1], [0.0, 0.0], element=element)


def test_what_is_left_keeps_its_names():
    grid = M.between_lines([0, 1, 2, 3], [0, 1, 2], element=M.Quad4())
    cut = M.submesh(
        grid, M.cells_inside(grid, sdf.Rectangle([0, 0], [3, 2]) - sdf.Circle([2.5, 1.5], 0.3))
    )
    assert cut.num_cells == 5
    assert cut.num_nodes == grid.num_nodes - 1
    top = np.asarray(cut.points)[np.asarray(cut.node_sets["top"])]
    assert np.all(top[:, 1] == 2) and len(top) == 3
    with pytest.raises(ValueError, match="got no cells"):
        M.submesh(grid, np.array([], int))
