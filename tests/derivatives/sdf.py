"""Slopes of fields, and of what is measured on them, in points and in a shape's numbers."""

import jax.numpy as jnp
import numpy as np

from sorojax import sdf
from tests.derivatives.case import Case
from tests.test_sdf_shapes import GALLERY

NONE = {
    "returns a shape: its field is compared below": (
        "bend displace elongate extrude grid_repeat image intersection mirror morph offset "
        "outlines polar_repeat repeat revolve rotate scale shell stadium stretch taper text "
        "translate trapezoid triangle turn twist union"
    ),
    "curves, surfaces and samples, found on the host": (
        "contour isosurface surface_report grid sample_boundary sample_interior"
    ),
    "a box that holds the shape, with room, for meshes and pictures": "bounding_box",
}

DRAW = np.random.default_rng(4)
PLANE, SPACE = (DRAW.uniform(-1.2, 1.2, (7, dim)) for dim in (2, 3))
EGG = sdf.SmoothUnion(sdf.Circle([0.1, 0], 0.8), sdf.Circle([0.7, 0.3], 0.6), 0.3)
BALL = sdf.SmoothUnion(sdf.Sphere([0.1, 0, 0], 0.8), sdf.Sphere([0.6, 0.3, 0.2], 0.6), 0.3)
RING, OVAL = sdf.Torus(0.8, 0.3), sdf.Ellipsoid([0.9, 0.5])  # smooth, as curvatures need


def near(shape, points):
    """Points next to the surface."""
    on = sdf.project(shape, jnp.asarray(points))
    return on + jnp.asarray(DRAW.uniform(-0.05, 0.05, points.shape))


def at_points(verb, shape, points):
    return Case(lambda at: verb(at[0], at[1]), (shape, points))


def counted(verb, shape, *rest):
    """A sum over cells, some of which a step lets the surface cut or leave."""
    return Case(lambda at: verb(at, *rest), shape, jit=False, step=1e-5, rtol=1e-5)


#: Made by verbs without a class of their own in the gallery.
MADE = {
    "intersection": sdf.intersection(EGG, sdf.Circle([0.3, 0.2], 0.9)),
    "offset": sdf.offset(EGG, 0.1), "shell": sdf.shell(EGG, 0.1),
    "union": sdf.union(BALL, sdf.Sphere([1, 0, 0], 0.6)),
    "rotate": sdf.rotate(EGG, 0.3, (0.1, 0.2)),
    "translate": sdf.translate(BALL, [0.1, 0.2, 0.3]),
    "scale": sdf.scale(EGG, 1.1), "repeat": sdf.repeat(BALL, [2.0, 0.1, 0], 2),
    "text": sdf.text("so", 1.0),
}  # fmt: skip
SMOOTH = {
    verb.__name__: at_points(verb, RING, near(RING, SPACE))
    for verb in (
        sdf.closest_point,
        sdf.curvature,
        sdf.evaluate,
        sdf.frame,
        sdf.gaussian_curvature,
        sdf.gradient,
        sdf.hessian,
        sdf.normal,
        sdf.value_and_normal,
    )
}
PAIRS = [
    (name, shape) for shapes in (*GALLERY.values(), MADE) for name, shape in shapes.items()
]
CASES = (
    {
        f"field of {name} {shape.dim}": Case(
            lambda at: at[0](at[1]),
            (shape, jnp.asarray(PLANE if shape.dim == 2 else SPACE)),
            step=1e-5,
            rtol=1e-6,
            forward=False,  # as tests/test_sdf_shapes.py goes, twice
        )
        for name, shape in PAIRS
    }
    | SMOOTH
    | {
        "curvature of a line": at_points(sdf.curvature, OVAL, near(OVAL, PLANE)),
        "project": at_points(sdf.project, BALL, sdf.project(BALL, jnp.asarray(SPACE))),
        "area": counted(sdf.area, EGG),
        "centroid": counted(sdf.centroid, EGG),
        "centroid of a solid": counted(sdf.centroid, BALL),
        "second_moments": counted(sdf.second_moments, EGG),
        "volume": counted(sdf.volume, BALL, 32),
        "inertia_tensor": counted(sdf.inertia_tensor, BALL, 2.0, 32),
    }
)
