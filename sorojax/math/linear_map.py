"""Linear maps of arrays that are one operation in a trace, and so are their transposes.

Staging the operations of a derivative takes longer than a small solve. What is staged here
is one operation; the work is done in whichever direction is asked for.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array

from sorojax._jax.operations import Rules, operation

Shapes = Sequence[jax.ShapeDtypeStruct | Array]


class LinearMap(Protocol):
    """A map at concrete numbers, compared by identity.

    `push` and `pull` are made of operations that JAX differentiates and batches; `push_now`
    and `pull_now` get concrete arrays. A map whose outputs cost much has also `onto(wanted)`,
    the map to some of them alone: where cotangents are zero, it is transposed.
    """

    @property
    def inputs(self) -> Shapes: ...

    @property
    def outputs(self) -> Shapes: ...

    def push(self, *rates: Any) -> Sequence[Any]: ...

    def pull(self, *changes: Any) -> Sequence[Any]: ...

    def push_now(self, *rates: Any) -> Sequence[Any]: ...

    def pull_now(self, *changes: Any) -> Sequence[Any]: ...


def pushed(rates: Sequence[Array], by: LinearMap) -> list[Array]:
    """The image of `rates` under `by`."""
    return _push(*rates, by=by)


def _rules(way: str, to: str, other: Callable[[], Any], this: Callable[[], Any]) -> Rules:
    """Of `way`, with results shaped as `to`, whose transpose is `other`."""

    def batch(values: Any, axes: Any, by: LinearMap) -> Any:
        return jax.vmap(getattr(by, way), axes)(*values)

    def derivative(primals: Any, tangents: Any, by: LinearMap) -> Any:
        return this()(*primals, by=by), this()(*tangents, by=by)

    def transpose(changes: Any, by: LinearMap) -> Any:
        onto, given = getattr(by, "onto", None), [c for c in changes if c is not None]
        if way == "push" and onto is not None:
            return other()(*given, by=onto([c is not None for c in changes]))
        return other()(*map(_filled, changes, getattr(by, to)), by=by)

    return Rules(
        run=lambda *values, by: getattr(by, f"{way}_now")(*values),
        stage=lambda *values, by: getattr(by, way)(*values),
        shapes=lambda *_, by: getattr(by, to),
        batch=batch,
        derivative=derivative,
        transpose=transpose,
    )


def _filled(change: Array | None, like: Any) -> Array:
    return jnp.zeros(like.shape, like.dtype) if change is None else change


_push = operation("linear_map", _rules("push", "outputs", lambda: _pull, lambda: _push))
_pull = operation(
    "linear_map_transpose", _rules("pull", "inputs", lambda: _push, lambda: _pull)
)
