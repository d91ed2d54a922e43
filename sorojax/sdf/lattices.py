"""Periodic lattices that fill space: cut a solid out of them with `&`."""

import abc
import functools
import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax._types import real
from sorojax.sdf.base import (
    OUTSIDE,
    AbstractSdf,
    Box,
    Exactness,
    absolute,
    minimum,
    ordered,
    positive,
    root,
)
from sorojax.sdf.shapes.bars import segment_square
from sorojax.sdf.shapes.curves import nearest, take


class AbstractLattice(AbstractSdf):
    """A shape that fills space."""

    def bounding_box(self) -> Box:
        infinity = jnp.full((self.dim,), jnp.inf, jnp.result_type(*jax.tree.leaves(self)))
        return -infinity, infinity


class AbstractSurfaceLattice(AbstractLattice):
    """A wall along the surface F(phase) = `level`, F periodic in x, y, z.

    The field is |F - level| / (bound * 2 pi / period) - thickness / 2, where `bound`
    limits |grad F|: a safe bound of the distance. Walls are `thickness` [m] thick where
    F is steepest and thicker elsewhere.
    """

    period: Float[Array, ""] = eqx.field(converter=positive)
    thickness: Float[Array, ""] = eqx.field(converter=positive)
    level: Float[Array, ""] = eqx.field(converter=real, default=0.0)
    bound: ClassVar[float]
    dim: ClassVar[int] = 3

    @abc.abstractmethod
    def surface(self, x: Array, y: Array, z: Array) -> Array:
        """F at the phases x, y, z [rad]."""

    def distance(self, x, y, z):
        w = 2 * math.pi / self.period
        value = self.surface(w * x, w * y, w * z) - self.level
        return absolute(value) / (self.bound * w) - self.thickness / 2


class Gyroid(AbstractSurfaceLattice):
    """Gyroid walls: `period` and `thickness` in m."""

    bound: ClassVar[float] = math.sqrt(3)

    def surface(self, x, y, z):
        sin, cos = jnp.sin, jnp.cos
        return sin(x) * cos(y) + sin(y) * cos(z) + sin(z) * cos(x)


class SchwarzP(AbstractSurfaceLattice):
    """Schwarz primitive walls: `period` and `thickness` in m."""

    bound: ClassVar[float] = math.sqrt(3)

    def surface(self, x, y, z):
        return jnp.cos(x) + jnp.cos(y) + jnp.cos(z)


class Diamond(AbstractSurfaceLattice):
    """Schwarz diamond walls: `period` and `thickness` in m."""

    bound: ClassVar[float] = math.sqrt(3)

    def surface(self, x, y, z):
        return jnp.cos(z) * jnp.sin(x + y) + jnp.sin(z) * jnp.cos(x - y)


class Neovius(AbstractSurfaceLattice):
    """Neovius walls: `period` and `thickness` in m."""

    bound: ClassVar[float] = 7.0

    def surface(self, x, y, z):
        a, b, c = jnp.cos(x), jnp.cos(y), jnp.cos(z)
        return 3 * (a + b + c) + 4 * a * b * c


class Lidinoid(AbstractSurfaceLattice):
    """Lidinoid walls: `period` and `thickness` in m."""

    bound: ClassVar[float] = 1.5 * math.sqrt(3)

    def surface(self, x, y, z):
        sin, cos = jnp.sin, jnp.cos
        first = (
            sin(2 * x) * cos(y) * sin(z)
            + sin(2 * y) * cos(z) * sin(x)
            + sin(2 * z) * cos(x) * sin(y)
        )
        a, b, c = cos(2 * x), cos(2 * y), cos(2 * z)
        return (first - a * b - b * c - c * a) / 2 + 0.15


class Iwp(AbstractSurfaceLattice):
    """Schoen's I-WP walls: `period` and `thickness` in m."""

    bound: ClassVar[float] = 3 * math.sqrt(3)

    def surface(self, x, y, z):
        a, b, c = jnp.cos(x), jnp.cos(y), jnp.cos(z)
        doubled = jnp.cos(2 * x) + jnp.cos(2 * y) + jnp.cos(2 * z)
        return 2 * (a * b + b * c + c * a) - doubled


