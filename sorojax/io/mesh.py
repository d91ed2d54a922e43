"""Meshes to and from files of other programs, through meshio. The order of nodes is that of
VTK on both sides.
"""

import contextlib
import io
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sorojax import _check
from sorojax.io import _files
from sorojax.io.surface import export_surface
from sorojax.mesh import Mesh, Tet4, quadratic, repair
from sorojax.mesh.elements.base import AbstractElement, exported_elements, facet_element
from sorojax.mesh.elements.polygon import PolyN
from sorojax.mesh.mesh import boundary_facets
from sorojax.mesh.repair import Repaired
from sorojax.sdf import Surface, surface_report


def _types() -> dict[str, type[AbstractElement]]:
    """Elements by the name of the cell in files."""
    return {kind.cell_type: kind for kind in exported_elements() if kind.cell_type}


def type_of(where: str, element: AbstractElement) -> str:
    if element.cell_type is None:
        names = ", ".join(kind.__name__ for kind in _types().values())
        raise ValueError(f"{where}: got {element.name} cells, need one of {names}.")
    return element.cell_type


def facet_type_of(where: str, element: AbstractElement) -> str:
    if element.dim == 2:
        return "line" if element.order == 1 else "line3"
    return type_of(where, facet_element(element))


def element_of(where: str, name: str, count: int) -> AbstractElement:
    if name == "polygon":
        return PolyN(count)
    if name in _types():
        return _types()[name]()
    raise ValueError(
        f"{where}: the file has {name} cells, need one of {', '.join(_types())}. Mesh the part "
        "with one of these."
    )


# Node sets, facet sets and regions as values and sets of a file, and back


_NODE, _FACET, _REGION = "node_set:", "facet_set:", "region:"
_PHYSICAL, _BETWEEN = "gmsh:physical", " + "


def packed(mesh: Mesh, facet_type: str, suffix: str) -> tuple[list, dict[str, dict]]:
    """Sets of `mesh`, as values of points and cells or in INP files as sets: the cells that
    they need, and what meshio calls the rest."""
    facets = {name: np.asarray(f) for name, f in mesh.facet_sets.items() if len(f)}
    blocks, number = [], {}
    if facets:
        every = np.concatenate(list(facets.values()))
        _, first, row = np.unique(
            np.sort(every, axis=1), axis=0, return_index=True, return_inverse=True
        )
        blocks = [(facet_type, every[first])]
        stops = np.cumsum([len(f) for f in facets.values()])
        number = dict(zip(facets, np.split(row.ravel(), stops[:-1]), strict=True))
    nodes = {name: np.asarray(ids) for name, ids in mesh.node_sets.items()}
    regions = {name: np.asarray(ids) for name, ids in mesh.regions.items()}
    nothing = np.zeros(0, int)
    lists = {n: [ids, nothing][: 1 + len(blocks)] for n, ids in regions.items()}
    lists |= {n: [nothing, ids] for n, ids in number.items()}
    if suffix == ".inp":
        return blocks, {"point_sets": nodes, "cell_sets": lists}
    size = mesh.num_cells, len(blocks[0][1]) if blocks else 0
    cell_data = {_REGION + n: _masks(size, 0, ids, blocks) for n, ids in regions.items()}
    cell_data |= {_FACET + n: _masks(size, 1, ids, blocks) for n, ids in number.items()}
    data = {}
    point_data = {_NODE + n: _mask(mesh.num_nodes, ids) for n, ids in nodes.items()}
    if suffix == ".msh":
        point_data = {name: mask.astype(float) for name, mask in point_data.items()}
        cell_data, names = _physical(lists, size[: 1 + len(blocks)], mesh.element.dim)
        data["field_data"] = names
    return blocks, {"point_data": point_data, "cell_data": cell_data} | data


def _physical(lists: dict, sizes, dim: int) -> tuple[dict, dict]:
    """Gmsh gives a cell one physical group: each combination of sets becomes one."""
    groups, names = [], {}
    for k, size in enumerate(sizes):
        member = np.zeros((size, len(lists)), bool)
        for column, rows in enumerate(lists.values()):
            member[rows[k], column] = True
        kinds, group = np.unique(member, axis=0, return_inverse=True)
        first = len(names) + 1
        for i, kind in enumerate(kinds):
            name = _BETWEEN.join(np.array(list(lists), dtype=object)[kind])
            names[name or f"rest_{dim - k}"] = np.array([first + i, dim - k])
        groups.append(group.ravel().astype(np.int32) + first)
    return {_PHYSICAL: groups, "gmsh:geometrical": groups}, names


