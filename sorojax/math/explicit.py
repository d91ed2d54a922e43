"""Explicit methods for y' = f(t, y), y any pytree, with their stages written out."""

from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from sorojax._jax.small_products import with_sums
from sorojax.math.method import AbstractMethod, Field, Step


class Tableau(NamedTuple):
    """Weights of the slopes before each stage, the last row those of the step; and the
    times of the stages after the first."""

    rows: tuple[tuple[float, ...], ...]
    times: tuple[float, ...]


DORMAND_PRINCE = Tableau(
    (
        (1 / 5,),
        (3 / 40, 9 / 40),
        (44 / 45, -56 / 15, 32 / 9),
        (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
        (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
        (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
    ),
    (1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0),
)
RK4 = Tableau(
    ((1 / 2,), (0.0, 1 / 2), (0.0, 0.0, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6)), (1 / 2, 1 / 2, 1.0)
)
_TSIT5 = dfx.Tsit5.tableau
TSIT5 = Tableau(
    tuple(tuple(map(float, row)) for row in _TSIT5.a_lower), tuple(map(float, _TSIT5.c[:-1]))
)
_TSIT5_ERROR = tuple(map(float, _TSIT5.b_error))


class Tsit5(AbstractMethod):
    """Explicit method of order 5 with an estimate of order 4 and six slopes per step.

    The same steps as `diffrax.Tsit5`, without its loop over stages.

    Reference:
        Tsitouras, Runge-Kutta pairs of order 5(4), Comput. Math. Appl. 62, 2011.
    """

    num_order: ClassVar[int] = 5
    interpolation_cls: ClassVar = dfx.Tsit5.interpolation_cls

    def begin(self, field, t, y, h):
        return field(t, y)

    def advance(self, field, t, y, h, memory):
        field = with_sums(field, t, y)
        slopes = _slopes(TSIT5, field, t, y, h, memory)
        new = _moved(y, h, TSIT5.rows[-1], slopes)
        slopes.append(field(t + h, new))
        error = jax.tree.map(lambda e: h * e, _sum(_TSIT5_ERROR, slopes))
        shifts = jax.tree.map(lambda *k: h * jnp.stack(k), *slopes)
        return Step(new, error, slopes[-1], {"k": shifts})


class RungeKutta4(AbstractMethod):
    """The classical method of order 4, for fixed steps; unstable beyond h omega = 2.8."""

    num_order: ClassVar[int] = 4
    interpolation_cls: ClassVar = dfx.LocalLinearInterpolation

    def begin(self, field, t, y, h):
        return ()

    def advance(self, field, t, y, h, memory):
        return Step(explicit_step(RK4, field, t, y, h), None, (), {})


class SemiImplicitEuler(AbstractMethod):
    """Rates first, then positions with the new rates: order 1, keeps energy bounded.

    For fixed steps of systems that oscillate fast, as in contact: stable below
    h omega = 2, take h omega <= 0.3.

    Attributes:
        positions: Keys of the state whose leaves move last: of dictionaries, attributes, or
            numbers within tuples, `("0",)`.
    """

    positions: tuple[str, ...] = eqx.field(static=True, converter=tuple, default=("q",))
    num_order: ClassVar[int] = 1
    interpolation_cls: ClassVar = dfx.LocalLinearInterpolation

    def begin(self, field, t, y, h):
        return ()

    def advance(self, field, t, y, h, memory):
        def among(path: Any) -> bool:
            keys = [jax.tree_util.keystr((entry,), simple=True) for entry in path]
            return any(key in self.positions for key in keys)

        last = jax.tree_util.tree_map_with_path(lambda path, _: among(path), y)
        if not any(jax.tree.leaves(last)):
            raise ValueError(
                f"SemiImplicitEuler: no leaf of the state lies under {self.positions}. Name "
                "the keys of positions: SemiImplicitEuler(positions=(...))."
            )
        early = jax.tree.map(lambda x, k, late: x if late else x + h * k, y, field(t, y), last)
        rates = field(t, early)
        new = jax.tree.map(lambda x, k, late: x + h * k if late else x, early, rates, last)
        return Step(new, None, (), {})


def rk4_step(field: Field, t: Float[Array, ""], y: PyTree, h: Float[Array, ""]) -> Any:
    """One classical Runge-Kutta step of y' = field(t, y), order 4, any pytree."""
    return explicit_step(RK4, field, t, y, h)


def dormand_prince_step(field: Field, t: Float[Array, ""], y: PyTree, h) -> Any:
    """One Dormand-Prince step of y' = field(t, y), order 5, any pytree."""
    return explicit_step(DORMAND_PRINCE, field, t, y, h)


def explicit_step(tableau: Tableau, field: Field, t, y: PyTree, h) -> Any:
    """One step with the stages written out."""
    field = with_sums(field, t, y)
    return _moved(y, h, tableau.rows[-1], _slopes(tableau, field, t, y, h, field(t, y)))


def rolled_step(tableau: Tableau, field: Field, t, y: PyTree, h) -> Any:
    """The same step traced once, however many stages there are: slower, compiles faster."""
    rows, times = tableau
    count = len(rows)
    weights = jnp.array([(*row, *[0.0] * (count - len(row))) for row in rows], h.dtype)
    starts = jnp.array([0.0, *times], h.dtype)

    def moved(row, slopes):
        return jax.tree.map(lambda x, k: x + h * jnp.tensordot(row, k, 1), y, slopes)

    def stage(i, slopes):
        start = jnp.where(i == 0, jnp.zeros_like(starts), weights[i - 1])
        rates = field(t + starts[i] * h, moved(start, slopes))
        return jax.tree.map(
            lambda k, rate: jax.lax.dynamic_update_index_in_dim(k, rate, i, 0), slopes, rates
        )

    blank = jax.tree.map(lambda x: jnp.zeros((count, *x.shape), x.dtype), y)
    return moved(weights[-1], jax.lax.fori_loop(0, count, stage, blank))


def _slopes(tableau: Tableau, field: Field, t, y, h, first) -> list:
    slopes = [first]
    for row, time in zip(tableau.rows[:-1], tableau.times, strict=True):
        slopes.append(field(t + time * h, _moved(y, h, row, slopes)))
    return slopes


def _moved(y, h, row, slopes):
    return jax.tree.map(lambda x, total: x + h * total, y, _sum(row, slopes))


def _sum(row, slopes):
    used = [(w, k) for w, k in zip(row, slopes, strict=True) if w]

    def add(*rates):
        total = used[0][0] * rates[0]
        for (weight, _), rate in zip(used[1:], rates[1:], strict=True):
            total = total + weight * rate
        return total

    return jax.tree.map(add, *(slope for _, slope in used))
