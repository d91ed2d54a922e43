"""NumPy functions inside compiled programs, and messages from them.

Rests on `jax.interpreters.mlir.emit_python_callback` and `sorojax._jax.operations`; without
them on `jax.pure_callback`. That one copies every argument into a JAX array by a thread of
the pool that runs programs: on one core, or with as many programs under way as there are
cores, that thread is the one that waits for the callback, and the program never ends. Here
the function reads the buffers of the program itself.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sorojax._jax import operations
from sorojax._jax.optional import optional, reason

_EMIT = "jax.interpreters.mlir", "emit_python_callback"
_emit_python_callback = optional(*_EMIT)

Shape = jax.ShapeDtypeStruct


def host_call(
    function: Callable[..., Sequence[np.ndarray]],
    shapes: Sequence[Shape],
    *args: jax.Array,
    sequential: bool = False,
) -> list[Any]:
    """Arrays of `shapes` that `function` makes of NumPy views of `args`, which it may not
    keep or change, on the host.

    `function` has to be pure, NumPy only, and the same object at every call, so that equal
    programs are compiled once. Under `vmap` it gets one more leading axis in every
    argument, of length 1 where that is not mapped, and returns that of the batch; with
    `sequential` it is called for one lane after another. It has no derivative.
    """
    kinds = tuple(Shape(s.shape, s.dtype) for s in shapes)
    return _host_call(*args, function=function, shapes=kinds, sequential=sequential)


def tell_host(function: Callable[..., None], *args: Any) -> None:
    """Have `function` called with `args` when the program gets there; under `vmap` once for
    each lane."""
    jax.debug.callback(function, *args)


def _called(function: Any, shapes: Sequence[Shape], args: Any) -> list[np.ndarray]:
    found = function(*(np.asarray(x) for x in args))
    return [np.asarray(x, s.dtype).reshape(s.shape) for x, s in zip(found, shapes, strict=True)]


def _run(*args: Any, function: Any, shapes: Any, sequential: bool) -> list[Any]:
    return [jnp.asarray(x) for x in _called(function, shapes, args)]


def _by_pure_callback(*args: Any, function: Any, shapes: Any, sequential: bool) -> list[Any]:
    def on_host(*views: Any) -> tuple[np.ndarray, ...]:
        return tuple(np.asarray(x) for x in function(*(np.asarray(x) for x in views)))

    method = "sequential" if sequential else "expand_dims"
    return list(jax.pure_callback(on_host, shapes, *args, vmap_method=method))


def _lowered(ctx: Any, *args: Any, function: Any, shapes: Any, sequential: bool) -> Any:
    def on_host(*views: Any) -> tuple[np.ndarray, ...]:
        return tuple(_called(function, shapes, views))

    results, *_ = _emit_python_callback(
        ctx, on_host, None, list(args), ctx.avals_in, ctx.avals_out, has_side_effect=False
    )
    return results


def _batched(args: Any, axes: Any, *, function: Any, shapes: Any, sequential: bool) -> Any:
    size = next(x.shape[a] for x, a in zip(args, axes, strict=True) if a is not None)
    args = [x if a is None else jnp.moveaxis(x, a, 0) for x, a in zip(args, axes, strict=True)]
    if not sequential:
        wide = [Shape((size, *s.shape), s.dtype) for s in shapes]
        args = [x[None] if a is None else x for x, a in zip(args, axes, strict=True)]
        return host_call(function, wide, *args)

    def one(row: Any) -> Any:
        lane = iter(row)
        mine = [x if a is None else next(lane) for x, a in zip(args, axes, strict=True)]
        return host_call(function, shapes, *mine, sequential=True)

    return jax.lax.map(one, [x for x, a in zip(args, axes, strict=True) if a is not None])


def _shapes(*_: Any, function: Any, shapes: Any, sequential: bool) -> Sequence[Shape]:
    return shapes


_host_call = operations.operation(
    "host_call",
    operations.Rules(
        run=_run,
        stage=_by_pure_callback,
        shapes=_shapes,
        batch=_batched,
        lowering=None if _emit_python_callback is None else _lowered,
    ),
)


def status() -> str:
    """Whether callbacks read the buffers of programs, for `sorojax info`."""
    if _emit_python_callback is None:
        return f"off: {reason(*_EMIT)}"
    return operations.status()
