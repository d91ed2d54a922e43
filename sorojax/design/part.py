"""From densities to a part: a smooth shape of the same volume, mirrored and repeated, meshed
to its boundary and analysed again."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sorojax import _check, sdf
from sorojax.design.field import (
    SplineField,
    cell_sizes,
    distance_field,
    joined,
    quantile,
    sampled,
)
from sorojax.mesh.mesh import Mesh
from sorojax.mesh.plane.triangulate import triangulate
from sorojax.mesh.quality import Quality, quality
from sorojax.mesh.solid.tetrahedralise import tetrahedralise
from sorojax.sdf.base import AbstractSdf
from sorojax.sdf.sampling import values, values_and_gradients
from sorojax.sdf.surface.report import SurfaceReport

_FINER = 4  # points per node of the grid where a volume is taken
_FAR = 4.0  # nodes of the grid: how far the surface may move to keep the volume


class Mirror(eqx.Module):
    """The body goes on as its image behind the plane x[`axis`] = `at` [m]; axis 0 is x."""

    axis: int = eqx.field(static=True)
    at: float = eqx.field(static=True)

    def extent(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        image = 2 * self.at - np.array([upper[self.axis], lower[self.axis]])
        lower, upper = lower.copy(), upper.copy()
        lower[self.axis] = min(lower[self.axis], image[0])
        upper[self.axis] = max(upper[self.axis], image[1])
        return lower, upper

    def fold(self, points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        side = 1.0 if (lower + upper)[self.axis] / 2 >= self.at else -1.0
        points = points.copy()
        points[:, self.axis] = self.at + side * np.abs(points[:, self.axis] - self.at)
        return points


class Repeat(eqx.Module):
    """The body `count` times in a row along `axis` (0 is x), each copy beside the last."""

    axis: int = eqx.field(static=True)
    count: int = eqx.field(static=True)

    def extent(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        upper = upper.copy()
        upper[self.axis] += (self.count - 1) * (upper - lower)[self.axis]
        return lower, upper

    def fold(self, points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        start, length = lower[self.axis], (upper - lower)[self.axis]
        along = (points[:, self.axis] - start) / length
        copy = np.clip(np.floor(along), 0, self.count - 1)
        points = points.copy()
        points[:, self.axis] = start + length * (along - copy)
        return points


Fold = Mirror | Repeat


class Part(eqx.Module):
    """A body made of densities.

    Attributes:
        shape: The whole part, mirrored and repeated.
        cell: The piece that was optimised, with sharp edges along its domain.
        wanted: Volume of `cell` [m^3], area in the plane [m^2], by the densities.
        volume: That of `cell`.
        threshold: Density at its boundary before the last correction of the volume.
        dropped: Share of the body in pieces that were left out.
    """

    shape: AbstractSdf
    cell: AbstractSdf
    wanted: float
    volume: float
    threshold: float
    dropped: float


def part(
    mesh: Mesh,
    density: Float[np.ndarray, " cells"],
    *,
    folds: tuple[Fold, ...] = (),
    domain: AbstractSdf | None = None,
    whole: AbstractSdf | None = None,
    volume: float | None = None,
    spacing: float | None = None,
    keep: int | None = 1,
    detail: float | None = None,
) -> Part:
    """A smooth body of the volume of the densities (to 1e-3), bounded by its domain.

    The boundary is where the density crosses the threshold that keeps the volume, as a
    smooth signed field; bends are rounded at the scale of `spacing`.

    Args:
        mesh: The cells that were optimised.
        density: Of every cell, 0 to 1, after filter and projection.
        folds: `Mirror` and `Repeat`, in the order in which the whole part is built up.
        domain: Shape of the mesh; its box if it fills that.
        whole: Shape of the domain after all folds; its box if omitted.
        volume: Volume of the body [m^3], in the plane area [m^2]; that of the densities if
            omitted.
        spacing: Of the grid that the field is kept on [m]; half a cell if omitted.
        keep: Number of pieces to keep, the largest ones; None for all.
        detail: Islands and holes smaller than that [m] are dropped; a cell if omitted.

    Returns:
        The shape and what it is worth as a piece.

    Raises:
        ValueError: If the mesh does not fill its box and no domain is given, or the volume
            does not fit into it.
    """
    _check.shape("part", "density", density, (mesh.num_cells,), "Give one per cell.")
    _check.finite("part", "density", density, "Take those of a finished optimisation.")
    sizes = cell_sizes(mesh)
    dim = mesh.element.dim
    points = np.asarray(mesh.points)
    lower, upper = points.min(axis=0), points.max(axis=0)
    pitch = float(np.mean(sizes)) ** (1 / dim)
    step = pitch / 2 if spacing is None else float(spacing)
    _check.positive("part", "spacing", step, "m", "About half a cell is usual.")
    domain = _box_of(mesh, sizes, lower, upper) if domain is None else domain
    wanted = float(np.sum(sizes * np.asarray(density))) if volume is None else float(volume)
    boxes = [(lower, upper)]
    for each in folds:
        boxes.append(each.extent(*boxes[-1]))
    if whole is None:
        if folds and not isinstance(domain, sdf.Rectangle | sdf.Box):
            raise ValueError(
                "part: got folds and a domain of its own, need `whole`, the shape of the "
                "domain after all folds. Draw it without seams between the copies."
            )
        whole = _box(*boxes[-1]) if folds else domain

    def fold(points):
        for each, box in zip(reversed(folds), reversed(boxes[:-1]), strict=True):
            points = each.fold(points, *box)
        return points

    grid = sampled(mesh, density, *boxes[-1], step, fold)
    inside = np.asarray(whole(jnp.asarray(grid.points))) <= 0
    copies = np.prod(boxes[-1][1] - boxes[-1][0]) / np.prod(upper - lower)
    share = wanted * copies / (step**dim * inside.sum())
    threshold = quantile(grid.density[inside], share)
    # Only what lies within the domain decides what hangs together.
    least = (detail if detail is not None else pitch) ** dim / step**dim
    body, dropped = joined(np.where(inside, threshold - grid.density, 1.0), keep, least)
    kept = np.where(inside, body, grid.density > threshold)
    grid = grid._replace(density=_corrected(grid.density, threshold, kept))
    field = distance_field(grid, threshold)
    shift, found = _shift(field, domain, lower, upper, wanted)
    field = eqx.tree_at(lambda f: f.coefficients, field, field.coefficients - shift)
    return Part(whole & field, domain & field, wanted, found, threshold, dropped)


def _corrected(density: np.ndarray, threshold: float, body: np.ndarray) -> np.ndarray:
    """Densities that exceed the threshold exactly where there is a body."""
    dense = np.where(body, np.maximum(density, threshold + 1e-6), density)
    return np.where(body, dense, np.minimum(density, threshold - 1e-6))


def _shift(
    field: SplineField, domain: AbstractSdf, lower, upper, wanted: float
) -> tuple[float, float]:
    """How far the surface moves outward for the wanted volume [m], and the volume there.

    A spline less a constant has all coefficients less that constant, so the field is
    evaluated once.
    """
    counts = np.ceil(_FINER * (upper - lower) / float(field.spacing)).astype(int)
    axes = [
        a + (b - a) * (np.arange(n) + 0.5) / n
        for a, b, n in zip(lower, upper, counts, strict=True)
    ]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(counts))
    f, g = values_and_gradients(field, points)
    steep = np.maximum(np.linalg.norm(g, axis=1), 0.1)
    outer, cell = values(domain, points), (upper - lower) / counts
    size = float(np.prod(cell)) ** (1 / len(counts))

    def volume(shift: float) -> float:
        depth = np.maximum((f - shift) / steep, outer)
        return float(np.prod(cell) * np.sum(np.clip(0.5 - depth / size, 0.0, 1.0)))

    low, high = -_FAR * float(field.spacing), _FAR * float(field.spacing)
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if volume(middle) < wanted else (low, middle)
    return high, volume(high)


def _box(lower, upper) -> AbstractSdf:
    return (sdf.Rectangle if len(lower) == 2 else sdf.Box)(lower, upper)


def _box_of(mesh: Mesh, sizes, lower, upper) -> AbstractSdf:
    if abs(float(sizes.sum()) / float(np.prod(upper - lower)) - 1) > 1e-9:
        raise ValueError(
            "part: the mesh does not fill its box, need the shape that was meshed. Pass it as "
            "`domain`."
        )
    return _box(lower, upper)


class PartReport(NamedTuple):
    """The part beside what the optimiser promised.

    Attributes:
        promised: The optimiser's own number, on its graded cells.
        found: The same number of the body, on a mesh that follows its boundary.
        mesh: The mesh it was found on.
        quality: Of that mesh.
        wanted, volume: Of the densities and of the body [m^3], areas in the plane [m^2].
        surface: Of the exported part, if a surface was given.
    """

    promised: float
    found: float
    mesh: Mesh
    quality: Quality
    wanted: float
    volume: float
    surface: SurfaceReport | None = None

    @property
    def ratio(self) -> float:
        """Found over promised."""
        return self.found / self.promised

    def __str__(self) -> str:
        rows = [
            f"promised {self.promised:.6g}, found {self.found:.6g}, ratio {self.ratio:.4f}",
            f"volume wanted {self.wanted:.6g}, found {self.volume:.6g}",
            f"mesh {self.quality}",
        ]
        if self.surface is not None:
            state = "watertight" if self.surface.watertight else "NOT watertight"
            rows.append(
                f"surface {state}, {self.surface.num_shells} shells, genus "
                f"{self.surface.genus}, {self.surface.volume:.6g} m^3"
            )
        return "\n".join(rows)

    __repr__ = __str__


def reanalyse(
    made: Part,
    performance: Callable[[Mesh], float],
    promised: float,
    *,
    size: float,
    order: int = 2,
    surface: sdf.Surface | None = None,
) -> PartReport:
    """The optimised piece meshed to its boundary, and its performance there.

    Args:
        made: The part; its `cell` is meshed, so that supports and loads stay where they were.
        performance: The optimiser's objective for a body that fills its mesh.
        promised: The optimiser's own number.
        size: Wanted length of the sides [m].
        order: Degree of the cells.
        surface: Triangles of the exported part, to be checked as well.

    Returns:
        The performance of the piece beside the one promised.
    """
    fill = triangulate if made.cell.dim == 2 else tetrahedralise
    mesh = fill(made.cell, size=size, order=order)
    checked = None if surface is None else sdf.surface_report(surface)
    return PartReport(
        float(promised),
        float(performance(mesh)),
        mesh,
        quality(mesh),
        made.wanted,
        made.volume,
        checked,
    )


def solid(made: Part, thickness: float | None = None) -> AbstractSdf:
    """The whole part in space: a plane one drawn out by `thickness` [m].

    Args:
        made: The part, from `part`.
        thickness: Of a plane part [m].

    Returns:
        The shape in space.
    """
    if made.shape.dim == 3:
        return made.shape
    if thickness is None:
        raise ValueError("solid: the part is plane, need its `thickness` [m]. Give one.")
    return sdf.extrude(made.shape, thickness)
