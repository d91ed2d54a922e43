"""Implicit shapes: signed distances in metres, negative inside."""

from sorojax._arguments import check_package as _check_package
from sorojax.sdf.base import AbstractSdf as AbstractSdf, Exactness as Exactness
from sorojax.sdf.lattices import (
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
from sorojax.sdf.measure.moments import (
    area as area,
    centroid as centroid,
    inertia_tensor as inertia_tensor,
    second_moments as second_moments,
    volume as volume,
)
from sorojax.sdf.operations.booleans import (
    AbstractBlend as AbstractBlend,
    Chamfer as Chamfer,
    Circular as Circular,
    Cubic as Cubic,
    Difference as Difference,
    Exponential as Exponential,
    Intersection as Intersection,
    Quadratic as Quadratic,
    SmoothDifference as SmoothDifference,
    SmoothIntersection as SmoothIntersection,
    SmoothUnion as SmoothUnion,
    Union as Union,
    intersection as intersection,
    union as union,
)
from sorojax.sdf.operations.deform import (
    AbstractRelief as AbstractRelief,
    Waves as Waves,
    bend as bend,
    displace as displace,
    morph as morph,
    stretch as stretch,
    taper as taper,
    twist as twist,
)
from sorojax.sdf.operations.lift import (
    elongate as elongate,
    extrude as extrude,
    grid_repeat as grid_repeat,
    mirror as mirror,
    polar_repeat as polar_repeat,
    revolve as revolve,
)
from sorojax.sdf.operations.transform import (
    offset as offset,
    repeat as repeat,
    rotate as rotate,
    scale as scale,
    shell as shell,
    translate as translate,
    turn as turn,
)
from sorojax.sdf.query import (
    bounding_box as bounding_box,
    closest_point as closest_point,
    curvature as curvature,
    evaluate as evaluate,
    frame as frame,
    gaussian_curvature as gaussian_curvature,
    gradient as gradient,
    hessian as hessian,
    normal as normal,
    project as project,
    value_and_normal as value_and_normal,
)
from sorojax.sdf.sampling import (
    grid as grid,
    sample_boundary as sample_boundary,
    sample_interior as sample_interior,
)
from sorojax.sdf.shapes.bars import (
    Capsule as Capsule,
    HalfSpace as HalfSpace,
    RoundCone as RoundCone,
    Slab as Slab,
    Strut as Strut,
    stadium as stadium,
)
from sorojax.sdf.shapes.curves import (
    Bezier as Bezier,
    Helix as Helix,
    Parabola as Parabola,
    Polyline as Polyline,
    Spline as Spline,
)
from sorojax.sdf.shapes.data import (
    HeightMap as HeightMap,
    Octahedron as Octahedron,
    Outlines as Outlines,
    Pyramid as Pyramid,
    Sampled as Sampled,
    TriangleMesh as TriangleMesh,
    image as image,
    outlines as outlines,
    text as text,
)
from sorojax.sdf.shapes.plane import (
    Arc as Arc,
    Circle as Circle,
    HalfPlane as HalfPlane,
    Pie as Pie,
    Polygon as Polygon,
    Rectangle as Rectangle,
    RegularPolygon as RegularPolygon,
    Ring as Ring,
    Squircle as Squircle,
    Star as Star,
    Vesica as Vesica,
    trapezoid as trapezoid,
    triangle as triangle,
)
from sorojax.sdf.shapes.solid import (
    Box as Box,
    BoxFrame as BoxFrame,
    CappedCone as CappedCone,
    CappedTorus as CappedTorus,
    Cone as Cone,
    Cylinder as Cylinder,
    Ellipsoid as Ellipsoid,
    HexagonalPrism as HexagonalPrism,
    InfiniteCylinder as InfiniteCylinder,
    Sphere as Sphere,
    Torus as Torus,
)
from sorojax.sdf.surface.marching import (
    Curve as Curve,
    Surface as Surface,
    contour as contour,
    isosurface as isosurface,
)
from sorojax.sdf.surface.report import (
    SurfaceReport as SurfaceReport,
    surface_report as surface_report,
)

_check_package(__name__)
