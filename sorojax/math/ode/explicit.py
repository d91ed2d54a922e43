"""The interface of one step for y' = f(t, y), y any pytree, in loops of fixed ticks and in
diffrax, and explicit Runge-Kutta methods with their stages written out.
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from sorojax._jax.small_products import with_sums

Time = Float[Array, ""]
Field = Callable[[Time, Any], Any]


class MethodStep(NamedTuple):
    """Result of a step.

    Attributes:
        y: The state after it.
        error: Estimate of its error, of the structure of y; None where a method has none.
        memory: What the next step may start from.
        dense: What the interpolation within the step needs.
        converged: Whether equations were solved, in a method that has some to solve. Where
            they were not, y is the state before the step.
    """

    y: PyTree
    error: PyTree | None
    memory: PyTree
    dense: dict[str, PyTree]
    converged: Any = True


class AbstractMethod(dfx.AbstractSolver):
    """A one-step method, used in two ways.

    In a loop of one's own: `method.advance(field, t, y, h, method.begin(field, t, y))`.
    As the `solver` of `diffrax.diffeqsolve`: there a step that meets NaN is rejected, and
    leaves no NaN in derivatives either.
    """

    num_order: eqx.AbstractClassVar[int]
    term_structure: ClassVar = dfx.AbstractTerm

    @abc.abstractmethod
    def begin(self, field: Field, t: Time, y: PyTree, h: Time) -> PyTree:
        """Memory before a first step of `h`, or after a jump of the field."""

    @abc.abstractmethod
    def advance(self, field: Field, t: Time, y: PyTree, h: Time, memory: PyTree) -> MethodStep:
        """A step of `h` from `t`."""

    def again(self, field: Field, t: Time, y: PyTree, h: Time) -> tuple[MethodStep, PyTree]:
        """A step for the programs of derivatives, which compiles fast, and the memory that it
        started from."""
        memory = self.begin(field, t, y, h)
        return self.advance(field, t, y, h, memory), memory

    @property
    def solves(self) -> bool:
        """Whether a step factors a matrix."""
        return False

    @property
    def keeps(self) -> bool:
        """Whether one memory serves a whole run of fixed steps."""
        return False

    @property
    def carries(self) -> bool:
        """Whether the memory goes on through a whole run of fixed steps, as a state does.
        Such a method answers for its own failures: what it yields is finite."""
        return False

    @property
    def takes_vector(self) -> bool:
        """Whether the state of a run may come as one vector, which makes fewer and larger
        kernels: not to a method that looks at the names within it."""
        return not self.carries

    def order(self, terms) -> int:
        return self.num_order

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def init(self, terms, t0, t1, y0, args):
        """The start of the first step, twice: the solver keeps what its next step and
        what its last step started from, so that a run may go on from within a step."""
        now = self.begin(_Rate(terms, args), jnp.asarray(t0), y0, jnp.asarray(t1 - t0))
        return now, now

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        t, h = jnp.asarray(t0), jnp.asarray(t1 - t0)
        now, _ = solver_state
        if made_jump is not False:
            field = _Rate(terms, args)
            now = jax.lax.cond(
                made_jump, lambda: self.begin(field, t, y0, h), lambda: solver_state[0]
            )
        new = guarded(_advance, (self, terms, args, t, y0, now), h)
        dense = {"y0": y0, "y1": new.y} | new.dense
        if new.converged is True:
            return new.y, new.error, dense, (new.memory, now), dfx.RESULTS.successful
        failed: dfx.RESULTS = dfx.RESULTS.nonlinear_divergence  # type: ignore[assignment]
        ended = dfx.RESULTS.where(new.converged, dfx.RESULTS.successful, failed)
        return new.y, new.error, dense, (new.memory, now), ended


class Again(AbstractMethod):
    """`method` by the steps that compile fast."""

    method: AbstractMethod

    @property
    def num_order(self) -> int:
        return self.method.num_order

    @property
    def interpolation_cls(self):
        return self.method.interpolation_cls

    def begin(self, field, t, y, h):
        return self.method.begin(field, t, y, h)

    def advance(self, field, t, y, h, memory):
        return self.method.again(field, t, y, h)[0]


def repeated(
    method: AbstractMethod,
    field: Field,
    t: Time,
    y: PyTree,
    h: Time,
    count: int,
    memory: PyTree = None,
) -> tuple[PyTree, PyTree, Array]:
    """y after `count` steps of `h` from `t`, with a memory made anew if none is given, the
    memory at the end, and whether all steps converged; the first that does not is the last one
    taken. A method that carries its memory computes none after it."""
    memory = method.begin(field, t, y, h) if memory is None else memory

    def one(k, carry):
        y, memory, good = carry
        new = method.advance(field, t + k.astype(h.dtype) * h, y, h, memory)
        if new.converged is True:
            return new.y, new.memory, good
        fine = good & new.converged
        taken = jax.tree.map(
            lambda a, b: jnp.where(fine, a, b), (new.y, new.memory), (y, memory)
        )
        return (*taken, fine)

    def next_one(k, carry):
        if not method.carries:
            return one(k, carry)
        return jax.lax.cond(carry[-1], one, lambda _, held: held, k, carry)

    return jax.lax.fori_loop(0, count, next_one, (y, memory, jnp.array(True)))


def finite(tree: PyTree) -> Array:
    """Whether every number in `tree` is finite."""
    leaves = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]
    return jnp.all(jnp.stack(leaves)) if leaves else jnp.array(True)


class _Rate(eqx.Module):
    """The field of diffrax terms, with all that it depends on as leaves."""

    terms: dfx.AbstractTerm
    args: Any

    def __call__(self, t, y):
        return self.terms.vf(t, y, self.args)


def _advance(given, h) -> MethodStep:
    method, terms, args, t, y, memory = given
    return method.advance(_Rate(terms, args), t, y, h, memory)


@eqx.filter_custom_jvp
def guarded(move: Callable[[Any, Time], Any], given: PyTree, h: Time) -> Any:
    """`move(given, h)`; where it is not finite, with the derivatives of a move of no length.

    Such a move is thrown away, so its derivatives are multiplied by zero, which would not
    help if they were NaN. `move` closes over nothing that is differentiated.
    """
    return move(given, h)


@guarded.def_jvp
def _guarded_jvp(primals, tangents):
    move, given, h = primals
    plain = move(given, h)
    safe_h = jnp.where(finite(eqx.filter(plain, eqx.is_inexact_array)), h, jnp.zeros_like(h))
    tangents = eqx.filter_jvp(move, (given, safe_h), tangents[1:])[1]
    return plain, tangents


# Explicit methods for y' = f(t, y), y any pytree, with their stages written out


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
        return MethodStep(new, error, slopes[-1], {"k": shifts})

    def again(self, field, t, y, h):
        new, slopes = _rolled(TSIT5, field, t, y, h, stages=len(TSIT5.rows) + 1)
        weights = jnp.array(_TSIT5_ERROR, h.dtype)
        error = jax.tree.map(lambda k: h * jnp.tensordot(weights, k, 1), slopes)
        shifts = jax.tree.map(lambda k: h * k, slopes)
        first = jax.tree.map(lambda k: k[0], slopes)
        last = jax.tree.map(lambda k: k[-1], slopes)
        return MethodStep(new, error, last, {"k": shifts}), first


class RungeKutta4(AbstractMethod):
    """The classical method of order 4, for fixed steps; unstable beyond h omega = 2.8."""

    num_order: ClassVar[int] = 4
    interpolation_cls: ClassVar = dfx.LocalLinearInterpolation

    def begin(self, field, t, y, h):
        return ()

    def advance(self, field, t, y, h, memory):
        return MethodStep(explicit_step(RK4, field, t, y, h), None, (), {})


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

    @property
    def takes_vector(self) -> bool:
        return False

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
        return MethodStep(new, None, (), {})


def explicit_step(tableau: Tableau, field: Field, t, y: PyTree, h) -> Any:
    """One step with the stages written out."""
    field = with_sums(field, t, y)
    return _moved(y, h, tableau.rows[-1], _slopes(tableau, field, t, y, h, field(t, y)))


def rolled_step(tableau: Tableau, field: Field, t, y: PyTree, h) -> Any:
    """The same step traced once, however many stages there are: slower, compiles faster."""
    return _rolled(tableau, field, t, y, h, stages=len(tableau.rows))[0]


def _rolled(tableau: Tableau, field: Field, t, y: PyTree, h, stages: int) -> tuple[Any, Any]:
    """The state after a step, and the slopes of its stages, of which one more is at its end."""
    rows, times = tableau
    weights = jnp.array([(*row, *[0.0] * (stages - len(row))) for row in rows], h.dtype)
    starts = jnp.array([0.0, *times, 1.0], h.dtype)

    def moved(row, slopes):
        return jax.tree.map(lambda x, k: x + h * jnp.tensordot(row, k, 1), y, slopes)

    def stage(i, slopes):
        start = jnp.where(i == 0, jnp.zeros_like(starts[:stages]), weights[i - 1])
        rates = field(t + starts[i] * h, moved(start, slopes))
        return jax.tree.map(
            lambda k, rate: jax.lax.dynamic_update_index_in_dim(k, rate, i, 0), slopes, rates
        )

    blank = jax.tree.map(lambda x: jnp.zeros((stages, *x.shape), x.dtype), y)
    slopes = jax.lax.fori_loop(0, stages, stage, blank)
    return moved(weights[-1], slopes), slopes


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
