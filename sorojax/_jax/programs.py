"""Which operations a function uses, read from its program, to leave out the others or to
compute them once before a loop of calls.

Rests on `jax.extend.core.Var`, `Jaxpr`, `ClosedJaxpr` and `Literal`, and on
`Primitive.get_bind_params`. Without them the answers are those that are right for every
function, and functions stay whole.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from sorojax._jax.optional import every
from sorojax._jax.trace_state import is_traced

_NAMES = "Var", "Jaxpr", "ClosedJaxpr", "Literal"
_found, _status = every(*(("jax.extend.core", name) for name in _NAMES))
_Var, _Jaxpr, _ClosedJaxpr, _Literal = _found.values()
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


# A function in two parts: what does not depend on its arguments, and what is left.
#
# XLA moves such work out of a loop, but compiles it with every copy of the function first, and
# the loop of a derivative in reverse keeps its transposed operations.

# Calls, and where their program is.
_INLINED = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr"}


class _Value:
    """A value that is computed in every call; one object stands for one value."""


class _Fixed(NamedTuple):
    """Numbers that are part of the program; equal ones are one object."""

    number: Any


class _Step(NamedTuple):
    """An equation that is computed in every call: each of `inputs` is a `_Value`, a `_Fixed`,
    or the number of a constant."""

    equation: Any
    inputs: tuple[Any, ...]
    outputs: tuple[_Value, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Remainder:
    """What is left of a function: `remainder(constants, *args)`."""

    steps: tuple[_Step, ...]
    inputs: tuple[_Value, ...]
    outputs: tuple[Any, ...]
    form: Any

    def __call__(self, constants: Sequence[Any], *args: Any) -> Any:
        values = dict(zip(self.inputs, jax.tree.leaves(args), strict=True))

        def read(at: Any) -> Any:
            if isinstance(at, _Value):
                return values[at]
            return at.number if isinstance(at, _Fixed) else constants[at]

        for equation, inputs, outputs in self.steps:
            found = _bound(equation, [read(at) for at in inputs])
            values.update(zip(outputs, found, strict=True))
        return jax.tree.unflatten(self.form, [read(at) for at in self.outputs])


def split(function: Callable[..., Any], *args: Any) -> tuple[list[Any], Callable[..., Any]]:
    """The arrays of `function` that do not depend on `args`, and what is left of it.

    Args:
        function: A pure function of pytrees of arrays; of what it closes over all is fixed.
        *args: Arguments of the shapes that all calls have.

    Returns:
        Arrays, among them what the function closes over, and a function of them and of
        `args` that closes over no tracer.
    """
    if not _READABLE:
        closed = eqx.filter_closure_convert(function, *args)
        arrays, rest = eqx.partition(closed, eqx.is_array)
        leaves, form = jax.tree.flatten(arrays)

        def whole(constants: Sequence[Any], *args: Any) -> Any:
            return eqx.combine(jax.tree.unflatten(form, constants), rest)(*args)

        return leaves, whole
    program, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
    return _Splitter().remainder(program, jax.tree.structure(shapes))


class _Splitter:
    """Computes what is fixed, notes what is not; what is written twice is computed once."""

    def __init__(self) -> None:
        self.steps: list[_Step] = []
        self.seen: dict[Hashable, list[Any]] = {}
        self.constants: list[Any] = []
        self.numbers: dict[Hashable, Any] = {}

    def remainder(self, program: Any, form: Any) -> tuple[list[Any], Remainder]:
        inputs = tuple(_Value() for _ in program.jaxpr.invars)
        outputs = self._read(program, inputs)
        wanted, kept = {at for at in outputs if isinstance(at, _Value)}, []
        for step in reversed(self.steps):
            if step.equation.effects or not wanted.isdisjoint(step.outputs):
                wanted |= {at for at in step.inputs if isinstance(at, _Value)}
                kept.append(step)
        numbers: dict[int, int] = {}

        def numbered(at: Any) -> Any:
            return numbers.setdefault(at, len(numbers)) if isinstance(at, int) else at

        steps = tuple(
            step._replace(inputs=tuple(map(numbered, step.inputs))) for step in reversed(kept)
        )
        outputs = tuple(map(numbered, outputs))
        return [self.constants[k] for k in numbers], Remainder(steps, inputs, outputs, form)

    def _read(self, closed: Any, inputs: Sequence[Any]) -> list[Any]:
        """The outputs of a program, as values or numbers of constants."""
        fixed = [self._number(x) for x in closed.consts]
        jaxpr = closed.jaxpr
        known = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*fixed, *inputs), strict=True))

        def read(var: Any) -> Any:
            return self._number(var.val) if isinstance(var, _Literal) else known[var]

        for equation in jaxpr.eqns:
            found = self._equation(equation, [read(var) for var in equation.invars])
            known.update(zip(equation.outvars, found, strict=True))
        return [read(var) for var in jaxpr.outvars]

    def _equation(self, equation: Any, inputs: list[Any]) -> list[Any]:
        if (name := equation.primitive.name) in _INLINED:
            return self._read(equation.params[_INLINED[name]], inputs)
        key = _key(equation, inputs)
        if key in self.seen:
            return self.seen[key]
        if equation.effects or any(isinstance(at, _Value) for at in inputs):
            found: list[Any] = [_Value() for _ in equation.outvars]
            self.steps.append(_Step(equation, tuple(inputs), tuple(found)))
        else:
            fixed = [
                at.number if isinstance(at, _Fixed) else self.constants[at] for at in inputs
            ]
            values = _bound(equation, fixed)
            found = [self._number(x) for x in values]
        if key is not None:
            self.seen[key] = found
        return found

    def _number(self, constant: Any) -> Any:
        """The number of a traced array, one for each object, or numbers that are known."""
        if is_traced(constant):
            key: Hashable = id(constant)
            new: Any = len(self.constants)
        else:
            key, new = _content(constant), _Fixed(constant)
        if key not in self.numbers:
            self.numbers[key] = new
            if isinstance(new, int):
                self.constants.append(constant)  # kept, so that no other takes its id
        return self.numbers[key]


def _content(constant: Any) -> Hashable:
    """Equal for constants with the same numbers."""
    try:
        return jax.typeof(constant), np.asarray(constant).tobytes()
    except TypeError:  # random keys
        return id(constant)


def _key(equation: Any, inputs: list[Any]) -> Hashable:
    """Equal for equations with equal results; None for those that are not compared."""
    inputs = [id(at) if isinstance(at, _Fixed) else at for at in inputs]
    params = tuple(sorted(equation.params.items()))
    key = (equation.primitive, equation.ctx, tuple(inputs), params)
    with contextlib.suppress(TypeError):
        hash(key)
        return None if equation.effects else key
    return None


def _bound(equation: Any, values: Sequence[Any]) -> Sequence[Any]:
    params = equation.primitive.get_bind_params(equation.params)
    with equation.ctx.manager:
        found = equation.primitive.bind(*values, **params)
    return found if equation.primitive.multiple_results else [found]


def status() -> str:
    """Whether programs are read, for `sorojax info`."""
    return _status
