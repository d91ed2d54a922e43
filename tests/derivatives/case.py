"""A derivative that a public verb promises, and its comparison with differences."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree


class Case(NamedTuple):
    """A verb as a function of what it promises to be differentiable in.

    Attributes:
        call: From `at` to any tree of arrays; leaves without a slope are left out of it.
        at: A tree of numbers and modules, all of whose floating leaves are varied.
        rtol: Of the slope, where the values are no more accurate (a search's tolerance).
        step: Of the differences, over the size of each leaf.
        forward: Whether `jax.jvp` is compared.
        reverse: Whether `jax.grad` is; without a rule of its own it is the transpose of the
            other, by JAX, and costs most of the time to compile.
        jit: Whether the call may be traced as a whole.
    """

    call: Callable[[Any], Any]
    at: Any
    rtol: float = 1e-7
    step: float = 1e-3
    forward: bool = True
    reverse: bool = True
    jit: bool = True


def direction_of(flat, moves, seed=0):
    """A random direction: each leaf by its own size, or by one where it is zero."""
    draw = np.random.default_rng(seed)
    parts = []
    for leaf in jax.tree.leaves(moves):
        size = float(jnp.max(jnp.abs(leaf), initial=0.0))
        parts.append(draw.uniform(0.3, 1.0, leaf.size) * draw.choice([-1, 1], leaf.size))
        parts[-1] *= size if size > 0 else 1.0
    return jnp.asarray(np.concatenate(parts)) if parts else jnp.zeros_like(flat)


def as_numbers(at):
    """Python floats as arrays, so that they are varied too."""
    return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, float) else x, at)


def slopes(case: Case):
    """Along a random direction, of a random sum of all outputs: by differences of fourth
    order, in reverse and in forward mode, and the size of what was summed."""
    moves, rest = eqx.partition(as_numbers(case.at), eqx.is_inexact_array)
    flat, build = ravel_pytree(moves)
    direction = direction_of(flat, moves)

    def outputs(flat):
        return eqx.filter(case.call(eqx.combine(build(flat), rest)), eqx.is_inexact_array)

    leaves = [np.asarray(x) for x in jax.tree.leaves(outputs(flat))]
    assert leaves and all(np.isfinite(x).all() for x in leaves), "no finite output"
    draw = np.random.default_rng(1)
    weights = [
        draw.uniform(0.3, 1.0, x.shape) / (np.abs(x).max(initial=0.0) or 1.0) for x in leaves
    ]

    def total(flat):
        found = jax.tree.leaves(outputs(flat))
        return sum(jnp.sum(w * x) for w, x in zip(weights, found, strict=True))

    def every(flat):
        value, slope = jax.jvp(total, (flat,), (direction,)) if case.forward else (total(flat), 0)
        return value, jax.grad(total)(flat) @ direction if case.reverse else slope, slope

    every = jax.jit(every) if case.jit else every
    _, reverse, along = every(flat)
    value = (lambda x: every(x)[0]) if case.jit else total
    at = {k: float(value(flat + k * case.step * direction)) for k in (-2, -1, 1, 2)}
    seen = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * case.step)
    size = sum(w.size for w in weights)
    return seen, float(reverse), float(along), size


def check(case: Case):
    seen, reverse, forward, size = slopes(case)
    rounding = 1e-13 * size / case.step
    near = case.rtol * abs(seen) + rounding
    assert abs(seen) > 1e3 * rounding, f"the outputs hardly move: {seen}"
    for mode, found in (("reverse", reverse), ("forward", forward)):
        if getattr(case, mode):
            assert abs(found - seen) <= near, f"{mode} {found}, differences {seen}"
