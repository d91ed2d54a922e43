"""Which operations a function uses, read from its program, to leave out the others.

Rests on `jax.extend.core.Var`, `Jaxpr` and `ClosedJaxpr`. Without them the answers are those
that are right for every function.
"""

from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Array

from sorojax._jax.optional import every

_found, _status = every(*(("jax.extend.core", n) for n in ("Var", "Jaxpr", "ClosedJaxpr")))
_Var, _Jaxpr, _ClosedJaxpr = _found.values()
_READABLE = _status == "on"


def depends(function: Callable[[Array], Array], x: Array) -> bool:
    """Whether the value of `function` is computed from `x`; `False` where only the shape is."""
    if not _READABLE:
        return True
    program = jax.make_jaxpr(function)(x).jaxpr
    reached = set(program.invars)
    for step in program.eqns:
        if any(isinstance(v, _Var) and v in reached for v in step.invars):
            reached.update(step.outvars)
    return any(isinstance(v, _Var) and v in reached for v in program.outvars)


def is_one_loop(function: Callable[..., Any], *x: Array) -> bool:
    """Whether `function` of arrays of one length is made of numbers of each entry alone: no
    search, no table of a row per entry."""
    return _READABLE and _scalars(jax.make_jaxpr(function)(*x).jaxpr, len(x[0]))


def _scalars(program: Any, count: int) -> bool:
    for step in program.eqns:
        if step.primitive.name in ("while", "scan", "gather"):
            return False
        if any(getattr(var.aval, "size", 0) > count for var in step.outvars):
            return False
        inner = (v.jaxpr if isinstance(v, _ClosedJaxpr) else v for v in step.params.values())
        if not all(_scalars(v, count) for v in inner if isinstance(v, _Jaxpr)):
            return False
    return True


def status() -> str:
    """Whether programs are read, for `sorojax info`."""
    return _status
