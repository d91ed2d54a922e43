"""Compiled functions whose derivative is one operation.

`jax.jit` differentiated outside of `jit` stages its linear part with every array that this
part needs. That is time that a small solve does not take.
"""

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.core
import jax.numpy as jnp
from jax.core import Tracer
from jax.extend.core import Literal, Primitive
from jax.interpreters import ad, batching, mlir
from jax.interpreters.partial_eval import DynamicJaxprTracer
from jaxtyping import Array

from sorojax._types import is_traced
from sorojax.math.linear_map import pushed

Verb = TypeVar("Verb", bound=Callable[..., Any])


def at_once(function: Verb) -> Verb:
    """`function` compiled as by `jax.jit`, with a derivative that is cheap to ask for.

    For functions of pytrees of arrays that are differentiated outside of `jit`, between a
    design and its equilibrium for example. The derivative runs the function again; all that
    it is taken by has to be an argument.
    """
    compiled, programs = jax.jit(function), {}

    @functools.wraps(function)
    def call(*args):
        leaves, tree = jax.tree.flatten(args)
        moving = tuple(k for k, leaf in enumerate(leaves) if isinstance(leaf, Tracer))
        if not moving or not all(_is_differentiated(leaves[k]) for k in moving):
            return compiled(*args)
        kinds = tuple(getattr(leaf, "aval", None) for leaf in leaves)
        if (key := (tree, moving, kinds)) not in programs:
            programs[key] = _Programs(function, tree, moving, leaves)
        call = _Call(programs[key], leaves)
        found = _value_p.bind(*(leaves[k] for k in moving), call=call)
        return jax.tree.unflatten(programs[key].tree, found)

    return call  # type: ignore[return-value]


def _is_differentiated(leaf: Tracer) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.inexact) and not isinstance(leaf, DynamicJaxprTracer)


class _Programs:
    """Value, derivative and its transpose over flat arguments of one structure; `live` are
    the results that move with the arguments."""

    def __init__(self, function, tree, moving: tuple[int, ...], leaves):
        def flat(moved, others):
            values = list(others)
            for k, leaf in zip(moving, moved, strict=True):
                values[k] = leaf
            found, self.tree = jax.tree.flatten(function(*jax.tree.unflatten(tree, values)))
            return [jnp.asarray(x) for x in found]

        def moves(moved, others):
            found = flat(moved, others)
            return [x for x, live in zip(found, self.live, strict=True) if live]

        def push(moved, others, rates):
            return jax.jvp(lambda moved: moves(moved, others), (moved,), (rates,))[1]

        def pull(moved, others, changes):
            return jax.vjp(lambda moved: moves(moved, others), moved)[1](changes)[0]

        self.moving, self.tree = moving, tree  # that of the results, once traced
        self.value, self.push, self.pull = jax.jit(flat), jax.jit(push), jax.jit(pull)
        shapes = [jax.ShapeDtypeStruct(leaves[k].shape, leaves[k].dtype) for k in moving]
        with jax.core.eval_context():
            traced = jax.make_jaxpr(flat)(shapes, self.others(leaves))
        self.shapes = traced.out_avals
        inputs = [k < len(moving) for k in range(len(traced.jaxpr.invars))]
        self.live = [
            reached and jnp.issubdtype(shape.dtype, jnp.inexact)
            for reached, shape in zip(_reached(traced.jaxpr, inputs), self.shapes, strict=True)
        ]

    def others(self, leaves) -> list:
        moving = set(self.moving)
        return [None if k in moving else leaf for k, leaf in enumerate(leaves)]


