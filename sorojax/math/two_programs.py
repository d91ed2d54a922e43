"""Functions of which each derivative is one program: of concrete numbers, outside `jit`.

JAX differentiates a compiled function in two programs more, one of which computes the value
again and keeps all that its transpose needs. Here the value under `jax.grad` is the program of
the value, and one program more computes it again and pulls back: half as much to compile, and
nothing is kept but the arguments. It is compiled by itself, for speed of compilation. For
functions that run faster than they compile.
"""

import contextlib
import copy
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.custom_derivatives import SymbolicZero

from sorojax._jax.jit import is_alone
from sorojax._jax.trace_state import (
    are_lanes,
    called_as_outside,
    evaluated_now,
    is_traced,
    is_tracer,
)
from sorojax._types import from_host
from sorojax.math.compiled import Split, jit_trees
from sorojax.math.linear_map import pushed

Verb = TypeVar("Verb", bound=Callable[..., Any])
Leaves = list[Any]
Again = Callable[..., tuple[Any, ...]]


_PRODUCT_OF_LANES = 40_000  # multiplications: a library costs more than it saves in a search


def two_programs(
    function: Verb,
    again: Again | None = None,
    within: Callable[..., Any] | None = None,
    *,
    keeps: bool = False,
    lanes_apart: bool = False,
    kernels: bool = False,
    largest: float = math.inf,
    optimised: bool = True,
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
        keeps: Where it has a derivative, the value is a program that keeps what the derivative
            needs, and each direction one program more that computes nothing again: for
            functions that take long to compile, of few numbers.
        lanes_apart: Lanes of `jax.vmap` outside `jit` go one after the other, each by kernels:
            for searches, of which lanes take differently many steps.
        kernels, largest: As of `sorojax.jit`.
        optimised: As of `jit_trees`, of small work.
    """
    how = {"kernels": kernels, "largest": largest, "optimised": optimised}
    programs = _Programs(function, again, keeps=keeps, **how)
    inside = programs.whole if within is None else eqx.filter_jit(within)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        traced = [x for x in jax.tree.leaves((args, kwargs)) if is_tracer(x)]
        # in a batch or under `jit`, and where nothing has a derivative
        if not traced:
            return programs.whole(*args, **kwargs)
        # A static function may close over a tracer, which JAX finds as late as in the program
        # and refuses by these errors; `inside` takes it, and raises the caller's own again.
        if lanes_apart and are_lanes(traced):
            with contextlib.suppress(AssertionError):
                return _one_by_one(programs, Split((args, kwargs))).whole()
        if is_traced(jax.lax.stop_gradient(traced)):
            return inside(*args, **kwargs)
        given = Split(jax.tree.map(_as_array, (args, kwargs)))
        with contextlib.suppress(jax.errors.UnexpectedTracerError):
            return _differentiable(_Call(programs, given.form), given.leaves).whole()
        return inside(*args, **kwargs)

    return call  # type: ignore[return-value]


def _one_by_one(programs: "_Programs", given: Split) -> Split:
    @jax.custom_batching.custom_vmap
    def lane(*leaves: Any) -> Split:
        return programs.value(list(leaves), given.form)

    @lane.def_vmap
    def _(count: int, moves: list[bool], *leaves: Any) -> Any:
        every = list(leaves)
        lanes, rest = _only(moves, every), _only(moves, every, False)
        if is_alone():
            found = programs.lanes(lanes, rest, given.form)
        else:
            one = lambda lane: programs.value(_joined(lane, rest), given.form)  # noqa: E731
            found = jax.vmap(one)(lanes)
        return found, jax.tree.map(lambda _: True, found)

    return lane(*given.leaves)


def _as_array(leaf: Any) -> Any:
    return from_host(leaf) if isinstance(leaf, np.ndarray | np.generic) else leaf


def linear_program(function: Callable[[Any, Any], Any]) -> Callable[[Any, Any, Any], Any]:
    """`function(given, rates)`, linear in the arrays `rates`, as one program, and its transpose
    as another; called with what its result is `like`, where `given` has no derivative. Compiled
    for speed of compilation, as for small work."""
    programs = _Programs(function, optimised=False)

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
        keeps: bool = False,
        kernels: bool = False,
        largest: float = math.inf,
        optimised: bool = True,
    ):
        def at(moving: Leaves, rest: Leaves, form: Any) -> Split:
            args, kwargs = form.whole(_joined(moving, rest))
            return Split(function(*args, **kwargs))

        def linearised(moving, rest, form):
            forms = []

            def by(moving):
                found = at(moving, rest, form)
                forms.append(found.form)
                which = [eqx.is_inexact_array(x) for x in found.leaves]
                return _only(which, found.leaves), _only(which, found.leaves, False)

            found, slope, others = jax.linearize(by, moving, has_aux=True)
            return Split.tree_unflatten(forms[-1], _joined(found, others)), slope

        def wanted(moving: Leaves, rest: Leaves, form: Any, which: Sequence[int]) -> Leaves:
            found = at(moving, rest, form).leaves
            return [found[k] for k in which]

        def push(moving, rest, rates, form, which):
            by = functools.partial(wanted, rest=rest, form=form, which=which)
            return jax.jvp(by, (moving,), (rates,))[1]

        def pull(moving, rest, changes, form, which):
            by = functools.partial(wanted, rest=rest, form=form, which=which)
            return jax.vjp(by, moving)[1](changes)[0]

        def lanes(moving, rest, form):
            return jax.lax.map(lambda lane: at(lane, rest, form), moving)

        for part in (push, pull, linearised, lanes):
            end = {push: "_pushed", pull: "_pulled"}.get(part, f"_{part.__name__}")
            part.__name__ = part.__qualname__ = function.__name__ + end
        how: dict[str, Any] = {"kernels": kernels, "optimised": optimised}
        self.whole = jit_trees(function, largest=largest, **how)
        # what a first run has found is no argument that makes a call large
        both: list[Callable[..., Any]] = [push, pull]
        alone = [jit_trees(part, **how) for part in both]
        self.derivatives = {True: alone, False: [eqx.filter_jit(part) for part in both]}
        self._again, self._largest = again, largest
        self.linearised = jit_trees(linearised, largest=largest, **how)
        self.keeps = keeps
        self.lanes = jit_trees(lanes, kernels=kernels, largest_product=_PRODUCT_OF_LANES)

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
    found = by = None
    if not is_traced(leaves):
        with called_as_outside(leaves):
            if of.programs.keeps:
                found, slope = of.programs.linearised(moving, rest, of.form)
                by = _Kept(slope, moving, _inexact(found))
            else:
                found = of.programs.value(leaves, of.form)
    if found is None or is_traced(found):
        alone = lambda moving: of.programs.value(_joined(moving, rest), of.form)  # noqa: E731
        return jax.jvp(alone, (moving,), (rates,))
    if by is None:
        by = _slope_again(of, leaves, moves, found)
    changed = dict(zip(by.places, pushed(_present(rates), by), strict=True))
    still = [
        changed.get(k, np.zeros(x.shape, jax.dtypes.float0)) for k, x in enumerate(found.leaves)
    ]
    return found, found.like(still)


def _slope_again(of: _Call, leaves: Leaves, moves: list[bool], found: Split) -> "_Slope":
    given = of.programs.given_again(of.form, leaves, found)
    of = _Call(of.programs, given.form, of.programs.is_small(leaves))
    more = given.leaves[len(leaves) :]
    moving = [*_only(moves, leaves), *[None] * len(more)]
    rest = [*_only(moves, leaves, False), *more]
    return _Slope(of, moving, rest, _inexact(found))


_differentiable.defjvp(_derivative, symbolic_zeros=True)


def _present(leaves: Leaves) -> Leaves:
    return [x for x in leaves if x is not None]


def _shape(x: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape, x.dtype)


def _inexact(found: Split) -> dict[int, jax.ShapeDtypeStruct]:
    """What has a derivative, by its place."""
    return {k: _shape(x) for k, x in enumerate(found.leaves) if eqx.is_inexact_array(x)}


class _Derivative:
    """What a derivative at concrete leaves takes, and yields, by its place."""

    _moving: Leaves
    _outputs: dict[int, Any]

    @property
    def inputs(self) -> Leaves:
        return _present(self._moving)

    @property
    def outputs(self) -> Leaves:
        return list(self._outputs.values())

    @property
    def places(self) -> tuple[int, ...]:
        return tuple(self._outputs)

    def onto(self, wanted: Sequence[bool]) -> Self:
        part, pairs = copy.copy(self), zip(self._outputs.items(), wanted, strict=True)
        part._outputs = dict(x for x, w in pairs if w)
        return part


class _Slope(_Derivative):
    """The derivative at concrete leaves as a `LinearMap`."""

    def __init__(self, of: _Call, moving: Leaves, rest: Leaves, outputs: dict[int, Any]):
        self._of, self._moving, self._rest, self._outputs = of, moving, rest, outputs

    def push(self, *rates: Any) -> Leaves:
        push, _ = self._of.programs.derivatives[self._of.small]
        return push(self._moving, self._rest, _placed(rates, self._moving), *self._kind())

    def pull(self, *changes: Any) -> Leaves:
        _, pull = self._of.programs.derivatives[self._of.small]
        found = pull(self._moving, self._rest, list(changes), *self._kind())
        return _present(found)

    push_now, pull_now = push, pull

    def _kind(self) -> tuple[Any, tuple[int, ...]]:
        return self._of.form, self.places


def _placed(rates: Sequence[Any], moving: Leaves) -> Leaves:
    left = iter(rates)
    return [None if x is None else next(left) for x in moving]


class _Kept(_Derivative):
    """The derivative as a `LinearMap`, from what the program of the value kept for it."""

    def __init__(self, slope: Any, moving: Leaves, outputs: dict[int, Any]):
        self._slope, self._moving, self._outputs = slope, moving, outputs

    def push(self, *rates: Any) -> Leaves:
        return _pushed_by(self._slope, _placed(rates, self._moving), self.places)

    def pull(self, *changes: Any) -> Leaves:
        like = [None if x is None else (x.shape, x.dtype) for x in self._moving]
        return _present(_pulled_by(self._slope, list(changes), like, self.places))

    push_now, pull_now = push, pull


@jit_trees
def _pushed_by(slope: Any, rates: Leaves, which: tuple[int, ...]) -> Leaves:
    changed = slope(rates)
    return [changed[k] for k in which]


@jit_trees
def _pulled_by(slope: Any, changes: Leaves, like: Leaves, which: tuple[int, ...]) -> Leaves:
    def by(rates: Leaves) -> Leaves:
        changed = slope(rates)
        return [changed[k] for k in which]

    rates = [None if x is None else jax.ShapeDtypeStruct(*x) for x in like]
    return jax.linear_transpose(by, rates)(changes)[0]
