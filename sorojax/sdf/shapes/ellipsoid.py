"""Ellipse and ellipsoid with their exact distance."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sorojax import _check
from sorojax._types import real
from sorojax.sdf.base import EXACT, AbstractSdf, Box, Exactness, absolute, norm

_STEPS = 26


class Ellipsoid(AbstractSdf):
    """Ellipse (two `radii` [m]) or ellipsoid (three) about the origin, along the axes.

    The closest point solves one equation of a multiplier, by Newton's method on a
    convex function: from its left end it never passes the root. Points are kept 1e-9 of
    the radii off the symmetry planes (1e-5 in float32), which is the error there.
    """

    radii: Float[Array, " dim"] = eqx.field(converter=real)

    def __check_init__(self):
        _check.positive("Ellipsoid", "radii", self.radii, "m", "Give lengths above zero.")
        if jnp.shape(self.radii) not in ((2,), (3,)):
            raise ValueError(
                f"Ellipsoid: `radii` has shape {jnp.shape(self.radii)}, need (2,) for an "
                "ellipse or (3,). Give one semi-axis per coordinate."
            )

    @property
    def dim(self) -> int:
        return self.radii.shape[0]

    @property
    def exactness(self) -> Exactness:
        return EXACT

    def distance(self, *x):
        radii = tuple(self.radii[i] for i in range(self.dim))
        # Off the symmetry planes by a hair: there the multiplier sits on a pole.
        tiny = 1e-9 if x[0].dtype == jnp.float64 else 1e-5
        p = tuple(absolute(c) + tiny * r for c, r in zip(x, radii, strict=True))
        t = _multiplier(p, radii)
        foot = tuple(r * r * c / (t + r * r) for c, r in zip(p, radii, strict=True))
        slope = tuple(f / (r * r) for f, r in zip(foot, radii, strict=True))
        return t * norm(*slope)

    def bounding_box(self) -> Box:
        return -self.radii, self.radii


@jax.custom_jvp
def _multiplier(p: tuple[Array, ...], radii: tuple[Array, ...]) -> Array:
    """The t with sum (r p / (t + r^2))^2 = 1 that belongs to the closest point [m^2]."""
    # Any single term alone gives a lower end, where the excess is not negative.
    low = functools.reduce(jnp.maximum, (r * c - r * r for c, r in zip(p, radii, strict=True)))

    def step(_, t):
        value, rate = _excess(t, p, radii)
        return t - value / rate

    return jax.lax.fori_loop(0, _STEPS + 1, step, low)


@_multiplier.defjvp
def _(primals, tangents):
    t = _multiplier(*primals)
    change = jax.jvp(lambda p, radii: _excess(t, p, radii)[0], primals, tangents)[1]
    return t, -change / _excess(t, *primals)[1]


def _excess(t: Array, p: tuple[Array, ...], radii: tuple[Array, ...]) -> tuple[Array, Array]:
    """What the sum is above 1, and its slope in t."""
    terms = [(r * c / (t + r * r)) ** 2 for c, r in zip(p, radii, strict=True)]
    rates = [-2 * q / (t + r * r) for q, r in zip(terms, radii, strict=True)]
    return sum(terms[1:], start=terms[0]) - 1, sum(rates[1:], start=rates[0])
