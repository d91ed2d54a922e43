"""Operations of our own in JAX programs.

Rests on `jax.extend.core.Primitive`, `jax.core.ShapedArray` and the tables of rules in
`jax.interpreters`. Without them JAX sees the operations that `stage` is made of: the same
numbers, from programs that are larger.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from sorojax._jax.optional import every
from sorojax._jax.trace_state import is_traced

_found, _status = every(
    ("jax.extend.core", "Primitive"),
    ("jax.core", "ShapedArray"),
    ("jax.interpreters.ad", "Zero"),
    ("jax.interpreters.ad", "instantiate_zeros"),
    ("jax.interpreters.ad", "primitive_jvps"),
    ("jax.interpreters.ad", "primitive_transposes"),
    ("jax.interpreters.batching", "primitive_batchers"),
    ("jax.interpreters.mlir", "lower_fun"),
    ("jax.interpreters.mlir", "register_lowering"),
)


class Rules(NamedTuple):
    """An operation by its functions; each gets the arrays, and the parameters by name.

    Attributes:
        run: Its results for concrete arrays, at once.
        stage: The same by operations of JAX, for compiled programs.
        shapes: Shapes and dtypes of the results.
        batch: Gets the arrays and the axis along which each is mapped (`None`: not at all),
            answers results that are mapped along their first axis.
        derivative: Gets the arrays and their tangents, answers results and their tangents.
            Without it the operation has no derivative.
        transpose: Gets the cotangents of the results (`None` for zeros, where JAX knows),
            answers those of the arrays; for operations that are linear in all their arrays.
        lowering: A rule of MLIR in place of `stage`, which is then the fallback.
    """

    run: Callable[..., Sequence[Any]]
    stage: Callable[..., Sequence[Any]]
    shapes: Callable[..., Sequence[jax.ShapeDtypeStruct]]
    batch: Callable[..., Sequence[Any]]
    derivative: Callable[..., tuple[Sequence[Any], Sequence[Any]]] | None = None
    transpose: Callable[..., Sequence[Any]] | None = None
    lowering: Callable[..., Any] | None = None


def operation(name: str, rules: Rules) -> Callable[..., list[Any]]:
    """A function of arrays and hashable parameters that is one operation in every trace."""
    return _primitive(name, rules) if _status == "on" else _public(rules)


def _public(rules: Rules) -> Callable[..., list[Any]]:
    def call(*arrays: Any, **params: Any) -> list[Any]:
        if is_traced(arrays) or is_traced(jnp.zeros(())):
            return list(rules.stage(*arrays, **params))
        # a thread of its own is outside of the transformation that this may be inside of
        with ThreadPoolExecutor(1) as pool:
            return list(pool.submit(rules.run, *arrays, **params).result())

    return call


def _primitive(name: str, rules: Rules) -> Callable[..., list[Any]]:
    one, with_zeros = _found["Primitive"](name), _found["instantiate_zeros"]
    one.multiple_results = True
    one.def_impl(lambda *arrays, **params: list(rules.run(*arrays, **params)))

    @one.def_abstract_eval
    def _(*arrays: Any, **params: Any) -> list[Any]:
        shapes = rules.shapes(*arrays, **params)
        return [_found["ShapedArray"](s.shape, s.dtype) for s in shapes]

    def batched(arrays: Any, axes: Any, **params: Any) -> Any:
        found = list(rules.batch(arrays, axes, **params))
        return found, [0] * len(found)

    def moved(primals: Any, tangents: Any, **params: Any) -> Any:
        return rules.derivative(primals, [with_zeros(t) for t in tangents], **params)  # type: ignore[misc]

    def transposed(changes: Any, *_: Any, **params: Any) -> Any:
        given = [None if isinstance(c, _found["Zero"]) else c for c in changes]
        return rules.transpose(given, **params)  # type: ignore[misc]

    _found["primitive_batchers"][one] = batched
    if rules.derivative is not None:
        _found["primitive_jvps"][one] = moved
    if rules.transpose is not None:
        _found["primitive_transposes"][one] = transposed
    _lower(one, rules)
    return one.bind


def _lower(one: Any, rules: Rules) -> None:
    if rules.lowering is not None:
        _found["register_lowering"](one, rules.lowering, cacheable=False)
        return

    def staged(*arrays: Any, **params: Any) -> list[Any]:
        return list(rules.stage(*arrays, **params))

    _found["register_lowering"](one, _found["lower_fun"](staged, multiple_results=True))


def status() -> str:
    """Whether operations are primitives, for `sorojax info`."""
    return _status
