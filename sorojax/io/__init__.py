"""Files: surfaces, contours, meshes, states and results in and out."""

from sorojax._arguments import check_package as _check_package
from sorojax.io.animation import (
    MovingSurface as MovingSurface,
    export_animation as export_animation,
)
from sorojax.io.fields import export_fields as export_fields
from sorojax.io.mesh import (
    export_mesh as export_mesh,
    import_mesh as import_mesh,
    mesh_surface as mesh_surface,
)
from sorojax.io.state import leaves as leaves, load as load, save as save
from sorojax.io.surface import (
    export_contour as export_contour,
    export_surface as export_surface,
    import_surface as import_surface,
)

_check_package(__name__)
