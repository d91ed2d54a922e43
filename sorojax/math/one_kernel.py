"""Loops over small arrays as one kernel each.

On a CPU, XLA makes a kernel of every few operations and calls them one after another. Of a
loop over arrays of a few numbers that is most of the time. A call that is marked so XLA
makes one kernel of, loops and all; here every loop is marked whose arrays are small and
whose operations such a kernel can hold.

Only programs that run by themselves can be compiled so: inside `jit`, `vmap` or `grad` a
function is part of a program that belongs to others.
"""

import functools
import math
import os
from collections.abc import Callable
from importlib import metadata
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend import core

LARGEST = 4096  # numbers in an array that is made inside a loop: some 32 kB
LARGEST_PRODUCT = 8192  # multiplications of a matrix product; beyond that a library is faster
LONGEST = 4000  # operations in a loop: beyond that one kernel compiles slowly
LARGEST_GIVEN = 1024  # numbers in an argument: batches of states are no small arrays
MARK = {"xla_cpu_small_call": "true", "inlineable": "false"}
# No kernel can hold products by that library; the emitters take longer to compile what is
# left, and gain nothing where arrays are small.
OPTIONS = {"xla_cpu_experimental_ynn_fusion_type": "", "xla_cpu_use_fusion_emitters": False}

_NUMBER = "float32"
_LOOPS = {"scan", "while"}
_INLINED = {
    "checkpoint", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call",
    "custom_vjp_call_jaxpr", "jit", "pjit", "remat", "remat2",
}  # fmt: skip
_HELD = _LOOPS | _INLINED | {
    "abs", "acos", "acosh", "add", "add_any", "and", "argmax", "argmin", "asin", "asinh",
    "atan", "atan2", "atanh", "broadcast_in_dim", "cbrt", "ceil", "clamp", "concatenate",
    "cond", "convert_element_type", "copy", "copy_p", "cos", "cosh", "cumsum",
    "custom_linear_solve", "div", "dot_general", "dynamic_slice", "dynamic_update_slice", "eq",
    "erf", "erf_inv", "erfc", "exp", "exp2", "expand_dims", "expm1", "floor", "gather", "ge",
    "gt", "integer_pow", "iota", "is_finite", "le", "log", "log1p", "logistic", "lt", "max",
    "min", "mul", "ne", "neg", "nextafter", "not", "or", "pad", "platform_index", "pow",
    "reduce_and", "reduce_max", "reduce_min", "reduce_or", "reduce_prod", "reduce_sum", "rem",
    "reshape", "rev", "round", "rsqrt", "select_n", "sign", "sin", "sinh", "slice", "split",
    "sqrt", "square", "squeeze", "stack", "stop_gradient", "sub", "tan", "tanh", "tile",
    "transpose", "unstack", "xor",
}  # fmt: skip

Answer = TypeVar("Answer")


def one_kernel(function: Callable[..., Answer]) -> Callable[..., tuple[Answer, Any]]:
    """`function` with its small loops marked, to be compiled by itself with `OPTIONS`.

    Beside the answer it returns a number that no one needs: it reads the arguments of every
    kernel, as the compiler aborts the process where a kernel does not use one.
    """

    @functools.wraps(function)
    def marked(*args: Any, **kwargs: Any) -> tuple[Answer, Any]:
        closed, shapes, rest = eqx.filter_make_jaxpr(function)(*args, **kwargs)
        arrays = jax.tree.leaves(eqx.filter((args, kwargs), eqx.is_array))
        reads: list[Any] = [jnp.zeros((), _NUMBER)]
        leaves = _run(closed.jaxpr, closed.consts, arrays, reads)
        answer = eqx.combine(jax.tree.unflatten(jax.tree.structure(shapes), leaves), rest)
        return answer, functools.reduce(jnp.add, reads)

    return marked


def runs_alone(*args: Any) -> bool:
    """Whether a call with `args` is a program of small arrays by itself, on a CPU."""
    if core.get_opaque_trace_state(convention="flax") != _AT_THE_TOP:
        return False
    for leaf in jax.tree.leaves(args):
        if isinstance(leaf, jax.core.Tracer) or getattr(leaf, "size", 0) > LARGEST_GIVEN:
            return False
    asked = os.environ.get("SOROJAX_ONE_KERNEL") == "1" and _KNOWN
    return asked and jax.default_backend() == "cpu" and jax.device_count() == 1


