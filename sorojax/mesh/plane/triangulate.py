"""From a plane shape to triangles: exact boundary, hexagonal inside, curved sides.

Meshes of polygons and of pictures.
"""

import numpy as np
from jaxtyping import Float

from sorojax import _check
from sorojax._types import Numbers, real
from sorojax.mesh.elements.simplex import Tri3, Tri6
from sorojax.mesh.mesh import Mesh, nodes_between, with_side_nodes
from sorojax.mesh.plane.delaunay import Missing, doubled_areas, fill
from sorojax.mesh.plane.outline import Outline, outline, split
from sorojax.mesh.resolution import bulging, raise_if_thin, raise_thin, unseen
from sorojax.mesh.sizes import SizeFunction, Sizes, sizes
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import EmptyShape, finite_box, land, raise_empty
from sorojax.sdf.shapes.plane import Polygon, touching_edges
from sorojax.sdf.surface.marching import cross


def least_jacobian(points: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Lower bound of det dx/dxi in each six-node triangle over twice its area.

    The determinant is a quadratic polynomial: its smallest Bernstein coefficient
    bounds it from below.
    """
    x, slopes = points[cells], Tri6().shape_gradients(Tri6().nodes())
    at_nodes = np.linalg.det(np.einsum("cai,qad->cqid", x, slopes))
    middles = 2 * at_nodes[:, 3:] - (at_nodes[:, :3] + np.roll(at_nodes[:, :3], -1, 1)) / 2
    return np.minimum(at_nodes[:, :3].min(axis=1), middles.min(axis=1)) / np.abs(
        doubled_areas(x)
    )


# From a plane shape to triangles: exact boundary, hexagonal inside, curved sides


_LOOKS = (4, 8, 24)  # points within a size where the shape is looked at: more if in doubt
_REPAIRS = 6  # rounds of splitting edges that cross


def triangulate(
    shape: AbstractSdf,
    *,
    size: float | SizeFunction,
    order: int = 1,
    interfaces: tuple[AbstractSdf, ...] = (),
    iterations: int = 6,
) -> Mesh:
    """Triangles that fill a plane shape.

    Boundary points lie on the zero set to rounding, corners included; edges turn by at
    most about 45 degrees on fillets and are split where walls are thinner than the edges
    are long. The inside starts from a hexagonal pattern and is smoothed over constrained
    Delaunay triangles. With `order=2` the sides on the boundary and on interfaces are curved.

    Node sets of the result: "corners" (also where curves cross) and "interface_0",
    ...; facet sets: "boundary" and "interface_0", ....

    Args:
        shape: A concrete, bounded plane shape.
        size: Wanted length of the sides [m]: a number, or a function of points (n, 2)
            that returns one length per point, such as `grade(...)`.
        order: 1 for `Tri3`, 2 for `Tri6`.
        interfaces: Shapes whose zero sets become sides of the mesh inside `shape`; none by
            default.
        iterations: Smoothing steps; more give slightly rounder triangles.

    Returns:
        The mesh, points [m].

    Raises:
        ValueError: If the shape is not plane, empty, unbounded, traced, or not resolved by
            `size`; without float64; or if a curved side would invert its triangle.

    Example:
        >>> plate = sdf.Rectangle([0, 0], [40 * mm, 10 * mm])
        >>> cells = mesh.triangulate(plate, size=5 * mm)
        >>> print(f"{float(mesh.cell_areas(cells).sum()) / mm**2:.3f} mm^2")
        400.000 mm^2

    Reference:
        Persson and Strang, A simple mesh generator in MATLAB, SIAM Review 46, 2004, for
        meshes of signed distances; Sloan, A fast algorithm for generating constrained Delaunay
        triangulations, Computers & Structures 47, 1993, for edges that must exist.
    """
    if order not in (1, 2):
        raise ValueError(
            f"triangulate: `order` is {order}, need 1 (Tri3) or 2 (Tri6). Other degrees "
            "do not exist."
        )
    _check.float64("triangulate", real(0.0))
    box = finite_box("triangulate", shape, 2)
    lengths = sizes("triangulate", size, *box)
    interfaces = tuple(interfaces)
    lines, points, cells = _filled(shape, interfaces, lengths, box, iterations)
    if order == 1:
        return Mesh(points, cells, Tri3(), *_sets(lines, lines.edges, len(interfaces)))
    return _curved((shape, *interfaces), lines, points, cells)


def _filled(shape, interfaces, lengths: Sizes, box, iterations: int):
    """`(lines, points, cells)`; the outline is drawn from nearer where it is in doubt."""
    for looks in _LOOKS:
        try:
            lines = outline(shape, interfaces, lengths, looks)
            if not len(lines.edges):
                raise_empty("triangulate", *box, lengths.smallest / looks)
        except EmptyShape:
            if looks < _LOOKS[-1]:
                continue
            raise_if_thin("triangulate", shape, *box, lengths)
            raise
        if looks < _LOOKS[-1] and bulging((shape, *interfaces), lines, lengths):
            continue
        doubt = unseen(shape, lines, lengths, *box)
        for _ in range(_REPAIRS if not len(doubt) else 0):
            try:
                return lines, *fill(shape, lines, lengths, iterations)
            except Missing as found:
                doubt = lines.points[lines.edges[found.edges]].mean(axis=1)
                lines = split((shape, *interfaces), lines, found.edges)
    raise_thin("triangulate", (shape, *interfaces), doubt, lengths)


def _curved(fields, lines: Outline, points, cells) -> Mesh:
    """The quadratic mesh, middles of outline edges moved onto their zero sets."""
    points, cells = with_side_nodes(points, cells, Tri6())
    middles = nodes_between(cells, Tri6(), lines.edges)
    for i, field in enumerate(fields):
        mine = middles[lines.owner == i]
        points[mine] = land(field, points[mine])
    worst = least_jacobian(points, cells)
    if worst.min() <= 0:
        where = points[cells[worst.argmin()]].mean(axis=0)
        raise ValueError(
            f"triangulate: a curved side turns its triangle inside out near {where} m. "
            "Lower `size` so that the bend is resolved."
        )
    facets = np.concatenate([lines.edges, middles[:, None]], axis=1)
    return Mesh(points, cells, Tri6(), *_sets(lines, facets, len(fields) - 1))


def _sets(lines: Outline, facets: np.ndarray, count: int):
    nodes = {"corners": np.flatnonzero(lines.corner)}
    sides = {"boundary": facets[lines.owner == 0]}
    for i in range(count):
        mine = facets[lines.owner == i + 1]
        nodes[f"interface_{i}"] = np.unique(mine)
        sides[f"interface_{i}"] = mine
    return nodes, sides


# Meshes of polygons and of pictures.


_MOST_CORNERS = 5000


def from_polygon(
    outer: Float[np.ndarray, "corners 2"],
    holes: tuple[Float[np.ndarray, "corners 2"], ...] = (),
    *,
    size: float | SizeFunction,
    order: int = 1,
) -> Mesh:
    """Triangles inside a polygon [m] with holes; every corner becomes a node.

    Args:
        outer: Corners of the outline [m].
        holes: Corners of each hole [m].
        size: Wanted length of the sides [m], a number or a function of points.
        order: 1 for `Tri3`, 2 for `Tri6`.

    Returns:
        The mesh, points [m].

    Raises:
        ValueError: If a ring has fewer than 3 corners, or rings touch or cross.
    """
    rings = [_ring(r) for r in (outer, *holes)]
    _check_simple(rings)
    shape: AbstractSdf = Polygon(rings[0])
    for hole in rings[1:]:
        shape = shape - Polygon(hole)
    return triangulate(shape, size=size, order=order)


def from_image(
    image: Float[np.ndarray, "rows columns"],
    *,
    pixel: float,
    size: float | SizeFunction,
    order: int = 1,
    level: float | None = None,
    smooth: float = 0.35,
) -> Mesh:
    """Triangles inside the bright part of a picture; x to the right, y up from its foot.

    The outline runs at the grey `level` between pixels, so an anti-aliased picture gives
    it to a fraction of a pixel.

    Args:
        image: Grey levels; for a dark body pass `-image`.
        pixel: Side of a pixel [m].
        size: Wanted length of the sides [m].
        order: 1 for `Tri3`, 2 for `Tri6`.
        level: Grey level of the outline; midway between darkest and brightest if omitted.
        smooth: Largest distance of the outline from the contour [pixels].

    Returns:
        The mesh, points [m].
    """
    return triangulate(
        image_shape(image, pixel=pixel, level=level, smooth=smooth), size=size, order=order
    )


def image_shape(
    image: Numbers, *, pixel: float, level: float | None = None, smooth: float = 0.35
) -> AbstractSdf:
    """The bright part of a picture as polygons minus their holes.

    Args:
        image: Grey levels, rows from top to bottom.
        pixel: Side of a pixel [m].
        level: Grey level of the outline; midway between darkest and brightest if omitted.
        smooth: Largest distance of the outline from the contour [pixels].

    Returns:
        The shape.
    """
    from skimage.measure import approximate_polygon, find_contours

    image = np.asarray(image, dtype=float)
    _check.shape("from_image", "image", image, (None, None), "Give grey levels, not colours.")
    _check.positive("from_image", "pixel", pixel, "m", "Give the side of a pixel.")
    _check.finite("from_image", "image", image, "Replace missing pixels.")
    low, high = float(image.min()), float(image.max())
    level = (low + high) / 2 if level is None else level
    if not low < level < high:
        raise ValueError(
            f"from_image: the outline at grey {level:g} does not exist, levels run from "
            f"{low:g} to {high:g}. Pass a `level` between them."
        )
    padded = np.pad(image, 1, constant_values=low)
    rings = []
    for contour in find_contours(padded, level):
        ring = approximate_polygon(contour, smooth)[:-1]
        if len(ring) >= 3:
            rings.append(pixel * np.stack([ring[:, 1] - 0.5, len(image) - ring[:, 0] + 0.5], 1))
    rings.sort(key=lambda r: -abs(ring_area(r)))
    _check_simple(rings)
    first = np.sign(ring_area(rings[0]))
    shape: AbstractSdf = Polygon(rings[0])
    for ring in rings[1:]:
        part = Polygon(ring)
        shape = shape | part if np.sign(ring_area(ring)) == first else shape - part
    return shape


def ring_area(x: np.ndarray) -> float:
    """Area inside a polygon of corners (n, 2), negative where they run clockwise."""
    return float(cross(x, np.roll(x, -1, axis=0)).sum() / 2)


def _ring(corners) -> np.ndarray:
    ring = np.asarray(corners, dtype=float)
    _check.shape("from_polygon", "corners", ring, (None, 2), "One row per corner.")
    _check.finite("from_polygon", "corners", ring, "Remove or correct them.")
    if len(ring) > 1 and np.array_equal(ring[0], ring[-1]):
        ring = ring[:-1]
    if len(ring) < 3:
        raise ValueError(f"from_polygon: a ring has {len(ring)} corners, need at least 3.")
    return ring


def _check_simple(rings: list[np.ndarray]) -> None:
    """Raise where two sides of the rings touch or cross."""
    a = np.concatenate(rings)
    if len(a) > _MOST_CORNERS:
        raise ValueError(
            f"from_polygon: the rings have {len(a)} corners, at most {_MOST_CORNERS} are "
            "allowed. Simplify them first."
        )
    b = np.concatenate([np.roll(r, -1, axis=0) for r in rings])
    if edges := touching_edges(*rings):
        i, j = edges
        raise ValueError(
            f"from_polygon: the side from {a[i]} to {b[i]} m touches or crosses the one "
            f"from {a[j]} to {b[j]} m. Separate them, or split the polygon."
        )
