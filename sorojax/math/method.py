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
    """

    y: PyTree
    error: PyTree | None
    memory: PyTree
    dense: dict[str, PyTree]


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

    def order(self, terms) -> int:
        return self.num_order

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def init(self, terms, t0, t1, y0, args):
        return self.begin(_field(terms, args), jnp.asarray(t0), y0, jnp.asarray(t1 - t0))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        t, h = jnp.asarray(t0), jnp.asarray(t1 - t0)
        memory = solver_state
        if made_jump is not False:
            field = _field(terms, args)
            memory = jax.lax.cond(
                made_jump, lambda: self.begin(field, t, y0, h), lambda: solver_state
            )
        new = guarded(_advance, (self, terms, args, t, y0, memory), h)
        dense = {"y0": y0, "y1": new.y} | new.dense
        return new.y, new.error, dense, new.memory, dfx.RESULTS.successful


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
    memory = method.begin(field, t, y, h) if memory is None else memory

    def one(k, carry):
        y, memory = carry
        new = method.advance(field, t + k.astype(h.dtype) * h, y, h, memory)
        return new.y, new.memory

    return jax.lax.fori_loop(0, count, one, (y, memory))[0]


def finite(tree: PyTree) -> Array:
    """Whether every number in `tree` is finite."""
    leaves = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]
    return jnp.all(jnp.stack(leaves)) if leaves else jnp.array(True)


def _field(terms: dfx.AbstractTerm, args: Any) -> Field:
    return lambda t, y: terms.vf(t, y, args)


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
