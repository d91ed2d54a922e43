"""Rodas4: a stiff method that solves linear systems only, one matrix per step."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from sorojax.math.ode.explicit import AbstractMethod, MethodStep

_GAMMA = 0.25
_STAGES = (  # weights of the increments before, in the point where the slope is taken
    (),
    (1.544,),
    (0.9466785280815826, 0.2557011698983284),
    (3.314825187068521, 2.896124015972201, 0.9986419139977817),
    (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950),
)
_COUPLING = (  # weights of the same in the right-hand side, over h
    (),
    (-5.6688,),
    (-2.430093356833875, -0.2063599157091915),
    (-0.1073529058151375, -9.594562251023355, -20.47028614809616),
    (7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160),
    (
        8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136,
        -6.058818238834054,
    ),
)  # fmt: skip
# the last point is that before with the increment there
_POINTS = (*_STAGES, (*_STAGES[-1], 1.0))
_TIMES = (0.0, 0.386, 0.21, 0.63, 1.0, 1.0)
_TIME_SLOPES = (0.25, -0.1043, 0.1035, -0.03620000000000023, 0.0, 0.0)
_DENSE = (
    (
        10.12623508344586,
        -7.487995877610167,
        -34.80091861555747,
        -7.992771707568823,
        1.025137723295662,
    ),
    (
        -0.6762803392806898,
        6.087714651680015,
        16.43084320892478,
        24.76722511418386,
        -6.594389125716872,
    ),
)


class CubicWithin(dfx.AbstractLocalInterpolation):
    """y between the ends of a step of Rodas4, of order 3."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    y0: object
    y1: object
    bend: object
    twist: object

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return jax.tree.map(lambda b, a: b - a, self.evaluate(t1), self.evaluate(t0))
        length = self.t1 - self.t0
        x = (t0 - self.t0) / jnp.where(length == 0, jnp.ones_like(length), length)

        def between(y0, y1, bend, twist):
            return (1 - x) * y0 + x * (y1 + (1 - x) * (bend + x * twist))

        return jax.tree.map(between, self.y0, self.y1, self.bend, self.twist)


class Rodas4(AbstractMethod):
    """Rosenbrock method of order 4 with an estimate of order 3, L-stable and stiffly accurate.

    The Jacobian of the field is exact, one product with a unit vector per state; a step
    needs it once, one factorisation, six slopes and no iteration. For up to about 60 states
    with eigenvalues of very different size: regulators, valves and filters beside a body.

    Reference:
        Hairer and Wanner, Solving Ordinary Differential Equations II, 1996, section IV.7.
    """

    num_order: ClassVar[int] = 4
    interpolation_cls: ClassVar = CubicWithin

    @property
    def solves(self) -> bool:
        return True

    def begin(self, field, t, y, h):
        return ()

    def advance(self, field, t, y, h, memory):
        slope, flat, unravel = _flat(field, y)
        moves = _moves(slope, t, flat, h)
        bend, twist = (unravel(row @ moves) for row in _table(_DENSE, moves.dtype))
        new = flat + _table(_POINTS, moves.dtype)[-1] @ moves + moves[-1]
        dense = {"bend": bend, "twist": twist}
        return MethodStep(unravel(new), unravel(moves[-1]), (), dense)


def _moves(slope, t, flat: Float[Array, " n"], h) -> Float[Array, "stages n"]:
    """The increments of a step of `h`, with the rate traced twice: compiles in half the time
    of stages written out."""
    points, couplings = _table(_POINTS, flat.dtype), _table(_COUPLING, flat.dtype)
    times, shares = jnp.array(_TIMES, flat.dtype), jnp.array(_TIME_SLOPES, flat.dtype)
    size = flat.shape[0]

    def column(direction):
        return jax.jvp(slope, (t, flat), (direction[0], direction[1:]))[1]

    columns = jax.vmap(column)(jnp.eye(size + 1, dtype=flat.dtype))
    drift, jacobian = columns[0], columns[1:].T
    # a step of no length stays where it is, in value and in derivative
    length = jnp.where(h == 0, jnp.ones_like(h), h)
    # six products with an inverse are cheaper than six solves
    inverse = jnp.linalg.inv(jnp.eye(size, dtype=flat.dtype) / (_GAMMA * length) - jacobian)
    solve = jnp.where(h == 0, jnp.zeros_like(inverse), inverse)

    def stage(k, moves):
        right = (
            slope(t + times[k] * h, flat + points[k] @ moves) + couplings[k] @ moves / length
        )
        move = solve @ (right + h * shares[k] * drift)
        return jax.lax.dynamic_update_index_in_dim(moves, move, k, 0)

    none = jnp.zeros((len(_POINTS), size), flat.dtype)
    return jax.lax.fori_loop(0, len(_POINTS), stage, none)


def _table(rows, dtype) -> Float[Array, "rows stages"]:
    """The same with zeros behind each row."""
    return jnp.array([(*row, *[0.0] * (len(_POINTS) - len(row))) for row in rows], dtype)


def _flat(field, y) -> tuple[Callable[[Any, Array], Array], Array, Callable[[Array], Any]]:
    """The field of states as vectors, `y` as a vector, and what makes a tree of one."""
    flat, unravel = ravel_pytree(y)

    def slope(t, x):
        return ravel_pytree(field(t, unravel(x)))[0]

    return slope, flat, unravel


# Fixed steps of stiff systems at the price of two slopes and one small product each


_GAMMA_OF_ORDER_2 = 1 - 2**-0.5


class Rosenbrock2(AbstractMethod):
    """Method of order 2 for fixed steps, whose Jacobian may be old.

    The order holds for any matrix, the stability for a matrix near the Jacobian: it is taken
    once at the start of a run, which suits rods (constant stiffness and damping in their
    coordinates) with slow changes of inertia, or at every saved instant or tick. With the
    Jacobian of its own step the method is L-stable.

    Attributes:
        refresh: Take a new Jacobian at every saved instant or tick of a controller.

    Reference:
        Verwer, Spee, Blom, Hundsdorfer, A second-order Rosenbrock method applied to
        photochemical dispersion problems, SIAM J. Sci. Comput. 20, 1999.
    """

    refresh: bool = eqx.field(static=True, default=False)
    num_order: ClassVar[int] = 2
    interpolation_cls: ClassVar = dfx.LocalLinearInterpolation

    @property
    def keeps(self) -> bool:
        return not self.refresh

    def begin(self, field, t, y, h):
        slope, flat, _ = _flat(field, y)
        jacobian = jax.jacfwd(lambda x: slope(t, x))(flat)
        eye = jnp.eye(flat.shape[0], dtype=flat.dtype)
        return jnp.linalg.inv(eye - _GAMMA_OF_ORDER_2 * h * jacobian)

    def advance(self, field, t, y, h, memory):
        slope, flat, unravel = _flat(field, y)
        first = memory @ slope(t, flat)
        second = memory @ (slope(t + h, flat + h * first) - 2 * first)
        return MethodStep(unravel(flat + h * (1.5 * first + 0.5 * second)), None, memory, {})
