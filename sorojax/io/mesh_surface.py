"""Tetrahedra of surfaces by other programs, where `tetrahedralise` is not enough."""

import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Literal

import numpy as np

from sorojax import _check
from sorojax.io.mesh import import_mesh
from sorojax.io.surface import export_surface
from sorojax.mesh import Mesh, Tet4, repair
from sorojax.mesh.mesh import boundary_facets
from sorojax.sdf import Surface, surface_report

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
        timeout: Time after which gmsh is stopped [s].

    Raises:
        ModuleNotFoundError: If pytetwild is missing.
        FileNotFoundError: If there is no program `gmsh`.
        ValueError: If the surface is empty or, for gmsh, not one closed shell; if the
            mesher fails.

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
    makers = {"pytetwild": _by_pytetwild, "gmsh": _by_gmsh}
    if mesher not in makers:
        raise ValueError(f"{where}: `mesher` is {mesher!r}, need one of {', '.join(makers)}.")
    found = makers[mesher](Surface(vertices, np.asarray(surface.triangles)), size, timeout)
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
    points, cells = tetrahedralize(
        surface.vertices, surface.triangles.astype(np.int32), optimize=True,
        edge_length_fac=min(size / extent, 1.0), quiet=True,
    )  # fmt: skip
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
