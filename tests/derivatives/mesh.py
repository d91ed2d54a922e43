"""Slopes of meshes and of their measures in points and shapes."""

import functools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from sorojax import mesh as M, sdf
from sorojax.sdf.operations.booleans import Difference
from tests.derivatives.case import Case

NONE = {
    "makes a mesh on the host: `move` carries it on as a function of the shape": (
        "between_lines box extrude from_image from_polygon image_shape merge submesh mirror "
        "polymesher rectangle repair revolve sweep tetrahedralise triangulate"
    ),
    "a size for a mesher": "grade",
    "facets, cells, nodes, sets and places, chosen on the host": (
        "boundary_facets boundary_loops cells_connected cells_inside cells_where chambers "
        "facets_on facets_where locate named nearest_node nodes_in_box nodes_inside "
        "nodes_on_line nodes_where"
    ),
    "numbers of a report, on the host": "quality",
}

SIZES = ([0.0, 0.0], [3.0, 2.0], [1.4, 1.0], 0.5)


def frame(lower, upper, center, radius):
    """Its corners stay sharp: at no radius their slope has two sides."""
    return Difference(sdf.Rectangle(lower, upper), sdf.Circle(center, radius))


FRAME = frame(*SIZES)
ROUND = FRAME.removed
BALL = sdf.Ellipsoid([1.0, 0.8, 1.2])


@functools.cache
def plate():
    return M.triangulate(FRAME, size=0.4, order=2)


@functools.cache
def egg():
    return M.tetrahedralise(BALL, size=0.7)


def block():
    return M.box([0, 0, 0], [2, 1, 1], divisions=(2, 1, 1))


def shaken(mesh):
    return mesh.points + 0.03 * np.random.default_rng(0).uniform(-1, 1, mesh.points.shape)


def in_points(verb, make):
    def case():
        mesh = make()
        return Case(lambda points: verb(replace(mesh, points=points)), shaken(mesh))

    return case


def around_the_hole():
    hole = M.facets_on(plate(), ROUND)
    return in_points(lambda mesh: M.enclosed_volume(mesh, hole), plate)()


def distorted():
    made = plate()

    def ratios(points):
        return M.distortion(made, replace(made, points=points))[:2]

    return Case(ratios, shaken(made), step=1e-5)  # the worst cell stays the worst


def moved_in_the_plane():
    made, sizes = plate(), tuple(jnp.asarray(x) for x in SIZES)
    return Case(lambda sizes: M.move(made, frame(*sizes)).points, sizes, step=1e-4)


def moved_in_space():
    made = egg()
    return Case(lambda shape: M.move(made, shape).points, BALL, step=1e-4)


CASES = {
    "cell_areas": in_points(M.cell_areas, plate),
    "cell_volumes of tetrahedra": in_points(M.cell_volumes, egg),
    "cell_volumes of hexahedra": in_points(M.cell_volumes, block),
    "distortion": distorted,
    "enclosed_volume": around_the_hole,
    "quadratic": in_points(lambda mesh: M.quadratic(mesh).points, egg),
    "enrich": in_points(lambda mesh: M.enrich(mesh).points, plate),
    "move in the plane": moved_in_the_plane,
    "move in space": moved_in_space,
}
