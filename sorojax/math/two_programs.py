"""Functions of which each derivative is one program: of concrete numbers, outside `jit`.

JAX differentiates a compiled function in two programs more, one of which computes the value
again and keeps all that its transpose needs. Here the value under `jax.grad` is the program of
the value, and one program more computes it again and pulls back: half as much to compile, and
nothing is kept but the arguments. It is compiled by itself, for speed of compilation. For
functions that run faster than they compile.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.custom_derivatives import SymbolicZero

from sorojax._jax.jit import jit
from sorojax._jax.trace_state import called_as_outside, evaluated_now, is_traced, is_tracer
from sorojax._types import from_host
from sorojax.math.compiled import Split
from sorojax.math.linear_map import pushed

Verb = TypeVar("Verb", bound=Callable[..., Any])
Leaves = list[Any]
Again = Callable[..., tuple[Any, ...]]


def two_programs(
    function: Verb,
    again: Again | None = None,
    within: Callable[..., Any] | None = None,
    *,
    kernels: bool = False,
    largest: float = math.inf,
) -> Verb:
    """`function` of pytrees compiled, and its derivatives as one program each.

    Arrays are traced, all else is static, also of what it returns. Under `jit`, `vmap` and in
    second derivatives it is what `eqx.filter_jit` makes of it.

    Args:
        function: Pure, and quick to run.
        again: From what a first run returned and its arguments to those of the derivative:
            the same arrays, what is static as it is known now, and behind them arrays that the
            run has found and the derivative need not compute again.
        within: What takes the place of the function under `jit` and `vmap`.
        kernels, largest: As of `sorojax.jit`.
    """
    programs = _Programs(function, again, kernels=kernels, largest=largest)
    inside = programs.whole if within is None else eqx.filter_jit(within)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        traced = [x for x in jax.tree.leaves((args, kwargs)) if is_tracer(x)]
        # in a batch or under `jit`, and where nothing has a derivative
        if not traced:
            return programs.whole(*args, **kwargs)
        if is_traced(jax.lax.stop_gradient(traced)):
            return inside(*args, **kwargs)
        given = Split(jax.tree.map(_as_array, (args, kwargs)))
        return _differentiable(_Call(programs, given.form), given.leaves).whole()

    return call  # type: ignore[return-value]


def _as_array(leaf: Any) -> Any:
    return from_host(leaf) if isinstance(leaf, np.ndarray | np.generic) else leaf


def linear_program(function: Callable[[Any, Any], Any]) -> Callable[[Any, Any, Any], Any]:
    """`function(given, rates)`, linear in the arrays `rates`, as one program, and its transpose
    as another; called with what its result is `like`, where `given` has no derivative."""
    programs = _Programs(function)

    def call(given: Any, rates: Any, like: Any) -> Any:
        if is_traced(given):
            return programs.whole(given, rates)
        both = Split(((given, rates), {}))
        outputs, tree = jax.tree.flatten(like)
        count = len(both.leaves) - len(jax.tree.leaves(rates))
        moves = [k >= count for k in range(len(both.leaves))]
        with evaluated_now():  # from NumPy: a program for every shape is not compiled
            zeros = [from_host(np.zeros(x.shape, x.dtype)) for x in both.leaves[count:]]
        start, rest = [None] * count + zeros, _only(moves, both.leaves, False)
        shapes = dict(enumerate(map(_shape, outputs)))
        by = _Slope(_Call(programs, both.form), start, rest, shapes)
        return jax.tree.unflatten(tree, pushed(both.leaves[count:], by))

    return call


def _only(moves: Sequence[bool], leaves: Leaves, chosen: bool = True) -> Leaves:
    """The leaves that move, or those that do not, with None in the place of the others."""
    return [x if m is chosen else None for x, m in zip(leaves, moves, strict=True)]


class _Programs:
    """The value of a function of leaves and the form of their tree, and its derivatives by
    the leaves that move; both lists have None in the places of the other."""

    def __init__(
        self,
        function: Callable[..., Any],
        again: Again | None = None,
        *,
        kernels: bool = False,
        largest: float = math.inf,
    ):
        def wanted(moving: Leaves, rest: Leaves, form: Any, which: Sequence[int]) -> Leaves:
            args, kwargs = form.whole(_joined(moving, rest))
            found = Split(function(*args, **kwargs)).leaves
            return [found[k] for k in which]

        def push(moving, rest, rates, form, which):
            by = functools.partial(wanted, rest=rest, form=form, which=which)
            return jax.jvp(by, (moving,), (rates,))[1]

        def pull(moving, rest, changes, form, which):
            by = functools.partial(wanted, rest=rest, form=form, which=which)
            return jax.vjp(by, moving)[1](changes)[0]

        for part, end in ((push, "_pushed"), (pull, "_pulled")):
            part.__name__ = part.__qualname__ = function.__name__ + end
        self.whole = jit(function, kernels=kernels, largest=largest)
        # what a first run has found is no argument that makes a call large
        alone = [jit(part, kernels=kernels, largest=math.inf) for part in (push, pull)]
        self.derivatives = {True: alone, False: [eqx.filter_jit(x) for x in (push, pull)]}
        self._again, self._largest = again, largest

    def value(self, leaves: Leaves, form: Any) -> Split:
        args, kwargs = form.whole(leaves)
        return Split(self.whole(*args, **kwargs))

    def is_small(self, leaves: Leaves) -> bool:
        """Whether a call with these arguments is one of small arrays."""
        return all(getattr(x, "size", 0) <= self._largest for x in leaves)

    def given_again(self, form: Any, leaves: Leaves, found: Split) -> Split:
        """The arguments of the derivative."""
        args, kwargs = form.whole(leaves)
        if self._again is None:
            return Split((args, kwargs))
        return Split((self._again(found.whole(), *args, **kwargs), {}))


def _joined(some: Leaves, others: Leaves) -> Leaves:
    return [y if x is None else x for x, y in zip(some, others, strict=True)]


class _Call(NamedTuple):
    programs: _Programs
    form: Any
    small: bool = True


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _differentiable(of: _Call, leaves: Leaves) -> Split:
    return of.programs.value(leaves, of.form)


def _derivative(of: _Call, primals: Any, tangents: Any) -> tuple[Split, Split]:
    (leaves,), (dots,) = primals, tangents
    moves = [not isinstance(dot, SymbolicZero) for dot in dots]
    moving, rates = _only(moves, leaves), _only(moves, dots)
    rest = _only(moves, leaves, False)
    found = None
    if not is_traced(leaves):
        with called_as_outside(leaves):
            found = of.programs.value(leaves, of.form)
    if found is None or is_traced(found):
        by = lambda moving: of.programs.value(_joined(moving, rest), of.form)  # noqa: E731
        return jax.jvp(by, (moving,), (rates,))
    given = of.programs.given_again(of.form, leaves, found)
    of = _Call(of.programs, given.form, of.programs.is_small(leaves))
    more = given.leaves[len(leaves) :]
    moving, rest = [*moving, *[None] * len(more)], [*rest, *more]
    which = tuple(k for k, x in enumerate(found.leaves) if eqx.is_inexact_array(x))
    by = _Slope(of, moving, rest, {k: _shape(found.leaves[k]) for k in which})
    changed = dict(zip(which, pushed(_present(rates), by), strict=True))
    still = [
        changed.get(k, np.zeros(x.shape, jax.dtypes.float0)) for k, x in enumerate(found.leaves)
    ]
    return found, found.like(still)


_differentiable.defjvp(_derivative, symbolic_zeros=True)


def _present(leaves: Leaves) -> Leaves:
    return [x for x in leaves if x is not None]


def _shape(x: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape, x.dtype)


class _Slope:
    """The derivative at concrete leaves as a `LinearMap`."""

    def __init__(self, of: _Call, moving: Leaves, rest: Leaves, outputs: dict[int, Any]):
        self._of, self._moving, self._rest, self._outputs = of, moving, rest, outputs

    @property
    def inputs(self) -> Leaves:
        return _present(self._moving)

    @property
    def outputs(self) -> Leaves:
        return list(self._outputs.values())

    def onto(self, wanted: Sequence[bool]) -> "_Slope":
        pairs = zip(self._outputs.items(), wanted, strict=True)
        return _Slope(self._of, self._moving, self._rest, dict(x for x, w in pairs if w))

    def push(self, *rates: Any) -> Leaves:
        left = iter(rates)
        moved = [None if x is None else next(left) for x in self._moving]
        push, _ = self._of.programs.derivatives[self._of.small]
        return push(self._moving, self._rest, moved, *self._kind())

    def pull(self, *changes: Any) -> Leaves:
        _, pull = self._of.programs.derivatives[self._of.small]
        found = pull(self._moving, self._rest, list(changes), *self._kind())
        return _present(found)

    push_now, pull_now = push, pull

    def _kind(self) -> tuple[Any, tuple[int, ...]]:
        return self._of.form, tuple(self._outputs)
