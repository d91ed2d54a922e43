"""Arguments of public functions and constructors, checked against their signatures.

A package of the framework ends with `check_package(__name__)`: what it makes public then
refuses arguments of a wrong kind before it does anything else, in the form got - need - do.
Annotations say what is needed. The package's own modules import each other's functions
unchecked, so inner loops pay nothing.
"""

import dataclasses
import functools
import inspect
import sys
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import numpy as np

from sorojax import _explain
from sorojax._explain import axis_lengths as axis_lengths
from sorojax._kinds import ANYTHING, NUMBERS, PUBLIC, Kind, converted, kind_of, number_like
from sorojax._signatures import Signature


class Parameters:
    """The kinds of the parameters of one function, read from its signature at first use."""

    def __init__(self, where: str, function: Callable[..., Any], noun: type | None) -> None:
        self.where, self.function, self.noun = where, function, noun

    @functools.cached_property
    def signature(self) -> inspect.Signature:
        return inspect.signature(self.function)

    @functools.cached_property
    def kinds(self) -> dict[str, Kind]:
        """By name, in order; `*args` and `**kwargs` by their own names."""
        scope = getattr(inspect.unwrap(self.function), "__globals__", {})
        fields = {} if self.noun is None else _fields(self.noun)
        return {
            name: _kind(parameter, fields.get(name), scope, is_noun=self.noun is not None)
            for name, parameter in self.signature.parameters.items()
        }

    @functools.cached_property
    def positional(self) -> tuple[tuple[str, Kind], ...]:
        early = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
        named = self.signature.parameters.values()
        return tuple((p.name, self.kinds[p.name]) for p in named if p.kind in early)

    @functools.cached_property
    def sized(self) -> tuple[str, ...]:
        """Arguments that fix lengths of axes, if there are arrays that go with them."""
        kinds = self.kinds.items()
        fixing = tuple(n for n, kind in kinds if kind.noun and issubclass(kind.noun, _SIZED))
        return fixing if self.arrays and self.noun is None else ()

    @functools.cached_property
    def arrays(self) -> tuple[tuple[str, Kind, tuple[str, ...]], ...]:
        """Arrays with named axes, the names from the last on."""
        found = [(n, kind, kind.dims) for n, kind in self.kinds.items() if kind.dims]
        return tuple((name, kind, dims[::-1]) for name, kind, dims in found)

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.positional)

    @functools.cached_property
    def rest(self) -> tuple[str, Kind] | None:
        return self._collecting(inspect.Parameter.VAR_POSITIONAL)

    @functools.cached_property
    def options(self) -> tuple[str, Kind] | None:
        return self._collecting(inspect.Parameter.VAR_KEYWORD)

    def _collecting(self, kind: Any) -> tuple[str, Kind] | None:
        found = [p.name for p in self.signature.parameters.values() if p.kind is kind]
        return (found[0], self.kinds[found[0]]) if found else None

    def check(self, args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> None:
        """Raise a `TypeError` or `ValueError` for the first argument of a wrong kind."""
        for value, (name, kind) in zip(args, self.positional, strict=False):
            if type(value) not in kind.always and not kind.accepts(value):
                raise _explain.refusal(self.where, name, kind, value)
        if self.rest is not None:
            for value in args[len(self.positional) :]:
                if not self.rest[1].accepts(value):
                    raise _explain.refusal(self.where, *self.rest, value)
        for name, value in kwargs.items():
            kind = self.kinds.get(name) or (self.options and self.options[1])
            if kind and type(value) not in kind.always and not kind.accepts(value):
                raise _explain.refusal(self.where, name, kind, value)
        if self.sized:
            bound = dict(zip(self.names, args, strict=False))
            bound.update(kwargs)
            self.check_sizes(bound)

    def check_sizes(self, bound: Mapping[str, Any]) -> None:
        """Raise a `ValueError` if arrays do not fit the noun that comes with them."""
        sizes: Mapping[str, int] = {}
        for name in self.sized:
            if (lengths := _explain.LENGTHS.get(type(bound.get(name)))) is not None:
                sizes = lengths(bound[name])
        for name, kind, dims in self.arrays:
            if (value := bound.get(name)) is None:
                continue
            fits = (
                _explain.counts(value, sizes.get(_explain.COUNTED.get(dims[-1], "")))
                if kind.is_whole
                else all(
                    sizes.get(dim, length) == length
                    for dim, length in zip(dims, np.shape(value)[::-1], strict=False)
                )
            )
            if not fits and (wrong := _explain.misfit(self.where, self.kinds, bound)):
                raise wrong


_SIZED: tuple[type, ...] = ()


def sized(noun: type) -> Callable[[Callable[[Any], Mapping[str, int]]], Any]:
    """Register lengths of axes that objects of `noun` fix, compared at every call: JAX would
    read beyond the ends of an array without a word."""
    global _SIZED
    _SIZED = (*_SIZED, noun)
    return axis_lengths(noun)


def _fields(noun: type) -> dict[str, dataclasses.Field[Any]]:
    if not dataclasses.is_dataclass(noun):
        return {}
    return {field.name: field for field in dataclasses.fields(noun)}


def _kind(
    parameter: inspect.Parameter,
    field: "dataclasses.Field[Any] | None",
    scope: dict[str, Any],
    is_noun: bool,
) -> Kind:
    empty = inspect.Parameter.empty
    if field is not None and "converter" in field.metadata:
        kind = converted(field.type, field.metadata["converter"], scope)
    elif parameter.annotation is not empty:
        kind = kind_of(parameter.annotation, scope, loose=is_noun)
    elif number_like(parameter.default) and not isinstance(parameter.default, bool):
        kind = NUMBERS
    elif isinstance(parameter.default, str | bool):
        kind = kind_of(type(parameter.default), scope)
    else:
        return ANYTHING
    return kind.or_none() if parameter.default is None else kind


def checked(function: Callable[..., Any], where: str) -> Callable[..., Any]:
    """`function` that checks the kinds of its arguments, and explains errors they cause."""
    parameters = Parameters(where, function, None)
    check = parameters.check

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        check(args, kwargs)
        try:
            return function(*args, **kwargs)
        except _explain.RAW as error:
            better = _explain.explained(parameters, args, kwargs, error)
            if better is None:
                raise
            raise better from None  # the one beneath can be pages of a program

    call.__arguments__ = parameters  # type: ignore[attr-defined]
    call.__signature__ = Signature(function=function)  # type: ignore[attr-defined]
    return call


def _check_noun(noun: type) -> None:
    """Let the constructor of `noun` check its arguments."""
    make: Any = noun.__dict__["__init__"]
    parameters = Parameters(noun.__name__, functools.partial(make, None), noun)
    parameters.signature = inspect.Signature(  # without `self`
        list(inspect.signature(make).parameters.values())[1:]
    )
    check = parameters.check

    @functools.wraps(make)
    def init(self: Any, *args: Any, **kwargs: Any) -> None:
        if type(self) is noun:
            check(args, kwargs)
        try:
            make(self, *args, **kwargs)
        except TypeError:
            if (wrong := _explain.unbound(parameters, args, kwargs)) is None:
                raise
            raise wrong from None

    init.__signature__ = Signature(function=make)  # type: ignore[attr-defined]
    noun.__init__ = init  # type: ignore[misc]
    noun.__arguments__ = parameters  # type: ignore[attr-defined]


def _has_constructor(noun: type) -> bool:
    """Whether users make objects of `noun`: those with a status are made by verbs only."""
    is_ours = noun.__module__.startswith("sorojax.") and "__init__" in noun.__dict__
    if "status" in getattr(noun, "__annotations__", {}):
        return False
    return is_ours and not issubclass(noun, BaseException | eqx.Enumeration)


def check_package(package: str) -> None:
    """Let the functions and constructors in `__all__` of a package check their arguments, and
    `dir` of it list these names alone."""
    names = vars(sys.modules[package])
    names["__dir__"] = lambda: sorted(names["__all__"])
    for name in names["__all__"]:
        if name in names:  # the others are imported when they are first asked for
            names[name] = public(package, name, names[name])


def public(package: str, name: str, value: Any) -> Any:
    """`value` as `package` makes it public under `name`: it checks its arguments."""
    if not getattr(value, "__module__", "").startswith("sorojax."):
        return value
    path = f"{package.rpartition('.')[2]}.{name}"
    if isinstance(value, type):
        if _has_constructor(value) and "__arguments__" not in value.__dict__:
            _check_noun(value)
        PUBLIC.setdefault(value, path)
        return value
    if not callable(value) or hasattr(value, "__arguments__"):
        return value
    made: Any = checked(value, path)
    made.__module__, made.__qualname__ = package, name  # where pickle looks it up
    return made
