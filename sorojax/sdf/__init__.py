"""Implicit shapes: signed distances in metres, negative inside."""

from sorojax._arguments import check_package as _check_package
from sorojax.sdf.bars import (
    Capsule as Capsule,
    HalfSpace as HalfSpace,
    RoundCone as RoundCone,
    Slab as Slab,
    Strut as Strut,
    stadium as stadium,
)
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
from sorojax.sdf.curves import (
    Bezier as Bezier,
    Helix as Helix,
    Parabola as Parabola,
    Polyline as Polyline,
)
from sorojax.sdf.deform import (
    bend as bend,
    taper as taper,
    twist as twist,
)
from sorojax.sdf.differential import (
    closest_point as closest_point,
    curvature as curvature,
    frame as frame,
    gaussian_curvature as gaussian_curvature,
    hessian as hessian,
)
from sorojax.sdf.ellipsoid import (
    Ellipsoid as Ellipsoid,
)
from sorojax.sdf.evaluate import (
    evaluate as evaluate,
    value_and_normal as value_and_normal,
)
from sorojax.sdf.isosurface import Surface as Surface, isosurface as isosurface
from sorojax.sdf.lattice import (
    BccLattice as BccLattice,
    Diamond as Diamond,
    Gyroid as Gyroid,
    Iwp as Iwp,
    KelvinLattice as KelvinLattice,
    Lidinoid as Lidinoid,
    Neovius as Neovius,
    OctetLattice as OctetLattice,
    SchwarzP as SchwarzP,
    VoronoiFoam as VoronoiFoam,
)
from sorojax.sdf.lift import (
    elongate as elongate,
    extrude as extrude,
    grid_repeat as grid_repeat,
    mirror as mirror,
    polar_repeat as polar_repeat,
    revolve as revolve,
)
from sorojax.sdf.measure import (
    area as area,
    centroid as centroid,
    second_moments as second_moments,
)
from sorojax.sdf.morph import (
    AbstractRelief as AbstractRelief,
    Waves as Waves,
    displace as displace,
    morph as morph,
    stretch as stretch,
)
from sorojax.sdf.outlines import Outlines as Outlines, outlines as outlines, text as text
from sorojax.sdf.polyhedra import (
    Octahedron as Octahedron,
    Pyramid as Pyramid,
    TriangleMesh as TriangleMesh,
)
from sorojax.sdf.query import (
    bounding_box as bounding_box,
    gradient as gradient,
    normal as normal,
    project as project,
)
from sorojax.sdf.sampled import (
    HeightMap as HeightMap,
    Sampled as Sampled,
    image as image,
)
from sorojax.sdf.scatter import (
    grid as grid,
    sample_boundary as sample_boundary,
    sample_interior as sample_interior,
)
from sorojax.sdf.shapes2d import (
    Circle as Circle,
    HalfPlane as HalfPlane,
    Polygon as Polygon,
    Rectangle as Rectangle,
)
from sorojax.sdf.shapes3d import Box as Box, Sphere as Sphere
from sorojax.sdf.sketch import (
    Arc as Arc,
    Pie as Pie,
    RegularPolygon as RegularPolygon,
    Ring as Ring,
    Squircle as Squircle,
    Star as Star,
    Vesica as Vesica,
    trapezoid as trapezoid,
    triangle as triangle,
)
from sorojax.sdf.solid_measure import inertia_tensor as inertia_tensor, volume as volume
from sorojax.sdf.solids import (
    BoxFrame as BoxFrame,
    CappedCone as CappedCone,
    CappedTorus as CappedTorus,
    Cone as Cone,
    Cylinder as Cylinder,
    HexagonalPrism as HexagonalPrism,
    InfiniteCylinder as InfiniteCylinder,
    Torus as Torus,
)
from sorojax.sdf.spline import (
    Spline as Spline,
)
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
from sorojax.sdf.turn import turn as turn

_check_package(__name__)
