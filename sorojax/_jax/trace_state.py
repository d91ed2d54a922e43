"""The state of tracing: which values are abstract, whether a transformation runs.

Rests on `jax.core.Tracer`, `jax.core.eval_context`,
`jax.extend.core.get_opaque_trace_state`, and what a lane of `jax.vmap` calls its batch, `val`.
"""

import contextlib
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sorojax._jax.optional import optional, reason

_STATE = "jax.extend.core", "get_opaque_trace_state"
_tracer = optional("jax.core", "Tracer")
_eval_context = optional("jax.core", "eval_context")
_state = optional(*_STATE)


def is_tracer(value: Any) -> bool:
    """Whether `value` is an abstract value of a JAX transformation."""
    if _tracer is not None:
        return isinstance(value, _tracer)
    return isinstance(value, jax.Array) and not isinstance(value, _concrete())


@functools.cache
def _concrete() -> tuple[type, ...]:
    """The classes of concrete arrays."""
    with jax.ensure_compile_time_eval():
        return type(jnp.zeros(())), type(jax.random.key(0))


def is_traced(tree: Any) -> bool:
    """Whether any leaf of `tree` is an abstract value of a JAX transformation."""
    return any(is_tracer(leaf) for leaf in jax.tree.leaves(tree))


def are_lanes(values: Sequence[Any]) -> bool:
    """Whether tracers are lanes of `jax.vmap` alone, outside of other transformations."""
    lane = _lane()
    whole = [x.val if isinstance(x, lane) and hasattr(x, "val") else x for x in values]
    return not any(is_tracer(x) for x in whole)


@functools.cache
def _lane() -> type:
    """The class of a lane in `jax.vmap`."""
    found: list[type] = []
    jax.vmap(lambda x: found.append(type(x)) or x)(np.zeros(1))
    return found[0]


def outside_transformations() -> bool:
    """Whether no transformation of JAX runs here; `False` where that cannot be known."""
    return _state is not None and _state(convention="flax") == _OUTSIDE


_OUTSIDE = None if _state is None else _state(convention="flax")


def evaluated_now(*trees: Any) -> contextlib.AbstractContextManager[Any]:
    """A context in which operations run at once, under every trace, where no leaf of `trees`
    is traced; what is around them is otherwise left alone.

    Without it, what a derivative computes of concrete numbers is staged with it.
    """
    if is_traced(trees):
        return contextlib.nullcontext()
    if _eval_context is not None:
        return _eval_context()
    return jax.ensure_compile_time_eval()


def called_as_outside(*trees: Any) -> contextlib.AbstractContextManager[Any]:
    """`evaluated_now` for calls of compiled programs, which are then those compiled outside a
    derivative; no context where JAX has `ensure_compile_time_eval` alone, under which checks
    of Equinox within a program raise without cause."""
    return evaluated_now(*trees) if _eval_context is not None else contextlib.nullcontext()


def status() -> str:
    """Whether it is known that no transformation runs, for `sorojax info`."""
    return "on" if _state is not None else f"off: {reason(*_STATE)}"
