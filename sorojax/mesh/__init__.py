"""Meshes: from an implicit shape to cells, and back to what is on them."""

from sorojax._arguments import check_package as _check_package
from sorojax.mesh.elements.base import AbstractElement as AbstractElement
from sorojax.mesh.elements.polygon import PolyN as PolyN
from sorojax.mesh.elements.simplex import (
    Tet4 as Tet4,
    Tet10 as Tet10,
    Tet15 as Tet15,
    Tri3 as Tri3,
    Tri6 as Tri6,
    Tri7 as Tri7,
)
from sorojax.mesh.elements.tensor import (
    Hex8 as Hex8,
    Quad4 as Quad4,
    Quad8 as Quad8,
    Quad9 as Quad9,
)
from sorojax.mesh.enrich import enrich as enrich
from sorojax.mesh.measure import (
    Locations as Locations,
    cell_areas as cell_areas,
    cell_volumes as cell_volumes,
    enclosed_volume as enclosed_volume,
    locate as locate,
)
from sorojax.mesh.mesh import (
    Mesh as Mesh,
    boundary_facets as boundary_facets,
    joined as joined,
    valences as valences,
)
from sorojax.mesh.motion.move import move as move
from sorojax.mesh.plane.polymesh import polymesher as polymesher
from sorojax.mesh.plane.triangulate import (
    from_image as from_image,
    from_polygon as from_polygon,
    image_shape as image_shape,
    triangulate as triangulate,
)
from sorojax.mesh.quality import (
    Distortion as Distortion,
    Quality as Quality,
    distortion as distortion,
    quality as quality,
)
from sorojax.mesh.repair import Repaired as Repaired, repair as repair
from sorojax.mesh.select import (
    Chambers as Chambers,
    boundary_loops as boundary_loops,
    cells_connected as cells_connected,
    cells_inside as cells_inside,
    cells_where as cells_where,
    chambers as chambers,
    facets_on as facets_on,
    facets_where as facets_where,
    named as named,
    nearest_node as nearest_node,
    nodes_in_box as nodes_in_box,
    nodes_inside as nodes_inside,
    nodes_on_line as nodes_on_line,
    nodes_where as nodes_where,
)
from sorojax.mesh.sizes import grade as grade
from sorojax.mesh.solid.tetrahedralise import tetrahedralise as tetrahedralise
from sorojax.mesh.structured import (
    between_lines as between_lines,
    box as box,
    extrude as extrude,
    kept as kept,
    mirrored as mirrored,
    rectangle as rectangle,
    revolve as revolve,
    sweep as sweep,
)

_check_package(__name__)
