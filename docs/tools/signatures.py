"""Signatures as a reader wants them: arrays by their axes, unions by the nouns in them."""

import collections.abc
import inspect
import types
import typing
from typing import Any

from sorojax._types import Numbers

_NUMBERS = set(typing.get_args(Numbers))


def signature(value: Any, paths: dict[Any, str]) -> tuple[str, str]:
    """Arguments and result of a function or constructor; `paths` has the public classes."""
    plain = inspect.unwrap(value)
    found = inspect.signature(value if inspect.isclass(value) else plain)
    texts, last = [], None
    for parameter in found.parameters.values():
        if last is None and parameter.kind is parameter.KEYWORD_ONLY:
            texts.append("*")
        if parameter.kind in (parameter.KEYWORD_ONLY, parameter.VAR_POSITIONAL):
            last = parameter
        texts.append(_parameter(parameter, paths))
    answer = found.return_annotation
    is_told = answer is not found.empty and not inspect.isclass(value)
    return f"({', '.join(texts)})", type_text(answer, paths) if is_told else ""


def _parameter(parameter: inspect.Parameter, paths: dict[Any, str]) -> str:
    stars = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}
    text = stars.get(parameter.kind, "") + parameter.name
    is_typed = parameter.annotation is not parameter.empty
    if is_typed:
        text += f": {type_text(parameter.annotation, paths)}"
    if parameter.default is parameter.empty:
        return text
    return f"{text} = {_default(parameter.default)}"


def _default(value: Any) -> str:
    """A default: numbers and words as they are, nouns by their class."""
    if isinstance(value, str | int | float | bool | None):
        return repr(value)
    if isinstance(value, tuple | list) and len(value) < 4:
        inner = ", ".join(map(_default, value)) + ("," if len(value) == 1 else "")
        return f"[{inner}]" if isinstance(value, list) else f"({inner})"
    if callable(value) and hasattr(value, "__name__"):
        return value.__name__ if value.__name__.isidentifier() else "..."
    return f"{type(value).__name__}(...)" if type(value).__name__.isidentifier() else "..."


def type_text(kind: Any, paths: dict[Any, str]) -> str:
    """A type in one short expression: `Float[nodes, 2]`, `Numbers | None`, `Rod`."""
    if kind is None or kind is type(None):
        return "None"
    if isinstance(kind, str):
        return kind.replace("sj.", "sorojax.")
    if hasattr(kind, "dim_str"):
        return _array(kind)
    if isinstance(kind, typing.TypeVar):
        return kind.__name__
    arguments = typing.get_args(kind)
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        return _union(arguments, paths)
    origin = typing.get_origin(kind)
    if origin is typing.Annotated:
        return type_text(arguments[0], paths)
    if origin is typing.Literal:
        return " | ".join(map(repr, arguments))
    if origin is collections.abc.Callable:
        return _function(arguments, paths)
    if origin is not None:
        inner = ", ".join("..." if x is ... else type_text(x, paths) for x in arguments)
        return f"{_name(origin, paths)}[{inner}]" if inner else _name(origin, paths)
    return _name(kind, paths)


def _array(kind: Any) -> str:
    axes = ", ".join(axis.replace("#", "").split("=")[-1] for axis in kind.dim_str.split())
    text = f"{kind.dtype.__name__}[{axes}]" if axes else kind.dtype.__name__
    try:
        compile(text, "", "eval")
    except SyntaxError:
        return kind.dtype.__name__
    return text


def _union(members: tuple[Any, ...], paths: dict[Any, str]) -> str:
    texts = [type_text(x, paths) for x in members if not _is_number(x, members)]
    if set(members) >= _NUMBERS:
        texts.insert(0, "Numbers")
    return " | ".join(sorted(dict.fromkeys(texts), key=lambda text: text == "None"))


def _is_number(member: Any, members: tuple[Any, ...]) -> bool:
    return set(members) >= _NUMBERS and member in _NUMBERS


def _function(arguments: tuple[Any, ...], paths: dict[Any, str]) -> str:
    if not arguments:
        return "Callable"
    taken, given = arguments[0], type_text(arguments[-1], paths)
    if taken is ...:
        return f"Callable[..., {given}]"
    return f"Callable[[{', '.join(type_text(x, paths) for x in taken)}], {given}]"


def _name(kind: Any, paths: dict[Any, str]) -> str:
    try:
        return paths.get(kind) or kind.__name__
    except (TypeError, AttributeError):
        return str(kind).rpartition(".")[2]
