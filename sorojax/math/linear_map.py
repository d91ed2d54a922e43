"""Linear maps of arrays that are one operation in a trace, and so are their transposes.

Staging the operations of a derivative takes longer than a small solve. What is staged here
is one operation; the work is done in whichever direction is asked for.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sorojax._jax.operations import Rules, operation
from sorojax._types import from_host

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


Parts = Callable[..., Sequence[Any]]


class OnHost:
    """A linear function as a `LinearMap`: by JAX where it is `staged`, else by NumPy, without
    a program that would be compiled for longer than it runs.

    Args:
        staged: The function, of JAX.
        there, back: It and its transpose, of NumPy.
        given: What has the shapes of its arguments.
        found: The shapes of its results, of the first argument's type.
    """

    def __init__(self, staged: Parts, there: Parts, back: Parts, given: Any, found: Any):
        self.push, self._there, self._back = staged, there, back
        self.inputs = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in given]
        self.outputs = [jax.ShapeDtypeStruct(shape, given[0].dtype) for shape in found]

    def pull(self, *changes: Any) -> Sequence[Any]:
        def listed(*rates: Any) -> list[Any]:
            return list(self.push(*rates))

        return jax.linear_transpose(listed, *self.inputs)(list(changes))

    def push_now(self, *rates: Any) -> list[Array]:
        return [from_host(x) for x in self._there(*map(np.asarray, rates))]

    def pull_now(self, *changes: Any) -> list[Array]:
        return [from_host(x) for x in self._back(*map(np.asarray, changes))]


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