def _mask(count: int, ids: np.ndarray) -> np.ndarray:
    mask = np.zeros(count, np.int32)
    mask[ids] = 1
    return mask


def _masks(size, which: int, ids, blocks) -> list[np.ndarray]:
    masks = [np.zeros(n, np.int32) for n in size[: 1 + len(blocks)]]
    masks[which] = _mask(size[which], ids)
    return masks


def unpacked(
    raw: Any, own: list[int], facet_blocks: list[int], fixed: Repaired, count: int
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Node sets, facet sets and regions of a file that was read, in the numbers of the
    repaired mesh."""
    new = np.full(count, -1)
    kept = np.setdiff1d(np.arange(count), np.concatenate([fixed.merged, fixed.removed]))
    new[kept] = np.arange(len(kept))
    nodes = {n: np.flatnonzero(v) for n, v in _named(raw.point_data, _NODE)}
    nodes |= {n: np.asarray(ids, int) for n, ids in raw.point_sets.items()}
    masks = [*_named(raw.cell_data, _REGION), *_named(raw.cell_data, _FACET)]
    lists = {n: [np.flatnonzero(v) for v in values] for n, values in masks}
    lists |= {n: [_ids(v) for v in vs] for n, vs in raw.cell_sets.items()}
    for name, (group, _) in raw.field_data.items():
        tags = raw.cell_data.get(_PHYSICAL, [])
        rows = [np.flatnonzero(np.asarray(t) == group) for t in tags]
        for part in () if name.startswith("rest_") or not tags else name.split(_BETWEEN):
            known = lists.get(part, rows)
            lists[part] = [np.union1d(a, b) for a, b in zip(known, rows, strict=True)]
    _check_sets(nodes, lists, count, [len(block.data) for block in raw.cells])
    start = np.cumsum([0, *(len(raw.cells[i].data) for i in own)])
    regions, facets = {}, {}
    for name, rows in lists.items():
        mine = [rows[i] + start[k] for k, i in enumerate(own)]
        if sum(map(len, mine)):
            regions[name] = np.concatenate(mine)
        sides = [np.asarray(raw.cells[i].data)[rows[i]] for i in facet_blocks]
        if sum(map(len, sides)):
            facets[name] = new[np.concatenate(sides)]
    renumbered = {name: new[ids] for name, ids in nodes.items()}
    return {n: ids[ids >= 0] for n, ids in renumbered.items()}, facets, regions


def _check_sets(nodes: dict, lists: dict, num_nodes: int, num_cells: list[int]) -> None:
    """Raise a `ValueError` where a set names nodes or cells that the file does not hold."""
    for name, ids in nodes.items():
        if not _within(ids, num_nodes):
            raise ValueError(_unknown(name, "nodes", f"{num_nodes} nodes"))
    for name, rows in lists.items():
        if len(rows) != len(num_cells) or not all(map(_within, rows, num_cells)):
            raise ValueError(_unknown(name, "cells", f"{len(num_cells)} blocks of {num_cells}"))


def _within(ids: np.ndarray, count: int) -> bool:
    return len(ids) == 0 or (ids.min() >= 0 and ids.max() < count)


def _unknown(name: str, kind: str, found: str) -> str:
    return (
        f"import_mesh: the set `{name}` names {kind} that the file does not hold, which has "
        f"{found}. Export it again."
    )


def _ids(value: Any) -> np.ndarray:
    return np.zeros(0, int) if value is None else np.asarray(value, int)


def _named(data: dict, prefix: str):
    return [(name[len(prefix) :], v) for name, v in data.items() if name.startswith(prefix)]


# Meshes to and from files of other programs, through meshio


_DATA = {".vtu", ".vtk", ".xdmf", ".xmf", ".msh"}  # formats that carry values of cells
_SURFACES = {".stl", ".obj", ".ply", ".off", ".svg"}  # meshio drops cells or planes there
_OPTIONS = {
    ".msh": {"file_format": "gmsh22"},
    ".xdmf": {"data_format": "XML"},
    ".xmf": {"data_format": "XML"},
}


def export_mesh(
    path: str | os.PathLike,
    mesh: Mesh,
    *,
    unit: float = 1.0,
    root: str | os.PathLike | None = None,
) -> None:
    """Write a mesh in any format that meshio writes, whole or not at all.

    Node sets, facet sets and regions go along as cell and point values in VTU, VTK and
    XDMF files (names "node_set:...", "facet_set:...", "region:..."; facets as cells of
    their own), as physical groups in MSH and as sets in INP files; other formats keep
    points and cells.

    Args:
        path: File name; its ending gives the format.
        mesh: The mesh; plane ones get z = 0 where a format has no plane.
        unit: What 1 in the file means [m]; a metre by default.
        root: Folder that the file must lie in, links followed; any by default.

    Returns:
        None.

    Raises:
        ValueError: If the format is unknown or cannot hold the cells, or the path leaves
            `root`.

    Example:
        >>> plate = mesh.rectangle([0, 0], [40 * mm, 10 * mm], divisions=(4, 1))
        >>> io.export_mesh("plate.vtu", plate, unit=mm)
        >>> io.import_mesh("plate.vtu", unit=mm).num_cells
        8
    """
    where = "export_mesh"
    file = _files.inside(where, path, root)
    suffix = _ending(where, file)
    _check.positive(where, "unit", unit, "m", "Write unit=sorojax.units.mm.")
    points = np.asarray(mesh.points, dtype=float) / unit
    _check.finite(where, "points", points, "Repair the mesh first.")
    if points.shape[1] == 2:
        points = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    cells: list[Any] = [(type_of(where, mesh.element), np.asarray(mesh.cells))]
    data: dict[str, Any] = {}
    if suffix in _DATA | {".inp"}:
        blocks, data = packed(mesh, facet_type_of(where, mesh.element), suffix)
        cells += blocks
    import meshio

    _write(where, file, meshio.Mesh(points, cells, **data), suffix)


def import_mesh(
    path: str | os.PathLike,
    *,
    unit: float = 1.0,
    root: str | os.PathLike | None = None,
    max_bytes: int = _files.MAX_BYTES,
) -> Mesh:
    """Read a mesh from any format that meshio reads.

    The cells of the highest dimension are taken; they must be of one kind. Cells one
    dimension below are the facets that facet sets are made of. Nodes without cells are
    left out, inverted cells turned.

    Args:
        path: File name; its ending gives the format.
        unit: What 1 in the file means [m].
        root: Folder that the file must lie in, links followed.
        max_bytes: Larger files are refused unread.

    Returns:
        The mesh, points [m].

    Raises:
        ValueError: If the file is damaged or too large, holds mixed or unknown cells, or
            the path leaves `root`.
    """
    where = "import_mesh"
    file = _files.inside(where, path, root)
    _ending(where, file)
    _check.positive(where, "unit", unit, "m", "Write unit=sorojax.units.mm.")
    _files.read(where, file, max_bytes)
    raw = _read(where, file)
    kinds = [block.type for block in raw.cells]
    dims = [block.dim for block in raw.cells]
    most = max(dims, default=0)
    if most < 2:
        raise ValueError(
            f"{where}: {file.name} holds cells {sorted(set(kinds))}, need triangles, "
            "quadrilaterals, tetrahedra or hexahedra. Export the solid, not its outline."
        )
    own = [i for i, dim in enumerate(dims) if dim == most]
    found = sorted({kinds[i] for i in own})
    if len(found) > 1:
        raise ValueError(
            f"{where}: {file.name} mixes {' and '.join(found)}, need cells of one kind. Mesh "
            "the part with one kind, or export the kinds as separate files."
        )
    cells = np.concatenate([np.asarray(raw.cells[i].data) for i in own])
    element = element_of(where, found[0], cells.shape[1])
    points = _placed(where, file.name, np.asarray(raw.points, dtype=float), cells, most) * unit
    fixed = repair(points, cells, element, tol=0.0)
    facet_blocks = [i for i, dim in enumerate(dims) if dim == most - 1]
    nodes, facets, regions = unpacked(raw, own, facet_blocks, fixed, len(points))
    facets = facets or {"boundary": boundary_facets(fixed.mesh)}
    return Mesh(fixed.mesh.points, fixed.mesh.cells, element, nodes, facets, regions)


def _ending(where: str, file: Path) -> str:
    from meshio import extension_to_filetypes

    suffix, known = file.suffix.lower(), extension_to_filetypes.keys() - _SURFACES
    if suffix not in known:
        names = ", ".join(sorted(known))
        raise ValueError(
            f"{where}: the file name ends in `{suffix}`, need one of {names}."
            + (" Surfaces have import_surface and export_surface." * (suffix in _SURFACES))
        )
    return suffix


def _placed(where: str, name: str, points, cells, dim: int) -> np.ndarray:
    """Points with as many coordinates as the cells have dimensions."""
    if cells.size and (cells.min() < 0 or cells.max() >= len(points)):
        raise ValueError(
            f"{where}: {name} names nodes {cells.min()} to {cells.max()}, it has "
            f"{len(points)}. The file is damaged: export it again."
        )
    if points.shape[1] == dim:
        return points
    if points.shape[1] < dim:
        raise ValueError(f"{where}: {name} has plane points and solid cells. Export it again.")
    height = points[np.unique(cells), 2]
    if np.ptp(height) > 1e-9 * max(float(np.ptp(points, axis=0).max()), 1e-300):
        raise ValueError(
            f"{where}: {name} is a surface in space (z from {height.min():g} to "
            f"{height.max():g}), need a plane or solid mesh. Read surfaces with "
            "import_surface and mesh them with tetrahedralise(sdf.TriangleMesh(...))."
        )
    return points[:, :2]


def _write(where: str, file: Path, whole, suffix: str) -> None:
    with _files.made_beside(file) as made:
        try:
            with _quiet():
                whole.write(made, **_OPTIONS.get(suffix, {}))
            # Some writers leave out cells that they do not know.
            cells = sum(len(block.data) for block in _read(where, made).cells)
            if cells < len(whole.cells[0].data):
                raise ValueError(f"{cells} of {len(whole.cells[0].data)} cells come back")
        except (SystemExit, Exception) as reason:
            raise ValueError(
                f"{where}: {file.suffix} cannot hold this mesh ({_short(reason)}). Write a "
                ".vtu file, which holds every cell and set."
            ) from reason


def _read(where: str, file: Path):
    import meshio

    try:
        with _quiet():
            return meshio.read(file)
    except (SystemExit, Exception) as reason:
        raise ValueError(
            f"{where}: {file.name} cannot be read as {file.suffix} ({_short(reason)}). Check "
            "that it is whole and of that format, or export it again."
        ) from reason


@contextlib.contextmanager
def _quiet():
    """meshio prints what it then raises."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield


def _short(reason: BaseException) -> str:
    if isinstance(reason, ModuleNotFoundError):
        return f"install {reason.name} first"
    text = " ".join(str(reason).split())
    return f"{type(reason).__name__}: {text[:120]}" if text else type(reason).__name__


# Foreign surfaces to tetrahedra by other programs, where `tetrahedralise` is not enough.


_SCRIPT = """Merge "{name}";
ClassifySurfaces{{40 * Pi / 180, 1, 1, Pi}};
CreateGeometry;
Surface Loop(1) = Surface{{:}};
Volume(1) = {{1}};
Mesh.MeshSizeFromPoints = 0;
Mesh.MeshSizeFromCurvature = 0;
Mesh.MeshSizeExtendFromBoundary = 0;
Mesh.MeshSizeMin = {size:.17g};
Mesh.MeshSizeMax = {size:.17g};
"""


def mesh_surface(
    surface: Surface,
    size: float,
    *,
    mesher: Literal["pytetwild", "gmsh"] = "pytetwild",
    order: int = 1,
    timeout: float = 600.0,
) -> Mesh:
    """Tetrahedra inside a surface from elsewhere, by a mesher that is installed apart.

    Clean closed surfaces need neither: `tetrahedralise(sdf.TriangleMesh(...), size=...)`.
    "pytetwild" takes surfaces with gaps and crossings and keeps to them within a
    thousandth of their extent; "gmsh" keeps edges sharp and wants one closed shell.

    Args:
        surface: Vertices [m] and triangles, as `import_surface` reads them.
        size: Wanted length of an edge [m].
        mesher: "pytetwild" (Python package, with its extra "all") or "gmsh" (program on the
            PATH, run as a process of its own).
        order: 1 for `Tet4`, 2 for `Tet10` with straight sides, which rubber needs.
        timeout: Time after which gmsh is stopped [s].

    Returns:
        The mesh, points [m].

    Raises:
        ModuleNotFoundError: If pytetwild is missing.
        FileNotFoundError: If there is no program `gmsh`.
        ValueError: If the surface is empty or, for gmsh, not one closed shell; if `order`
            is neither 1 nor 2; if the mesher fails.

    Reference: Hu et al., Fast tetrahedral meshing in the wild, SIGGRAPH 2020; Geuzaine and
        Remacle, Gmsh, Int. J. Numer. Meth. Eng. 79 (2009).
    """
    where = "mesh_surface"
    _check.positive(where, "size", size, "m", "Give the wanted length of an edge.")
    vertices = np.asarray(surface.vertices, dtype=float)
    _check.finite(where, "vertices", vertices, "Repair the surface first.")
    if len(surface.triangles) < 4:
        raise ValueError(
            f"{where}: the surface has {len(surface.triangles)} triangles, need at least 4. "
            "Export the part again."
        )
    if order not in (1, 2):
        raise ValueError(f"{where}: `order` is {order}, need 1 (Tet4) or 2 (Tet10).")
    makers = {"pytetwild": _by_pytetwild, "gmsh": _by_gmsh}
    if mesher not in makers:
        raise ValueError(f"{where}: `mesher` is {mesher!r}, need one of {', '.join(makers)}.")
    found = makers[mesher](Surface(vertices, np.asarray(surface.triangles)), size, timeout)
    if order == 2:
        found = quadratic(found)
    return Mesh(
        found.points, found.cells, found.element, {}, {"boundary": boundary_facets(found)}
    )


def _by_pytetwild(surface: Surface, size: float, timeout: float) -> Mesh:
    del timeout
    try:
        from pytetwild import tetrahedralize
    except ImportError as reason:
        raise ModuleNotFoundError(
            f"mesh_surface: pytetwild cannot be imported ({reason}), need the package. Install "
            "it with `pip install 'pytetwild[all]'`, or use mesher='gmsh'."
        ) from reason
    extent = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    with (
        tempfile.TemporaryDirectory(prefix="mesh_surface.") as folder,
        contextlib.chdir(folder),  # it leaves a file of the surface where it runs
    ):
        points, cells = tetrahedralize(
            surface.vertices,
            surface.triangles.astype(np.int32),
            optimize=True,
            edge_length_fac=min(size / extent, 1.0),
            quiet=True,
        )
    if not len(cells):
        raise ValueError(
            "mesh_surface: pytetwild found no inside. Check that the triangles face outwards, "
            "or lower `size`."
        )
    return repair(points, np.asarray(cells)[:, :4], Tet4(), tol=0.0).mesh


def _by_gmsh(surface: Surface, size: float, timeout: float) -> Mesh:
    program = shutil.which("gmsh")
    if program is None:
        raise FileNotFoundError(
            "mesh_surface: no program `gmsh` on the PATH, need one. Install Gmsh from its own "
            "site or package, or use mesher='pytetwild'."
        )
    report = surface_report(surface)
    if not report.watertight or report.num_shells != 1:
        raise ValueError(
            f"mesh_surface: the surface has {report.num_shells} shells and "
            f"{len(report.open_edges)} open edges, gmsh needs one closed shell. Use "
            "mesher='pytetwild'."
        )
    with tempfile.TemporaryDirectory(prefix="mesh_surface.") as folder:
        place = Path(folder)
        export_surface(place / "part.stl", surface, unit=1.0)
        (place / "part.geo").write_text(_SCRIPT.format(name="part.stl", size=float(size)))
        command = [program, "-3", "part.geo", "-o", "part.msh", "-format", "msh22", "-v", "2"]
        try:
            done = subprocess.run(
                command, cwd=place, capture_output=True, text=True, timeout=timeout, check=False
            )
        except subprocess.TimeoutExpired as reason:
            raise ValueError(
                f"mesh_surface: gmsh took more than {timeout:g} s. Raise `size` or `timeout`."
            ) from reason
        if done.returncode or not (place / "part.msh").exists():
            said = " ".join((done.stderr or done.stdout).split())[-300:]
            raise ValueError(
                f"mesh_surface: gmsh failed ({said}). Repair the surface, or use "
                "mesher='pytetwild'."
            )
        mesh = import_mesh(place / "part.msh")
    if not isinstance(mesh.element, Tet4):
        raise ValueError(
            f"mesh_surface: gmsh made {mesh.element.name} cells only, need Tet4. The surface "
            "encloses no volume: repair it."
        )
    return mesh
