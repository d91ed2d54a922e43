"""Meshes: from an implicit shape to cells, and back to what is on them."""

from sorojax._arguments import check_package as _check_package
from sorojax.mesh.elements.base import AbstractElement
from sorojax.mesh.elements.polygon import PolyN
from sorojax.mesh.elements.simplex import Tet4, Tet10, Tet15, Tri3, Tri6, Tri7
from sorojax.mesh.elements.tensor import Hex8, Quad4, Quad8, Quad9
from sorojax.mesh.enrich import enrich, quadratic
from sorojax.mesh.measure import cell_areas, cell_volumes, enclosed_volume, locate
from sorojax.mesh.mesh import Mesh, boundary_facets, merge
from sorojax.mesh.motion.move import move
from sorojax.mesh.plane.polymesh import polymesher
from sorojax.mesh.plane.triangulate import from_image, from_polygon, image_shape, triangulate
from sorojax.mesh.quality import distortion, quality
from sorojax.mesh.repair import repair
from sorojax.mesh.select import (
    boundary_loops,
    cells_connected,
    cells_inside,
    cells_where,
    chambers,
    facets_on,
    facets_where,
    named,
    nearest_node,
    nodes_in_box,
    nodes_inside,
    nodes_on_line,
    nodes_where,
)
from sorojax.mesh.sizes import grade
from sorojax.mesh.solid.tetrahedralise import tetrahedralise
from sorojax.mesh.structured import (
    between_lines,
    box,
    extrude,
    mirror,
    rectangle,
    revolve,
    submesh,
    sweep,
)

__all__ = [
    "AbstractElement",
    "Hex8",
    "Mesh",
    "PolyN",
    "Quad4",
    "Quad8",
    "Quad9",
    "Tet4",
    "Tet10",
    "Tet15",
    "Tri3",
    "Tri6",
    "Tri7",
    "between_lines",
    "boundary_facets",
    "boundary_loops",
    "box",
    "cell_areas",
    "cell_volumes",
    "cells_connected",
    "cells_inside",
    "cells_where",
    "chambers",
    "distortion",
    "enclosed_volume",
    "enrich",
    "extrude",
    "facets_on",
    "facets_where",
    "from_image",
    "from_polygon",
    "grade",
    "image_shape",
    "locate",
    "merge",
    "mirror",
    "move",
    "named",
    "nearest_node",
    "nodes_in_box",
    "nodes_inside",
    "nodes_on_line",
    "nodes_where",
    "polymesher",
    "quadratic",
    "quality",
    "rectangle",
    "repair",
    "revolve",
    "submesh",
    "sweep",
    "tetrahedralise",
    "triangulate",
]

_check_package(__name__)
