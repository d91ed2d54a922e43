"""One step interface for y' = f(t, y): in loops of fixed ticks, and in diffrax."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

Time = Float[Array, ""]
Field = Callable[[Time, Any], Any]


class Step(NamedTuple):
    """What a step yields.

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
    def advance(self, field: Field, t: Time, y: PyTree, h: Time, memory: PyTree) -> Step:
        """A step of `h` from `t`."""

    @property
    def keeps(self) -> bool:
        """Whether one memory serves a whole run of fixed steps."""
        return False

    @property
    def carries(self) -> bool:
        """Whether the memory goes on through a whole run of fixed steps, as a state does.
        Such a method answers for its own failures: what it yields is finite."""
        return False

    def order(self, terms) -> int:
        return self.num_order

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def init(self, terms, t0, t1, y0, args):
        """What the first step starts from, twice: the solver keeps what its next step and
        what its last step started from, so that a run may go on from within a step."""
        now = self.begin(_field(terms, args), jnp.asarray(t0), y0, jnp.asarray(t1 - t0))
        return now, now

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        t, h = jnp.asarray(t0), jnp.asarray(t1 - t0)
        now, _ = solver_state
        if made_jump is not False:
            field = _field(terms, args)
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


def repeat(
    method: AbstractMethod,
    field: Field,
    t: Time,
    y: PyTree,
    h: Time,
    count: int,
    memory: PyTree = None,
) -> PyTree:
    """y after `count` steps of `h` from `t`, with a memory made anew if none is given."""
    return repeated(method, field, t, y, h, count, memory)[0]


def repeated(
    method: AbstractMethod,
    field: Field,
    t: Time,
    y: PyTree,
    h: Time,
    count: int,
    memory: PyTree = None,
) -> tuple[PyTree, PyTree, Array]:
    """As `repeat`, with the memory at the end and whether all steps converged; the first
    that does not is the last one taken. A method that carries its memory computes none
    after it."""
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


def _field(terms: dfx.AbstractTerm, args: Any) -> Field:
    return _Rate(terms, args)


def _advance(given, h) -> Step:
    method, terms, args, t, y, memory = given
    return method.advance(_field(terms, args), t, y, h, memory)


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
