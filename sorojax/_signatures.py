"""Signatures as a reader wants them: arrays by their axes, unions by the nouns in them.

The annotations themselves stay what they are: the checks of arguments and tools read those.
"""

import collections.abc
import inspect
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any


class Parameter(inspect.Parameter):
    """One whose text is short."""

    def __str__(self) -> str:
        return _parameter(self, _public())


class Signature(inspect.Signature):
    """That of a function, read when something asks for it, since most are never shown."""

    def __init__(
        self, *args: Any, function: Callable[..., Any] | None = None, **kwargs: Any
    ) -> None:
        self._function = function
        if function is None:
            super().__init__(*args, **kwargs)

    def _read(self) -> None:
        if self._function is None:
            return
        plain, self._function = inspect.signature(self._function), None
        short = [
            Parameter(p.name, p.kind, default=p.default, annotation=p.annotation)
            for p in plain.parameters.values()
        ]
        super().__init__(short, return_annotation=plain.return_annotation)

    @property
    def parameters(self) -> Mapping[str, inspect.Parameter]:  # type: ignore[override]
        self._read()
        return super().parameters

    @property
    def return_annotation(self) -> Any:
        self._read()
        return super().return_annotation

    def __reduce__(self) -> Any:
        self._read()
        return super().__reduce__()

    def __str__(self) -> str:
        return self.format()

    def format(self, *, max_width: int | None = None, **_: Any) -> str:
        """In one line, or one line for each parameter where it is wider than `max_width`."""
        paths = _public()
        texts, answer = parameter_texts(self, paths), self.return_annotation
        tail = "" if answer is self.empty else f" -> {type_text(answer, paths)}"
        line = f"({', '.join(texts)}){tail}"
        if max_width is None or len(line) <= max_width:
            return line
        return "(\n    " + ",\n    ".join(texts) + f"\n){tail}"


def _public() -> dict[Any, str]:
    from sorojax._kinds import PUBLIC

    return PUBLIC


def parameter_texts(found: inspect.Signature, paths: Mapping[Any, str]) -> list[str]:
    """The parameters and the marks between their kinds; `paths` has the public classes."""
    texts: list[str] = []
    before: Any = None
    for parameter in found.parameters.values():
        kind = parameter.kind
        if before is parameter.POSITIONAL_ONLY and kind is not before:
            texts.append("/")
        collects = before in (parameter.KEYWORD_ONLY, parameter.VAR_POSITIONAL)
        if kind is parameter.KEYWORD_ONLY and not collects:
            texts.append("*")
        texts.append(_parameter(parameter, paths))
        before = kind
    return [*texts, "/"] if before is inspect.Parameter.POSITIONAL_ONLY else texts


def _parameter(parameter: inspect.Parameter, paths: Mapping[Any, str]) -> str:
    stars = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}
    text = stars.get(parameter.kind, "") + parameter.name
    if parameter.annotation is not parameter.empty:
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
    if type(value).__name__ == "_HAS_DEFAULT_FACTORY_CLASS":  # of a field: made anew each time
        return "..."
    if callable(value) and hasattr(value, "__name__"):
        return value.__name__ if value.__name__.isidentifier() else "..."
    return f"{type(value).__name__}(...)" if type(value).__name__.isidentifier() else "..."


def type_text(kind: Any, paths: Mapping[Any, str]) -> str:
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


def _union(members: tuple[Any, ...], paths: Mapping[Any, str]) -> str:
    texts = [type_text(x, paths) for x in members]
    return " | ".join(sorted(dict.fromkeys(texts), key=lambda text: text == "None"))


def _function(arguments: tuple[Any, ...], paths: Mapping[Any, str]) -> str:
    if not arguments:
        return "Callable"
    taken, given = arguments[0], type_text(arguments[-1], paths)
    if taken is ...:
        return f"Callable[..., {given}]"
    return f"Callable[[{', '.join(type_text(x, paths) for x in taken)}], {given}]"


def _name(kind: Any, paths: Mapping[Any, str]) -> str:
    try:
        return paths.get(kind) or kind.__name__.rpartition(".")[2]
    except (TypeError, AttributeError):
        return str(kind).rpartition(".")[2]
