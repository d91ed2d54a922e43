"""Meshes to and from files of other programs, through meshio."""

import contextlib
import io
import os
import tempfile
from pathlib import Path

import numpy as np

from sorojax import _check
from sorojax.io import _files, mesh_sets
from sorojax.io.mesh_cells import element_of, facet_type_of, kind_of, topological_dim, type_of
from sorojax.mesh import Mesh, repair
from sorojax.mesh.mesh import boundary_facets

_DATA = {".vtu", ".vtk", ".xdmf", ".xmf", ".msh"}  # formats that carry values of cells
_SURFACES = {".stl", ".obj", ".ply", ".off", ".svg"}  # meshio drops cells or planes there
_OPTIONS = {
    ".msh": {"file_format": "gmsh22"}, ".xdmf": {"data_format": "XML"},
    ".xmf": {"data_format": "XML"},
}  # fmt: skip


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
        unit: What 1 in the file means [m].
        root: Folder that the file must lie in, links followed.

    Raises:
        ValueError: If the format is unknown or cannot hold the cells, or the path leaves
            `root`.
    """
    where = "export_mesh"
    file = _files.inside(where, path, root)
    suffix = _ending(where, file)
    _check.positive(where, "unit", unit, "m", "Write unit=sorojax.units.mm.")
    points = np.asarray(mesh.points, dtype=float) / unit
    _check.finite(where, "points", points, "Repair the mesh first.")
    if points.shape[1] == 2:
        points = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    parts = mesh_sets.packed(mesh, facet_type_of(mesh.element), suffix)
    if suffix not in _DATA | {".inp"}:
        parts = mesh_sets.Parts([], {}, {}, {}, {}, {})
    import meshio

    blocks = [(type_of(where, mesh.element), np.asarray(mesh.cells)), *parts.blocks]
    whole = meshio.Mesh(
        points, blocks, point_data=parts.point_data, cell_data=parts.cell_data,
        point_sets=parts.point_sets, cell_sets=parts.cell_sets, field_data=parts.field_data,
    )  # fmt: skip
    _write(where, file, whole, suffix)


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
    kinds = [kind_of(block.type) for block in raw.cells]
    dims = [topological_dim(kind) for kind in kinds]
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
    sets = mesh_sets.unpacked(raw, own, facet_blocks, fixed, len(points))
    facets = sets.facets or {"boundary": boundary_facets(fixed.mesh)}
    return Mesh(fixed.mesh.points, fixed.mesh.cells, element, sets.nodes, facets, sets.regions)


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
    with tempfile.TemporaryDirectory(dir=file.parent, prefix=f".{file.stem}.") as folder:
        made = Path(folder) / file.name
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
        os.replace(made, file)


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