# The mark and the options belong to the compiler of these releases. It does not always refuse a
# kernel that it cannot hold, but may end the process: hence only where it is asked for.
_KNOWN = metadata.version("jaxlib").startswith("0.10.")
_AT_THE_TOP = core.get_opaque_trace_state(convention="flax")


def _run(jaxpr: Any, consts: Any, args: Any, reads: list[Any]) -> list[Any]:
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *args], strict=True))

    def read(atom: Any) -> Any:
        return atom.val if isinstance(atom, core.Literal) else values[atom]

    for equation in jaxpr.eqns:
        found = _answer(jaxpr, equation, [read(atom) for atom in equation.invars], reads)
        values.update(zip(equation.outvars, found, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _answer(jaxpr: Any, equation: Any, given: list[Any], reads: list[Any]) -> list[Any]:
    name, inner = equation.primitive.name, _bodies(equation)
    if name in _LOOPS and _is_small(equation) and _length(equation) <= LONGEST:
        with set_xla_metadata(**MARK):
            found, number = jax.jit(lambda *x: (_bound(jaxpr, equation, x), _read(x)))(*given)
        reads.append(number)
        return found
    if name in _INLINED and len(inner) == 1:
        return _run(*inner[0], given, reads)
    return _bound(jaxpr, equation, given)


def _read(arrays: Any) -> Any:
    """A number that needs all arrays."""
    first = [jax.lax.slice(x, (0,) * x.ndim, (1,) * x.ndim) for x in arrays if x.size]
    numbers = [jax.lax.convert_element_type(x.reshape(()).real, _NUMBER) for x in first]
    return functools.reduce(jnp.add, numbers, jnp.zeros((), _NUMBER))


def _bound(jaxpr: Any, equation: Any, given: Any) -> list[Any]:
    """The answer of one equation."""
    pairs = {
        var: value
        for var, value in zip(equation.invars, given, strict=True)
        if not isinstance(var, core.Literal)
    }
    parts = {"eqns": [equation], "outvars": equation.outvars, "constvars": []}
    unnamed = jaxpr.debug_info._replace(arg_names=None, result_paths=None)
    alone = jaxpr.replace(invars=list(pairs), **parts, debug_info=unnamed)
    return jax.core.eval_jaxpr(alone, (), *pairs.values())


def _is_small(equation: Any) -> bool:
    """Whether a kernel can hold what an equation does, and should."""
    name = equation.primitive.name
    if name not in _HELD or equation.effects:
        return False
    # Neither may a branch leave an argument unused, nor a loop its state.
    if name == "cond" and equation.params.get("branches_platforms") is None:
        return False
    if name == "while" and not all(_uses_state(equation, part) for part in ("cond", "body")):
        return False
    if name == "dot_general" and _multiplications(equation) > LARGEST_PRODUCT:
        return False
    return all(
        all(getattr(var.aval, "size", 0) <= LARGEST for var in inner.outvars)
        and _is_small(inner)
        for jaxpr, _ in _bodies(equation)
        for inner in jaxpr.eqns
    )


def _uses_state(loop: Any, part: str) -> bool:
    fixed, body = loop.params[f"{part}_nconsts"], loop.params[f"{part}_jaxpr"].jaxpr
    state = set(body.invars[fixed:])
    return any(
        not isinstance(atom, core.Literal) and atom in state
        for equation in body.eqns
        for atom in equation.invars
    )


def _multiplications(product: Any) -> int:
    (summed, _), _ = product.params["dimension_numbers"]
    sizes = product.invars[0].aval.shape
    return product.outvars[0].aval.size * math.prod(sizes[axis] for axis in summed)


def _length(equation: Any) -> int:
    inside = [inner for jaxpr, _ in _bodies(equation) for inner in jaxpr.eqns]
    return len(inside) + sum(map(_length, inside))


def _bodies(equation: Any) -> list[tuple[Any, Any]]:
    """The programs inside an equation, with their constants."""
    found = []
    leaves = jax.tree.leaves(
        list(equation.params.values()),
        is_leaf=lambda x: isinstance(x, core.Jaxpr | core.ClosedJaxpr),
    )
    for leaf in leaves:
        if isinstance(leaf, core.ClosedJaxpr):
            found.append((leaf.jaxpr, leaf.consts))
        elif isinstance(leaf, core.Jaxpr):
            found.append((leaf, ()))
    return found
