"""Where boundary nodes go when the shape changes, by the implicit-function rule."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sorojax._jax.jit import once
from sorojax._jax.trace_state import evaluated_now, is_traced
from sorojax._types import from_host, integers, real
from sorojax.math.linear_map import OnHost, pushed
from sorojax.math.two_programs import linear_program
from sorojax.sdf.base import AbstractSdf, quotient
from sorojax.sdf.query import shape_tangent
from sorojax.sdf.sampling import value_and_gradient, values_and_gradients

Fields = tuple[AbstractSdf, ...]
# Parts of an edge at which the sides of a corner are looked at, one after the other.
ZOOMS = (0.9, 0.5, 0.2, 0.06, 0.02, 6e-3, 2e-3, 5e-4, 1e-4, 1e-5, 1e-6)
_MOST_STEPS = 40


class FieldPlan(eqx.Module):
    """One zero set: its smooth nodes with the direction in which each of them moves, and
    for every side of a sharp node which one (by place) and a vector along the side."""

    nodes: Int[Array, " smooth"] = eqx.field(converter=integers)
    normal: Float[Array, "smooth dim"] = eqx.field(converter=real)
    beside: Int[Array, " sides"] = eqx.field(converter=integers)
    along: Float[Array, "sides dim"] = eqx.field(converter=real)


class BoundaryPlan(eqx.Module):
    """Sharp nodes (corners and ridges) and one plan per field, the boundary first.

    A sharp node on a ridge, listed by place in `ridge`, stays in the plane across its
    `tangent`; other sharp nodes lie where their sides meet.
    """

    sharp: Int[Array, " sharp"] = eqx.field(converter=integers)
    ridge: Int[Array, " ridges"] = eqx.field(converter=integers)
    tangent: Float[Array, "ridges dim"] = eqx.field(converter=real)
    fields: tuple[FieldPlan, ...]


@eqx.filter_custom_jvp
def meet(
    fields: Fields, plan: BoundaryPlan, start: Float[Array, "sharp dim"]
) -> Float[Array, "sharp dim"]:
    """Where the sides of each sharp node meet, ridge nodes abreast of `start`."""
    with evaluated_now((fields, start)):
        return _meet(fields, plan, start)[0]


@meet.def_jvp
def _meet_jvp(primals, tangents):
    fields, plan, start = primals
    with evaluated_now((fields, start)):
        x, normals, slopes, seen = _meet(fields, plan, start)
    if not is_traced(primals):
        f_dot = _fields_dot(fields, plan, seen, tangents[0])
        by = _meet_slope(plan, np.asarray(normals), np.asarray(slopes), [*f_dot, start])
        with evaluated_now():
            rate = jnp.zeros_like(start) if tangents[2] is None else tangents[2]
        return x, pushed([*f_dot, rate], by)[0]
    given = fields, plan, normals, slopes, seen
    return x, _meet_dot(given, (tangents[0], tangents[2]), x)


@once
def _meet(fields: Fields, plan: BoundaryPlan, start):
    zooms = jnp.asarray(ZOOMS, start.dtype)

    def closer(i, state):
        x = state[0]
        normals, levels, slopes, seen = _sides_near(fields, plan, x, zooms[i])
        back = jnp.sum(plan.tangent * (start - x)[plan.ridge], axis=1)
        return x + _least_squares(plan, normals, levels, back), normals, slopes, seen

    # What the last step saw is carried out: the field is compiled once.
    count = sum(own.beside.shape[0] for own in plan.fields)
    along = tuple(own.along.astype(start.dtype) for own in plan.fields)
    slopes = jnp.zeros(count, start.dtype)
    begin = (start, jnp.broadcast_to(slopes[:, None], (count, start.shape[1])), slopes, along)
    return jax.lax.fori_loop(0, len(ZOOMS), closer, begin)


@linear_program
def _meet_dot(given, rates):
    fields, plan, normals, slopes, seen = given
    fields_dot, start_dot = rates
    if start_dot is None:
        start_dot = jnp.zeros((plan.sharp.shape[0], normals.shape[1]), normals.dtype)

    def fields_at(fields):
        return tuple(f(p) for f, p in zip(fields, seen, strict=True))

    f_dot = jnp.concatenate(shape_tangent(fields_at, fields, fields_dot))
    across = jnp.sum(plan.tangent * start_dot[plan.ridge], axis=1)
    return _least_squares(plan, normals, -f_dot / slopes, across)


def _sides_near(fields: Fields, plan: BoundaryPlan, x, zoom):
    """Sides beside the sharp nodes `x`: normal, how far x is from its plane, slope, place."""
    sides, seen = [], []
    for field, own in zip(fields, plan.fields, strict=True):
        step = zoom * own.along
        p = x[own.beside] + step
        f, g = value_and_gradient(field, p)
        slope = jnp.sqrt(jnp.sum(g * g, axis=1))
        slope = jnp.where(slope > 0, slope, jnp.ones_like(slope))
        n = g / slope[:, None]
        sides.append((n, jnp.sum(n * step, axis=1) - f / slope, slope))
        seen.append(p)
    normals, levels, slopes = (jnp.concatenate(part) for part in zip(*sides, strict=True))
    return normals, levels, slopes, tuple(seen)


def _least_squares(plan: BoundaryPlan, normals, levels, across):
    """Step s of each sharp node with n . s = level for its sides, t . s = across."""
    beside = jnp.concatenate([own.beside for own in plan.fields] + [plan.ridge])
    rows = jnp.concatenate([normals, plan.tangent])
    levels = jnp.concatenate([levels, across])
    count, dim = plan.sharp.shape[0], rows.shape[1]
    # The small identity decides where sides are parallel, and vanishes with the step.
    matrix = jnp.broadcast_to(1e-9 * jnp.eye(dim, dtype=rows.dtype), (count, dim, dim))
    matrix = matrix.at[beside].add(rows[:, :, None] * rows[:, None, :])
    rhs = jnp.zeros((count, dim), rows.dtype).at[beside].add(rows * levels[:, None])
    return _cramer(matrix, rhs)


def _cramer(matrix, rhs, numpy: Any = jnp):
    """Solutions of small systems, one per row; a library call would compile for a second."""
    if rhs.shape[1] == 2:
        (a, b), (c, d) = numpy.moveaxis(matrix, 0, 2)
        x, y = rhs.T
        return numpy.stack([d * x - b * y, a * y - c * x], axis=1) / (a * d - b * c)[:, None]
    a, b, c = numpy.moveaxis(matrix, 2, 0)
    cross = numpy.cross
    cofactors = numpy.stack([cross(b, c), cross(c, a), cross(a, b)], axis=1)
    det = numpy.sum(a * cofactors[:, 0], axis=1)
    return numpy.sum(cofactors * rhs[:, None, :], axis=2) / det[:, None]


@eqx.filter_custom_jvp
def slide(
    fields: Fields, plan: BoundaryPlan, start: tuple[Float[Array, "smooth dim"], ...]
) -> tuple[Float[Array, "smooth dim"], ...]:
    """Smooth nodes of each field moved from `start` along their normals to the zero set."""
    with evaluated_now((fields, start)):
        return _slide(fields, plan, start)[0]


@slide.def_jvp
def _slide_jvp(primals, tangents):
    fields, plan, start = primals
    with evaluated_now((fields, start)):
        x, gradients = _slide(fields, plan, start)
    if not is_traced(primals):
        f_dot = _fields_dot(fields, plan, x, tangents[0])
        by = _slide_slope(plan, list(map(np.asarray, gradients)), [*f_dot, *start])
        rates = (None,) * len(x) if tangents[2] is None else tangents[2]
        with evaluated_now():
            ways = zip(start, rates, strict=True)
            rates = [jnp.zeros_like(a) if r is None else r for a, r in ways]
        return x, tuple(pushed([*f_dot, *rates], by))
    slopes = tuple(
        jnp.sum(g * own.normal, axis=1) for g, own in zip(gradients, plan.fields, strict=True)
    )
    return x, _slide_dot((fields, plan, x, slopes), (tangents[0], tangents[2]), x)


@once
def _slide(fields: Fields, plan: BoundaryPlan, start):
    pairs = [
        _slide_one(field, own.normal, x)
        for field, own, x in zip(fields, plan.fields, start, strict=True)
    ]
    return tuple(x for x, _ in pairs), tuple(gradient for _, gradient in pairs)


def _slide_one(field: AbstractSdf, normal, start):
    tiny = 4 * jnp.finfo(start.dtype).eps

    def descend(state):
        x, _, _, count = state
        f, gradient = value_and_gradient(field, x)
        slope = jnp.sum(gradient * normal, axis=1)
        new = x - quotient(f, slope)[:, None] * normal
        far = jnp.max(jnp.abs(new - x), initial=0) > tiny * jnp.max(jnp.abs(x), initial=0)
        return new, gradient, far, count + 1

    begin = (start, jnp.zeros_like(start), jnp.array(start.size > 0), 0)
    final = jax.lax.while_loop(lambda s: s[2] & (s[3] < _MOST_STEPS), descend, begin)
    return final[:2]


@linear_program
def _slide_dot(given, rates):
    fields, plan, x, slopes = given
    fields_dot, start_dot = rates
    if start_dot is None:
        start_dot = (None,) * len(x)
    start_dot = tuple(
        jnp.zeros_like(at) if dot is None else dot for at, dot in zip(x, start_dot, strict=True)
    )

    def fields_at(both):
        return tuple(f(p) for f, p in zip(*both, strict=True))

    f_dot = shape_tangent(fields_at, (fields, x), (fields_dot, start_dot))
    return tuple(
        dot - quotient(f, slope)[:, None] * own.normal
        for dot, f, slope, own in zip(start_dot, f_dot, slopes, plan.fields, strict=True)
    )


# Rates outside `jit`: one program for those of the fields, the rest by NumPy


def _filled(rows: np.ndarray, room: int) -> np.ndarray:
    """`rows`, the first one again and again behind them."""
    rows = np.asarray(rows)
    full = np.zeros((room, *rows.shape[1:]), rows.dtype)
    full[: len(rows)] = rows
    if len(rows):
        full[len(rows) :] = rows[0]
    return full


@linear_program
def _fields_moved(given, fields_dot):
    fields, points = given

    def fields_at(fields):
        return tuple(f(p) for f, p in zip(fields, points, strict=True))

    return shape_tangent(fields_at, fields, fields_dot)


def _fields_dot(fields: Fields, plan: BoundaryPlan, points, fields_dot) -> list[Array]:
    """Rates of each field at its points, more rows than these: as many in both searches."""
    most = max(max(len(own.nodes), len(own.beside)) for own in plan.fields)
    room = 1 << max(most - 1, 0).bit_length()
    with evaluated_now():
        seen = tuple(from_host(_filled(p, room)) for p in points)
        still = [from_host(np.zeros(room, p.dtype)) for p in seen]
    if all(x is None for x in jax.tree.leaves(fields_dot, is_leaf=lambda x: x is None)):
        return still
    return list(_fields_moved((fields, seen), fields_dot, tuple(still)))


class _Corners:
    """Steps of all sharp nodes, with the normals of their sides."""

    def __init__(self, plan: BoundaryPlan, normals: np.ndarray):
        beside = [np.asarray(own.beside) for own in plan.fields]
        self._beside = np.concatenate([*beside, np.asarray(plan.ridge)])
        self._rows = np.concatenate([normals, np.asarray(plan.tangent, normals.dtype)])
        self._shape = count, dim = plan.sharp.shape[0], self._rows.shape[1]
        eye = 1e-9 * np.eye(dim, dtype=normals.dtype)
        self._matrix = np.broadcast_to(eye, (count, dim, dim)).copy()
        outer = self._rows[:, :, None] * self._rows[:, None, :]
        np.add.at(self._matrix, self._beside, outer)

    def step(self, levels: np.ndarray) -> np.ndarray:
        """By the levels of all sides, then those along the ridges."""
        rhs = np.zeros(self._shape, self._rows.dtype)
        np.add.at(rhs, self._beside, self._rows * levels[:, None])
        return _cramer(self._matrix, rhs, np)

    def back(self, change: np.ndarray) -> np.ndarray:
        """The transpose of `step`."""
        return (self._rows * _cramer(self._matrix, change, np)[self._beside]).sum(axis=1)


def _meet_slope(plan: BoundaryPlan, normals, slopes: np.ndarray, given) -> OnHost:
    """From the rates of the fields, and of where sharp nodes start, to those of the nodes."""
    corners = _Corners(plan, normals)
    counts = [len(own.beside) for own in plan.fields]
    rooms = [x.shape[0] for x in given[:-1]]
    ridge, tangent = np.asarray(plan.ridge), np.asarray(plan.tangent)

    def staged(*rates):
        *f_dot, start_dot = rates
        levels = [-f[:n] for f, n in zip(f_dot, counts, strict=True)]
        across = jnp.sum(plan.tangent * start_dot[plan.ridge], axis=1)
        return (_least_squares(plan, normals, jnp.concatenate(levels) / slopes, across),)

    def there(*rates):
        *f_dot, start_dot = rates
        levels = np.concatenate([-f[:n] for f, n in zip(f_dot, counts, strict=True)])
        across = (tangent * start_dot[ridge]).sum(axis=1)
        return (corners.step(np.concatenate([levels / slopes, across])),)

    def back(change):
        levels, across = np.split(corners.back(change), [len(slopes)])
        start = np.zeros_like(change)
        np.add.at(start, ridge, tangent * across[:, None])
        parts = np.split(-levels / slopes, np.cumsum(counts)[:-1])
        return [*map(_padded, parts, rooms), start]

    return OnHost(staged, there, back, given, [given[-1].shape])


def _divided(f: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """`quotient` by NumPy."""
    return np.where(slope == 0, 0, f) / np.where(slope == 0, 1, slope).astype(f.dtype)


def _slide_slope(plan: BoundaryPlan, gradients: list[np.ndarray], given) -> OnHost:
    """From the rates of the fields, and of where smooth nodes start, to those of the nodes."""
    pairs = zip(plan.fields, gradients, strict=True)
    normals = [np.asarray(own.normal, g.dtype) for own, g in pairs]
    slopes = [(g * n).sum(axis=1) for g, n in zip(gradients, normals, strict=True)]
    count, rooms = len(normals), [x.shape[0] for x in given]

    def moved(divided, rates):
        sides = gradients, normals, slopes
        for f, dot, g, n, slope in zip(rates[:count], rates[count:], *sides, strict=True):
            rate = f[: len(g)] + (g * dot).sum(axis=1)
            yield dot - divided(rate, slope)[:, None] * n

    def staged(*rates):
        return list(moved(quotient, rates))

    def there(*rates):
        return list(moved(_divided, rates))

    def back(*changes):
        rates = [
            -_divided((change * n).sum(axis=1), slope)
            for change, n, slope in zip(changes, normals, slopes, strict=True)
        ]
        ways = zip(changes, rates, gradients, strict=True)
        starts = [change + rate[:, None] * g for change, rate, g in ways]
        return [*map(_padded, rates, rooms[:count]), *starts]

    return OnHost(staged, there, back, given, [g.shape for g in gradients])


def _padded(row: np.ndarray, room: int) -> np.ndarray:
    return np.concatenate([row, np.zeros(room - len(row), row.dtype)])


# Points put where several sides of zero sets meet, on the host


SETTLE_ZOOMS = (0.5, 0.25, 0.1, 0.03, 0.01, 1e-3, 1e-4, 1e-5)
_NO_ROWS = np.zeros((0, 3))


class Sides(NamedTuple):
    """Sides that points lie on, one row each.

    Attributes:
        point: (n,) which point.
        field: (n,) which zero set.
        along: (n, 3) from the point along the side [m]; zero where the set is smooth.
    """

    point: np.ndarray
    field: np.ndarray
    along: np.ndarray

    def of(self, points: np.ndarray, count: int) -> "Sides":
        """The sides of some `points` of `count`, renumbered in their order."""
        place = np.full(count, -1)
        place[points] = np.arange(len(points))
        own = place[self.point] >= 0
        return Sides(place[self.point[own]], self.field[own], self.along[own])


def no_sides() -> Sides:
    return Sides(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)))


def joined(*parts: Sides) -> Sides:
    return Sides(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def normals_near(fields: tuple[AbstractSdf, ...], x, sides: Sides, zoom: float):
    """Unit normals of sides looked at from `zoom` of their vectors away, and how far the
    points are from their tangent planes."""
    step = zoom * sides.along
    p = x[sides.point] + step
    f, g = np.zeros(len(p)), np.zeros_like(p)
    for i, field in enumerate(fields):
        own = sides.field == i
        f[own], g[own] = values_and_gradients(field, p[own])
    slope = np.maximum(np.linalg.norm(g, axis=1), 1e-9)
    n = g / slope[:, None]
    return n, (n * step).sum(axis=1) - f / slope


def settle(
    fields: tuple[AbstractSdf, ...],
    x,
    sides: Sides,
    zooms=SETTLE_ZOOMS,
    ridge=(),
    tangent=_NO_ROWS,
) -> np.ndarray:
    """`x` (points, 3) moved by the shortest way to where their sides meet; those listed in
    `ridge` stay in the planes across their `tangent`."""
    start, x, ridge = np.asarray(x, dtype=float), np.array(x, dtype=float), list(ridge)
    for zoom in zooms if len(x) else ():
        n, level = normals_near(fields, x, sides, zoom)
        matrix = np.broadcast_to(1e-11 * np.eye(3), (len(x), 3, 3)).copy()
        np.add.at(matrix, sides.point, n[:, :, None] * n[:, None, :])
        rhs = np.zeros_like(x)
        np.add.at(rhs, sides.point, n * level[:, None])
        if ridge:
            matrix[ridge] += tangent[:, :, None] * tangent[:, None, :]
            rhs[ridge] += tangent * ((start - x)[ridge] * tangent).sum(axis=1, keepdims=True)
        x += np.linalg.solve(matrix, rhs[..., None])[..., 0]
    return x
