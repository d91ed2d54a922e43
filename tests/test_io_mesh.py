"""Mesh files: every element and its sets there and back, foreign and damaged files."""

import jax
import numpy as np
import pytest

from sorojax import fem, io, material, mesh as M, sdf

PLANE = (M.Tri3(), M.Tri6(), M.Quad4(), M.Quad8())
SOLID = (M.Tet4(), M.Tet10(), M.Hex8())


def sample(element):
    if element is None:
        mesh = M.polymesher(sdf.Rectangle([0, 0], [1, 1]), 6, key=jax.random.key(0))
    elif element.dim == 2:
        mesh = M.rectangle([0, 0], [2, 1], divisions=(3, 2), element=element)
    else:
        mesh = M.box([0, 0, 0], [2, 1, 1], divisions=(2, 1, 1), element=element)
    half = {"half": np.arange(mesh.num_cells // 2)}
    return M.Mesh(mesh.points, mesh.cells, mesh.element, mesh.node_sets, mesh.facet_sets, half)


def rows(facets):
    return {tuple(row) for row in np.sort(np.asarray(facets), axis=1).tolist()}


def same_cells(a, b, atol=1e-15):
    assert type(a.element) is type(b.element)
    assert np.allclose(a.points, b.points, rtol=1e-12, atol=atol)
    assert np.array_equal(a.cells, b.cells)


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh", ".inp"])
@pytest.mark.parametrize("element", [*PLANE, *SOLID, None], ids=lambda e: e and e.name)
def test_cells_and_sets_come_back(element, suffix, tmp_path):
    mesh, file = sample(element), tmp_path / f"part{suffix}"
    if element is None and suffix in (".msh", ".inp"):
        with pytest.raises(ValueError, match="vtu"):
            io.export_mesh(file, mesh)
        assert not list(tmp_path.iterdir())
        return
    io.export_mesh(file, mesh, unit=1e-3)
    back = io.import_mesh(file, unit=1e-3)
    same_cells(back, mesh)
    assert np.array_equal(back.regions["half"], mesh.regions["half"])
    for name, ids in mesh.node_sets.items():
        assert np.array_equal(np.sort(back.node_sets[name]), np.sort(ids))
    for name, facets in mesh.facet_sets.items():
        assert rows(back.facet_sets[name]) == rows(facets)
    assert [f.name for f in tmp_path.iterdir()] == [file.name]


@pytest.mark.parametrize("suffix", [".bdf", ".mdpa", ".vol"])
@pytest.mark.versions
def test_plain_formats_keep_cells(suffix, tmp_path):
    for element in (M.Tri6(), M.Tet10(), M.Hex8()):
        mesh = sample(element)
        io.export_mesh(f"part{suffix}", mesh, root=tmp_path)
        # A field of a BDF file holds few digits.
        same_cells(io.import_mesh(f"part{suffix}", root=tmp_path), mesh, atol=1e-7)


@pytest.mark.stress(32)
def test_mixed_foreign_and_damaged_files_are_refused(tmp_path):
    import meshio

    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0.5, 0.0]])
    mixed: list = [("quad", [[0, 1, 2, 3]]), ("triangle", [[1, 4, 2]])]
    meshio.Mesh(points, mixed).write(tmp_path / "mixed.vtu")
    with pytest.raises(ValueError, match="quad and triangle"):
        io.import_mesh(tmp_path / "mixed.vtu")
    bent = points + np.array([0, 0, 1]) * points[:, :1] ** 2
    meshio.Mesh(bent, mixed[1:]).write(tmp_path / "skin.vtu")
    with pytest.raises(ValueError, match="surface in space"):
        io.import_mesh(tmp_path / "skin.vtu")
    meshio.Mesh(points, {"line": np.array([[0, 1]])}).write(tmp_path / "line.vtu")
    with pytest.raises(ValueError, match="line"):
        io.import_mesh(tmp_path / "line.vtu")
    for name in ("half.vtu", "half.msh", "half.inp", "page.vtk"):
        io.export_mesh(tmp_path / "whole.vtu", sample(M.Tri3()))
        whole = (tmp_path / "whole.vtu").read_bytes()
        page = b"<html><body>not found</body></html>"
        (tmp_path / name).write_bytes(page if "page" in name else whole[: len(whole) // 2])
        with pytest.raises(ValueError, match="whole and of that format|holds cells"):
            io.import_mesh(tmp_path / name)
    with pytest.raises(ValueError, match="limit"):
        io.import_mesh(tmp_path / "whole.vtu", max_bytes=10)
    with pytest.raises(ValueError, match="leads to"):
        io.import_mesh("../whole.vtu", root=tmp_path / "inner")
    with pytest.raises(ValueError, match="import_surface"):
        io.export_mesh(tmp_path / "a.stl", sample(M.Tri3()))


def test_fields_on_polygons_keep_the_corners_of_each(tmp_path):
    import meshio

    mesh = M.polymesher(sdf.Rectangle([0, 0], [1, 1]), 9, key=jax.random.key(0))
    rubber = material.neo_hookean(young_modulus=1e5, poisson_ratio=0.3)
    held = fem.Fixed(M.nodes_where(mesh, lambda p: p[0] < 1e-9))
    problem = fem.problem(mesh, rubber, kinematics=fem.PlaneStrain(), supports=(held,))
    rest = np.zeros(mesh.points.shape)
    (file,) = io.export_fields(tmp_path / "a.vtu", problem, rest, fields=("energy",))
    read = meshio.read(file)
    corners = M.mesh.valences(mesh)
    counts = {block.data.shape[1]: len(block.data) for block in read.cells}
    assert max(counts) > 4 and counts == {n: np.sum(corners == n) for n in np.unique(corners)}
    assert sum(map(len, read.cell_data["energy"])) == mesh.num_cells
