"""NumPy functions inside compiled programs.

`jax.pure_callback` copies every argument into a JAX array by a thread of the pool that
runs programs. On one core, or with as many programs under way as there are cores, that
thread is the one that waits for the callback, and the program never ends. Here the
function reads the buffers of the program itself.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

_host_call_p = Primitive("host_call")
_host_call_p.multiple_results = True


def host_call(
    function: Callable[..., Sequence[np.ndarray]],
    shapes: Sequence[jax.ShapeDtypeStruct],
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
    avals = tuple(jax.core.ShapedArray(s.shape, s.dtype) for s in shapes)
    return _host_call_p.bind(
        *args, function=function, avals=avals, sequential=sequential
    )  # fmt: skip


def _called(function, avals, args) -> list[np.ndarray]:
    found = function(*(np.asarray(x) for x in args))
    return [np.asarray(x, a.dtype).reshape(a.shape) for x, a in zip(found, avals, strict=True)]


@_host_call_p.def_impl
def _at_once(*args, function, avals, sequential):
    return [jnp.asarray(x) for x in _called(function, avals, args)]


@_host_call_p.def_abstract_eval
def _shapes(*args, function, avals, sequential):
    return list(avals)


def _lower(ctx, *args, function, avals, sequential):
    def on_host(*views):
        return tuple(_called(function, avals, views))

    results, *_ = mlir.emit_python_callback(
        ctx, on_host, None, list(args), ctx.avals_in, ctx.avals_out, has_side_effect=False
    )
    return results


mlir.register_lowering(_host_call_p, _lower, cacheable=False)


def _batch(args, axes, *, function, avals, sequential):
    size = next(x.shape[a] for x, a in zip(args, axes, strict=True) if a is not None)
    args = [x if a is None else jnp.moveaxis(x, a, 0) for x, a in zip(args, axes, strict=True)]
    if sequential:
        rows = [x for x, a in zip(args, axes, strict=True) if a is not None]

        def one(row):
            lane = iter(row)
            mine = [x if a is None else next(lane) for x, a in zip(args, axes, strict=True)]
            return host_call(function, avals, *mine, sequential=True)

        out = jax.lax.map(one, rows)
    else:
        wide = [jax.ShapeDtypeStruct((size, *a.shape), a.dtype) for a in avals]
        args = [x[None] if a is None else x for x, a in zip(args, axes, strict=True)]
        out = host_call(function, wide, *args)
    return out, [0] * len(out)


batching.primitive_batchers[_host_call_p] = _batch
