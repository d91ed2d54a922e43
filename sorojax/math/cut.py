"""Steps that may fail: halved until they converge, and grown again afterwards."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from sorojax.math.method import finite
from sorojax.math.told import any_of_lanes

#: (given, offset, size, state) -> state after a step of `size` at `offset`, converged or not.
Attempt = Callable[[Any, Array, Array, PyTree], tuple[PyTree, Bool[Array, ""]]]

_ROWS = 32  # parts of a step at most


class _Walk(NamedTuple):
    """A step on its way: what is done of it, in parts whose ends `ends` holds."""

    state: PyTree
    done: Float[Array, ""]
    share: Float[Array, ""]
    failures: Int[Array, ""]
    row: Int[Array, ""]
    ends: Float[Array, " rows"]
    running: Bool[Array, ""]


@eqx.filter_custom_jvp
def cut(
    attempt: Attempt, max_cuts: int, given: PyTree, h: Float[Array, ""], state: PyTree
) -> tuple[PyTree, Bool[Array, ""]]:
    """The state after a step of `h`, taken in parts where it does not converge whole.

    A part that fails is halved, at most `max_cuts` times in a row, and parts grow again
    afterwards. A part that did not converge is never accepted: where the end is not reached
    the state before the step comes back, and False.

    Derivatives are those of the parts that were taken, as if chosen beforehand. `attempt`
    closes over nothing that is differentiated.
    """
    walk = _walked(attempt, max_cuts, given, h, state)
    return _held(walk, walk.state, state)


@cut.def_jvp
def _cut_jvp(primals, tangents):
    attempt, max_cuts, given, h, state = primals

    def whole(given, h, state):
        return attempt(given, jnp.zeros_like(h), h, state)

    (new, converged), (moved, _) = eqx.filter_jvp(whole, primals[2:], tangents[2:])
    fine = _fine(new, converged)

    def in_parts():
        walk = _walked(attempt, max_cuts, given, h, state)
        ends = jax.lax.stop_gradient(walk.ends)

        def replayed(given, h, state):
            return _replay(attempt, ends, given, h, state)

        moved = eqx.filter_jvp(replayed, primals[2:], tangents[2:])[1]
        reached = walk.done >= 1.0
        kept = jax.tree.map(lambda a: jnp.where(reached, a, jnp.zeros_like(a)), moved)
        return _held(walk, walk.state, state), kept

    # most steps are whole, whose derivative needs no replay
    return_whole = (new, fine), moved
    values, moved = jax.lax.cond(any_of_lanes(~fine), in_parts, lambda: return_whole)
    return values, (moved, None)


def filled(values: PyTree, tangents: PyTree) -> PyTree:
    """Tangents of `values`, zeros where there is none."""

    def one(value, tangent):
        return jnp.zeros_like(value) if tangent is None else tangent

    return jax.tree.map(one, values, tangents, is_leaf=lambda x: x is None)


def _fine(new: PyTree, converged: Bool[Array, ""]) -> Bool[Array, ""]:
    return converged & finite(eqx.filter(new, eqx.is_inexact_array))


def _held(walk: _Walk, new: PyTree, old: PyTree):
    reached = walk.done >= 1.0
    return jax.tree.map(lambda a, b: jnp.where(reached, a, b), new, old), reached


def _walked(attempt: Attempt, max_cuts: int, given, h, state) -> _Walk:
    def one_pass(walk: _Walk) -> _Walk:
        new, converged = attempt(given, walk.done * h, walk.share * h, walk.state)
        fine = _fine(new, converged)
        end = walk.done + walk.share
        wide = 2 * walk.share
        grows = (wide <= 1.0) & (jnp.remainder(end, wide) == 0.0)
        accepted = _Walk(
            new, end, jnp.where(grows, wide, walk.share), jnp.zeros_like(walk.failures),
            walk.row + 1, walk.ends.at[walk.row].set(end),
            (end < 1.0) & (walk.row + 1 < _ROWS),
        )  # fmt: skip
        halved = walk._replace(
            share=walk.share / 2, failures=walk.failures + 1, running=walk.failures < max_cuts
        )
        return jax.tree.map(lambda a, b: jnp.where(fine, a, b), accepted, halved)

    zero, none = jnp.zeros_like(h), jnp.zeros((), jnp.int32)
    ends = jnp.zeros(_ROWS, h.dtype)
    begin = _Walk(state, zero, zero + 1, none, none, ends, jnp.array(True))
    return jax.lax.while_loop(lambda walk: walk.running, one_pass, begin)


def _replay(attempt: Attempt, ends, given, h, state) -> PyTree:
    """The parts of a walk again, in a loop of known length."""
    starts = jnp.concatenate([jnp.zeros_like(ends[:1]), ends[:-1]])

    def one(state, part):
        start, end = part

        def taken(state):
            return attempt(given, start * h, (end - start) * h, state)[0]

        return jax.lax.cond(end > start, taken, lambda state: state, state), None

    # only the states between the parts are kept for a derivative in reverse
    part = jax.checkpoint(one, prevent_cse=False)  # pyright: ignore[reportPrivateImportUsage]
    return jax.lax.scan(part, state, (starts, ends))[0]
