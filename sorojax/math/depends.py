"""Whether a function reads its argument, so that what is constant need not be computed."""

from collections.abc import Callable

import jax
from jax.extend.core import Var
from jaxtyping import Array


def depends(function: Callable[[Array], Array], x: Array) -> bool:
    """Whether the value of `function` is computed from `x`; `False` where only the shape is."""
    program = jax.make_jaxpr(function)(x).jaxpr
    reached = set(program.invars)
    for step in program.eqns:
        if any(isinstance(v, Var) and v in reached for v in step.invars):
            reached.update(step.outvars)
    return any(isinstance(v, Var) and v in reached for v in program.outvars)
