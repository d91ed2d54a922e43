"""Matrix products of a few numbers as sums, which a compiler joins with what is around them.

A product of its own is a kernel of its own, and so is each of its factors: of the step of a
network with a dozen states that is a quarter of the time.

Rests on `jax.extend.core.Primitive` and `ClosedJaxpr`, on `jax.core.eval_jaxpr` and on the
tables of rules in `jax.interpreters`. Without them products stay as they are.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from sorojax._jax.optional import every
from sorojax._jax.trace_state import outside_transformations

LARGEST = 36  # multiplications in a product
LARGEST_BATCH = 128  # in all lanes: beyond that, factors computed again cost more
# Calls, and where their program is.
_INLINED = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vmap_call": "call",
}

_found, _status = every(
    ("jax.extend.core", "Primitive"),
    ("jax.extend.core", "ClosedJaxpr"),
    ("jax.core", "ShapedArray"),
    ("jax.core", "eval_jaxpr"),
    ("jax.interpreters.ad", "primitive_jvps"),
    ("jax.interpreters.batching", "primitive_batchers"),
    ("jax.interpreters.mlir", "lower_fun"),
    ("jax.interpreters.mlir", "register_lowering"),
)


def with_sums(field: Any, *args: Any) -> Any:
    """`field`, for arguments like `args`, with its small products written as sums.

    It is traced once for all its calls; run operation by operation, it stays as it is.
    """
    if _status != "on" or outside_transformations():
        return field
    closed, shapes = jax.make_jaxpr(field, return_shape=True)(*args)
    program = _with_sums(closed.jaxpr)
    form = jax.tree.structure(shapes)

    def summed(*args: Any) -> Any:
        leaves = _found["eval_jaxpr"](program, closed.consts, *jax.tree.leaves(args))
        return jax.tree.unflatten(form, leaves)

    return summed


def _with_sums(jaxpr: Any) -> Any:
    """The program with small products replaced; itself where it has none."""
    equations = [_replaced(equation) for equation in jaxpr.eqns]
    if all(new is old for new, old in zip(equations, jaxpr.eqns, strict=True)):
        return jaxpr
    return jaxpr.replace(eqns=equations)


def _replaced(equation: Any) -> Any:
    name, params = equation.primitive.name, equation.params
    if name == "dot_general" and _is_small(*(var.aval for var in equation.invars), **params):
        return equation.replace(primitive=product_p)
    if name in _INLINED:
        where = _INLINED[name]
        inner = _with_sums(params[where].jaxpr)
        if inner is not params[where].jaxpr:
            closed = _found["ClosedJaxpr"](inner, params[where].consts)
            return equation.replace(params=params | {where: closed})
    return equation


def _is_small(a, b, *, dimension_numbers, preferred_element_type, out_sharding, **_) -> bool:
    plain = preferred_element_type in (None, a.dtype) and out_sharding is None
    real = a.dtype == b.dtype and jnp.issubdtype(a.dtype, jnp.floating)
    return plain and real and 0 < multiplications(a, b, dimension_numbers) <= LARGEST


def multiplications(a: Any, b: Any, dimension_numbers: Any) -> int:
    """Of a product, by the shapes of its factors."""
    (_, summed), (_, shared) = dimension_numbers
    return a.size * math.prod(b.shape[axis] for axis in _free(b, summed, shared))


def as_sum(a: Array, b: Array, *, dimension_numbers, **_: Any) -> Array:
    """`jax.lax.dot_general` by an elementwise product and a sum."""
    (summed_a, summed_b), (shared_a, shared_b) = dimension_numbers
    free_a, free_b = _free(a, summed_a, shared_a), _free(b, summed_b, shared_b)
    a = jnp.transpose(a, (*shared_a, *free_a, *summed_a))
    b = jnp.transpose(b, (*shared_b, *free_b, *summed_b))
    shared = len(shared_a)
    b = jnp.expand_dims(b, range(shared, shared + len(free_a)))
    a = jnp.expand_dims(a, range(shared + len(free_a), shared + len(free_a) + len(free_b)))
    return jnp.sum(a * b, axis=tuple(range(a.ndim - len(summed_a), a.ndim)))


def _free(x: Any, *axes: tuple[int, ...]) -> list[int]:
    return [k for k in range(x.ndim) if not any(k in some for some in axes)]


def _in_lanes(values, axes, *, dimension_numbers, **params):
    (a, b), (axis_a, axis_b) = values, axes
    (summed_a, summed_b), (shared_a, shared_b) = dimension_numbers
    both = None not in axes
    summed_a, shared_a = _beside(axis_a, summed_a, shared_a, both)
    summed_b, shared_b = _beside(axis_b, summed_b, shared_b, both)
    free_a, free_b = _free(a, summed_a, shared_a), _free(b, summed_b, shared_b)
    if axis_a is None:
        lane = len(shared_a) + len(free_a) + free_b.index(axis_b)
    else:
        lane = [*shared_a, *free_a].index(axis_a)
    numbers = (summed_a, summed_b), (shared_a, shared_b)
    few = multiplications(a, b, numbers) <= LARGEST_BATCH
    product = product_p if few else jax.lax.dot_general_p
    return product.bind(a, b, dimension_numbers=numbers, **params), lane


def _beside(lane: Any, summed: Any, shared: Any, both: bool) -> Any:
    """The axes of an array that has one more, which the other factor may have too."""
    if lane is None:
        return summed, shared
    summed, shared = (tuple(k + (k >= lane) for k in axes) for axes in (summed, shared))
    return summed, (lane, *shared) if both else shared


def _primitive() -> Any:
    one, dot = _found["Primitive"]("small_product"), jax.lax.dot_general_p
    one.def_impl(dot.bind)

    @one.def_abstract_eval
    def _(a: Any, b: Any, **params: Any) -> Any:
        found = jax.eval_shape(lambda a, b: dot.bind(a, b, **params), a, b)
        return _found["ShapedArray"](found.shape, found.dtype)

    _found["primitive_jvps"][one] = _found["primitive_jvps"][dot]
    _found["primitive_batchers"][one] = _in_lanes
    _found["register_lowering"](one, _found["lower_fun"](as_sum, multiple_results=False))
    return one


product_p: Any = _primitive() if _status == "on" else None


def status() -> str:
    """Whether small products become sums, for `sorojax info`."""
    return _status