def _reached(jaxpr, inputs: Sequence[bool]) -> list[bool]:
    """Which results of `jaxpr` depend on its `inputs`."""
    on = {variable for variable, is_on in zip(jaxpr.invars, inputs, strict=True) if is_on}

    def is_on(atom) -> bool:
        return not isinstance(atom, Literal) and atom in on

    for equation in jaxpr.eqns:
        found = [is_on(atom) for atom in equation.invars]
        if any(found):
            inside = equation.params.get("jaxpr")
            if equation.primitive.name in ("jit", "pjit"):
                results = _reached(inside.jaxpr, found)
            else:
                results = [True] * len(equation.outvars)
            on.update(v for v, is_it in zip(equation.outvars, results, strict=True) if is_it)
    return [is_on(atom) for atom in jaxpr.outvars]


class _Call:
    """A function with all its arguments but those that move; compared by identity."""

    def __init__(self, programs: _Programs, leaves: list):
        self.programs, self.others = programs, programs.others(leaves)

    def __call__(self, *moved) -> list[Array]:
        return self.programs.value(list(moved), self.others)


class _Slope:
    """The derivative of a `_Call` at concrete arguments, a `LinearMap`."""

    def __init__(self, call: _Call, moved: Sequence[Array]):
        self.call, self.inputs = call, list(moved)

    @property
    def outputs(self):
        programs = self.call.programs
        return [x for x, live in zip(programs.shapes, programs.live, strict=True) if live]

    def push(self, *rates):
        return self.call.programs.push(self.inputs, self.call.others, list(rates))

    def pull(self, *changes):
        return self.call.programs.pull(self.inputs, self.call.others, list(changes))

    push_at_once, pull_at_once = push, pull


_value_p = Primitive("at_once")
_value_p.multiple_results = True
_value_p.def_impl(lambda *moved, call: call(*moved))


@_value_p.def_abstract_eval
def _(*_, call):
    return [jax.core.ShapedArray(x.shape, x.dtype) for x in call.programs.shapes]


def _derivative(primals, tangents, *, call: _Call):
    if is_traced(primals):
        rates = [ad.instantiate_zeros(rate) for rate in tangents]
        found, moves = jax.jvp(call, tuple(primals), tuple(rates))
        return found, _with_zeros(call, found, moves)
    with jax.core.eval_context():
        found = call(*primals)
    return found, _moved(call, primals, found, tangents)


def _moved(call: _Call, primals, found, tangents) -> list:
    """The rates of the results `found`, in one operation."""
    rates = [ad.instantiate_zeros(rate) for rate in tangents]
    rows = iter(pushed(rates, _Slope(call, primals)))
    moves = [next(rows) if live else None for live in call.programs.live]
    return _with_zeros(call, found, moves)


def _with_zeros(call: _Call, found, moves) -> list:
    return [
        move if live else ad.Zero(jax.typeof(x).to_tangent_aval())
        for x, move, live in zip(found, moves, call.programs.live, strict=True)
    ]


def _batched(moved, axes, *, call: _Call):
    found = jax.vmap(call, axes)(*moved)
    return found, [0] * len(found)


ad.primitive_jvps[_value_p] = _derivative
batching.primitive_batchers[_value_p] = _batched
mlir.register_lowering(
    _value_p, mlir.lower_fun(lambda *moved, call: call(*moved), multiple_results=True)
)


def _tell_jax_the_linear_part() -> None:
    """Spares JAX tracing `_derivative` to find it. Its door for that is not public: where it is
    missing or another, JAX traces."""
    try:
        from jax._src.interpreters.ad import fallback_linearize_rule, primitive_linearizations
    except ImportError:
        return
    known = ["_prim", "_is_vjp", "_nonzeros", "primals", "params"]
    if list(inspect.signature(fallback_linearize_rule).parameters) != known:
        return

    def linearised(is_vjp, moving, *primals, call: _Call):
        if is_traced(primals):
            return fallback_linearize_rule(_value_p, is_vjp, moving, *primals, call=call)
        found = call(*primals)

        def moved(_, *rates):
            return _moved(call, primals, found, rates)

        return found, call.programs.live, [], moved

    primitive_linearizations[_value_p] = linearised


_tell_jax_the_linear_part()
