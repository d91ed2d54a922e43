"""Slopes of meshes and of their measures in points and shapes."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from sorojax import mesh as M, sdf
from tests.derivatives.case import Case

NONE = {
    "makes a mesh on the host: `move` carries it on as a function of the shape": (
        "between_lines box extrude from_image from_polygon image_shape joined kept mirrored "
        "polymesher rectangle repair revolve sweep tetrahedralise triangulate"
    ),
    "a size for a mesher": "grade",
    "facets, cells, nodes, sets and places, chosen on the host": (
        "boundary_facets boundary_loops cells_connected cells_inside cells_where chambers "
        "facets_on facets_where locate named nearest_node nodes_in_box nodes_inside "
        "nodes_on_line nodes_where valences"
    ),
    "numbers of a report, on the host": "quality",
}

SIZES = ([0.0, 0.0], [3.0, 2.0], [1.4, 1.0], 0.5)


def frame(lower, upper, center, radius):
    """Its corners stay sharp: at no radius their slope has two sides."""
    return sdf.Difference(sdf.Rectangle(lower, upper), sdf.Circle(center, radius))


FRAME = frame(*SIZES)
ROUND = FRAME.removed
PLATE = M.triangulate(FRAME, size=0.4, order=2)
HOLE = M.facets_on(PLATE, ROUND)
BALL = sdf.Ellipsoid([1.0, 0.8, 1.2])
EGG = M.tetrahedralise(BALL, size=0.7)
BLOCK = M.box([0, 0, 0], [2, 1, 1], divisions=(2, 1, 1))


def shaken(mesh):
    return mesh.points + 0.03 * np.random.default_rng(0).uniform(-1, 1, mesh.points.shape)


def in_points(verb, mesh):
    return Case(lambda points: verb(replace(mesh, points=points)), shaken(mesh))


CASES = {
    "cell_areas": in_points(M.cell_areas, PLATE),
    "cell_volumes of tetrahedra": in_points(M.cell_volumes, EGG),
    "cell_volumes of hexahedra": in_points(M.cell_volumes, BLOCK),
    "distortion": Case(
        lambda points: M.distortion(PLATE, replace(PLATE, points=points))[:2],
        shaken(PLATE),
        step=1e-5,  # the worst cell stays the worst
    ),
    "enclosed_volume": in_points(lambda mesh: M.enclosed_volume(mesh, HOLE), PLATE),
    "enrich": in_points(lambda mesh: M.enrich(mesh).points, PLATE),
    "move in the plane": Case(
        lambda sizes: M.move(PLATE, frame(*sizes)).points,
        tuple(jnp.asarray(x) for x in SIZES),
        step=1e-4,
    ),
    "move in space": Case(lambda shape: M.move(EGG, shape).points, BALL, step=1e-4),
}
