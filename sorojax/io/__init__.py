"""Files: surfaces, contours, meshes, states, results and robots in and out."""

from sorojax._arguments import check_package as _check_package
from sorojax.io.animation import MovingSurface, export_animation
from sorojax.io.fields import export_fields
from sorojax.io.mesh import export_mesh, import_mesh, mesh_surface
from sorojax.io.mjcf import ChainFit, ExportedMjcf, export_mjcf
from sorojax.io.robot import import_robot
from sorojax.io.state import leaves, load, save
from sorojax.io.surface import export_contour, export_surface, import_surface

__all__ = [
    "ChainFit",
    "ExportedMjcf",
    "MovingSurface",
    "export_animation",
    "export_contour",
    "export_fields",
    "export_mesh",
    "export_mjcf",
    "export_surface",
    "import_mesh",
    "import_robot",
    "import_surface",
    "leaves",
    "load",
    "mesh_surface",
    "save",
]

_check_package(__name__)
