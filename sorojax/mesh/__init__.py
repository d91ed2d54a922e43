"""Meshes: from an implicit shape to cells, and back to what is on them."""

from sorojax.mesh.elements import (
    AbstractElement as AbstractElement,
    Tri3 as Tri3,
    Tri6 as Tri6,
)
from sorojax.mesh.locate import Locations as Locations, locate as locate
from sorojax.mesh.mesh import Mesh as Mesh, boundary_facets as boundary_facets
from sorojax.mesh.motion import move as move
from sorojax.mesh.quality import (
    Quality as Quality,
    cell_areas as cell_areas,
    quality as quality,
)
from sorojax.mesh.select import (
    cells_where as cells_where,
    facets_on as facets_on,
    facets_where as facets_where,
    nearest_node as nearest_node,
    nodes_where as nodes_where,
)
from sorojax.mesh.structured import rectangle as rectangle
from sorojax.mesh.triangulate import triangulate as triangulate