class AbstractBeamLattice(AbstractLattice):
    """Round beams of `width` [m] in cubic cells of `period` [m], a node at the origin.

    Mirror planes of the lattice fold space onto the wedge 0 <= z <= y <= x <= period/2,
    in which the nearest beam lies too; `beams` are those of the wedge over period/2.
    """

    period: Float[Array, ""] = eqx.field(converter=positive)
    width: Float[Array, ""] = eqx.field(converter=positive)
    beams: ClassVar[tuple]
    dim: ClassVar[int] = 3
    exactness: ClassVar[Exactness] = OUTSIDE

    def distance(self, x, y, z):
        half = self.period / 2
        p = tuple(
            absolute(c - self.period * jnp.round(c / self.period)) / half for c in (x, y, z)
        )
        low, high = ordered(p[0], p[1])
        middle, high = ordered(high, p[2])
        low, middle = ordered(low, middle)
        p = high, middle, low
        beams = jnp.asarray(self.beams, x.dtype)
        squares = (segment_square(p, tuple(a), tuple(b)) for a, b in beams)
        return half * root(functools.reduce(minimum, squares)) - self.width / 2


class BccLattice(AbstractBeamLattice):
    """Body-centred cubic beams: from the corners of every cell to its middle."""

    beams: ClassVar[tuple] = (((0, 0, 0), (1, 1, 1)),)


class OctetLattice(AbstractBeamLattice):
    """Octet truss: beams between the nearest nodes of a face-centred cubic lattice."""

    beams: ClassVar[tuple] = (((0, 0, 0), (1, 1, 0)), ((1, 1, 0), (1, 0.5, 0.5)))


class KelvinLattice(AbstractBeamLattice):
    """Kelvin foam: the edges of truncated octahedra that fill space."""

    beams: ClassVar[tuple] = (
        ((1, 0.5, 0), (1, 0.25, 0.25)),
        ((1, 0.5, 0), (0.75, 0.75, 0)),
    )


class VoronoiFoam(AbstractLattice):
    """Walls of `thickness` [m] between the cells of explicit `seeds` [m], in 2-D or 3-D."""

    seeds: Float[Array, "seeds dim"] = eqx.field(converter=real)
    thickness: Float[Array, ""] = eqx.field(converter=positive)
    exactness: ClassVar[Exactness] = OUTSIDE

    def __check_init__(self):
        size = jnp.shape(self.seeds)
        if len(size) != 2 or size[1] not in (2, 3) or size[0] < 2:
            raise ValueError(
                f"VoronoiFoam: `seeds` has shape {size}, need at least 2 rows of (x, y) or "
                "(x, y, z). Draw them with an explicit key."
            )

    @property
    def dim(self) -> int:
        return self.seeds.shape[1]

    def distance(self, *x):
        table = (self.seeds,)
        (own,) = take(table, nearest(lambda row, *x: _square(x, row[0]), table, x))
        (other,) = take(table, nearest(lambda row, *x: _wall(x, own, row[0]), table, x))
        return _wall(x, own, other) - self.thickness / 2


def _square(x: tuple[Array, ...], seed) -> Array:
    return sum(((c - seed[i]) ** 2 for i, c in enumerate(x)), start=jnp.zeros_like(x[0]))


def _wall(x: tuple[Array, ...], own, other) -> Array:
    """Distance from x, nearest to `own`, to the wall halfway to `other` [m]."""
    zero = jnp.zeros_like(x[0])
    away = tuple(other[i] - own[i] for i in range(len(x)))
    length = root(sum((a * a for a in away), start=zero))
    middle = tuple((other[i] + own[i]) / 2 for i in range(len(x)))
    gap = sum(((m - c) * a for m, c, a in zip(middle, x, away, strict=True)), start=zero)
    # Of a seed and itself there is no wall.
    safe = jnp.where(length > 0, length, jnp.ones_like(length))
    return jnp.where(length > 0, gap / safe, jnp.full_like(gap, jnp.inf))
