"""Linear maps of arrays that are one operation in a trace, and so are their transposes.

Staging the operations of a derivative takes longer than a small solve. What is staged here
is one primitive; the work is done in whichever direction is asked for.
"""

from collections.abc import Sequence
from typing import Any, Protocol

import jax
import jax.core
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

Shapes = Sequence[jax.ShapeDtypeStruct | Array]


class LinearMap(Protocol):
    """A map at concrete numbers, compared by identity.

    `push` and `pull` are made of operations that JAX differentiates and batches;
    `push_at_once` and `pull_at_once` get concrete arrays.
    """

    @property
    def inputs(self) -> Shapes: ...

    @property
    def outputs(self) -> Shapes: ...

    def push(self, *rates: Any) -> Sequence[Any]: ...

    def pull(self, *changes: Any) -> Sequence[Any]: ...

    def push_at_once(self, *rates: Any) -> Sequence[Any]: ...

    def pull_at_once(self, *changes: Any) -> Sequence[Any]: ...


def pushed(rates: Sequence[Array], by: LinearMap) -> list[Array]:
    """What `by` makes of `rates`."""
    return _push_p.bind(*rates, by=by)


_push_p, _pull_p = Primitive("linear_map"), Primitive("linear_map_transpose")


def _define(primitive: Primitive, transpose: Primitive, way: str, to: str) -> None:
    primitive.multiple_results = True

    def run(*values, by):
        return list(getattr(by, f"{way}_at_once")(*values))

    def shapes(*_, by):
        return [jax.core.ShapedArray(x.shape, x.dtype) for x in getattr(by, to)]

    def derivative(primals, tangents, *, by):
        moves = map(ad.instantiate_zeros, tangents)
        return primitive.bind(*primals, by=by), primitive.bind(*moves, by=by)

    def transposed(changes, *_, by):
        return transpose.bind(*map(ad.instantiate_zeros, changes), by=by)

    def batched(values, axes, *, by):
        out = jax.vmap(getattr(by, way), axes)(*values)
        return list(out), [0] * len(out)

    def staged(*values, by):
        return list(getattr(by, way)(*values))

    primitive.def_impl(run)
    primitive.def_abstract_eval(shapes)
    ad.primitive_jvps[primitive] = derivative
    ad.primitive_transposes[primitive] = transposed
    batching.primitive_batchers[primitive] = batched
    mlir.register_lowering(primitive, mlir.lower_fun(staged, multiple_results=True))


_define(_push_p, _pull_p, "push", "outputs")
_define(_pull_p, _push_p, "pull", "inputs")
