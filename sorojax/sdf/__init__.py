"""Implicit shapes: signed distances in metres, negative inside."""

from sorojax.sdf.base import AbstractSdf as AbstractSdf, Exactness as Exactness
from sorojax.sdf.blend import (
    AbstractBlend as AbstractBlend,
    Chamfer as Chamfer,
    Circular as Circular,
    Cubic as Cubic,
    Exponential as Exponential,
    Quadratic as Quadratic,
    SmoothDifference as SmoothDifference,
    SmoothIntersection as SmoothIntersection,
    SmoothUnion as SmoothUnion,
)
from sorojax.sdf.combine import (
    Difference as Difference,
    Intersection as Intersection,
    Union as Union,
    intersection as intersection,
    union as union,
)
from sorojax.sdf.isosurface import Surface as Surface, isosurface as isosurface
from sorojax.sdf.measure import area as area, centroid as centroid
from sorojax.sdf.query import (
    bounding_box as bounding_box,
    gradient as gradient,
    normal as normal,
    project as project,
)
from sorojax.sdf.shapes2d import (
    Circle as Circle,
    HalfPlane as HalfPlane,
    Polygon as Polygon,
    Rectangle as Rectangle,
)
from sorojax.sdf.shapes3d import Box as Box, Sphere as Sphere
from sorojax.sdf.solid_measure import inertia_tensor as inertia_tensor, volume as volume
from sorojax.sdf.surface import Curve as Curve, contour as contour
from sorojax.sdf.surface_report import (
    SurfaceReport as SurfaceReport,
    surface_report as surface_report,
)
from sorojax.sdf.transform import (
    offset as offset,
    repeat as repeat,
    rotate as rotate,
    scale as scale,
    shell as shell,
    translate as translate,
)
