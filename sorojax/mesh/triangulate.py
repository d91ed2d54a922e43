"""From a plane shape to triangles: exact boundary, hexagonal inside, curved sides."""

import numpy as np

from sorojax import _check
from sorojax._types import real
from sorojax.mesh.constrained import Missing
from sorojax.mesh.delaunay import fill
from sorojax.mesh.elements import Tri3, Tri6
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.outline import Outline, outline, split
from sorojax.mesh.resolved import bulging, raise_if_thin, raise_thin, unseen
from sorojax.mesh.sizes import SizeFunction, Sizes, sizes
from sorojax.mesh.tri6 import least_jacobian, with_middles
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sample import EmptyShape, finite_box, land, raise_empty

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

    Boundary points lie on the zero set to rounding, corners included; edges turn at
    most about 45 degrees on fillets and are split where walls are thinner than they
    are long. With `order=2` the sides on the boundary and on interfaces are curved.

    Node sets of the result: "corners" (also where curves cross) and "interface_0",
    ...; facet sets: "boundary" and "interface_0", ....

    Args:
        shape: A concrete, bounded plane shape.
        size: Wanted length of the sides [m]: a number, or a function of points (n, 2)
            that returns one length per point, such as `grade(...)`.
        order: 1 for `Tri3`, 2 for `Tri6`.
        interfaces: Shapes whose zero sets become sides of the mesh inside `shape`.
        iterations: Smoothing steps; more give slightly rounder triangles.

    Raises:
        ValueError: If the shape is empty, unbounded, traced, or not resolved by `size`.
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
    points, cells, middles = with_middles(points, cells, lines.edges)
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
