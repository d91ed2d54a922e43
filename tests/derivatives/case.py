"""A derivative that a public verb promises, and its comparison with differences."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sorojax._jax.jit import once


class Case(NamedTuple):
    """A verb as a function of what it promises to be differentiable in.

    Attributes:
        call: From `at` to any tree of arrays; leaves without a slope are left out of it.
        at: A tree of numbers and modules, all of whose floating leaves are varied.
        rtol: Of the slope, where the values are no more accurate (a search's tolerance).
        step: Of the differences, over the size of each leaf.
        forward: Whether `jax.jvp` is compared.
        reverse: Whether `jax.grad` is; without a rule of its own it is the transpose of the
            other, by JAX, and takes most of the time to compile.
        jit: Whether the call may be traced as a whole.
    """

    call: Callable[[Any], Any]
    at: Any
    rtol: float = 1e-7
    step: float = 1e-3
    forward: bool = True
    reverse: bool = True
    jit: bool = True


def flattened(moves):
    """All numbers of a tree in one row, by NumPy, and the function that puts them back: every
    operation of JAX on a new shape would be a program of its own."""
    leaves, structure = jax.tree.flatten(moves)
    ends = np.cumsum([0, *(leaf.size for leaf in leaves)])

    def build(flat):
        parts = [flat[a:b] for a, b in itertools.pairwise(ends)]
        again = [
            part.reshape(x.shape).astype(x.dtype) for part, x in zip(parts, leaves, strict=True)
        ]
        return jax.tree.unflatten(structure, [jnp.asarray(x) for x in again])

    return np.concatenate([np.ravel(leaf) for leaf in leaves] or [np.zeros(0)]), build


def direction_of(moves, seed=0):
    """A random direction: each leaf by its own size, by one where it is zero, not at all where
    it is a bound at infinity."""
    draw = np.random.default_rng(seed)
    parts = [np.zeros(0)]
    for leaf in jax.tree.leaves(moves):
        size = float(np.abs(leaf).max(initial=0.0)) or 1.0
        signs = draw.choice([-1, 1], leaf.size) if np.isfinite(size) else np.zeros(leaf.size)
        parts.append(draw.uniform(0.3, 1.0, leaf.size) * signs)
        parts[-1] *= size if np.isfinite(size) else 0.0
    return np.concatenate(parts)


def as_numbers(at):
    """Python floats as arrays, so that they are varied too."""
    return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, float) else x, at)


def slopes(case: Case):
    """Along a random direction, of a random sum of all outputs: by differences of fourth
    order, in reverse and in forward mode, and the size of what was summed."""
    moves, rest = eqx.partition(as_numbers(case.at), eqx.is_inexact_array)
    flat, build = flattened(moves)
    direction = direction_of(moves)

    def outputs(flat):
        return eqx.filter(case.call(eqx.combine(build(flat), rest)), eqx.is_inexact_array)

    def total(flat, weights):
        found = jax.tree.leaves(outputs(flat))
        return sum(jnp.sum(w * x) for w, x in zip(weights, found, strict=True)), found

    def every(flat, weights):
        """The sum, its slopes in reverse and forward mode, and all outputs."""
        reverse = along = jnp.nan
        if case.forward:
            way = (flat,), (jnp.asarray(direction),)
            value, along, found = jax.jvp(lambda x: total(x, weights), *way, has_aux=True)
        if case.reverse:
            (value, found), slope = jax.value_and_grad(total, has_aux=True)(flat, weights)
            reverse = slope @ direction
        return value, reverse, along, found

    every = once(every) if case.jit else every
    # The sizes of the outputs, without a program of their own where the call is traced.
    shapes = jax.tree.leaves(jax.eval_shape(outputs, flat) if case.jit else outputs(flat))
    draw = np.random.default_rng(1)
    weights = [draw.uniform(0.3, 1.0, x.shape) for x in shapes]
    leaves = every(flat, weights)[3] if case.jit else shapes
    assert leaves and all(np.isfinite(x).all() for x in leaves), "no finite output"
    sizes = [float(np.abs(x).max(initial=0.0)) or 1.0 for x in leaves]
    weights = [w / size for w, size in zip(weights, sizes, strict=True)]
    _, reverse, along, _ = every(flat, weights)
    value = every if case.jit else total
    ends = {k: value(flat + k * case.step * direction, weights) for k in (-2, -1, 1, 2)}
    at = {k: float(end[0]) for k, end in ends.items()}
    seen = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * case.step)
    size = sum(w.size for w in weights)
    return seen, float(reverse), float(along), size


def check(case: Case | Callable[[], Case]):
    """Compares; a function makes a case that takes time to make only when it is asked for."""
    case = case() if callable(case) else case
    seen, reverse, forward, size = slopes(case)
    rounding = 1e-13 * size / case.step
    near = case.rtol * abs(seen) + rounding
    assert abs(seen) > 1e3 * rounding, f"the outputs hardly move: {seen}"
    for mode, found in (("reverse", reverse), ("forward", forward)):
        if getattr(case, mode):
            assert abs(found - seen) <= near, f"{mode} {found}, differences {seen}"
